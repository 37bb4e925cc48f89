"""Origins of beams: points of a scanner on the roof of a car, stored in the car's axes, in a street of boxes."""

import dataclasses
import functools

import numpy as np
import pytest
import tiny_clip

from nurec_sim import geometry, logs
from nurec_sim.logs.origins import contradicted, origin_of
from nurec_sim.types import Sweep

SCANNER_M = np.array([1.4, 0.0, 1.8])
ROOF_M = np.array([1.4, 0.0, 1.5])


@functools.cache
def street(origin_m=tuple(SCANNER_M)):
    """Returns of 40 x 720 beams from the origin, in the axes of the car: the road, and 30 boxes that stand on it."""
    random = np.random.default_rng(3)
    elevation, azimuth = np.meshgrid(np.radians(np.linspace(8.1, -20, 40)), np.radians(np.arange(0.1, 360, 0.5)))
    level = np.cos(elevation)
    ray = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    distance = np.where(ray[:, 2] < 0, origin_m[2] / np.maximum(-ray[:, 2], 1e-9), np.inf)
    away, turn = random.uniform(6, 40, 30), random.uniform(0, 2 * np.pi, 30)
    for place in np.column_stack([away * np.cos(turn), away * np.sin(turn), np.zeros(30)]):
        low, high = place - [1, 1, 0] - origin_m, place + [1, 1, 3] - origin_m
        near, far = np.sort([low / ray, high / ray], axis=0)
        near, far = near.max(axis=1), far.min(axis=1)
        distance = np.where((near < far) & (near > 0), np.minimum(distance, near), distance)
    hit = distance < 60
    return origin_m + ray[hit] * distance[hit, None]


def test_points_in_the_cars_axes_show_how_high_their_scanner_is():
    found = origin_of(street(), ROOF_M)
    assert found == pytest.approx(SCANNER_M, abs=0.41)
    assert contradicted(street() - found) < 0.02 < 0.05 < contradicted(street())


def test_points_of_a_scanner_that_is_where_the_log_has_it_move_nothing():
    assert origin_of(street() - SCANNER_M, ROOF_M) is None
    assert origin_of(street()[:2], ROOF_M) is None


@pytest.fixture
def folder(tmp_path):
    """Makes a log whose LiDAR is mounted at the given height and that has the points of ``street`` in the rig frame."""

    def make(height_m):
        rig = tiny_clip.rig()
        mount = geometry.pose(np.eye(3), np.array([0.0, 0.0, height_m]))
        rig = dataclasses.replace(rig, lidars={"top": dataclasses.replace(rig.lidars["top"], rig_from_lidar=mount)})
        ego = tiny_clip.ego()
        t_us = ego.start_us
        xyz_m = street() - [0, 0, height_m]
        sweep = Sweep(t_us, t_us, t_us, ego.at(t_us) @ mount, xyz_m, None, np.full(len(xyz_m), t_us))
        path = tmp_path / f"{height_m}"
        return logs.write_clip(path, id="a", rig=rig, ego=ego, frames=[logs.LidarEntry("top", sweep)])

    return make


def test_an_opened_log_has_its_lidar_where_beams_start_and_its_points_where_they_were(folder):
    clip = logs.open_clip(folder(0.0))
    sweep = clip.sweep("top", 0)
    assert clip.rig.lidars["top"].rig_from_lidar[:3, 3] == pytest.approx([1.3, 0, 1.8], abs=0.41)
    rig_from_world = geometry.inverse(clip.ego.at(sweep.t_us))
    assert rig_from_world @ sweep.world_from_lidar == pytest.approx(clip.rig.lidars["top"].rig_from_lidar)
    assert geometry.transform_points(rig_from_world, sweep.xyz_world_m) == pytest.approx(street(), abs=1e-3)
    assert clip.facts["beams_of_top"].startswith("start 1.")


def test_a_lidar_above_the_road_stays_where_the_log_has_it(folder):
    clip = logs.open_clip(folder(0.5))
    assert clip.rig.lidars["top"].rig_from_lidar[2, 3] == 0.5 and "beams_of_top" not in clip.facts


def test_a_log_opens_whose_sweep_cannot_be_read(folder):
    path = folder(0.0)
    (path / "lidar/top/0000.npz").write_bytes(b"")
    clip = logs.open_clip(path)
    assert clip.rig.lidars["top"].rig_from_lidar[2, 3] == 0
