"""Compressed PLY and SPZ files: those of other programs, and words packed by hand after the formats' descriptions."""

import gzip
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
import render_scenes as worlds

from nurec_sim import cli, geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.files import decoding
from nurec_sim.files.decoding import Limits
from nurec_sim.scene import import_scene, read_ply, read_scene, write_ply
from nurec_sim.scene.checks import check_gaussians
from nurec_sim.scene.interop.spz import read_spz
from nurec_sim.scene.transform import transformed
from nurec_sim.types import Gaussians

MADE = Path(__file__).parents[1] / "data" / "splat_files"
"""The same 300 Gaussians in three formats, the last two by splat-transform 2.7.1 (data/splat_files/README.md)."""


def covariance(gaussians: Gaussians) -> np.ndarray:
    """In units of the largest standard deviation: does not tell quaternions of the same ellipsoid apart."""
    axes = geometry.matrix_from_quat(gaussians.quat_wxyz) * gaussians.scale_m[:, None].astype(float)
    return axes @ axes.swapaxes(1, 2) / gaussians.scale_m.max(axis=1)[:, None, None] ** 2


def matched(gaussians: Gaussians, wanted: Gaussians) -> Gaussians:
    """In the order of ``wanted``: writers sort by place."""
    distance = np.linalg.norm(gaussians.mean_m[None] - wanted.mean_m[:, None], axis=-1)
    order = distance.argmin(axis=1)
    assert len(set(order.tolist())) == len(wanted) == len(gaussians)
    return gaussians[order]


def check_alike(gaussians: Gaussians, wanted: Gaussians, *, mean_m, shape, opacity, rgb, sh):
    gaussians = matched(gaussians, wanted)
    assert np.abs(gaussians.mean_m - wanted.mean_m).max() < mean_m
    assert np.abs(covariance(gaussians) - covariance(wanted)).max() < shape
    assert np.abs(gaussians.opacity - wanted.opacity).max() < opacity
    assert np.abs(gaussians.rgb - wanted.rgb).max() < rgb
    assert np.abs(gaussians.sh_rest - wanted.sh_rest).max() < sh


# --------------------------------------------------------------------------------------------- other programs' files


def test_a_compressed_ply_of_another_program():
    """Steps of 1/1023 of the chunk's extent (27 m), 1/255 of colour and opacity, 1/32 of harmonics."""
    gaussians, dropped = read_ply(MADE / "cloud.compressed.ply")
    assert dropped == 0
    wanted, _ = read_ply(MADE / "cloud.ply")
    check_alike(gaussians, wanted, mean_m=0.02, shape=0.01, opacity=0.004, rgb=0.003, sh=0.017)


def test_an_spz_file_of_another_program():
    """Steps of 1/4096 m, 1/16 of the logarithm of scales; y is up where the PLY had -y."""
    gaussians, dropped = read_spz(MADE / "cloud.spz")
    assert dropped == 0
    wanted, _ = read_ply(MADE / "cloud.ply")
    turned = transformed(wanted, geometry.pose(np.diag([1.0, -1, -1]), np.zeros(3)))
    check_alike(gaussians, turned, mean_m=2.1e-4, shape=0.13, opacity=0.004, rgb=0.004, sh=0.036)


def test_a_scene_of_an_spz_file_stands_upright(tmp_path):
    """splat-transform takes a PLY to have -y up."""
    from_ply, from_spz = import_scene(MADE / "cloud.ply", up="-y"), import_scene(MADE / "cloud.spz")
    assert from_spz.provenance["up"] == "y" and from_spz.id == "cloud"
    difference = matched(from_spz.static, from_ply.static).mean_m - from_ply.static.mean_m
    assert np.abs(difference).max() < 2.1e-4
    turned = import_scene(MADE / "cloud.spz", up="-z")
    assert np.abs(matched(turned.static, from_z := read_ply(MADE / "cloud.ply")[0]).mean_m - from_z.mean_m).max() < 3e-4


