"""Segments in the layout of Waymo's Perception data set v2: range images, poses of beams, exposures, boxes, damage."""

import dataclasses
import shutil

import numpy as np
import polars
import pytest
import tiny_clip
from waymo_files import write_waymo

from nurec_sim import geometry, logs
from nurec_sim.errors import ClipError
from nurec_sim.logs.readers.waymo_v2 import WaymoReader
from nurec_sim.serving.store import content_key
from nurec_sim.types import Rig

# Their first column looks half a column right of straight back; 90 columns are 4 degrees apart.
HALF_COLUMN = geometry.pose(geometry.rotation_from_yaw(np.radians(-2.0)), np.array([1.2, 0.1, 1.8]))


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """The tiny clip with one pinhole camera, and its LiDAR turned so that its beams are those of the layout."""
    whole = logs.open_clip(tiny_clip.write(tmp_path_factory.mktemp("tiny") / "tiny"))
    top = dataclasses.replace(whole.rig.lidars["top"], rig_from_lidar=HALF_COLUMN)
    lens = dataclasses.replace(whole.rig.cameras["front"].lens, thin_prism=(0.0,) * 4)
    front = dataclasses.replace(whole.rig.cameras["front"], lens=lens)
    rows = {"front": whole.image_records("front")}, {"top": whole.sweep_records("top")}
    return logs.Clip(
        "tiny", Rig({"front": front}, {"top": top}), whole.ego, *rows, whole.source, tracks=whole.tracks[:1]
    )


def distance_m(row, column, index):
    return 8.0 + index + 0.1 * row + 0.05 * column


@pytest.fixture(scope="module")
def images():
    """Three range images; the first beam of each has no return."""
    row, column = np.indices((16, 90))
    found = []
    for index in range(3):
        image = np.stack([distance_m(row, column, index), 0 * row + 0.5, 0 * row, 0 * row], axis=-1)
        image[0, 0, 0] = -1.0
        found.append(image)
    return found


@pytest.fixture(scope="module")
def segment(clip, images, tmp_path_factory):
    return write_waymo(tmp_path_factory.mktemp("waymo"), clip, ranges=images)


def test_a_segment_gives_what_was_written(clip, segment):
    opened = logs.open_clip(segment)
    assert (opened.id, opened.format) == ("tiny", "waymo-v2")
    front, given = opened.rig.cameras["front"], clip.rig.cameras["front"]
    assert (front.lens, front.shutter) == (given.lens, given.shutter)
    assert np.allclose(front.rig_from_camera, given.rig_from_camera, atol=1e-12)
    assert np.array_equal(opened.camera_times_us("front"), clip.camera_times_us("front"))
    for index in range(3):
        assert np.array_equal(opened.image("front", index), clip.image("front", index))
    top, given = opened.rig.lidars["top"], clip.rig.lidars["top"]
    assert np.allclose(top.elevation_rad, given.elevation_rad) and np.allclose(top.azimuth_rad, given.azimuth_rad)


def test_every_beam_is_placed_by_its_own_pose(clip, segment):
    """The world point of single beams, from their angles, ranges and the car's pose when they were fired."""
    opened, lidar = logs.open_clip(segment), clip.rig.lidars["top"]
    for index in range(3):
        sweep = opened.sweep("top", index)
        start = clip.sweep_times_us("top")[index, 0]
        assert (sweep.start_us, sweep.t_us, sweep.end_us) == (start, start + 50_000, start + 100_000)
        assert len(sweep.xyz_m) == 16 * 90 - 1 and np.allclose(sweep.intensity, np.tanh(0.5))
        for row, column in ((3, 17), (15, 88)):
            at = row * 90 + column - 1
            high, around = lidar.elevation_rad[row], lidar.azimuth_rad[column]
            ray = np.array([np.cos(high) * np.cos(around), np.cos(high) * np.sin(around), np.sin(high)])
            fired = start + round((column + 0.5) / 90 * 100_000)
            point = geometry.transform_points(clip.ego.at(fired) @ HALF_COLUMN, ray * distance_m(row, column, index))
            assert np.allclose(sweep.xyz_world_m[at], point, atol=1e-9) and sweep.point_t_us[at] == fired


