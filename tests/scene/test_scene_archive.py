"""A scene archive gives back what went in, rounded once, in the same bytes every time, and replaces nothing unasked."""

import dataclasses
import hashlib
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from pxr import Usd
from scene_worlds import END_US, START_US, curved_path, empty_scene, full_scene, gaussians, hilly_road, moving_car

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.scene import archive_faults, read_scene, scene_hash, summary, write_scene
from nurec_sim.scene.describe import scene_arrays
from nurec_sim.scene.precision import archived
from nurec_sim.sensors import lidar_model
from nurec_sim.types import DynamicGaussians, Gaussians, GaussianScene, Label, Rig, Trajectory

KNOT_FIELDS = ("knot_t_us", "knot_m", "track")


def assert_same(a, b, where="scene"):
    """Equality of nested dataclasses, mappings, sequences and arrays; NaN equals NaN, and -0 equals 0."""
    if dataclasses.is_dataclass(a):
        assert type(a) is type(b), where
        for field in dataclasses.fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name), f"{where}.{field.name}")
    elif isinstance(a, np.ndarray):
        assert (a.dtype, a.shape) == (b.dtype, b.shape), where
        assert np.array_equal(a, b, equal_nan=a.dtype.kind == "f"), where
    elif isinstance(a, dict):
        assert list(a) == list(b), where
        for key in a:
            assert_same(a[key], b[key], f"{where}[{key!r}]")
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b), where
        for index, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same(x, y, f"{where}[{index}]")
    else:
        assert a == b, where


@pytest.mark.parametrize("sh_terms", [0, 3, 8, 15])
def test_round_trip_loses_nothing(tmp_path, sh_terms):
    scene = full_scene(sh_terms)
    assert write_scene(scene, tmp_path / "a.usdz") == tmp_path / "a.usdz"
    back = read_scene(tmp_path / "a.usdz")
    assert_same(scene, back)
    assert scene_hash(scene) == scene_hash(back)
    assert archive_faults(tmp_path / "a.usdz") == []


@pytest.mark.parametrize("make", [empty_scene, hilly_road])
def test_round_trip_of_unusual_scenes(tmp_path, make):
    write_scene(make(), tmp_path / "new folder" / "a [1].usdz")
    assert_same(make(), read_scene(tmp_path / "new folder" / "a [1].usdz"))


def test_no_moving_gaussians_keep_their_degree(tmp_path):
    """Otherwise they could not be joined with the static ones."""
    scene = full_scene(15)
    none = DynamicGaussians(scene.dynamic.gaussians[:0], *(getattr(scene.dynamic, name)[:0] for name in KNOT_FIELDS))
    write_scene(dataclasses.replace(scene, dynamic=none), tmp_path / "a.usdz")
    back = read_scene(tmp_path / "a.usdz")
    assert_same(none, back.dynamic)
    assert len(Gaussians.concatenate([back.static, back.dynamic.gaussians])) == 400


def with_ray_drop(scene):
    """The scene with a drop probability and a falloff for every Gaussian."""

    def dropping(part):
        probability = np.random.default_rng(len(part)).integers(0, 3, len(part)).astype(np.float32) / 2
        return dataclasses.replace(part, ray_drop=probability, falloff=1 - probability)

    moving = dataclasses.replace(scene.dynamic, gaussians=dropping(scene.dynamic.gaussians))
    return dataclasses.replace(scene, static=dropping(scene.static), dynamic=moving)


@pytest.mark.parametrize("make", [full_scene, empty_scene])
def test_ray_drop_is_kept_where_there_is_one(tmp_path, make):
    scene = with_ray_drop(make())
    write_scene(scene, tmp_path / "a.usdz")
    back = read_scene(tmp_path / "a.usdz")
    assert_same(scene, back)
    assert scene_hash(scene) == scene_hash(back) != scene_hash(make())
    assert archive_faults(tmp_path / "a.usdz") == []


