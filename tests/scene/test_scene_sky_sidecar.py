"""Sky files beside PLY files: the released arrays, texels that keep their place, files that are wrong."""

import zipfile

import numpy as np
import pytest
from ply_files import textured_sky

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.scene.interop import sky_sidecar
from nurec_sim.scene.interop.sky_sidecar import FACE_AXES, FACE_ORDER, SkySidecar, read_sky, write_sky


def test_the_sky_file_has_the_released_arrays(tmp_path):
    isp = {"front": np.arange(12.0).reshape(3, 4), "rear": np.eye(3, 4)}
    sidecar = SkySidecar(textured_sky(), np.full((6, 16, 16), 0.75, np.float32), isp, "observed")
    write_sky(sidecar, tmp_path / "a.sky.npz", tmp_path / "a.sky.png", ["left", "rear", "front"])
    with np.load(tmp_path / "a.sky.npz", allow_pickle=False) as file:
        arrays = dict(file)
    kinds = {name: (array.dtype.kind + str(array.dtype.itemsize), array.shape) for name, array in arrays.items()}
    assert kinds["sky_cubemap"] == ("f2", (6, 16, 16, 3)) and kinds["sky_cubemap_mask"] == ("f2", (6, 16, 16, 1))
    assert kinds["affine_matrix"] == ("f4", (2, 3, 4)) and kinds["affine_sensor_indices"] == ("i8", (2,))
    assert arrays["format_version"] == 1 and str(arrays["coordinate_frame"]) == "ncore_world"
    assert arrays["affine_sensor_indices"].tolist() == [2, 1] and arrays["affine_sensor_ids"].tolist() == list(isp)
    assert arrays["face_order"].tolist() == ["+X", "-X", "-Y", "+Y", "+Z", "-Z"]
    assert arrays["sky_observed_fraction"] == 1 and arrays["face_axes"].shape == (6,)
    # Each texel's colour is its own direction's: the middle of the first face looks along +x of the world, ...
    axes = (arrays["sky_cubemap"][:, 7:9, 7:9].mean(axis=(1, 2), dtype=np.float64) - 0.5) / 0.4
    expected = [[1, 0, 0], [-1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1]]
    assert np.allclose(axes, expected, atol=0.01)
    colours = geometry.released_cubemap_directions(16) * 0.4 + 0.5
    assert np.allclose(arrays["sky_cubemap"], colours, atol=1e-3)


def test_face_axes_say_what_the_faces_do():
    def axis(text):
        return np.eye(3)["XYZ".index(text[1])] * (1 if text[0] == "+" else -1)

    corner = geometry.released_cubemap_directions(128)[:, 0, 0]  # u = v = -1, nearly
    for face, axes, direction in zip(FACE_ORDER, FACE_AXES, corner, strict=True):
        u, v = (axis(text[2:]) for text in axes.split())
        assert np.allclose(direction * np.sqrt(3), axis(face) - u - v, atol=0.03)


def test_the_networks_cubemap_is_the_files():
    from nurec_sim.network.sky import cubemap

    assert np.allclose(cubemap.directions(9).numpy(), geometry.released_cubemap_directions(9), atol=1e-6)


@pytest.mark.parametrize("size", [1, 2, 7])
def test_the_sky_comes_back_texel_by_texel(tmp_path, size):
    rng = np.random.default_rng(3)
    sky = rng.normal(size=(6, size, size, 3)).astype(np.float16).astype(np.float32)  # beyond 0..1: not clamped
    seen = rng.random((6, size, size)).astype(np.float16).astype(np.float32)
    write_sky(SkySidecar(sky, seen, {"front": np.eye(3, 4)}, "observed"), tmp_path / "a.npz")
    back = read_sky(tmp_path / "a.npz")
    assert np.array_equal(back.sky, sky) and np.array_equal(back.seen, seen) and back.source == "observed"
    assert np.array_equal(back.isp["front"], np.eye(3, 4))


def test_the_picture_shows_six_faces_in_two_rows(tmp_path):
    import cv2

    write_sky(SkySidecar(textured_sky(8)), tmp_path / "a.npz", tmp_path / "a.png")
    picture = cv2.imread(str(tmp_path / "a.png"))[..., ::-1]
    assert picture.shape == (16, 24, 3)
    middles = picture[4::8, 4::8].reshape(6, 3) / 255 - 0.5
    assert np.argmax(np.abs(middles), axis=1).tolist() == [0, 0, 1, 1, 2, 2]
    assert (middles[:, [0, 0, 1, 1, 2, 2]].diagonal() > 0).tolist() == [True, False, False, True, True, False]


