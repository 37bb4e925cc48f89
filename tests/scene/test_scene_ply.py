"""PLY files: the released layout byte by byte, everyone else's layouts, damaged files."""

import dataclasses
import struct
import tracemalloc

import numpy as np
import pytest
import render_scenes as worlds
from ply_files import NEEDED, ply, standard, values

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.scene import read_ply, write_ply
from nurec_sim.scene.checks import check_gaussians
from nurec_sim.types import GAUSSIAN_FIELDS, Gaussians, Label

RELEASED = (
    "float x,float y,float z,float nx,float ny,float nz,uchar red,uchar green,uchar blue,uchar alpha,float rot_0,"
    "float rot_1,float rot_2,float rot_3,float scale_0,float scale_1,float scale_2,float opacity,float f_dc_0,"
    "float f_dc_1,float f_dc_2,uchar road_mask,float sky_mask"
).split(",")


def same(a: Gaussians, b: Gaussians, tolerance=1e-5):
    assert len(a) == len(b)
    for name in (*GAUSSIAN_FIELDS, "sh_rest"):
        x, y = getattr(a, name), getattr(b, name)
        assert (x is None) == (y is None), name
        if x is not None:
            assert np.allclose(x, y, rtol=tolerance, atol=tolerance, equal_nan=True), name


# -------------------------------------------------------------------------------------------------------- writing


def one_gaussian():
    return dataclasses.replace(
        worlds.gaussians([[1.5, -2.25, 3.0]], scale=(0.1, 0.2, 0.3), opacity=0.75, rgb=(0.0, 0.5, 1.0), label=1),
        normal=np.array([[0, 0.6, 0.8]], np.float32), quat_wxyz=np.array([[0.5, -0.5, 0.5, 0.5]], np.float32),
    )  # fmt: skip


def test_a_vertex_has_the_properties_of_inrias_code_all_floats(tmp_path):
    """One property more, or one that is no float, and viewers draw black dots or refuse the file."""
    assert write_ply(one_gaussian(), tmp_path / "a.ply") == 1
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
    lines = header.decode().splitlines()
    assert [line for line in lines if line.startswith("property")] == [f"property float {name}" for name in names]
    c0 = 0.28209479177387814
    expected = [1.5, -2.25, 3.0, 0.0, 0.6, 0.8, -0.5 / c0, 0.0, 0.5 / c0, np.log(3.0), np.log(0.1), np.log(0.2),
                np.log(0.3), 0.5, -0.5, 0.5, 0.5]  # fmt: skip
    assert np.allclose(struct.unpack("<17f", body), expected, rtol=1e-6, atol=1e-6)


def test_a_vertex_has_77_bytes_in_the_released_order(tmp_path):
    assert write_ply(one_gaussian(), tmp_path / "a.ply", layout="release") == 1
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"] and "element vertex 1" in lines
    assert [line[9:] for line in lines if line.startswith("property")] == RELEASED
    assert len(body) == 77
    got = struct.unpack("<6f4B4f3ff3fBf", body)
    c0 = 0.28209479177387814
    expected = [1.5, -2.25, 3.0, 0.0, 0.6, 0.8, 0, 128, 255, 255, 0.5, -0.5, 0.5, 0.5, np.log(0.1), np.log(0.2),
                np.log(0.3), np.log(3.0), -0.5 / c0, 0.0, 0.5 / c0, 1, 0.0]  # fmt: skip
    assert np.allclose(got, expected, rtol=1e-6, atol=1e-6)


def test_view_dependent_coefficients_follow_channel_by_channel(tmp_path):
    one = dataclasses.replace(worlds.gaussians([[0, 0, 0]]), sh_rest=np.arange(24, dtype=np.float32).reshape(1, 8, 3))
    for layout, size, at, follows in (("release", 77, 72, b"road_mask"), ("inria", 68, 36, b"opacity")):
        write_ply(one, tmp_path / "a.ply", layout=layout, overwrite=True)
        header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
        assert len(body) == size + 4 * 24
        assert header.index(b"f_dc_2") < header.index(b"f_rest_0") < header.index(b"f_rest_23") < header.index(follows)
        rest = struct.unpack("<24f", body[at : at + 96])
        assert rest[:8] == tuple(range(0, 24, 3)) and rest[8:16] == tuple(range(1, 24, 3))


def test_a_layout_or_axis_that_is_none(tmp_path):
    with pytest.raises(ArchiveError, match=r"layout must be one of \['inria', 'release'\], got 'spz'"):
        write_ply(one_gaussian(), tmp_path / "a.ply", layout="spz")
    with pytest.raises(ArchiveError, match=r"up must be one of \['z', '-z', .*\], got 'w'"):
        write_ply(one_gaussian(), tmp_path / "a.ply", up="w")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("opacity", [0.0, 1.0])
def test_full_and_no_opacity_stay_finite(tmp_path, opacity):
    write_ply(worlds.gaussians([[0, 0, 0]], opacity=opacity), tmp_path / "a.ply", layout="release")
    logit = struct.unpack("<f", (tmp_path / "a.ply").read_bytes()[-77:][56:60])[0]
    assert np.isfinite(logit)
    assert read_ply(tmp_path / "a.ply")[0].opacity[0] == pytest.approx(opacity, abs=2e-6)


