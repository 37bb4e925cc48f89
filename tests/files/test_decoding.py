"""Small files that ask for a lot of memory: refused before it is taken, with what was found and what is allowed.

Memory is what Python and NumPy take at most while the file is read (``tracemalloc``).
"""

import gzip
import io
import json
import struct
import tracemalloc
import zipfile
import zlib
from dataclasses import replace

import numpy as np
import pytest
import tiny_clip

from nurec_sim import logs
from nurec_sim.errors import ArchiveError, ClipError
from nurec_sim.files import decoding
from nurec_sim.files.decoding import LIMITS, TooMuchError
from nurec_sim.files.zip_package import Package
from nurec_sim.logs.storage import Storage
from nurec_sim.scene import codec
from nurec_sim.scene.interop.nurec.volume import read_volume
from nurec_sim.scene.interop.validate import maps
from nurec_sim.scene.interop.validate.contents import Contents
from nurec_sim.scene.opendrive.xml import opendrive_root

MIB = 1 << 20


@pytest.fixture
def memory():
    """Gives the most bytes taken beside those that were taken when it was last asked."""
    tracemalloc.start()
    before = 0

    def most():
        nonlocal before
        now, peak = tracemalloc.get_traced_memory()
        taken, before = peak - before, now
        tracemalloc.reset_peak()
        return taken

    yield most
    tracemalloc.stop()


