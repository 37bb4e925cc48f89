"""Argoverse 2 in its published layout: the demo log written so, a real log, and what the package ``av2`` reads."""

import shutil
from pathlib import Path

import numpy as np
import polars
import published_logs as published
import pytest

from nurec_sim import geometry, logs, sensors
from nurec_sim.errors import ClipError
from nurec_sim.logs.checks.calibration import check_calibration
from nurec_sim.logs.checks.sampling import sample_sweeps
from nurec_sim.logs.readers.argoverse2 import Argoverse2Reader

LIDAR, EPOCH_US = published.LIDAR, published.EPOCH_NS // 1000
REAL = "argoverse2/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede"


@pytest.fixture(scope="module")
def demo() -> logs.Clip:
    return published.demo()


@pytest.fixture(scope="module")
def folder(demo, tmp_path_factory) -> Path:
    return published.argoverse2(tmp_path_factory.mktemp("argoverse2"), demo)


@pytest.fixture(scope="module")
def clip(folder) -> logs.Clip:
    return logs.open_clip(folder)


@pytest.fixture
def spoilt(folder, tmp_path) -> Path:
    """A copy that may be spoilt."""
    return Path(shutil.copytree(folder, tmp_path / "log"))


def change(path: Path, *expressions) -> None:
    polars.read_ipc(path.read_bytes()).with_columns(*expressions).write_ipc(path)


@pytest.mark.slow
def test_a_log_keeps_the_contract(folder):
    assert logs.check_reader(folder, Argoverse2Reader()) == []


def test_a_log_is_what_was_recorded(clip, demo):
    assert (clip.id, clip.format) == (published.LOG, "argoverse2")
    assert tuple(clip.rig.cameras) == published.CAMERAS  # one more is calibrated, and has no images
    shift = demo.ego.world_from_body[0, :3, 3]
    origin = np.floor(published.CITY_M + shift + [0, 0, 0.33]) - published.CITY_M
    moved = geometry.pose(np.eye(3), -origin)
    assert (clip.ego.t_us == demo.ego.t_us + EPOCH_US).all()
    assert np.allclose(clip.ego.world_from_body, moved @ demo.ego.world_from_body, atol=1e-6)
    for name, camera in clip.rig.cameras.items():
        given = demo.rig.cameras[name]
        assert np.allclose(camera.rig_from_camera, given.rig_from_camera, atol=1e-9)
        assert np.allclose([camera.lens.fx_px, camera.lens.cx_px], [given.lens.fx_px, given.lens.cx_px])
        assert not camera.lens.distorted  # images are undistorted: k1 to k3 do not apply
        assert (clip.camera_times_us(name) == demo.camera_times_us(name)[list(published.INDICES)] + EPOCH_US).all()
        index = published.INDICES[3]
        assert np.allclose(clip.world_from_camera(name, 3), moved @ demo.world_from_camera(name, index), atol=1e-6)
        assert np.abs(clip.image(name, 3).astype(float) - demo.image(name, index)).mean() < 3


def test_each_lidar_has_its_own_points_and_frame(clip, demo):
    same = demo.sweep(LIDAR, published.INDICES[2])
    shift = clip.ego.world_from_body[0, :3, 3] - demo.ego.world_from_body[0, :3, 3]
    for name, first in (("up_lidar", 0), ("down_lidar", 1)):
        sweep = clip.sweep(name, 2)
        # Coordinates are of half precision: 3 cm at 60 m.
        assert np.abs(sweep.xyz_world_m - same.xyz_world_m[first::2] - shift).max() < 0.07
        assert (sweep.point_t_us - sweep.start_us == (same.point_t_us - same.start_us)[first::2]).all()
        assert np.allclose(sweep.intensity, same.intensity[first::2], atol=1e-3)
    assert np.allclose(clip.rig.lidars["down_lidar"].rig_from_lidar, published.DOWN)


def test_boxes_become_tracks(clip, demo):
    times = [demo.sweep_records(LIDAR)[index].t_us for index in published.INDICES]
    shift = clip.ego.world_from_body[0, :3, 3] - demo.ego.world_from_body[0, :3, 3]
    for track, given in zip(clip.tracks, demo.tracks, strict=True):
        assert (track.id, track.label, track.size_m) == (given.id, given.label, given.size_m)
        assert track.path.t_us.tolist() == [t_us + EPOCH_US for t_us in times]
        assert np.allclose(track.path.position_m, given.path.at(np.array(times))[:, :3, 3] + shift, atol=1e-6)


def test_the_map_has_areas_and_the_middle_of_lanes_for_cars(clip, demo):
    here = clip.ego.world_from_body[0, :3, 3] - demo.ego.world_from_body[0, :3, 3]
    ((ring,),) = clip.road_map.drivable
    assert (ring - here[:2]).round(6).tolist() == [[0, 0], [9, 0], [9, 9], [0, 9]]
    (lane,) = clip.road_map.lanes  # that of buses; bicycles have their own
    assert np.allclose(lane[0] - here, [0, 2, 0]) and np.allclose(lane[-1] - here, [8, 2, 1])


def test_inverted_extrinsics_are_found(demo, tmp_path):
    clip = logs.open_clip(published.argoverse2(tmp_path, demo, invert=True))
    rows = check_calibration(clip, sample_sweeps(clip)[1:3])
    assert [len(row.faults) for row in rows] == [1, 1]


def test_a_folder_above_one_log_is_enough_and_several_are_named(folder):
    root = folder.parents[1]
    assert logs.open_clip(root).id == published.LOG
    other = shutil.copytree(folder, folder.parent / "other", ignore=shutil.ignore_patterns("sensors", "map"))
    try:
        with pytest.raises(
            ClipError, match=rf"holds 2 logs of Argoverse 2; give .* one: .'val/{published.LOG}', 'val/oth"
        ):
            logs.open_clip(root)
        assert not logs.open_clip(other).rig.cameras  # tables alone are a log without sensors
    finally:
        shutil.rmtree(other)