finite32 = st.floats(allow_nan=False, allow_infinity=False, width=32)
finite64 = st.floats(allow_nan=False, allow_infinity=False)


@pytest.mark.slow
@settings(max_examples=25, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(data=st.data(), count=st.integers(0, 6), scene_id=st.text("aé/@ \"\\'{}", min_size=1))
def test_round_trip_of_any_numbers(tmp_path_factory, data, count, scene_id):
    def floats(*shape):
        values = data.draw(st.lists(finite32, min_size=int(np.prod(shape)), max_size=int(np.prod(shape))))
        return np.array(values, np.float32).reshape(shape)

    def unit(values):
        return np.clip(np.abs(values), 0, 1)

    quat = np.zeros((count, 4), np.float32)
    quat[np.arange(count), data.draw(st.lists(st.integers(0, 3), min_size=count, max_size=count))] = 1
    static = Gaussians(
        floats(count, 3), quat, np.abs(floats(count, 3)), unit(floats(count)), floats(count, 3), floats(count, 3),
        np.full(count, data.draw(st.sampled_from(Label)), np.uint8), unit(floats(count)),
    )  # fmt: skip
    times = data.draw(st.lists(st.integers(-(2**50), 2**50), min_size=3 * count, max_size=3 * count))
    knot_t_us = np.sort(np.array(times, np.int64).reshape(count, 3), axis=1)
    base = empty_scene()
    dynamic = DynamicGaussians(static, knot_t_us, floats(count, 3, 3), np.full(count, -1, np.int32))
    isp = np.array(data.draw(st.lists(finite64, min_size=12, max_size=12))).reshape(3, 4)
    scene = dataclasses.replace(base, id=scene_id, static=static, dynamic=dynamic, isp={scene_id: isp})
    path = tmp_path_factory.mktemp("any") / "a.usdz"
    write_scene(scene, path)
    back, kept = read_scene(path), archived(scene)
    assert_same(kept, back)
    assert_same(kept, archived(kept))
    assert scene_hash(kept) == scene_hash(back)
    for name in KNOT_FIELDS:
        assert np.array_equal(getattr(scene.dynamic, name), getattr(back.dynamic, name)), name


def test_all_but_positions_are_rounded():
    """To IEEE 754 binary16, what LiDARs tell to 254ths, and colours by less than an image of 8 bits shows."""
    given = dataclasses.replace(gaussians(10_000, 2, 3), ray_drop=np.linspace(0, 1, 10_000, dtype=np.float32))
    kept = archived(dataclasses.replace(empty_scene(), static=given)).static
    assert np.array_equal(kept.mean_m, given.mean_m)
    assert np.array_equal(kept.label, given.label)
    for name in ("quat_wxyz", "scale_m", "opacity", "normal", "sh_rest"):
        wanted = getattr(given, name)
        assert np.array_equal(getattr(kept, name), wanted.astype(np.float16), equal_nan=True), name
    for name in ("intensity", "ray_drop"):
        wanted = np.round(getattr(given, name) * 254) / np.float32(254)
        assert np.array_equal(getattr(kept, name), wanted, equal_nan=True), name
    assert np.abs(kept.rgb - given.rgb).max() * 255 < 0.04
    tiny = dataclasses.replace(given, scale_m=np.full_like(given.scale_m, 1e6))
    assert archived(dataclasses.replace(empty_scene(), static=tiny)).static.scale_m.max() == 65504


def as_discs(given: Gaussians, degrees: float = 0.0) -> Gaussians:
    """The Gaussians with normals this far from their third axis, about the first one."""
    axes = geometry.matrix_from_quat(given.quat_wxyz.astype(np.float64))
    angle = np.deg2rad(degrees)
    normal = np.cos(angle) * axes[:, :, 2] - np.sin(angle) * axes[:, :, 1]
    return dataclasses.replace(given, normal=normal.astype(np.float32))


def test_normals_of_discs_are_not_stored_twice(tmp_path):
    """A field has no normals if all are the third axis of their Gaussians within 0.1 degrees; else it has them all."""

    def written(static):
        path = write_scene(dataclasses.replace(full_scene(0), static=static), tmp_path / "a.usdz", overwrite=True)
        stage = Usd.Stage.Open(str(path))
        normals = stage.GetPrimAtPath("/World/Static/road").GetAttribute("primvars:nurec_sim:normal")
        return read_scene(path).static, normals.HasAuthoredValue()

    discs = as_discs(gaussians(400, 4))
    for degrees, stored in ((0.0, False), (0.05, False), (1.0, True)):
        turned = as_discs(discs, degrees)
        back, has_normals = written(turned)
        assert has_normals == stored
        assert np.abs(back.normal - turned.normal).max() < 0.002
    one_turned = dataclasses.replace(discs, normal=discs.normal.copy())
    one_turned.normal[np.flatnonzero(discs.label == Label.ROAD)[0]] *= -1
    back, has_normals = written(one_turned)
    assert has_normals
    assert np.abs(back.normal - one_turned.normal).max() < 0.002


def test_bytes_of_a_gaussian(tmp_path):
    """Its attributes and an index; knots only for those that change place, times of knots once."""
    count = 20_000
    given = dataclasses.replace(as_discs(gaussians(count, 4)), label=np.full(count, Label.ROAD, np.uint8))

    def size_of(**changes):
        path = write_scene(dataclasses.replace(full_scene(0), **changes), tmp_path / "a.usdz", overwrite=True)
        with zipfile.ZipFile(path) as package:
            own = [entry for entry in package.infolist() if "splats" in entry.filename or "dynamic" in entry.filename]
        return sum(entry.file_size for entry in own)

    position, halves, intensity = 3 * 4, 2 * (4 + 3 + 1 + 3), 1
    packed = 0.5  # labels and indices: equal numbers, or steps of one, in a row take no room
    one, base = position + halves + intensity + packed, size_of()
    assert (size_of(static=given) - base) / count < one
    rigid = DynamicGaussians.rigid(given, np.zeros(count, np.int32), START_US)
    assert (size_of(dynamic=rigid) - base) / count < one


ARCHIVES = Path(__file__).parents[1] / "data" / "archives"


def old_scene(name: str) -> GaussianScene:
    """What ``version_1.usdz`` and ``version_2.usdz`` were written from, without ray drop."""
    rigid = DynamicGaussians.rigid(gaussians(4, 8, 3), np.zeros(4, np.int32), START_US)
    dynamic = DynamicGaussians.concatenate([moving_car(1, 6, 5, 3), rigid])
    sky = np.random.default_rng(1).random((6, 8, 8, 3), np.float32)
    return dataclasses.replace(
        full_scene(3), id=name, static=gaussians(12, 7, 3), dynamic=dynamic, sky=sky,
        rig=Rig({}, {}), isp={}, camera_times_us={}, ego=curved_path(3), road_map=None,
    )  # fmt: skip


def test_archives_of_version_1_are_read_exactly(tmp_path):
    """Written by release 0.1: float32 throughout, a primvar of colours, all knots of all moving Gaussians."""
    scene = read_scene(ARCHIVES / "version_1.usdz")
    assert_same(old_scene("version-1"), scene)
    assert scene.static.opacity[0] != np.float16(scene.static.opacity[0])
    write_scene(scene, tmp_path / "a.usdz")
    assert_same(archived(scene), read_scene(tmp_path / "a.usdz"))


def test_archives_of_version_2_are_read_exactly(tmp_path):
    """Half floats for all but positions, the sky as an array, columns of moving Gaussians as members."""
    scene = read_scene(ARCHIVES / "version_2.usdz")
    given, moving = old_scene("version-2"), scene.dynamic
    assert np.array_equal(scene.static.mean_m, given.static.mean_m)
    for name in ("quat_wxyz", "normal", "intensity"):
        wanted = getattr(given.static, name).astype(np.float16).astype(np.float32)
        assert np.array_equal(getattr(scene.static, name), wanted, equal_nan=True), name
    drop = np.random.default_rng(12).random(12, np.float32)
    assert np.array_equal(scene.static.ray_drop, drop.astype(np.float16))
    assert np.array_equal(scene.sky, given.sky.astype(np.float16))
    for name in (*KNOT_FIELDS, "in_box"):
        assert np.array_equal(getattr(moving, name), getattr(given.dynamic, name)), name
    assert moving.in_box is not None and moving.in_box.tolist() == [False] * 6 + [True] * 4
    write_scene(scene, tmp_path / "a.usdz")
    assert_same(archived(scene), read_scene(tmp_path / "a.usdz"))


@pytest.mark.slow
def test_same_scene_gives_the_same_bytes_in_every_process(tmp_path):
    first = write_scene(full_scene(), tmp_path / "a.usdz").read_bytes()
    assert write_scene(full_scene(), tmp_path / "b.usdz").read_bytes() == first
    code = (
        "import sys; from scene_worlds import full_scene; from nurec_sim.scene import write_scene;"
        "write_scene(full_scene(), sys.argv[1])"
    )
    environment = os.environ | {
        "PYTHONPATH": str(Path(__file__).parents[1] / "helpers"),
        "PYTHONHASHSEED": "7",
        "TZ": "Asia/Tokyo",
    }
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "c.usdz")], env=environment, check=True, timeout=60)
    assert hashlib.sha256((tmp_path / "c.usdz").read_bytes()).digest() == hashlib.sha256(first).digest()