def test_defect_7_texels_that_nobody_saw_keep_their_colour(tmp_path):
    sky, seen = textured_sky(8), np.zeros((6, 8, 8), np.float32)
    write_sky(SkySidecar(sky, seen), tmp_path / "a.npz")
    back = read_sky(tmp_path / "a.npz")
    assert np.abs(back.sky - sky).max() < 1e-3 and not back.seen.any()


def released_sky(path, **changes):
    """A file as the released network's exporter makes it; None leaves an array out."""
    arrays = {
        "format_version": 1, "sky_cubemap": np.zeros((6, 4, 4, 3), np.float16),
        "sky_cubemap_mask": np.ones((6, 4, 4, 1), np.float16), "affine_matrix": np.zeros((1, 3, 4), np.float32),
        "affine_sensor_indices": np.array([0]), "affine_sensor_ids": np.array(["camera_front_wide_120fov"]),
        "face_order": np.array(["+X", "-X", "-Y (top)", "+Y (bottom)", "+Z", "-Z"]),
        "coordinate_frame": "ncore_world", "sky_observed_fraction": np.float32(0.5),
    }  # fmt: skip
    np.savez_compressed(path, **{name: value for name, value in (arrays | changes).items() if value is not None})
    return path


def test_a_released_sky_file_reads(tmp_path):
    back = read_sky(released_sky(tmp_path / "a.npz"))
    assert back.sky.shape == (6, 4, 4, 3) and list(back.isp) == ["camera_front_wide_120fov"]
    least = read_sky(released_sky(tmp_path / "b.npz", sky_cubemap_mask=None, affine_matrix=None, face_order=None))
    assert least.seen is None and least.isp is None


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"format_version": 2}, r"format_version \[2\]; this nurec_sim reads \[1\]"),
        ({"sky_cubemap": None}, r"\['sky_cubemap'\] missing; it holds"),
        ({"sky_cubemap": np.zeros((6, 4, 5, 3), np.float16)}, r"must be floats \(6, 4, 4, 3\), got float16 \(6, 4, 5"),
        ({"sky_cubemap": np.zeros((6, 4, 4, 3), np.int32)}, "must be floats"),
        ({"sky_cubemap": np.full((6, 4, 4, 3), np.nan)}, "sky_cubemap is not finite"),
        ({"sky_cubemap": np.zeros(3)}, "s in 1..64"),
        ({"sky_cubemap": np.zeros((6, 80, 80, 3), np.float32)}, "takes 460,928 bytes; at most 294,912 are read"),
        ({"sky_cubemap_mask": np.ones((6, 4, 4), np.float16)}, "sky_cubemap_mask must be"),
        ({"affine_matrix": np.ones((2, 3, 4), np.float32)}, r"affine_matrix must be floats \(1, 3, 4\)"),
        ({"coordinate_frame": "camera"}, "coordinate_frame 'camera'; only 'ncore_world'"),
        ({"face_order": np.array(["-X", "+X", "-Y", "+Y", "+Z", "-Z"])}, "face_order"),
        ({"affine_sensor_ids": np.array([print], object)}, "must hold plain values"),
    ],
)
def test_sky_files_that_are_wrong(tmp_path, monkeypatch, changes, text):
    monkeypatch.setattr(sky_sidecar, "MAX_FACE_TEXELS", 64)
    with pytest.raises(ArchiveError, match=text):
        read_sky(released_sky(tmp_path / "a.npz", **changes))


def test_sky_files_that_are_no_archives(tmp_path):
    path = released_sky(tmp_path / "a.npz")
    whole = path.read_bytes()
    for data in (b"", whole[:-30], b"PK" + bytes(100), whole[:60] + bytes(40) + whole[100:]):
        path.write_bytes(data)
        with pytest.raises(ArchiveError, match=r"a\.npz"):
            read_sky(path)
    with zipfile.ZipFile(path, "w") as package:
        package.writestr("format_version.npy", b"no array")
    with pytest.raises(ArchiveError, match="format_version is no array file"):
        read_sky(path)
    with pytest.raises(ArchiveError, match="cannot be opened"):
        read_sky(tmp_path / "none.npz")