def npy_header(dtype, shape):
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def zeros_deflated(count):
    """``count`` zero bytes as a raw deflate stream, made without holding them."""
    packer, parts = zlib.compressobj(9, zlib.DEFLATED, -15), []
    for _ in range(count // MIB):
        parts.append(packer.compress(bytes(MIB)))
    parts.append(packer.compress(bytes(count % MIB)) + packer.flush())
    return b"".join(parts)


def bomb_npz(name="dxyz_mm", dtype="|i1", shape=(3, 20_000_000), *, declared=None):
    """An ``.npz`` whose one array is zeros; ``declared`` is what the ZIP says of its unpacked size."""
    header, count = npy_header(dtype, shape), int(np.prod(shape)) * np.dtype(dtype).itemsize
    whole, file = header + bytes(min(count, 64 * MIB)), io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as package:
        package.writestr(f"{name}.npy", whole)
    data = bytearray(file.getvalue())
    if declared is not None:
        for mark, at in ((b"PK\3\4", 22), (b"PK\1\2", 24)):
            struct.pack_into("<I", data, data.index(mark) + at, declared)
    return bytes(data)


def clip_with(tmp_path, name, data):
    """A clip folder one of whose files is replaced."""
    folder = tiny_clip.write(tmp_path / "clip")
    (folder / name).write_bytes(data)
    return folder


def sweep_file(folder):
    return sorted(folder.glob("lidar*/**/*.npz"))[0].relative_to(folder).as_posix()


# ------------------------------------------------------------------------------------------------------------- arrays


def test_an_uploaded_clip_of_a_few_kilobytes_does_not_take_gigabytes(tmp_path, memory):
    """60 million points in an ``.npz`` in a ZIP, packed twice: 400 bytes a point would be 24 GB."""
    whole = tiny_clip.write(tmp_path / "clip")
    name = sweep_file(whole)
    (whole / name).write_bytes(bomb_npz(shape=(3, 60_000_000)))
    with zipfile.ZipFile(tmp_path / "clip.zip", "w", zipfile.ZIP_DEFLATED) as package:
        for file in whole.rglob("*"):
            if file.is_file():
                package.write(file, file.relative_to(whole).as_posix())
    assert (tmp_path / "clip.zip").stat().st_size < 105_000
    memory()
    clip = logs.open_clip(tmp_path / "clip.zip")
    with pytest.raises(ClipError, match=rf"{name} promises dxyz_mm of int8 \(3, 60000000\), 180,000,000 bytes in"):
        clip.sweep(next(iter(clip.rig.lidars)), 0)
    assert memory() < 8 * MIB


def test_more_points_than_a_sweep_may_have_are_refused_before_they_are_converted(tmp_path, memory):
    folder = tiny_clip.write(tmp_path / "clip")
    (folder / (name := sweep_file(folder))).write_bytes(bomb_npz(shape=(3, 4_000_000)))
    memory()
    clip = logs.open_clip(folder)
    with pytest.raises(ClipError, match=f"{name} has 4,000,000 points; a sweep may have 2,097,152"):
        clip.sweep(next(iter(clip.rig.lidars)), 0)
    assert memory() < 24 * MIB


@pytest.mark.parametrize(
    ("shape", "dtype"),
    [((3, 85_000_000), "<i4"), ((2**62, 2**62), "<f8"), ((10**12,), "|S0"), ((1,) * 3 + (2**40,), "<U9")],
)
def test_what_a_header_promises_is_counted_first(shape, dtype, memory):
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as package:
        package.writestr("a.npy", npy_header(dtype, shape))
    with pytest.raises(TooMuchError, match="promises a of .* at most 134,217,728 are read"):
        decoding.npz_arrays(data.getvalue())
    assert memory() < 4 * MIB


def test_arrays_are_counted_together(memory):
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as package:
        for i in range(34):
            package.writestr(f"a{i}.npy", npy_header("|u1", (4 * MIB,)) + bytes(4 * MIB))
    with pytest.raises(TooMuchError, match="promises a32 .* 138,412,032 bytes in all"):
        decoding.npz_arrays(data.getvalue())
    assert memory() < 140 * MIB


def test_a_member_that_unpacks_to_more_or_less_than_it_says_is_damaged():
    with pytest.raises(ValueError, match="holds more than the 3,000 bytes that it promises"):
        decoding.npz_arrays(bomb_npz(shape=(3, 1000)).replace(b"(3, 1000)", b"(3, 1000)") and _longer())
    with pytest.raises((ValueError, zipfile.BadZipFile)):
        decoding.npz_arrays(bomb_npz(shape=(3, 1000), declared=200))


def _longer():
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as package:
        package.writestr("a.npy", npy_header("|i1", (3, 1000)) + bytes(50 * MIB))
    return data.getvalue()


def test_arrays_come_back_as_numpy_wrote_them():
    arrays = {
        "f": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "scalar": np.array(3, np.int16),
        "empty": np.zeros((0, 4), np.float32),
        "words": np.array(["a", "bcd"]),
        "big": np.arange(5, dtype=">u4"),
        "flags": np.array([True, False]),
    }
    for save in (np.savez, np.savez_compressed):
        data = io.BytesIO()
        save(data, **arrays)
        found = decoding.npz_arrays(data.getvalue())
        assert list(found) == list(arrays)
        for name, array in arrays.items():
            assert found[name].dtype == array.dtype and found[name].shape == array.shape
            assert np.array_equal(found[name], array)
    data = io.BytesIO()
    np.savez(data, a=np.array([object()]))
    with pytest.raises(ValueError, match="a must hold plain values, got object"):
        decoding.npz_arrays(data.getvalue())


# ----------------------------------------------------------------------------------------------------------- pictures


def png(width, height):
    """A true PNG of one colour, a few hundred times smaller than its pixels."""

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    rows = zlib.compress(bytes((width // 8 + 1) * height), 9)
    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def test_a_picture_of_two_hundred_megapixels_is_not_decoded(tmp_path, memory):
    data = png(20_000, 10_000)
    assert len(data) < 30_000
    folder = tiny_clip.write(tmp_path / "clip")
    name = sorted(folder.glob("images/front/*.png"))[0].relative_to(folder).as_posix()
    (folder / name).write_bytes(data)
    memory()
    with pytest.raises(ClipError, match=f"image {name} may have 33177600 pixels, got 20000 x 10000"):
        Storage(folder).read_image(name)
    assert memory() < MIB
    (folder / name).write_bytes(png(64, 32))
    assert Storage(folder).read_image(name).shape == (32, 64, 3)


def test_sizes_of_pictures_are_those_that_others_find():
    import cv2

    picture = np.zeros((37, 91, 3), np.uint8)
    for ending, options in ((".png", []), (".jpg", []), (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])):
        assert decoding.image_size(cv2.imencode(ending, picture, options)[1].tobytes()) == (91, 37)


# -------------------------------------------------------------------------------------------------------------- texts


@pytest.mark.parametrize("text", [b"[" + b"[]," * 9_000_000 + b"0]", b'{"a":[' + b"0," * 9_000_000 + b"0]}"])
def test_json_of_too_many_values_is_not_parsed(text, memory):
    packed = zlib.compress(text)
    assert len(packed) < 40_000
    memory()
    with pytest.raises(ArchiveError, match=r"facts holds up to [\d,]+ values; at most 8,000,000 are read"):
        codec.load(text, "facts")
    assert memory() < MIB
    assert codec.load(b'{"a": [1, 2.5, "x"]}', "facts") == {"a": [1, 2.5, "x"]}


def test_json_of_a_clip_that_unpacks_to_too_many_values_is_not_parsed(tmp_path, memory):
    whole = tiny_clip.write(tmp_path / "clip")
    (whole / "tracks.json").write_bytes(b'{"tracks":[' + b"[]," * 9_000_000 + b"0]}")
    with pytest.raises(ClipError, match=r"tracks.json holds up to 18,\d+,\d+ values; at most 8,000,000 are read"):
        logs.open_clip(whole)
    assert memory() < 80 * MIB


def test_a_member_of_a_clip_may_not_grow_without_bound(tmp_path, memory):
    body = zeros_deflated(200 * MIB)
    with zipfile.ZipFile(tmp_path / "clip.zip", "w") as package:
        info = zipfile.ZipInfo("meta.json")
        package.writestr(info, body)
    data = bytearray((tmp_path / "clip.zip").read_bytes())
    for mark, at in ((b"PK\3\4", 8), (b"PK\1\2", 10)):
        place = data.index(mark)
        struct.pack_into("<H", data, place + at, zipfile.ZIP_DEFLATED)
        struct.pack_into("<I", data, place + at + 14, 200 * MIB)
    (tmp_path / "clip.zip").write_bytes(data)
    memory()
    with pytest.raises(ClipError, match=r"meta.json unpacks from \d+ to 209715200 bytes; at most \d+ are allowed"):
        logs.open_clip(tmp_path / "clip.zip")
    with Contents(tmp_path / "clip.zip") as contents, pytest.raises(ArchiveError, match="meta.json has more than"):
        contents.read("meta.json")
    assert memory() < 200 * MIB


def test_json_that_could_not_be_read_again_is_not_written(monkeypatch):
    monkeypatch.setattr(decoding, "LIMITS", replace(LIMITS, json_values=100))
    assert len(codec.load(codec.dump(list(range(98)), "facts"), "facts")) == 98
    with pytest.raises(ArchiveError, match="facts holds up to 151 values; at most 100 are read, so it is not written"):
        codec.dump(list(range(150)), "facts")


def test_a_table_of_too_many_rows_is_not_decoded(tmp_path, monkeypatch):
    polars = pytest.importorskip("polars")
    polars.select(key=polars.repeat(0, 2_000_000), lane=polars.repeat(0, 2_000_000)).write_parquet(tmp_path / "a")
    assert (tmp_path / "a").stat().st_size < 20_000
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as package:
        package.write(tmp_path / "a", "clipgt/lane.parquet")
    with (
        Contents(tmp_path / "a.zip") as contents,
        pytest.raises(ArchiveError, match="2,000,000 rows; at most"),
    ):
        maps._table(contents, "clipgt/lane.parquet", "lane")


def test_xml_of_too_many_tags_is_not_parsed(memory):
    text = b"<OpenDRIVE>" + b"<a/>" * 5_000_000 + b"</OpenDRIVE>"
    memory()
    with pytest.raises(ArchiveError, match=r"the map has 5,000,002 tags .* at most 4,000,000"):
        opendrive_root(text, "map.xodr")
    assert memory() < MIB
    assert opendrive_root(b"<OpenDRIVE><road/></OpenDRIVE>", "map.xodr")[0].tag == "road"


@pytest.mark.slow
def test_a_volume_of_lists_within_lists_is_given_up_while_it_is_counted(memory):
    """3,000 bytes unpack to 2 million empty lists and mappings: 64 bytes each."""
    list_of_many = struct.pack(">BI", 0xDD, 100_000) + b"\x90\x80" * 50_000
    data = gzip.compress(b"\x81\xa8nre_data" + struct.pack(">BI", 0xDD, 20) + list_of_many * 20)
    assert len(data) < 10_000
    with pytest.raises(ArchiveError, match="x: holds more than 262,144 values"):
        read_volume(data, "x")
    assert memory() < 40 * MIB


def test_msgpack_is_read_as_its_own_library_does():
    msgpack = pytest.importorskip("msgpack")
    value = {
        "a": [1, -5, 2.5, None, True, "text", b"bytes", [], {}],
        3: {"deep": [[[["x"]]]]},
        "long": list(range(70_000)),
    }
    assert decoding.msgpack_value(msgpack.packb(value)) == value
    for broken in (b"", b"\x92\x01", msgpack.packb(value) + b"\x01", b"\x81\x90\x01", b"\xc7\x04\x05abcd"):
        with pytest.raises((ValueError, msgpack.UnpackException)):
            decoding.msgpack_value(broken)


# --------------------------------------------------------------------------------------------------------------- zips


def many_members(path, count):
    """A ZIP whose list of members names one of them again and again."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as package:
        package.writestr("meta.json", "{}")
    data = file.getvalue()
    start = data.index(b"PK\1\2")
    entry = data[start : data.index(b"PK\5\6")]
    directory = entry * count
    end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0)
    end64 = struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, count, count, len(directory), start)
    place = struct.pack("<4sLQL", b"PK\6\7", 0, start + len(directory), 1)
    path.write_bytes(data[:start] + directory + end64 + place + end)


def test_a_long_list_of_members_is_not_read(tmp_path, memory):
    path = tmp_path / "many.zip"
    many_members(path, 320_000)
    memory()
    said = r"lists its members in 17,600,000 bytes; at most 16,777,216 are read"
    with pytest.raises(ClipError, match=f"many.zip: the zip file is damaged or too large: {said}"):
        logs.open_clip(path)
    with pytest.raises(ArchiveError, match=said):
        Package(path)
    with pytest.raises(ArchiveError, match=said):
        Contents(path)
    assert memory() < 4 * MIB
    many_members(path, 3)
    with zipfile.ZipFile(path) as package:
        assert len(package.infolist()) == 3
    with path.open("rb") as file:
        decoding.check_directory(file)


def test_limits_leave_room_for_what_sensors_give():
    """A turn of 128 beams and 4096 columns, twice; an 8K picture; poses of 20 cameras at 30 Hz for ten minutes."""
    assert LIMITS.sweep_points >= 2 * 128 * 4096 and LIMITS.image_pixels >= 7680 * 4320
    assert LIMITS.array_bytes >= LIMITS.sweep_points * (3 * 8 + 8 + 8)
    assert LIMITS.json_values >= 20 * 30 * 600 * 20
    assert replace(LIMITS, growth=1).growth == 1
    assert json.loads(json.dumps(LIMITS.__dict__))["growth"] == 64