def test_many_windows_are_binned_for_usd_but_stay_exact(tmp_path, monkeypatch):
    monkeypatch.setattr("nurec_sim.scene.usd.actors.MAX_WINDOWS", 10)
    scene = full_scene()
    rng = np.random.default_rng(0)
    times = np.sort(rng.integers(START_US, END_US, (len(scene.dynamic), 3)), axis=1)
    scene = dataclasses.replace(scene, dynamic=dataclasses.replace(scene.dynamic, knot_t_us=times))
    write_scene(scene, tmp_path / "a.usdz")
    assert_same(scene, read_scene(tmp_path / "a.usdz"))


def test_an_existing_file_is_kept_unless_asked(tmp_path):
    path = tmp_path / "a.usdz"
    path.write_bytes(b"precious")
    with pytest.raises(ArchiveError, match="exists; pass overwrite=True"):
        write_scene(full_scene(), path)
    assert path.read_bytes() == b"precious"
    write_scene(full_scene(), path, overwrite=True)
    assert archive_faults(path) == []


def test_a_failed_write_leaves_what_was_there(tmp_path, monkeypatch):
    path = write_scene(empty_scene(), tmp_path / "a.usdz")
    before = path.read_bytes()

    def no_space(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(OSError, match="No space left"):
        write_scene(full_scene(), path, overwrite=True)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.usdz"]


def test_name_must_end_in_usdz(tmp_path):
    with pytest.raises(ArchiveError, match=r"must end in \.usdz, got 'a\.zip'"):
        write_scene(empty_scene(), tmp_path / "a.zip")


def broken(**changes):
    """A scene with some of its static Gaussians' columns replaced."""
    static = gaussians(5, 0)
    return dataclasses.replace(empty_scene(), static=dataclasses.replace(static, **changes))


NAN = np.full((5, 3), np.nan, np.float32)
NEARSIGHTED = dataclasses.replace(lidar_model("VLP-16", np.eye(4), id="x"), range_m=(2.0, 1.0))
FAULTS = {
    "NaN mean": (lambda: broken(mean_m=NAN), r"static\.mean_m: 5 of 5 are not finite; the first is number 0"),
    "doubles": (lambda: broken(mean_m=NAN.astype(float)), r"mean_m must be float32 \(5, 3\), got float64 \(5, 3\)"),
    "lengths": (lambda: broken(opacity=np.ones(4, np.float32)), r"opacity must be float32 \(5,\), got float32 \(4,\)"),
    "opacity": (lambda: broken(opacity=np.full(5, 1.5, np.float32)), r"opacity: 5 of 5 are outside 0\.\.1"),
    "intensity": (lambda: broken(intensity=np.full(5, -1, np.float32)), r"intensity: 5 of 5 are outside 0\.\.1"),
    "ray drop": (lambda: broken(ray_drop=np.full(5, 1.5, np.float32)), r"ray_drop: 5 of 5 are outside 0\.\.1"),
    "falloff": (lambda: broken(falloff=np.full(5, -0.5, np.float32)), r"falloff: 5 of 5 are outside 0\.\.1"),
    "no ray drop": (lambda: broken(ray_drop=NAN[:, 0]), r"ray_drop: 5 of 5 are not finite"),
    "scale": (lambda: broken(scale_m=np.full((5, 3), -1, np.float32)), r"scale_m: 5 of 5 are negative"),
    "quaternion": (lambda: broken(quat_wxyz=np.ones((5, 4), np.float32)), r"quat_wxyz: 5 of 5 are not of unit length"),
    "label": (lambda: broken(label=np.full(5, 99, np.uint8)), r"label: 5 of 5 are not a Label"),
    "harmonics": (lambda: broken(sh_rest=np.zeros((5, 4, 3), np.float32)), r"sh_rest has 4 coefficients"),
    "start": (lambda: dataclasses.replace(empty_scene(), span_us=(0, 10)), r"start >= 1000000, got \(0, 10\)"),
    "id": (lambda: dataclasses.replace(empty_scene(), id="a\n"), r"needs a printable id, got 'a\\n'"),
    "sky": (lambda: dataclasses.replace(empty_scene(), sky=np.zeros((6, 2, 3, 3), np.float32)), r"sky must be float32"),
    "isp": (lambda: dataclasses.replace(full_scene(), isp={"a": np.eye(4)}), r"isp\['a'\] must be float64 \(3,"),
    "twins": (lambda: dataclasses.replace(full_scene(), tracks=full_scene().tracks[:1] * 2), "track ids must differ"),
    "owner": (lambda: dataclasses.replace(full_scene(), tracks=[]), r"dynamic\.track: 46 of 53 are outside -1\.\.-1"),
    "skew path": (
        lambda: dataclasses.replace(empty_scene(), ego=Trajectory(np.array([1]), 2 * np.eye(4)[None])),
        r"ego\.poses: 1 of 1 are not rotations",
    ),
    "names": (
        lambda: dataclasses.replace(empty_scene(), rig=Rig({"a": full_scene().rig.cameras["roof"]}, {})),
        "the rig lists the sensor 'roof' as 'a'",
    ),
    "LiDAR": (
        lambda: dataclasses.replace(empty_scene(), rig=Rig({}, {"x": NEARSIGHTED})),
        r"LiDAR 'x': range_m must be \(near, far\)",
    ),
    "provenance": (
        lambda: dataclasses.replace(empty_scene(), provenance={"x": float("nan")}),
        "cannot be written as JSON: Out of range float",
    ),
    "provenance kind": (
        lambda: dataclasses.replace(empty_scene(), provenance={"path": Path("x")}),
        "cannot be written as JSON: Object of type .*Path",
    ),
}  # fmt: skip


@pytest.mark.parametrize("make, text", FAULTS.values(), ids=FAULTS)
def test_unsound_scenes_are_refused_before_anything_is_written(tmp_path, make, text):
    with pytest.raises(ArchiveError, match=text):
        write_scene(make(), tmp_path / "a.usdz")
    assert list(tmp_path.iterdir()) == []


def test_hash_sees_every_array_and_fact():
    scene = full_scene()
    hashes = {scene_hash(scene)}
    for name, array in scene_arrays(scene).items():
        array.reshape(-1).view(np.uint8)[0] ^= 1
        hashes.add(scene_hash(scene))
        assert len(hashes) > 1, name
    hashes.add(scene_hash(dataclasses.replace(scene, id="other")))
    assert len(hashes) == len(scene_arrays(scene)) + 2


def test_whole_numbers_hash_like_floats():
    scene = full_scene()
    car = dataclasses.replace(scene.tracks[0], size_m=(5, 2, 1))
    same = dataclasses.replace(scene.tracks[0], size_m=(5.0, 2.0, 1.0))
    rest = scene.tracks[1]
    assert scene_hash(dataclasses.replace(scene, tracks=[car, rest])) == scene_hash(
        dataclasses.replace(scene, tracks=[same, rest])
    )


def test_summary_counts_what_is_there():
    rows = dict(summary(full_scene()))
    assert rows["static Gaussians"].startswith("400 (other 126, road 131, movable 143), harmonics degree 2")
    assert rows["moving Gaussians"] == "53 of 2 tracks"
    assert rows["time"] == "4.00 s from 1700000000123457 us"
    assert rows["road map"] == "2 drivable areas, 1 lane"
    assert dict(summary(empty_scene()))["cameras"] == "none"


def test_the_faces_of_the_sky_are_archived_in_their_order(tmp_path):
    """Read without our reader: a cubemap whose face n has as much red."""
    sky = np.broadcast_to(np.float32([0, 0.5, 0.25]), (6, 4, 4, 3)).copy()
    sky[..., 0] = np.arange(6)[:, None, None] / 8
    write_scene(dataclasses.replace(full_scene(0), sky=sky), tmp_path / "a.usdz")
    with zipfile.ZipFile(tmp_path / "a.usdz") as package:
        png = np.frombuffer(package.read("nurec_sim/sky_cubemap.png"), np.uint8)
    blue_green_red = cv2.imdecode(png, cv2.IMREAD_UNCHANGED)
    assert blue_green_red.shape == (24, 4, 3)
    kept = blue_green_red[..., ::-1].copy().view(np.float16)
    assert kept[::4, 0].tolist() == [[n / 8, 0.5, 0.25] for n in range(6)]
    assert np.array_equal(read_scene(tmp_path / "a.usdz").sky, sky)


def test_a_sky_that_has_more_pixels_than_an_image_may_have_is_read(tmp_path):
    """A NuRec scene may have faces of 4096 texels; six of 2360 are more than a camera image of 7680 x 4320."""
    sky = np.full((6, 2360, 2360, 3), 0.5, np.float32)
    write_scene(dataclasses.replace(full_scene(0), sky=sky), tmp_path / "a.usdz")
    assert np.array_equal(read_scene(tmp_path / "a.usdz").sky, sky)


def scene_with_bonnet(shape=(720, 1280, 4)) -> GaussianScene:
    image = np.zeros(shape, np.uint8)
    image[-4:] = (200, 30, 40, 255)
    image[-4, :, 3] = 128
    return dataclasses.replace(full_scene(), ego_images={"front": image})


def test_images_of_the_ego_vehicle_are_kept_exactly(tmp_path):
    scene = scene_with_bonnet()
    assert_same(scene, read_scene(write_scene(scene, tmp_path / "a.usdz")))
    assert scene_hash(scene) != scene_hash(full_scene())


def test_images_of_the_ego_vehicle_must_fit_their_camera(tmp_path):
    with pytest.raises(ArchiveError, match=r"ego_images\['front'\].*\(720, 1280, 4\).*\(4, 1280, 4\)"):
        write_scene(scene_with_bonnet((4, 1280, 4)), tmp_path / "a.usdz")
    stray = dataclasses.replace(scene_with_bonnet(), ego_images={"back": np.zeros((2, 2, 4), np.uint8)})
    with pytest.raises(ArchiveError, match=r"ego_images\['back'\]: the rig has no such camera"):
        write_scene(stray, tmp_path / "b.usdz")
    assert not list(tmp_path.iterdir())
