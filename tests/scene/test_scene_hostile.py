"""Archives that are damaged, foreign or hostile are refused with a clear text, and nothing is written or run."""

import dataclasses
import io
import json
import os
import pickle
import struct
import zipfile
import zlib

import cv2
import numpy as np
import pytest
from scene_worlds import empty_scene, full_scene

from nurec_sim.errors import ArchiveError
from nurec_sim.files.zip_package import Package, write_package
from nurec_sim.scene import archive, archive_faults, knots, read_scene, scene_hash, write_scene
from nurec_sim.scene.precision import third_axes
from nurec_sim.scene.usd.actors import actors_layer
from nurec_sim.scene.usd.layers import static_layer
from nurec_sim.types import Label


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """The bytes of a sound archive."""
    return write_scene(full_scene(0), tmp_path_factory.mktemp("hostile") / "a.usdz").read_bytes()


@pytest.fixture
def good(sound, tmp_path):
    """A sound archive in a folder of its own."""
    (tmp_path / "good").mkdir()
    (tmp_path / "good" / "a.usdz").write_bytes(sound)
    return tmp_path / "good" / "a.usdz"


def members_of(path):
    with Package(path) as package:
        return {name: package.read(name) for name in package.names}


def forge(good, **changes):
    """A copy with members replaced (None removes one) and the manifest's hashes made to fit."""
    members = members_of(good)
    for name, data in changes.items():
        members[name] = data
    manifest = json.loads(members[archive.MANIFEST] or "{}") if members.get(archive.MANIFEST) else None
    if manifest:
        hashed = {n: d for n, d in members.items() if n != archive.MANIFEST and d is not None}
        manifest["sha256"] = {name: archive.hashlib.sha256(data).hexdigest() for name, data in hashed.items()}
        members[archive.MANIFEST] = json.dumps(manifest).encode()
    path = good.parent / "forged.usdz"
    write_package(path, {name: data for name, data in members.items() if data is not None})
    return path


def refused(path, text):
    before = sorted(os.listdir(path.parent))
    with pytest.raises(ArchiveError, match=text) as caught:
        read_scene(path)
    assert str(path) in str(caught.value)
    assert sorted(os.listdir(path.parent)) == before
    assert archive_faults(path)


def zip_with(path, name, data=b"x", compression=zipfile.ZIP_STORED, **attributes):
    """A ZIP by Python's own writer, with one member after a harmless one."""
    with zipfile.ZipFile(path, "w", compression) as writer:
        writer.writestr("default.usda", b"#usda 1.0\n")
        info = zipfile.ZipInfo("placeholder")
        info.filename, info.compress_type = name, compression
        for key, value in attributes.items():
            setattr(info, key, value)
        writer.writestr(info, data)
    return path


def test_missing_file(tmp_path):
    with pytest.raises(ArchiveError, match=r"none\.usdz: cannot be opened \(No such file"):
        read_scene(tmp_path / "none.usdz")


def test_folder(tmp_path):
    with pytest.raises(ArchiveError, match="cannot be opened"):
        read_scene(tmp_path)


@pytest.mark.parametrize("data", [b"", b"PK", b"\x93NUMPY" * 100, pickle.dumps([1] * 100)])
def test_not_a_zip(tmp_path, data):
    (tmp_path / "a.usdz").write_bytes(data)
    refused(tmp_path / "a.usdz", "bytes; a scene archive has 22|not a readable ZIP archive")


@pytest.mark.parametrize("part", [0.1, 0.5, 0.9, 0.999])
def test_cut_short(good, part):
    data = good.read_bytes()
    good.write_bytes(data[: int(len(data) * part)])
    refused(good, "not a readable ZIP archive, or cut short")


def test_middle_cut_out(good):
    data = good.read_bytes()
    good.write_bytes(data[:1000] + data[3000:])
    refused(good, "archive is damaged|cut short|not a readable ZIP")


@pytest.mark.parametrize("name", ["/etc/passwd", "C:/a.json", "//host/a"])
def test_absolute_path(tmp_path, name):
    refused(zip_with(tmp_path / "a.usdz", name), "absolute paths are not allowed")


@pytest.mark.parametrize("name", ["../a.json", "nurec_sim/../../a", "a/./b", "a//b"])
def test_path_out_of_the_archive(tmp_path, name):
    refused(zip_with(tmp_path / "a.usdz", name), "must stay inside the archive")


