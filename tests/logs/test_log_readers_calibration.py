"""A town in other formats: sweeps, cameras and boxes still fit together, and wrong extrinsics are still found."""

import pytest
from ncore_files import write_ncore
from part_of_log import DEMO, first_frames
from ros_files import write_bag
from waymo_files import write_waymo

from nurec_sim import geometry, logs

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def town():
    return first_frames(logs.open_clip(DEMO), frames=3, cameras=2)


def write_ros(folder, clip, **options):
    return write_bag(folder / "town.mcap", clip, **options)


FORMATS = pytest.mark.parametrize(
    "write, needs", [(write_ncore, "ncore"), (write_ros, "mcap_ros2"), (write_waymo, "polars")]
)


@FORMATS
def test_lidar_projects_into_every_camera(town, write, needs, tmp_path):
    pytest.importorskip(needs)
    clip = logs.open_clip(write(tmp_path, town))
    assert logs.check_clip(clip) == []
    measures = logs.measure_clip(clip)
    assert [fault for each in measures for fault in each.faults] == []
    fits = [each for each in measures if each.what.startswith("LiDAR in camera")]
    assert len(fits) == 2 and all(each.found.startswith("fits at") for each in fits), measures


@FORMATS
def test_inverted_extrinsics_are_found(town, write, needs, tmp_path):
    pytest.importorskip(needs)
    clip = logs.open_clip(write(tmp_path, first_frames(town, 2), pose_of=geometry.inverse))
    faults = [fault for each in logs.measure_clip(clip) for fault in each.faults]
    assert any("inverted" in fault for fault in faults), faults