def test_boxes_become_tracks(clip, segment):
    (track,) = logs.open_clip(segment).tracks
    given = clip.tracks[0]
    assert (track.id, track.label, track.size_m) == (given.id, given.label, given.size_m)
    assert np.allclose(track.path.world_from_body, given.path.at(track.path.t_us), atol=1e-9)
    assert track.path.t_us.tolist() == [2_050_000, 2_150_000]


def test_the_reader_keeps_the_contract_for_folders_and_files(segment, tmp_path):
    assert logs.check_reader(segment, WaymoReader()) == []
    both = shutil.copytree(segment, tmp_path / "both")
    for file in list(both.glob("*/tiny.parquet")):
        shutil.copy(file, file.with_stem("other"))
    with pytest.raises(ClipError, match=r"both: holds 2 segments.*'vehicle_pose/other.parquet'"):
        logs.open_clip(both)
    other = both / "lidar" / "other.parquet"
    assert logs.open_clip(other).id == "other"
    before = content_key(other, "lift")
    (both / "lidar" / "tiny.parquet").unlink()
    assert content_key(other, "lift") == before
    (both / "lidar_box" / "other.parquet").unlink()
    assert content_key(other, "lift") != before


def test_frames_alone_give_the_path_and_rows_of_equal_height(clip, images, tmp_path):
    folder = write_waymo(tmp_path, clip, ranges=images)
    for name in ("camera_image", "lidar_pose", "lidar_box"):
        shutil.rmtree(folder / name)
    change(folder, "lidar_calibration", lambda table: table.drop("[LiDARCalibrationComponent].beam_inclination.values"))
    opened = logs.open_clip(folder)
    assert opened.tracks == () and not opened.rig.cameras
    assert np.allclose(opened.ego.world_from_body, clip.ego.at(opened.ego.t_us))
    # From edge to edge 30 degrees in 16 rows.
    assert np.allclose(np.degrees(opened.rig.lidars["top"].elevation_rad[[0, -1]]), [15 - 15 / 16, -15 + 15 / 16])


def change(folder, component, how):
    file = folder / component / "tiny.parquet"
    how(polars.read_parquet(file)).write_parquet(file)


LIDAR, POSE = "[LiDARComponent].range_image_return1", "[VehiclePoseComponent].world_from_vehicle.transform"


@pytest.mark.parametrize(
    "component, how, error",
    [
        ("vehicle_pose", lambda t: t.drop(POSE), "vehicle_pose/tiny.parquet: column '.VehiclePose.*' is missing; have"),
        ("vehicle_pose", lambda t: t.head(2), "vehicle_pose: there is no pose of the frame at 2200000 us"),
        (
            "vehicle_pose",
            lambda t: t.with_columns(polars.col(POSE).arr.to_list().list.head(9)),
            "'world_from_vehicle.transform' must hold lists of 16 numbers",
        ),
        (
            "lidar",
            lambda t: t.with_columns(polars.lit([16, 91, 4]).alias(LIDAR + ".shape")),
            r"must have the shape \[rows, columns, 4\], got \[16, 91, 4\] and 5,760 values",
        ),
        (
            "lidar_pose",
            lambda t: t.with_columns(polars.lit([16, 90, 4]).alias("[LiDARPoseComponent].range_image_return1.shape")),
            r"lidar_pose: a range image must have the shape \[rows, columns, 6\]",
        ),
        ("camera_calibration", lambda t: t.with_columns(polars.lit(9).alias("key.camera_name")), "camera 9 is unknown"),
    ],
)
def test_damaged_tables_are_named(segment, tmp_path, component, how, error):
    folder = shutil.copytree(segment, tmp_path / "segment")
    change(folder, component, how)
    with pytest.raises(ClipError, match=error):
        logs.open_clip(folder).sweep("top", 0)


def test_a_file_that_is_no_table_is_named(segment, tmp_path):
    folder = shutil.copytree(segment, tmp_path / "segment")
    (folder / "lidar_box" / "tiny.parquet").write_bytes(b"PAR1 nothing")
    with pytest.raises(ClipError, match="lidar_box/tiny.parquet is not a readable Parquet file"):
        logs.open_clip(folder)
