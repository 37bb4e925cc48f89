"""Poses corrected by points of sweeps that images show elsewhere than expected: a part of the demo log, shaken."""

import types

import numpy as np
import pytest
from misaligned import LIDAR, street, turned
from scipy.spatial.transform import Rotation

from nurec_sim import geometry, logs
from nurec_sim.errors import ClipError
from nurec_sim.logs.alignment import FACT, followed, with_aligned_sweeps
from nurec_sim.logs.alignment.align import worth_it
from nurec_sim.logs.alignment.followed import FollowedPoints, followed_points
from nurec_sim.logs.moved import corrected
from nurec_sim.types import Trajectory

CAMERA, SWEEPS = "camera_front", 16


@pytest.fixture(scope="module")
def exact() -> logs.Clip:
    return street(SWEEPS, CAMERA)


@pytest.fixture(scope="module")
def yawed(exact) -> tuple[logs.Clip, np.ndarray]:
    """The log with poses that are turned about the vertical, another way at each sweep, and by how much."""
    times = np.array([record.t_us for record in exact.sweep_records(LIDAR)])
    yaw_deg = np.random.default_rng(2).normal(0, 0.15, len(times))
    at = exact.ego.at(times)
    jolts = np.array([turned([0, 0, each]) for each in yaw_deg])
    return corrected(exact, Trajectory(times, at @ jolts @ geometry.inverse(at))), yaw_deg


def yaw_error_deg(clip: logs.Clip, exact: logs.Clip) -> np.ndarray:
    """At the times of the images."""
    times = exact.camera_times_us(CAMERA).sum(axis=1) // 2
    off = geometry.inverse(exact.ego.at(times)) @ clip.ego.at(times)
    return np.degrees(Rotation.from_matrix(off[:, :3, :3]).as_rotvec()[:, 2])


def test_points_are_found_where_the_poses_say(exact):
    found = followed_points(exact, [CAMERA], (), {})
    assert len(found) > 500 and (found.second_us > found.first_us).all()
    assert np.median(np.linalg.norm(found.off_px, axis=1)) < 0.4
    # A point one metre farther to a side is so many pixels farther in the image: by its own projection.
    index = len(found) // 2
    times = exact.camera_times_us(CAMERA).sum(axis=1) // 2
    frame = int(np.flatnonzero(times == found.second_us[index])[0])
    camera, pose = exact.rig.cameras[CAMERA], exact.world_from_camera(CAMERA, frame)[0]
    step = np.array([0.01, -0.02, 0.005])

    def pixel(xyz):
        x, y, z = geometry.transform_points(geometry.inverse(pose), xyz)
        return np.array([camera.lens.fx_px * x / z, camera.lens.fy_px * y / z])

    moved = pixel(found.xyz_m[index] + step) - pixel(found.xyz_m[index])
    assert found.by_xyz[index] @ step == pytest.approx(moved, abs=0.02)


