"""Kernels of ``lift.points`` against the NumPy that says the same."""

import numpy as np

from nurec_sim import geometry
from nurec_sim.reconstruct.lift.cloud import Cloud, thinned
from nurec_sim.reconstruct.lift.points import BODY_MARGIN_M, NEAREST_M, _usable


def test_points_of_one_voxel_are_averaged_and_unknown_intensity_is_left_out():
    """Two points share a voxel of 0.1 m; a third lies in it too, but has voxels of 0.2 m."""
    xyz = np.array([[0.31, -0.02, 1.04], [0.51, 0.02, 1.04], [0.39, -0.06, 1.08], [0.35, -0.05, 1.05]])
    eye = np.array([[0.0, 0, 2], [0, 0, 2], [1, 0, 2], [3, 3, 3]])
    spacing, intensity = np.float32([0.1, 0.1, 0.1, 0.2]), np.float32([0.2, np.nan, np.nan, 0.7])
    found = thinned(Cloud(xyz, eye, spacing, intensity))
    np.testing.assert_allclose(found.xyz_m, [(xyz[0] + xyz[2]) / 2, xyz[1], xyz[3]])
    np.testing.assert_allclose(found.eye_m, [[0.5, 0, 2], [0, 0, 2], [3, 3, 3]])
    np.testing.assert_array_equal(found.spacing_m, np.float32([0.1, 0.1, 0.2]))
    np.testing.assert_array_equal(found.intensity, np.float32([0.2, np.nan, 0.7]))
    assert not len(thinned(Cloud.empty()))


def test_returns_of_the_ego_car_too_near_ones_and_far_ones_are_no_points():
    random = np.random.default_rng(0)
    xyz = random.normal(0, 4, (2000, 3))
    xyz[:3] = [[np.nan, 0, 9], [0, np.inf, 0], [0.1, 0.2, 0.3]]
    pose = geometry.pose_from_xyyaw(3.0, -2.0, 0.4)
    centre, half = np.array([1.0, 0.0, 0.5]), np.array([2.0, 1.0, 0.8]) + BODY_MARGIN_M
    with np.errstate(invalid="ignore"):
        distance, rig = np.linalg.norm(xyz, axis=1), geometry.transform_points(pose, xyz)
    expected = (distance > NEAREST_M) & (distance < 8.0) & (np.abs(rig - centre) > half).any(axis=1)
    np.testing.assert_array_equal(_usable(xyz, xyz, 8.0, pose, centre, half), np.flatnonzero(expected))
    assert 0 < expected.sum() < (distance < 8.0).sum() < len(xyz)