def test_backslash_path(tmp_path):
    refused(zip_with(tmp_path / "a.usdz", "..\\a.json"), "backslashes are not allowed")


def test_bomb(tmp_path):
    path = zip_with(tmp_path / "a.usdz", archive.MANIFEST, bytes(50_000_000), zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 100_000
    refused(path, "is compressed .*stored members only")


def test_bomb_of_overlapping_members(tmp_path):
    """Two directory entries that share their data: each passes alone."""
    name, data = b"a.json", b"x" * 1000
    head = (20, 0, 0, 0, 33, zlib.crc32(data), len(data), len(data), len(name))
    local = struct.pack("<IHHHHHIIIHH", 0x04034B50, *head, 0) + name + data
    entries = b"".join(
        struct.pack("<IHHHHHHIIIHHHHHII", 0x02014B50, 20, *head, 0, 0, 0, 0, 0, 0) + other
        for other in (b"a.json", b"b.json")
    )
    end = struct.pack("<IHHHHIIH", 0x06054B50, 0, 0, 2, 2, len(entries), len(local), 0)
    (tmp_path / "a.usdz").write_bytes(local + entries + end)
    refused(tmp_path / "a.usdz", "members 'a.json' and 'b.json' overlap")


def test_lying_size(good):
    data = bytearray(good.read_bytes())
    where = data.rfind(b"default.usda") - 46 + 20  # sizes in the central directory
    struct.pack_into("<II", data, where, 2**31, 2**31)
    good.write_bytes(data)
    refused(good, "lies outside the file")


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_duplicate_member(tmp_path):
    refused(zip_with(tmp_path / "a.usdz", "default.usda"), "appears twice")


def test_symbolic_link(tmp_path):
    refused(zip_with(tmp_path / "a.usdz", "link", b"/etc/passwd", external_attr=0o120777 << 16), "symbolic link")


def test_encrypted_member(good):
    data = bytearray(good.read_bytes())
    data[data.rfind(b"default.usda") - 46 + 8] |= 1
    good.write_bytes(data)
    refused(good, "is encrypted")


def test_archive_of_another_program(tmp_path):
    path = zip_with(tmp_path / "a.usdz", "volume.nurec")
    refused(path, "no Gaussians that can be read: neither nurec_sim/manifest.json")


class Trap:
    """Runs when unpickled."""

    def __reduce__(self):
        return os.mkdir, ("unpickled",)


@pytest.mark.parametrize("name", ["checkpoint.ckpt", "nurec_sim/extra.pkl"])
def test_pickles_are_never_opened(good, monkeypatch, name):
    monkeypatch.chdir(good.parent)
    read_scene(forge(good, **{name: pickle.dumps(Trap())}))
    assert not os.path.exists("unpickled")


def test_array_with_a_pickle(good, monkeypatch):
    monkeypatch.chdir(good.parent)
    buffer = io.BytesIO()
    np.save(buffer, np.array([Trap()], dtype=object), allow_pickle=True)
    refused(forge(good, **{knots.KNOTS: buffer.getvalue()}), "must hold plain values in C order, got object")
    assert not os.path.exists("unpickled")


def test_array_that_promises_too_much(good):
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (6, 1000000000, 1000000000, 3), }"
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    data = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
    refused(forge(good, **{knots.KNOTS: data}), "promises float32 .* but holds 0 bytes")


def test_array_of_another_shape(good):
    data = archive.npy_bytes(np.zeros((7, 3), np.int64))
    refused(forge(good, **{knots.KNOTS: data}), "must hold plain values in C order, got int64")
    data = archive.npy_bytes(np.zeros((2, 3), np.float32))
    refused(forge(good, **{knots.KNOTS: data}), "dynamic_knot_m.npy must have the knots of those of 53 Gaussians")


def test_columns_that_do_not_fit(good):
    """Numbers of moving Gaussians in the layer of actors: missing, too few, or beyond the times that there are."""
    scene = read_scene(good)
    columns = knots.knot_arrays(scene.dynamic)[1]
    without = {name: column for name, column in columns.items() if name != knots.TRACK}
    short = columns | {knots.WINDOW: columns[knots.WINDOW][1:]}
    beyond = columns | {knots.WINDOW: np.full(53, 99, np.int32)}
    for changed, text in (
        (without, "track must be int32 .* got nothing"),
        (short, r"53 moving Gaussians, but other shapes .*window.*\(52,\)"),
        (beyond, "window must name one of 2 triples of times for each of 53"),
    ):
        refused(forge(good, **{archive.ACTORS_LAYER: actors_layer(scene, changed)}), text)