def test_import_and_open_on_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("cloud.compressed.ply", "cloud.spz"):
        cli.main(["import", str(MADE / name), "--out", "a.usdz", "--overwrite"])
        assert "300 (other 300)" in " ".join(capsys.readouterr().out.split())
        assert len(read_scene("a.usdz").static) == len(read_scene(MADE / name).static) == 300


def test_others_read_what_we_write(tmp_path):
    """gsply and splat-transform get the numbers that were written."""
    cloud = worlds.cloud(50, sh=8)
    cloud.quat_wxyz[:] = geometry.quat_normalize(cloud.quat_wxyz)
    write_ply(cloud, tmp_path / "a.ply")
    peers = 0
    if program := shutil.which("splat-transform"):
        subprocess.run([program, "-q", "a.ply", "b.ply"], cwd=tmp_path, check=True, timeout=60)
        back, _ = read_ply(tmp_path / "b.ply")
        assert np.allclose(back.mean_m, cloud.mean_m) and np.allclose(back.sh_rest, cloud.sh_rest)
        assert np.allclose(back.opacity, cloud.opacity, atol=1e-6) and np.allclose(back.rgb, cloud.rgb, atol=1e-6)
        peers += 1
    try:
        import gsply
    except ImportError:
        pass
    else:
        data = gsply.plyread(str(tmp_path / "a.ply"))
        assert np.allclose(data.means, cloud.mean_m) and np.allclose(np.exp(data.scales), cloud.scale_m)
        assert np.allclose(data.sh0 * 0.28209479 + 0.5, cloud.rgb, atol=1e-6) and np.allclose(data.shN, cloud.sh_rest)
        assert np.allclose(data.quats, cloud.quat_wxyz, atol=1e-6)
        peers += 1
    if not peers:
        pytest.skip("neither gsply (PyPI) nor splat-transform (npm: @playcanvas/splat-transform) is installed")


# ------------------------------------------------------------------------------------------------- packed by hand


def compressed(path: Path, words, *, bounds=None, colours=(), sh=None, chunks=1, kind="uint") -> Path:
    """A file with one chunk from (-1, 0, 10) to (1, 4, 20), logarithmic scales from -4 to 0."""
    axes = [f"{end}_{what}{axis}" for what in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
    axes += [f"{end}_{c}" for end in ("min", "max") for c in "rgb"] if len(colours) else []
    low_high = [-1, 0, 10, 1, 4, 20, -4, -4, -4, 0, 0, 0] if bounds is None else bounds
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}"]
    lines += [f"property float {axis}" for axis in axes] + [f"element vertex {len(words)}"]
    lines += [f"property {kind} packed_{name}" for name in ("position", "rotation", "scale", "color")]
    if sh is not None:
        lines += [f"element sh {len(sh)}", *(f"property uchar f_rest_{i}" for i in range(len(sh[0])))]
    body = struct.pack(f"<{len(axes)}f", *low_high, *colours) * chunks
    body += b"".join(struct.pack("<4I", *word) for word in words) + b"".join(bytes(row) for row in sh or ())
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + body)
    return path


WORD = (
    2047 << 21 | 0 << 11 | 0,  # far along x, near along y and z
    2 << 30 | 1023 << 20 | 512 << 10 | 511,  # y is the largest; w = sqrt(1/2), x and z all but 0
    0 << 21 | 1023 << 11 | 2047,  # log scales -4, 0, 0
    255 << 24 | 0 << 16 | 51 << 8 | 204,  # red 1, green 0, blue 0.2; opacity 0.8
)