def test_what_has_no_finite_form_is_left_out(tmp_path):
    cloud = worlds.cloud(20)
    cloud.opacity[0], cloud.scale_m[1, 2], cloud.mean_m[2, 0] = np.nan, 0, np.inf
    cloud.rgb[3, 1], cloud.normal[4] = np.nan, np.nan
    assert write_ply(cloud, tmp_path / "a.ply") == 16
    back, dropped = read_ply(tmp_path / "a.ply")
    assert dropped == 0 and np.array_equal(back.mean_m, cloud.mean_m[4:]) and not back.normal[0].any()


@pytest.mark.parametrize("layout", ["inria", "release"])
@pytest.mark.parametrize("k", [0, 3, 8, 15])
def test_gaussians_come_back(tmp_path, k, layout):
    cloud = worlds.cloud(300, sh=k)
    cloud.label[:] = np.random.default_rng(1).choice([Label.OTHER, Label.ROAD, Label.SKY], 300)
    cloud.intensity[:] = np.nan
    cloud = dataclasses.replace(cloud, quat_wxyz=geometry.quat_normalize(cloud.quat_wxyz).astype(np.float32))
    write_ply(cloud, tmp_path / "a.ply", layout=layout)
    if layout == "inria":  # which has no place for labels
        cloud.label[:] = Label.OTHER
    back, dropped = read_ply(tmp_path / "a.ply")
    assert dropped == 0
    same(back, cloud, 2e-6)


def test_files_appear_whole_or_not_at_all(tmp_path):
    path = tmp_path / "a.ply"
    write_ply(worlds.cloud(3), path)
    before = path.read_bytes()
    with pytest.raises(ArchiveError, match="exists; pass overwrite=True"):
        write_ply(worlds.cloud(4), path)

    def stop(stage, fraction):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_ply(worlds.cloud(4), path, overwrite=True, progress=stop)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


# ------------------------------------------------------------------------------------------------- others' layouts


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("kind", ["float", "double", "float32"])
def test_any_order_and_type_of_properties_reads_alike(tmp_path, form, kind):
    table = values(6, k=3)
    expected, _ = read_ply(standard(tmp_path / "plain.ply", table))
    table |= {"nx": np.zeros(6), "confidence": np.arange(6.0)}
    order = np.random.default_rng(2).permutation(list(table)).tolist()
    extra = ("comment trained by somebody", "obj_info 3", "comment")
    got, dropped = read_ply(standard(tmp_path / "a.ply", table, order, kind, form=form, extra=extra))
    assert dropped == 0
    same(got, expected)
    assert np.allclose(got.scale_m[:, 1], np.exp(table["scale_1"]), rtol=1e-6)
    assert np.allclose(got.opacity, 1 / (1 + np.exp(-table["opacity"])), rtol=1e-6)
    assert np.allclose(got.sh_rest[:, 1, 2], table["f_rest_7"]) and got.sh_rest.shape == (6, 3, 3)
    assert np.allclose(got.rgb[:, 0], 0.5 + 0.28209479 * table["f_dc_0"])


def test_small_integers_and_windows_line_ends(tmp_path):
    table = values(2)
    expected, _ = read_ply(standard(tmp_path / "plain.ply", table | {"opacity": np.array([3.0, 7.0])}))
    rows = [[3.0, 7.0][i : i + 1] + [table[n][i] for n in NEEDED if n != "opacity"] for i in range(2)]
    names = ["uchar opacity", *(f"float {n}" for n in NEEDED if n != "opacity")]
    path = ply(tmp_path / "a.ply", names, [[int(r[0]), *r[1:]] for r in rows])
    header, body = path.read_bytes().split(b"end_header\n", 1)
    path.write_bytes(header.replace(b"\n", b"\r\n") + b"end_header\r\n" + body)
    same(read_ply(path)[0], expected)


def test_elements_after_the_vertices_do_not_matter(tmp_path):
    path = standard(tmp_path / "a.ply", values(2))
    data = path.read_bytes()
    faces = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_bytes(data.replace(b"end_header\n", faces) + b"\x03" + bytes(12))
    assert len(read_ply(path)[0]) == 2


def test_coefficients_of_zero_are_none(tmp_path):
    table = values(3, k=15) | {f"f_rest_{i}": np.zeros(3) for i in range(45)}
    gaussians, _ = read_ply(standard(tmp_path / "a.ply", table))
    assert gaussians.sh_rest is None and gaussians.rgb.min() >= 0


def test_rows_that_are_no_gaussians_are_dropped_and_counted(tmp_path):
    table = values(9)
    table["x"][0] = table["f_dc_1"][1] = np.nan
    table["rot_2"][2] = np.inf
    for name in ("rot_0", "rot_1", "rot_2", "rot_3"):
        table[name][3] = 0
    table["scale_0"][4], table["scale_1"][5], table["opacity"][6] = 100.0, -np.inf, np.nan
    table["opacity"][7], table["opacity"][8] = np.inf, -np.inf
    gaussians, dropped = read_ply(standard(tmp_path / "a.ply", table))
    # An infinite logit is what the released network writes for a density of 1: that one must not get lost.
    assert dropped == 7 and gaussians.opacity.tolist() == [1.0, 0.0]