@pytest.mark.parametrize(
    "file, expression, text",
    [
        ("city_SE3_egovehicle.feather", polars.lit(0).alias("timestamp_ns"), "feather: row 0: there is no pose"),
        ("city_SE3_egovehicle.feather", -polars.col("timestamp_ns"), "time goes back at row 1"),
        ("city_SE3_egovehicle.feather", polars.col("qw") * 2, "row .*: the quaternion is not of length 1"),
        ("city_SE3_egovehicle.feather", polars.lit(None, polars.Float64).alias("tx_m"), "'tx_m' has empty entries"),
        ("city_SE3_egovehicle.feather", polars.lit(float("nan")).alias("tx_m"), "tx_m, ty_m, tz_m must be finite"),
        ("calibration/intrinsics.feather", polars.lit("wide").alias("fx_px"), "'fx_px' must hold numbers, got String"),
        ("calibration/intrinsics.feather", polars.lit(-5.0).alias("fx_px"), "focal"),
        ("annotations.feather", polars.lit(0.0).alias("length_m"), "feather: row 0: sizes must be positive"),
        ("annotations.feather", polars.lit("a").alias("track_uuid"), "track 'a' has two boxes at one time"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(spoilt, file, expression, text):
    change(spoilt / file, expression)
    with pytest.raises(ClipError, match=text):
        logs.open_clip(spoilt)


def test_damaged_and_missing_files_are_named(spoilt):
    file = spoilt / "annotations.feather"
    whole = file.read_bytes()
    for spoil in (whole[:-300], whole[: len(whole) // 2], b"feather", whole[:200] + bytes(600) + whole[800:]):
        file.write_bytes(spoil)
        with pytest.raises(ClipError, match="annotations.feather"):
            logs.open_clip(spoilt)
    polars.read_ipc(whole).drop("qz").write_ipc(file)
    with pytest.raises(ClipError, match="annotations.feather: column 'qz' is missing; have .'timestamp_ns', "):
        logs.open_clip(spoilt)
    file.unlink()
    assert logs.open_clip(spoilt).tracks == ()
    (spoilt / "calibration/intrinsics.feather").unlink()
    with pytest.raises(ClipError, match="file calibration/intrinsics.feather is missing"):
        logs.open_clip(spoilt)


@pytest.mark.realdata
def test_beams_of_a_published_log_are_those_of_the_device(rawlogs):
    """In the frame of the LiDAR to which a laser belongs, elevations are those of the data sheet."""
    clip = logs.open_clip(rawlogs / REAL)
    for name in ("up_lidar", "down_lidar"):
        xyz = clip.source.sweep(name, 0).xyz_m
        far = xyz[np.linalg.norm(xyz, axis=1) > 5]
        elevation = np.degrees(np.arctan2(far[:, 2], np.hypot(far[:, 0], far[:, 1])))
        table = sensors.LIDAR_TABLES["VLP-32C"].elevation_deg
        assert np.median(np.abs(elevation[:, None] - table).min(axis=1)) < 0.05
    assert [fault for each in logs.measure_clip(clip) for fault in each.faults] == []


@pytest.mark.realdata
def test_a_published_log_is_what_av2_reads(rawlogs):
    pytest.importorskip("av2", reason="the package av2 is not installed")
    from av2.map.map_api import ArgoverseStaticMap
    from av2.structures.sweep import Sweep
    from av2.utils.io import read_city_SE3_ego, read_feather

    clip = logs.open_clip(rawlogs / REAL)
    origin = np.array(eval(clip.facts["world"].split("less ")[1].removesuffix(" m")))
    poses = read_city_SE3_ego(rawlogs / REAL)
    for index, file in enumerate(sorted((rawlogs / REAL / "sensors/lidar").glob("*.feather"))):
        sweep, city_from_ego = Sweep.from_feather(file), poses[int(file.stem)]
        ours = np.concatenate([clip.sweep(name, index).xyz_world_m for name in ("up_lidar", "down_lidar")])
        order = np.argsort(sweep.laser_number // 32, kind="stable")
        assert np.allclose(ours + origin, city_from_ego.transform_point_cloud(sweep.xyz)[order], atol=1e-3)
    boxes = read_feather(rawlogs / REAL / "annotations.feather")
    row = boxes.iloc[5000]
    track = next(each for each in clip.tracks if each.id == row.track_uuid)
    centre = poses[row.timestamp_ns].transform_point_cloud(row[["tx_m", "ty_m", "tz_m"]].to_numpy(float)[None])
    assert np.allclose(track.path.at(round(row.timestamp_ns / 1000))[:3, 3] + origin, centre[0], atol=1e-3)
    theirs = ArgoverseStaticMap.from_map_dir(rawlogs / REAL / "map", build_raster=False)
    areas = [area.xyz[:, :2] for area in theirs.get_scenario_vector_drivable_areas()]
    assert all(
        np.allclose(a[0] + origin[:2], b[:-1]) for a, b in zip(clip.road_map.drivable, areas, strict=True)
    )  # theirs are closed
    cars = [lane for lane in theirs.get_scenario_lane_segments() if lane.lane_type.value in ("VEHICLE", "BUS")]
    for lane, ours in zip(cars, clip.road_map.lanes, strict=True):
        middle = theirs.get_lane_segment_centerline(lane.id)
        assert np.allclose(ours[[0, -1]] + origin, middle[[0, -1]], atol=1e-6)