def test_words_of_a_compressed_ply(tmp_path):
    sh = [0, 255, 128, *range(1, 7)]
    gaussians, _ = read_ply(compressed(tmp_path / "a.ply", [WORD], sh=[sh]))
    assert np.allclose(gaussians.mean_m, [[1, 0, 10]]) and np.allclose(gaussians.scale_m, [[np.exp(-4), 1, 1]])
    assert np.allclose(gaussians.quat_wxyz, [[np.sqrt(0.5), 0, np.sqrt(0.5), 0]], atol=2e-3)
    assert np.allclose(gaussians.rgb, [[1, 0, 0.2]], atol=1e-6) and gaussians.opacity[0] == pytest.approx(0.8)
    assert gaussians.sh_rest.shape == (1, 3, 3)
    assert np.allclose(gaussians.sh_rest[0, :, 0], [-4, 4, 0.015625])  # red first: -4..4 in 256 steps, the ends exact
    assert np.allclose(gaussians.sh_rest[0, 0, 1], (1.5 / 256 - 0.5) * 8)


def test_colours_between_the_bounds_of_their_chunk(tmp_path):
    gaussians, _ = read_ply(compressed(tmp_path / "a.ply", [WORD], colours=(0.5, 0.25, 0.0, 0.75, 1.0, 1.0)))
    assert np.allclose(gaussians.rgb, [[0.75, 0.25, 0.2]], atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"chunks": 2}, "1 vertices need 1 chunks, got 2"),
        ({"kind": "float"}, r"\['packed_position', .*\] must be of type uint"),
        ({"sh": [[0] * 10]}, "must have f_rest_0 to f_rest_8, 23 or 44 for each of 1 vertices, got 10 properties"),
        ({"sh": [[0] * 9] * 2}, "got 9 properties and 2 rows"),
    ],
)
def test_compressed_files_that_are_wrong(tmp_path, changes, text):
    with pytest.raises(ArchiveError, match=text):
        read_ply(compressed(tmp_path / "a.ply", [WORD], **changes))


def test_a_compressed_file_cut_short_or_without_an_element(tmp_path):
    data = compressed(tmp_path / "a.ply", [WORD] * 3, sh=[[0] * 9] * 3).read_bytes()
    for cut in (1, 9 * 3 + 1, 9 * 3 + 4 * 16):
        (tmp_path / "a.ply").write_bytes(data[:-cut])
        with pytest.raises(ArchiveError, match="is the file cut short"):
            read_ply(tmp_path / "a.ply")
    (tmp_path / "a.ply").write_bytes(data.replace(b"element chunk", b"element block"))
    with pytest.raises(ArchiveError, match=r"no element 'chunk'; it has \['block', 'vertex', 'sh'\]"):
        read_ply(tmp_path / "a.ply")
    bounds = [np.nan, 0, 10, 1, 4, 20, -4, -4, -4, 0, 0, 0]
    assert read_ply(compressed(tmp_path / "a.ply", [WORD], bounds=bounds))[1] == 1


def spz(path: Path, version=2, *, degree=0, count=1, rotation=b"\xff\x80\x80", position=None, tail=b"") -> Path:
    """A file of one Gaussian at (1, -2, 0.5)."""
    if position is None:
        whole = b"".join((round(x * 4096)).to_bytes(3, "little", signed=True) for x in (1, -2, 0.5))
        position = np.array([1, -2, 0.5], "<f2").tobytes() if version == 1 else whole
    header = struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, 0, 0)
    # Opacity 0.8; f_dc 0 (colour 0.5), -10/3 and 10/3; scales exp(-10), exp(0), exp(5.9375).
    content = header + position + b"\xcc" + bytes([128, 0, 255]) + bytes([0, 160, 255]) + rotation + tail
    path.write_bytes(gzip.compress(content))
    return path