def test_a_file_without_gaussians_reads_as_none(tmp_path):
    for form in ("ascii", "binary_little_endian"):
        gaussians, dropped = read_ply(ply(tmp_path / "a.ply", RELEASED, [], form=form))
        assert (len(gaussians), dropped) == (0, 0)
    assert write_ply(gaussians, tmp_path / "b.ply") == 0 and len(read_ply(tmp_path / "b.ply")[0]) == 0


# ----------------------------------------------------------------------------------------------------- hostile files


def test_missing_properties_are_all_named(tmp_path):
    path = ply(tmp_path / "points.ply", ["float x", "float y", "float z", "uchar red"], [(0.0, 0.0, 0.0, 1)])
    with pytest.raises(ArchiveError, match=r"lack \['rot_0', .*'opacity', 'f_dc_0', 'f_dc_1', 'f_dc_2'\]; they have"):
        read_ply(path)


def test_harmonics_of_no_degree(tmp_path):
    table = values(2) | {f"f_rest_{i}": np.ones(2) for i in range(10)}
    with pytest.raises(ArchiveError, match=r"10 properties f_rest_\*; degrees 0 to 3 have 0, 9, 24 and 45"):
        read_ply(standard(tmp_path / "a.ply", table))


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("count", [10**6, 10**12, 10**17])
def test_a_promise_the_file_cannot_keep_takes_no_memory(tmp_path, form, count):
    path = standard(tmp_path / "a.ply", values(2), form=form, count=count)
    tracemalloc.start()
    with pytest.raises(ArchiveError, match=r"promises 1[0,]+ vertices .* is the file cut short"):
        read_ply(path)
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


@pytest.mark.parametrize("form", ["ascii", "binary_big_endian"])
def test_a_file_cut_short(tmp_path, form):
    path = standard(tmp_path / "a.ply", values(40), form=form)
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(b"\n", 0, -1) if form == "ascii" else -1])
    with pytest.raises(ArchiveError, match="cut short|vertices of 14 numbers are promised"):
        read_ply(path)


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        (b"ply\n", b"PK\x03\x04\n", "its first line must be 'ply'"),
        (b"format ascii 1.0", b"format ascii 2.0", "header line 'format ascii 2.0' is wrong"),
        (b"format ascii 1.0", b"format binary_middle_endian 1.0", "header line 'format binary_middle"),
        (b"format ascii 1.0\n", b"", "names no format; allowed are"),
        (b"element vertex 2", b"element vertex -2", "header line 'element vertex -2'"),
        (b"element vertex 2", b"element vertex 1e3", "header line 'element vertex 1e3'"),
        (b"element vertex 2", b"element vertex 9999999999999999999999", "header line 'element vertex 999"),
        (b"element vertex 2", b"element face 2", r"no element 'vertex'; it has \['face'\]"),
        (b"element vertex 2", b"element face 1\nproperty list uchar int i\nelement vertex 2", "lists come before"),
        (b"element vertex 2", b"element camera 1\nproperty float f\nelement vertex 2", "only the first element"),
        (b"float y", b"float x", "header line 'property float x'"),
        (b"float y", b"quad y", "header line 'property quad y'"),
        (b"float y", b"list uchar float y", "header line 'property list uchar float y'"),
        (b"end_header\n", b"", "header line"),
        (b"end_header\n", b"comment " + b"x" * 2**19 + b"\nend_header\n", "no 'end_header' line in the first"),
        (b"end_header\n", b"end_header\none two three\n", "a vertex is not readable"),
    ],
)  # fmt: skip
def test_headers_that_are_wrong(tmp_path, old, new, text):
    path = standard(tmp_path / "a.ply", values(2), form="ascii")
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new, 1))
    with pytest.raises(ArchiveError, match=text):
        read_ply(path)


def test_files_that_cannot_be_opened(tmp_path):
    for path in (tmp_path, tmp_path / "none.ply"):
        with pytest.raises(ArchiveError, match="cannot be opened"):
            read_ply(path)


def test_damaged_bytes_read_or_are_refused(tmp_path):
    """Whatever is flipped: Gaussians that a scene may hold, or an ArchiveError."""
    rng = np.random.default_rng(0)
    path = tmp_path / "a.ply"
    for form in ("ascii", "binary_little_endian"):
        whole = standard(path, values(4, k=3), form=form).read_bytes()
        for _ in range(300):
            data = bytearray(whole[: len(whole) - int(rng.integers(0, 3)) * int(rng.integers(0, 200))])
            for at in rng.integers(0, len(data), rng.integers(1, 6)):
                data[at] = rng.integers(0, 256)
            path.write_bytes(data)
            try:
                gaussians, _ = read_ply(path)
            except ArchiveError:
                continue
            check_gaussians(gaussians, "read")
