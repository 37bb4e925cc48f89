"""Clocks of cameras: images of a car that accelerates through a bend, whose poses and stamps say different times."""

import types

import numpy as np
import pytest
import tiny_clip

from nurec_sim import geometry, logs
from nurec_sim.logs.clocks import with_image_clocks
from nurec_sim.types import Rig, Trajectory

START_US, FRAME_US = 5_000_000, 100_000


def path(speed_mps: float) -> Trajectory:
    """Three seconds at 100 Hz, from this speed to twice of it."""
    seconds = np.arange(301) / 100
    driven = speed_mps * (seconds + seconds**2 / 6)
    poses = [geometry.pose_from_xyyaw(40 * np.sin(s / 40), 40 - 40 * np.cos(s / 40), s / 40) for s in driven]
    return Trajectory(START_US + np.rint(seconds * 1e6).astype(np.int64), np.array(poses))


def log(late_us, speed_mps: float = 6.0, count: int = 24, ahead_m: float = 0.0, noise_m: float = 0.0) -> logs.Clip:
    """A log of two cameras, whose ``left`` has stamps that are so much later than its poses.

    Args:
        late_us: one number for all images, or one for each.
        ahead_m: how far its images' poses lie ahead of where the rig has the camera.
        noise_m: standard deviation of their places along the road.
    """
    rig, ego, random = tiny_clip.rig(), path(speed_mps), np.random.default_rng(0)
    cameras = {name: rig.cameras[name] for name in ("front", "left")}
    taken_us = START_US + 350_000 + FRAME_US * np.arange(count)
    images: dict[str, list[logs.ImageRecord]] = {name: [] for name in cameras}
    for t_us, late in zip(taken_us.tolist(), np.broadcast_to(late_us, count).tolist(), strict=True):
        for name, camera in cameras.items():
            times = np.array([t_us - 4_000, t_us + 4_000])
            poses = ego.at(times)
            if name == "left":
                poses = poses @ geometry.pose_from_xyyaw(ahead_m + random.normal(0, noise_m), 0.0, 0.0)
                times = times + late
            images[name].append(logs.ImageRecord("", int(times[0]), int(times[1]), poses @ camera.rig_from_camera))
    return logs.Clip("bend", Rig(cameras, {}, rig.body), ego, images, {}, source=None)


def starts(clip: logs.Clip, camera: str) -> list[int]:
    return clip.camera_times_us(camera)[:, 0].tolist()


@pytest.mark.parametrize("late_us", [10_500, -3_000, 60_000])
def test_images_get_the_times_of_their_poses(late_us):
    given, exact = log(late_us), log(0)
    found = with_image_clocks(given)
    assert np.abs(np.subtract(starts(found, "left"), starts(exact, "left"))).max() <= 20
    assert starts(found, "front") == starts(exact, "front")
    exposures = np.diff(found.camera_times_us("left"))
    assert (exposures == 8_000).all() and np.array_equal(
        found.world_from_camera("left", 7), given.world_from_camera("left", 7)
    )
    assert "times_of_front" not in found.facts and "times_of_left" not in given.facts
    side = "before" if late_us > 0 else "after"
    assert found.facts["times_of_left"] == f"are those of its poses, {abs(late_us) / 1000:.1f} ms {side} its stamps"
    assert with_image_clocks(found) is found


def test_noise_of_single_images_does_not_matter():
    """3 cm at 6 to 12 m/s are up to 5 ms."""
    found = with_image_clocks(log(12_000, noise_m=0.03))
    assert np.abs(np.subtract(starts(found, "left"), starts(log(0), "left"))).max() <= 1_500


def test_a_pose_that_is_no_number_tells_nothing():
    given = log(10_500)
    given.image_records("left")[5].world_from_camera[:] = np.nan
    assert starts(with_image_clocks(given), "left") == pytest.approx(starts(log(0), "left"), abs=20)


@pytest.mark.parametrize(
    "given",
    [
        pytest.param(log(0), id="exact"),
        pytest.param(log(600), id="less than a pixel can tell"),
        pytest.param(log(150_000), id="more than a frame"),
        pytest.param(log(10_000, speed_mps=0.9), id="a car that hardly moves"),
        pytest.param(log(10_000, count=4), id="a few images"),
        pytest.param(log(0, ahead_m=0.1), id="a mounting that is off, 8 to 17 ms by the speed"),
        pytest.param(log(2_000, noise_m=0.05), id="noise"),
        pytest.param(log(np.tile([0, 20_000], 12)), id="every other image"),
    ],
)
def test_a_log_that_does_not_clearly_tell_stays(given):
    assert with_image_clocks(given) is given


def test_opening_a_log_corrects_its_clocks(tmp_path):
    reader = types.SimpleNamespace(
        name="bends", description="", can_open=lambda path: True, open=lambda path: log(10_500)
    )
    assert starts(logs.open_clip(tmp_path, reader), "left") == starts(with_image_clocks(log(10_500)), "left")
