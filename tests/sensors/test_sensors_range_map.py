"""Range maps: which beam returned each point, and which beams did not return."""

import dataclasses

import numpy as np
import pytest

from nurec_sim import sensors
from nurec_sim.types import LidarModel, Spin


def returned(lidar: LidarModel, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points of a sweep in the order of its beams, and the image of beams that returned: a gap, and 10 % at random."""
    rng = np.random.default_rng(seed)
    direction = sensors.beam_directions(lidar)
    fired = rng.random(direction.shape[:2]) > 0.1
    fired[:, 40:60] = False
    return (direction * rng.uniform(3, 60, fired.shape)[..., None])[fired], fired


@pytest.mark.parametrize("name", ["PANDAR128", "AT128", "HDL-64", "HDL-32", "VLP-32C", "VLP-16"])
def test_beams_of_every_table_are_found_from_points_in_any_order(name):
    lidar = sensors.lidar_model(name, np.eye(4), columns=500)
    xyz, fired = returned(lidar)
    order = np.random.default_rng(1).permutation(len(xyz))
    found = sensors.range_map(lidar, xyz[order])
    assert found.known and not found.ordered and found.mapped == 1
    assert np.array_equal(found.point >= 0, fired)
    assert np.allclose(found.range_m[fired], np.linalg.norm(xyz, axis=1))
    assert np.array_equal(found.image(order, missing=-1)[fired], np.arange(len(xyz)))
    assert np.abs(found.residual_rad).max() < 1e-6


def test_elevations_and_columns_that_the_table_does_not_have_are_found():
    nominal = sensors.lidar_model("VLP-16", np.eye(4), columns=500)
    step = 2 * np.pi / 517
    true = dataclasses.replace(
        nominal, elevation_rad=nominal.elevation_rad + 0.003, azimuth_rad=nominal.azimuth_rad[0] - step * np.arange(517)
    )
    xyz, fired = returned(true)
    found = sensors.range_map(nominal, xyz)
    assert np.allclose(found.lidar.elevation_rad, true.elevation_rad, atol=1e-6)
    assert found.point.shape == (16, 517) and found.mapped > 0.999
    assert np.mean((found.point >= 0) == fired) > 0.999


def as_kitti_stores_it() -> tuple[LidarModel, np.ndarray, np.ndarray]:
    """Row by row from straight ahead to the left, rows starting 0.2 and 0.12 m above the origin, azimuths in steps.

    Returns the nominal model, the points, and the row of each.
    """
    lidar = sensors.lidar_model("HDL-64", np.eye(4))
    rng, columns = np.random.default_rng(2), 2155
    azimuth = np.round(np.arange(columns) * 360 / columns / 0.09) * 0.09
    rows, points = [], []
    for row, elevation in enumerate(lidar.elevation_rad):
        fired = rng.random(columns) > 0.1
        turn = np.radians(azimuth[fired])
        across = rng.uniform(5, 50, len(turn))
        height = (0.2 if row < 32 else 0.12) + across * np.tan(elevation)
        points.append(np.column_stack([across * np.cos(turn), across * np.sin(turn), height]))
        rows.append(np.full(len(turn), row))
    return lidar, np.concatenate(points), np.concatenate(rows)


def test_rows_stored_one_after_the_other_are_found_though_their_beams_cross():
    lidar, xyz, row = as_kitti_stores_it()
    found = sensors.range_map(lidar, xyz)
    assert found.ordered and found.known and found.mapped > 0.98
    assert found.point.shape == (64, 2155)
    place = np.nonzero(found.point >= 0)
    assert np.array_equal(place[0], row[found.point[place]])
    assert np.allclose(found.apex_m[:32], 0.2, atol=0.005) and np.allclose(found.apex_m[32:], 0.12, atol=0.005)
    # Shuffled, rows that cross cannot be told apart, and that is noticed.
    assert not sensors.range_map(lidar, xyz[np.random.default_rng(0).permutation(len(xyz))]).known


def test_directions_of_no_rows_are_not_known():
    direction = np.random.default_rng(3).uniform(-1, 1, (20000, 3)) * (1, 1, 0.3)
    found = sensors.range_map(sensors.lidar_model("HDL-32", np.eye(4)), 20 * direction)
    assert not found.known and found.scatter > 0.8
    assert not sensors.range_map(sensors.lidar_model("VLP-16", np.eye(4)), np.zeros((0, 3))).known


def test_columns_know_when_they_were_fired():
    lidar = sensors.lidar_model("VLP-16", np.eye(4), columns=500)
    xyz, fired = returned(dataclasses.replace(lidar, spin=Spin.CLOCKWISE))
    found = sensors.range_map(lidar, xyz)
    times = np.broadcast_to(np.arange(500) / 499, fired.shape)[fired]
    assert np.allclose(found.fraction(times), np.arange(500) / 499)