def png_of(pixels):
    return bytes(cv2.imencode(".png", pixels)[1])


def test_another_picture_than_a_sky(good):
    text = "sky_cubemap.png must be RGB with 16 bits, six squares below each other, got"
    for shape, dtype in (((48, 8, 3), np.uint8), ((48, 8), np.uint16), ((40, 8, 3), np.uint16)):
        refused(forge(good, **{archive.SKY: png_of(np.zeros(shape, dtype))}), text)
    refused(forge(good, **{archive.SKY: b"hello"}), "sky_cubemap.png is not a readable PNG")
    infinite = np.full((48, 8, 3), 0x7C00, np.uint16)
    refused(forge(good, **{archive.SKY: png_of(infinite)}), "sky.*not finite")


def test_a_rotation_that_is_none(good):
    static = read_scene(good).static
    static.quat_wxyz[3] = 0
    static.normal[:] = third_axes(static.quat_wxyz)
    refused(forge(good, **{archive.STATIC_LAYER: static_layer(static)}), "quat_wxyz.*1 of 400 are not of unit length")


def test_a_label_that_is_none(good):
    static = read_scene(good).static
    for wrong in (77, 256 + Label.ROAD, -1):
        labels = static.label.astype(np.int32)
        labels[3] = wrong
        layer = static_layer(dataclasses.replace(static, label=labels))
        refused(forge(good, **{archive.STATIC_LAYER: layer}), "label.*1 of 400 are not a Label")


def test_text_instead_of_an_array(good):
    refused(forge(good, **{knots.TIMES: b"hello"}), "is no array file")


@pytest.mark.parametrize("name", [*archive.TRUTH, archive.SKY, *knots.KINDS])
def test_missing_member(good, name):
    refused(forge(good, **{name: None}), "does not list")
    members = members_of(good)
    del members[name]
    write_package(good, members)
    refused(good, f"{name} is missing; have")


@pytest.mark.parametrize("name", [*archive.TRUTH, archive.SKY, *knots.KINDS])
def test_changed_member(good, name):
    members = members_of(good)
    members[name] = members[name][:-1] + bytes([members[name][-1] ^ 1])
    write_package(good, members)
    refused(good, f"{name} was changed or damaged")


def test_changed_sidecar_is_reported_but_does_not_stop_reading(good):
    write_package(good, members_of(good) | {"map.xodr": b"<OpenDRIVE/>"})
    read_scene(good)
    assert archive_faults(good) == [
        f"{good}: map.xodr was changed or damaged: its hash differs from {archive.MANIFEST}"
    ]


@pytest.mark.parametrize("version", [4, 0, "1", None])
def test_other_version(good, version):
    manifest = json.loads(members_of(good)[archive.MANIFEST]) | {"version": version}
    path = forge(good, **{archive.MANIFEST: json.dumps(manifest).encode()})
    refused(path, f"format version {version!r}; this nurec_sim reads versions 1 to 3")


@pytest.mark.parametrize("text", [b"[]", b"{}", b"{", b"\xff", b"[" * 100_000, b'{"format": NaN}', b'{"a":1,"a":2}'])
def test_broken_manifest(good, text):
    members = members_of(good) | {archive.MANIFEST: text}
    write_package(good, members)
    refused(good, "not the manifest|is not valid JSON")


@pytest.mark.parametrize("counts", [{}, {"static": 1, "dynamic": 2}, {"static": "many"}, [], {"static": -1}])
def test_broken_counts(good, counts):
    manifest = json.loads(members_of(good)[archive.MANIFEST]) | {"counts": counts}
    refused(forge(good, **{archive.MANIFEST: json.dumps(manifest).encode()}), "manifest.json: counts")


def test_impossible_harmonics(good):
    members = members_of(write_scene(empty_scene(), good.parent / "b.usdz"))
    manifest = json.loads(members[archive.MANIFEST])
    for count in (4, -3, 10**15):
        manifest["counts"]["dynamic_sh_rest"] = count
        write_package(good, members | {archive.MANIFEST: json.dumps(manifest).encode()})
        refused(good, "dynamic_sh_rest must be 0, 3, 8 or 15, got")