def test_an_image_from_a_turned_camera_shows_points_to_the_side(exact):
    """Turned to the left by 0.2 degrees from the middle of the log on: what comes after is expected farther right."""
    times = exact.camera_times_us(CAMERA).sum(axis=1) // 2
    middle = int(times[len(times) // 2])
    knots = np.array([times[0], middle - 1, middle, times[-1]])
    at = exact.ego.at(knots)
    jolts = np.array([turned([0, 0, each]) for each in (0, 0, 0.2, 0.2)])
    late = corrected(exact, Trajectory(knots, at @ jolts @ geometry.inverse(at)))
    found = followed_points(late, [CAMERA], (), {})
    across = (found.first_us < middle) & (found.second_us >= middle)
    expected_px = -np.tan(np.radians(0.2)) * exact.rig.cameras[CAMERA].lens.fx_px
    assert np.median(found.off_px[across, 0]) == pytest.approx(expected_px, rel=0.25)
    assert abs(np.median(found.off_px[~across, 0])) < 0.2 * abs(expected_px)


def test_images_tell_turns_that_planes_do_not(yawed, exact):
    wrong, given = yawed
    right = with_aligned_sweeps(wrong)
    before, after = (np.std(yaw_error_deg(clip, exact)) for clip in (wrong, right))
    assert before > 0.7 * np.std(given) and after < 0.4 * before
    px = right.facts[FACT]["apart_px"]
    assert px[1] < 0.6 * px[0]
    # A camera that is not to be used tells nothing.
    alone = with_aligned_sweeps(wrong, cameras=[])
    assert alone.facts[FACT]["apart_px"] == [0, 0] and np.std(yaw_error_deg(alone, exact)) > after


def test_images_that_are_held_out_are_not_read_and_move_with_the_rest(yawed, exact):
    wrong, _ = yawed
    held = set(range(1, exact.frame_count(CAMERA), 4))

    class Guarded:
        def image(self, camera_id, index):
            assert index not in held, f"image {index} was read"
            return wrong.source.image(camera_id, index)

        def __getattr__(self, name):
            return getattr(wrong.source, name)

    guarded = wrong.replaced()
    guarded.source = Guarded()
    sweeps = {index for index in range(SWEEPS) if index % 5 == 4}
    right = with_aligned_sweeps(guarded, sweeps, cameras=[CAMERA], held_images={CAMERA: held})
    assert FACT in right.facts
    poses = [clip.world_from_camera(CAMERA, min(held)) for clip in (wrong, right)]
    assert np.abs(poses[0] - poses[1]).max() > 1e-5
    found = followed_points(wrong, [CAMERA], sweeps, {CAMERA: held})
    times = exact.camera_times_us(CAMERA).sum(axis=1) // 2
    assert not set(times[sorted(held)].tolist()) & {*found.first_us.tolist(), *found.second_us.tolist()}


def test_a_log_without_images_or_points_in_them_has_no_followed_points(exact):
    assert len(followed_points(exact, [], (), {})) == len(FollowedPoints.concatenate([])) == 0
    assert len(followed_points(exact, [CAMERA], range(SWEEPS), {})) == 0
    assert len(followed_points(exact, [CAMERA], (), {CAMERA: range(1, exact.frame_count(CAMERA))})) == 0


def test_images_that_cannot_be_read_are_left_out_and_many_are_thinned(exact, monkeypatch):
    class Damaged:
        def image(self, camera_id, index):
            if index == 4:
                raise ClipError("image 4 is damaged")
            return exact.source.image(camera_id, index)

        def __getattr__(self, name):
            return getattr(exact.source, name)

    damaged = exact.replaced()
    damaged.source = Damaged()
    times = exact.camera_times_us(CAMERA).sum(axis=1) // 2
    seen = followed_points(damaged, [CAMERA], (), {})
    assert {*seen.first_us.tolist(), *seen.second_us.tolist()} == set(np.delete(times, 4).tolist())
    monkeypatch.setattr(followed, "MOST_IMAGES", exact.frame_count(CAMERA) - 1)
    seen = followed_points(exact, [CAMERA], (), {})
    assert {*seen.first_us.tolist(), *seen.second_us.tolist()} == set(times[::2].tolist())


@pytest.mark.parametrize(
    ("apart_m", "apart_px", "followed", "worth"),
    [
        ((0.010, 0.008), (1.0, 1.0), 1000, True),
        ((0.010, 0.0095), (1.0, 0.95), 1000, False),
        ((0.0002, 0.0009), (1.0, 0.5), 1000, True),  # less than a millimetre is no loss
        ((0.010, 0.0115), (1.0, 0.5), 1000, False),
        ((0.010, 0.008), (0.1, 0.14), 1000, True),
        ((0.010, 0.008), (1.0, 1.1), 1000, False),
        ((0.010, 0.008), (1.0, 1.1), 100, True),  # too few to count
        ((0.010, 0.010), (1.0, 0.5), 100, False),
    ],
)
def test_a_log_is_aligned_if_one_gains_and_none_loses(apart_m, apart_px, followed, worth):
    assert worth_it(types.SimpleNamespace(apart_m=apart_m, apart_px=apart_px), followed) is worth


def test_images_of_a_real_drive_agree_once_it_is_aligned(realdata):
    clip = logs.open_clip(realdata / "kitti_raw_0002")
    before, after = with_aligned_sweeps(clip, cameras=["cam_left"]).facts[FACT]["apart_px"]
    assert before > 0.9 and after < 0.4
