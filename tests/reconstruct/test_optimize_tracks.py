"""Corrections of tracks: gradients by turn and shift, and labels that are off."""

import dataclasses

import numpy as np
import pytest
from fitted_street import CROSSING, SMALL, Flicker

from nurec_sim import geometry
from nurec_sim.reconstruct import OptimizeSettings, reconstruct
from nurec_sim.reconstruct.optimize import method
from nurec_sim.reconstruct.optimize.settings import LearningRates, PosePriors, TrackPriors
from nurec_sim.reconstruct.optimize.tracks import TrackCorrections, wrenches
from nurec_sim.types import Trajectory

STILL = LearningRates(0, 0, 0, 0, 0, 0, 0)


def moved_tracks(scene, shifts, turns=0.0):
    """The scene with its first track shifted by [t,3] metres and turned by [t] rad, in the frame of the box."""
    path = scene.tracks[0].path
    poses = path.world_from_body.copy()
    for k, (shift, turn) in enumerate(zip(shifts, np.broadcast_to(turns, len(poses)), strict=True)):
        change = geometry.pose_from_xyyaw(0.0, 0.0, turn)
        change[:3, 3] = shift
        poses[k] = poses[k] @ change
    wrong = dataclasses.replace(scene.tracks[0], path=Trajectory(path.t_us, poses))
    return dataclasses.replace(scene, tracks=(wrong, *scene.tracks[1:]))


@pytest.fixture(scope="module")
def seen_well():
    """A street in which the moving box fills much of the images."""
    size, where = CROSSING["moving"]
    return Flicker(frames=4, boxes={"moving": (size, where - (4.0, 0.0))})


@pytest.fixture(scope="module")
def with_car(seen_well):
    return reconstruct(seen_well, "lift", cameras=["front"], settings=SMALL)