@pytest.mark.parametrize("version", [1, 2, 3])
def test_numbers_of_an_spz_file(tmp_path, version):
    # Version 3: w (number 3) is the largest, x = -sqrt(1/2) * 511/511, y and z are 0.
    smallest = (3 << 30 | (512 | 511) << 20).to_bytes(4, "little")
    rotation = smallest if version == 3 else b"\xff\x80\x80"
    gaussians, dropped = read_spz(spz(tmp_path / "a.spz", version, rotation=rotation))
    assert dropped == 0 and np.allclose(gaussians.mean_m, [[1, -2, 0.5]])
    assert np.allclose(gaussians.scale_m, np.exp([[-10, 0, 5.9375]])) and gaussians.opacity[0] == pytest.approx(0.8)
    dc = (np.array([128, 0, 255]) / 255 - 0.5) / 0.15
    assert np.allclose(gaussians.rgb, np.maximum(0.5 + 0.28209479 * dc, 0), atol=1e-6)
    wanted = [np.sqrt(0.5), -np.sqrt(0.5), 0, 0] if version == 3 else [0, 1, 0.0039, 0.0039]
    assert np.allclose(gaussians.quat_wxyz, [wanted], atol=1e-4)


def test_harmonics_of_an_spz_file(tmp_path):
    """Colour by colour of each function: 128 is 0, 0 is -1."""
    gaussians, _ = read_spz(spz(tmp_path / "a.spz", degree=1, tail=bytes([0, 64, 128, 192, 255, 1, 2, 3, 4])))
    assert np.allclose(gaussians.sh_rest[0, :2], [[-1, -0.5, 0], [0.5, 127 / 128, -127 / 128]])


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda path: spz(path, 9), r"SPZ version 9 .*versions \[1, 2, 3\] and degrees 0 to 3"),
        (lambda path: spz(path, degree=4), "degree 4"),
        (lambda path: spz(path, count=2), "2 Gaussians take 38 bytes, 19 follow"),
        (lambda path: spz(path, count=2**32 - 1), "4,294,967,295 Gaussians take"),
        (lambda path: path.write_bytes(b"NGSP" + struct.pack("<I", 4) + bytes(24)), "splat-transform a.spz a.ply"),
        (lambda path: path.write_bytes(b"ply\n"), "not an SPZ file; it begins with b'ply"),
        (lambda path: path.write_bytes(gzip.compress(b"words")), "not an SPZ file; unpacked it begins with b'word'"),
        (lambda path: path.write_bytes(spz(path).read_bytes()[:-9]), "cut short"),
        (lambda path: path.write_bytes(gzip.compress(bytes(2**20))), "unpack to more than"),
        (lambda path: path.mkdir(), "cannot be opened"),
    ],
)  # fmt: skip
def test_spz_files_that_are_wrong(tmp_path, make, text, monkeypatch):
    monkeypatch.setattr(decoding, "LIMITS", Limits(free_bytes=1000))
    make(tmp_path / "a.spz")
    with pytest.raises(ArchiveError, match=text):
        read_spz(tmp_path / "a.spz")


@pytest.mark.parametrize("name", ["cloud.compressed.ply", "cloud.spz"])
def test_damaged_bytes_read_or_are_refused(tmp_path, name):
    """Whatever is flipped: Gaussians that a scene may hold, or an ArchiveError."""
    rng = np.random.default_rng(0)
    path, whole = tmp_path / name, (MADE / name).read_bytes()
    whole = gzip.decompress(whole) if name.endswith("spz") else whole
    for _ in range(100):
        data = bytearray(whole[: len(whole) - int(rng.integers(0, 3)) * int(rng.integers(0, 200))])
        for at in rng.integers(0, rng.choice([20, 1000, len(data)]), rng.integers(1, 6)):
            data[at] = rng.integers(0, 256)
        path.write_bytes(gzip.compress(data, 1) if name.endswith("spz") else data)
        try:
            gaussians, _ = (read_spz if name.endswith("spz") else read_ply)(path)
        except ArchiveError:
            continue
        check_gaussians(gaussians, "read")


@pytest.mark.parametrize("name", ["a.sog", "a.splat"])
def test_formats_that_another_program_converts(tmp_path, name):
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(ArchiveError, match=f"`splat-transform {name} a.ply` .npm: @playcanvas/splat-transform. makes"):
        import_scene(tmp_path / name)