def test_gaussians_that_are_not_finite(good):
    static = full_scene(0).static
    static.mean_m[7, 1] = np.nan
    refused(forge(good, **{"splats_static.usdc": static_layer(static)}), r"static\.mean_m: 1 of 400 are not finite")


def test_fewer_gaussians_than_promised(good):
    static = full_scene(0).static[:300]
    refused(forge(good, **{"splats_static.usdc": static_layer(static)}), "promises 400 Gaussians.*got 300")


def test_a_layer_that_is_not_usd(good):
    refused(forge(good, **{"splats_static.usdc": b"PXR-USDC" + bytes(100)}), "no readable USD layer")


def test_a_layer_without_splats(good):
    text = b'#usda 1.0\ndef Xform "Static"\n{\n}\n'
    refused(forge(good, **{"splats_static.usdc": text}), "no readable USD layer|must be float32 .* got nothing")


def test_references_to_other_files_are_not_followed(good):
    """The root layer is for other programs; ours opens the splats only, without composing."""
    trap = b"#usda 1.0\n(\n    subLayers = [@/etc/passwd@, @http://localhost:1/a.usda@]\n)\n"
    assert scene_hash(read_scene(forge(good, **{"default.usda": trap}))) == scene_hash(read_scene(good))


FACT_FAULTS = {
    "camera size": (("rig", "cameras", "front", "width_px"), "many", "front: width_px: expected a 64-bit integer"),
    "lens": (
        ("rig", "cameras", "front", "lens", "type"),
        "Box",
        "lens: unknown lens model 'Box'; known are .'fisheye'",
    ),
    "lens field": (("rig", "cameras", "roof", "lens", "k7"), 1.0, "Pinhole: unknown field 'k7'; known are"),
    "shutter": (("rig", "cameras", "roof", "shutter"), "slow", "shutter: 'slow' is not a valid Shutter"),
    "pose": (("rig", "cameras", "roof", "rig_from_camera"), [[1.0]], r"expected an array 4x4, got shape \(1, 1\)"),
    "path": (("ego", "t_us"), [5, 4, 3], "a trajectory needs times"),
    "times": (("ego", "t_us"), [0.5], "t_us: expected int64 numbers, got float64"),
    "tracks": (("tracks",), {}, "tracks: expected a list"),
    "track id": (("tracks", 0, "id"), 3, "id: expected text, got 3"),
    "extra": (("surprise",), 3, "needs the fields"),
    "road": (("road_map", "lanes"), [[1, 2]], r"lanes: expected an array nx3, got shape \(2,\)"),
    "span": (("span_us",), [1, 2], "span_us must be"),
}


@pytest.mark.parametrize("place, value, text", FACT_FAULTS.values(), ids=FACT_FAULTS)
def test_wrong_facts(good, place, value, text):
    facts = json.loads(members_of(good)[archive.FACTS])
    part = facts
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = value
    refused(forge(good, **{archive.FACTS: json.dumps(facts).encode()}), text)


def test_package_writer_refuses_bad_names_and_sizes(tmp_path, monkeypatch):
    with pytest.raises(ArchiveError, match=r"cannot store '\.\./a': paths must stay inside"):
        write_package(tmp_path / "a.usdz", {"../a": b""})
    monkeypatch.setattr("nurec_sim.files.zip_package.MAX_PACKAGE_BYTES", 1000)
    with pytest.raises(ArchiveError, match="would take .* bytes; USDZ packages end at"):
        write_package(tmp_path / "a.usdz", {"a": bytes(1001)})
    assert list(tmp_path.iterdir()) == []


def test_reading_limits(good):
    with Package(good) as package, pytest.raises(ArchiveError, match="at most 10 are read"):
        package.read(archive.MANIFEST, 10)


def test_the_scene_is_checked_after_reading(good):
    """A manifest and facts that agree can still describe an impossible scene."""
    facts = json.loads(members_of(good)[archive.FACTS])
    facts["tracks"] = facts["tracks"][:1]
    refused(forge(good, **{archive.FACTS: json.dumps(facts).encode()}), r"dynamic\.track: .* outside -1\.\.0")
    scene = dataclasses.replace(empty_scene(), id="x")
    assert read_scene(write_scene(scene, good.parent / "b.usdz")).id == "x"