def test_wrenches_are_the_derivatives_by_turn_and_shift():
    rng = np.random.default_rng(1)
    pose = geometry.pose(geometry.matrix_from_quat(np.array([0.8, 0.1, -0.3, 0.5])), np.array([4.0, -2.0, 1.0]))
    mean, quat = rng.normal(size=(6, 3)) + pose[:3, 3], rng.normal(size=(6, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    by_mean, by_quat = rng.normal(size=(6, 3)), rng.normal(size=(6, 4))

    def moved(turn, shift):
        angle = np.linalg.norm(turn)
        half = np.concatenate([[np.cos(angle / 2)], np.sinc(angle / 2 / np.pi) / 2 * np.asarray(turn)])
        about = (mean[:5] - pose[:3, 3]) @ geometry.matrix_from_quat(half).T + pose[:3, 3] + shift
        return (about * by_mean[:5]).sum() + (geometry.quat_multiply(half, quat[:5]) * by_quat[:5]).sum()

    sums = np.zeros((2, 6))
    row_turn = np.array([1, 1, 1, 1, 1, -1], np.int32)
    wrenches(np.arange(6, dtype=np.int32), row_turn, np.stack([np.eye(4), pose]), mean, quat, by_mean, by_quat, sums)
    step = 1e-5
    expected = [(moved(step * axis, 0) - moved(-step * axis, 0)) / (2 * step) for axis in np.eye(3)] + [
        (moved(np.zeros(3), step * axis) - moved(np.zeros(3), -step * axis)) / (2 * step) for axis in np.eye(3)
    ]
    assert sums[1] == pytest.approx(expected, rel=1e-5, abs=1e-6)
    assert not sums[0].any()


def fitted(clip, scene, **settings):
    """The scene after a fit that changes nothing but tracks; they keep what the images, few and small, pull at."""
    settings = OptimizeSettings(seconds=None, rates=STILL, **{"steps": 240, **settings})
    return method.refine(scene, clip, ["front"], set(), lambda *_: None, settings)


@pytest.fixture(scope="module")
def right(seen_well, with_car):
    return fitted(seen_well, with_car)


def yaw_deg(scene):
    return np.degrees([np.arctan2(*pose[[1, 0], 0]) for pose in scene.tracks[0].path.world_from_body])


def test_a_label_that_is_off_is_moved_back(seen_well, with_car, right):
    """Errors of -7.5 to 7.5 cm beside the box; the 20 cm that they have in common move its Gaussians, not the box."""
    wrong = moved_tracks(with_car, np.array([0.0, 0.20, 0.0]) + np.linspace(-0.075, 0.075, 4)[:, None] * [0, 1, 0])
    scene = fitted(seen_well, wrong)
    off = scene.tracks[0].path.position_m - right.tracks[0].path.position_m
    assert off[:, 1] == pytest.approx(np.full(4, 0.20), abs=0.015)
    shift = (scene.dynamic.gaussians.mean_m - right.dynamic.gaussians.mean_m).mean(axis=0)
    assert shift[1] == pytest.approx(-0.20, abs=0.015)
    assert np.allclose(scene.dynamic.knot_m[:, 1], scene.dynamic.gaussians.mean_m)
    told = scene.provenance["refined"]["tracks"]
    assert told["tracks"] == 1 and 0.2 < told["largest_shift_m"] < 0.4


def test_a_label_that_is_turned_is_turned_back(seen_well, with_car, right):
    wrong = moved_tracks(with_car, np.zeros((4, 3)), turns=np.radians([-3.0, -1.0, 1.0, 3.0]))
    assert yaw_deg(fitted(seen_well, wrong)) == pytest.approx(yaw_deg(right), abs=0.4)


def test_tracks_are_kept_if_that_is_wanted(seen_well, with_car):
    kept = fitted(seen_well, with_car, correct_tracks=False, steps=2)
    assert np.array_equal(kept.tracks[0].path.world_from_body, with_car.tracks[0].path.world_from_body)
    assert "tracks" not in kept.provenance["refined"]


def test_what_stands_keeps_its_track(with_car):
    path = with_car.tracks[0].path
    standing = Trajectory(path.t_us, np.repeat(path.world_from_body[:1], len(path.t_us), axis=0))
    scene = dataclasses.replace(with_car, tracks=(dataclasses.replace(with_car.tracks[0], path=standing),))
    corrections = TrackCorrections(scene, TrackPriors())
    assert len(corrections.values) == 0 and corrections.report()["tracks"] == 0
    assert np.array_equal(corrections.pose(0, int(path.t_us[1])), standing.world_from_body[0])


def test_between_knots_corrections_are_interpolated(with_car):
    corrections = TrackCorrections(with_car, TrackPriors(shift_m=0.1))
    path = with_car.tracks[0].path
    assert len(corrections.values) == 2, "0.6 s"
    corrections.values[1, 2] = 1.0
    middle = (path.start_us + path.end_us) // 2
    for t_us, left in ((path.start_us, 0.0), (middle, 0.05), (path.end_us, 0.1)):
        moved = geometry.inverse(path.at(t_us)) @ corrections.pose(0, t_us)
        assert moved[:3, 3] == pytest.approx([0, left, 0], abs=1e-9)


def test_where_no_image_shows_an_actor_its_box_keeps_its_label(with_car):
    path = with_car.tracks[0].path
    longer = Trajectory(path.t_us * 4, path.world_from_body)
    scene = dataclasses.replace(with_car, tracks=(dataclasses.replace(with_car.tracks[0], path=longer),))
    corrections = TrackCorrections(scene, TrackPriors(shift_m=0.1))
    assert len(corrections.values) == 6, "2.4 s"
    corrections.values[:2, 2], corrections.adam.visits[:2] = (1.0, 2.0), 1
    assert corrections.report()["median_shift_m"] == pytest.approx(0.15), "of 0.1 and 0.2 m"
    done = corrections.applied(scene)
    start, end = (geometry.inverse(longer.world_from_body[k]) @ done.tracks[0].path.world_from_body[k] for k in (0, -1))
    assert start[:3, 3] == pytest.approx([0, -0.05, 0], abs=1e-9) and end[:3, 3] == pytest.approx(np.zeros(3), abs=1e-9)
    shift = done.dynamic.gaussians.mean_m - scene.dynamic.gaussians.mean_m
    assert shift == pytest.approx(np.tile([0, 0.15, 0], (len(shift), 1)), abs=1e-5)
    untouched = TrackCorrections(scene, TrackPriors()).applied(scene)
    assert np.array_equal(untouched.dynamic.gaussians.quat_wxyz, scene.dynamic.gaussians.quat_wxyz)


@pytest.mark.parametrize("wrong", [{"shift_m": -0.1}, {"turn_deg": float("nan")}, {"weight": float("inf")}])
def test_priors_below_0_are_refused(wrong):
    name, value = next(iter(wrong.items()))
    for priors in (TrackPriors, PosePriors):
        with pytest.raises(ValueError, match=f"{name} must be 0 or more and finite, got {value}"):
            priors(**wrong)
