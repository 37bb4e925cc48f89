"""Kernels that read sweeps, each against the plain formula that it stands for."""

import math

import numpy as np
import pytest

from nurec_sim import geometry
from nurec_sim.compute.angles import arctan2
from nurec_sim.compute.kernels import kernel
from nurec_sim.logs.beam_errors import BeamErrors
from nurec_sim.logs.points import APART_US, instants_of, moved_points, turn_times_us, unpacked_points
from nurec_sim.types import Trajectory


@kernel
def _angles(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    result = np.empty(len(x))
    for i in range(len(x)):
        result[i] = arctan2(y[i], x[i])
    return result


def _points(count: int, seed: int = 0) -> np.ndarray:
    """More than one block of points, some of them at, above and below the scanner."""
    xyz = np.random.default_rng(seed).normal(size=(count, 3)) * [20.0, 20.0, 2.0]
    xyz[:4] = [[0.0, 0.0, 0.0], [0.0, 0.0, 1.5], [0.0, 0.0, -1.5], [-1.0, 0.0, 0.0]]
    return xyz


def test_angles_are_those_of_the_mathematical_library():
    rng = np.random.default_rng(1)
    y, x = rng.normal(size=(2, 50_000)) * 10.0 ** rng.uniform(-9, 6, (2, 50_000))
    expected = np.arctan2(y, x)
    assert (np.abs(_angles(y, x) - expected) <= 3 * np.spacing(np.abs(expected))).all()
    y, x = np.array([(0, 0), (0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1e200, 1e-200)]).T
    np.testing.assert_allclose(_angles(y, x), np.arctan2(y, x), rtol=1e-15)


@pytest.mark.parametrize("kind", [np.int8, np.uint16, np.int32, np.int64, ">i4"])
def test_points_are_sums_of_their_steps_moved_by_a_pose(kind):
    steps = np.random.default_rng(2).integers(0, 100, (3, 2_000)).astype(kind)
    pose = geometry.pose(geometry.rotation_from_yaw(0.3), np.array([1.0, -2.0, 0.5]))
    expected = geometry.transform_points(pose, np.cumsum(steps, axis=1, dtype=np.int64).T / 1000.0)
    np.testing.assert_array_equal(unpacked_points(steps, pose), expected)


def test_sums_of_steps_are_wider_than_the_steps():
    steps = np.full((3, 4), 2**30, np.int32)
    np.testing.assert_array_equal(unpacked_points(steps, np.eye(4))[-1], 2**32 / 1000.0)


@pytest.mark.parametrize("turn_us", [100_000.0, -50_000.0])
def test_times_of_points_follow_their_azimuth(turn_us):
    xyz = _points(5_000)
    expected = np.rint(np.arctan2(xyz[:, 1], xyz[:, 0]) / (2 * np.pi) * turn_us)
    np.testing.assert_array_equal(turn_times_us(xyz, turn_us), expected)


@pytest.mark.parametrize("late_us", [0, 40_000])
def test_each_point_is_moved_by_the_pose_at_its_time(late_us):
    """On the way, and up to 40 ms after it, where the car stands still."""
    rng, xyz = np.random.default_rng(3), _points(3_000)
    path = Trajectory(
        np.array([10**15, 10**15 + 60_000, 10**15 + 100_000]),
        np.stack([geometry.pose_from_xyyaw(2.0 * k, 0.0, 0.01 * k * k) for k in range(3)]),
    )
    t_us = path.start_us + rng.integers(0, 100_001, len(xyz)) + late_us
    instants = instants_of(t_us, path)
    assert 0 < np.diff(instants).max() <= APART_US
    expected = np.einsum("nij,nj->ni", path.at(t_us), np.column_stack([xyz, np.ones(len(xyz))]))[:, :3]
    # Where the speed changes, the pose is off by at most that change within a quarter of a step.
    np.testing.assert_allclose(moved_points(xyz, t_us, instants, path.at(instants)), expected, atol=0.003)
    even = t_us < path.t_us[1] - APART_US
    moved = moved_points(xyz[even], t_us[even], instants, path.at(instants))
    np.testing.assert_allclose(moved, expected[even], atol=5e-5)


@pytest.mark.parametrize("t_us", [[500], [500, 500], [500, 501]])
def test_points_of_one_instant_are_moved_by_its_pose(t_us):
    path = Trajectory(np.array([0, 1_000]), np.stack([np.eye(4), geometry.pose_from_xyyaw(1.0, 0.0, 0.0)]))
    instants = instants_of(np.array(t_us), path)
    found = moved_points(np.zeros((len(t_us), 3)), np.array(t_us), instants, path.at(instants))
    np.testing.assert_allclose(found[:, 0], np.array(t_us) / 1_000, atol=1e-12)


@pytest.mark.parametrize("size", [0.001, 0.3])
def test_points_are_lowered_by_the_error_of_their_beam(size):
    xyz = _points(5_000)
    knots = np.radians(np.arange(-30.0, 10.1, 2.0))
    errors = BeamErrors(knots, size * np.random.default_rng(5).normal(size=len(knots)))
    level = np.hypot(xyz[:, 0], xyz[:, 1])
    elevation = np.arctan2(xyz[:, 2], level)
    true, distance = elevation - np.interp(elevation, knots, errors.error_rad), np.hypot(level, xyz[:, 2])
    found = errors.removed(xyz)
    np.testing.assert_allclose(found[:, 2], distance * np.sin(true), atol=1e-12)
    beside = level > 0
    shrunk = (distance * np.cos(true) / np.maximum(level, 1e-9))[beside]
    np.testing.assert_allclose(found[beside, :2], xyz[beside, :2] * shrunk[:, None], rtol=1e-12, atol=1e-12)
    assert (found[~beside, :2] == 0).all()


def test_one_error_is_that_of_all_beams():
    xyz = np.array([[10.0, 0.0, 0.0], [0.0, 10.0, 5.0]])
    found = BeamErrors(np.array([0.1]), np.array([0.01])).removed(xyz)
    np.testing.assert_allclose(found[0], [10 * math.cos(0.01), 0.0, -10 * math.sin(0.01)], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), np.linalg.norm(xyz, axis=1), rtol=1e-14)
