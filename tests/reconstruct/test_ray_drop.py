"""Ray drop learnt from recorded beams that did not return, and the beams that the car blocks."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from reconstruct_street import Street

from nurec_sim import logs, sensors
from nurec_sim.reconstruct import ray_drop_fit, reconstruct
from nurec_sim.reconstruct.ray_drop import _shift, found_scanner
from nurec_sim.reconstruct.ray_drop_fit import RIDGE, logistic, sigmoid
from nurec_sim.render import make_renderer
from nurec_sim.types import SensorRequest, Sweep

HELD = 3
DARK_M = (2.0, 20.0)


def dark(xyz_world: np.ndarray, seed: int) -> np.ndarray:
    """A stretch of the left wall that swallows two beams of three."""
    return (
        (np.random.default_rng(seed).random(len(xyz_world)) < 2 / 3)
        & (xyz_world[:, 1] > 5.0)
        & (xyz_world[:, 0] > DARK_M[0])
        & (xyz_world[:, 0] < DARK_M[1])
    )


def behind_the_roof(xyz_lidar: np.ndarray) -> np.ndarray:
    """Beams that go down and backwards, where the car is in the way."""
    back = np.abs(np.arctan2(xyz_lidar[:, 1], xyz_lidar[:, 0])) > np.radians(150)
    return back & (xyz_lidar[:, 2] < -0.26 * np.hypot(xyz_lidar[:, 0], xyz_lidar[:, 1]))


class PartlyDark(Street):
    """The street with a dark wall, from a car that blocks beams."""

    def sweep(self, lidar_id: str, index: int) -> Sweep:
        full = super().sweep(lidar_id, index)
        keep = ~dark(full.xyz_world_m, index) & ~behind_the_roof(full.xyz_m)
        parts = {name: getattr(full, name)[keep] for name in ("xyz_m", "intensity", "point_t_us")}
        return dataclasses.replace(full, **parts)


@pytest.fixture(scope="module")
def clip() -> PartlyDark:
    return PartlyDark(frames=7, speed_mps=10.0)


@pytest.fixture(scope="module")
def scene(clip):
    return reconstruct(clip, "lift", cameras=[], hold_out_sweeps=[HELD])


def returned(scene, clip, scanner) -> np.ndarray:
    """Beams of the held-out sweep that return in the simulation."""
    sweep = clip.sweep("top", HELD)
    _, poses = logs.as_fired(clip, "top", sweep)
    request = SensorRequest(clip.id, scanner, sweep.start_us, sweep.end_us, poses)
    found = np.zeros((len(scanner.elevation_rad), len(scanner.azimuth_rad)), bool)
    found.reshape(-1)[make_renderer(scene, "cpu").render_lidar(request).beam] = True
    return found


def test_sweeps_hold_as_many_returns_as_recorded_ones(clip, scene):
    nominal, scanner = clip.rig.lidars["top"], scene.rig.lidars["top"]
    plain = dataclasses.replace(scene, static=dataclasses.replace(scene.static, ray_drop=None))
    recorded = sensors.range_map(nominal, clip.sweep("top", HELD).xyz_m).point >= 0
    # Of the beams for which the scene has a surface: coarse sweeps leave holes far away.
    wanted = np.count_nonzero(returned(plain, clip, nominal) & recorded)
    assert np.count_nonzero(returned(scene, clip, scanner)) == pytest.approx(wanted, rel=0.03)
    assert np.count_nonzero(returned(scene, clip, nominal)) > 1.05 * wanted
    assert np.count_nonzero(returned(plain, clip, scanner)) > 1.1 * wanted


def test_beams_that_the_car_blocks_are_the_scanners(clip, scene):
    scanner = scene.rig.lidars["top"]
    directions = sensors.beam_directions(scanner)
    wanted = behind_the_roof(directions.reshape(-1, 3)).reshape(directions.shape[:2])
    found = sensors.blocked_beams(scanner)
    assert found[wanted].mean() > 0.9 and found[~wanted].mean() < 0.02
    assert np.allclose(scanner.elevation_rad, clip.rig.lidars["top"].elevation_rad, atol=1e-4)
    standing = reconstruct(PartlyDark(frames=3, speed_mps=0.0), "lift", cameras=[])
    assert not len(standing.rig.lidars["top"].blocked)


def test_what_is_known_of_the_beams_is_kept_in_the_provenance(scene):
    learnt = scene.provenance["ray_drop"]
    assert 0 < learnt["dropped"] < learnt["beams"] and len(learnt["logistic"]) == 5


def test_a_log_of_scattered_points_says_that_nothing_was_learnt(clip):
    class Merged(PartlyDark):
        def sweep(self, lidar_id: str, index: int) -> Sweep:
            sweep = super().sweep(lidar_id, index)
            jitter = np.random.default_rng(index).normal(0, 0.05, sweep.xyz_m.shape)
            far = np.linalg.norm(sweep.xyz_m, axis=1, keepdims=True) / 10
            return dataclasses.replace(sweep, xyz_m=sweep.xyz_m + jitter * far)

    found = reconstruct(Merged(frames=2), "lift", cameras=[])
    assert found.static.ray_drop is None
    assert "beams of LiDAR 'top' are not known: no ray drop learnt from it" in found.provenance["unknown"]


def test_the_regression_finds_the_coefficients_that_made_the_outcomes():
    rng = np.random.default_rng(0)
    features = np.column_stack([np.ones(50_000), rng.normal(size=(50_000, 2))])
    true = np.array([-1.0, 0.8, -0.5])
    dropped = rng.random(50_000) < 1 / (1 + np.exp(-features @ true))
    assert np.allclose(logistic(features, dropped), true, atol=0.05)


def test_a_start_from_some_beams_does_not_change_the_regression(monkeypatch):
    rng = np.random.default_rng(1)
    features = np.column_stack([np.ones(250_000), rng.normal(size=(250_000, 2))])
    # The beams that it starts from say something else.
    dropped = rng.random(250_000) < np.where(np.arange(250_000) % 5 == 0, 0.6, 0.2)
    found = logistic(features, dropped)
    gradient = features.T @ (dropped - sigmoid(features @ found)) - RIDGE * found
    assert np.abs(gradient).max() < 1e-6
    monkeypatch.setattr(ray_drop_fit, "MANY", 1_000_000)
    np.testing.assert_allclose(found, logistic(features, dropped), atol=1e-12)


def test_as_many_beams_are_dropped_as_were_recorded():
    p = np.linspace(0.05, 0.45, 1000)
    odds = np.log(p / (1 - p)) - _shift(p, 250)
    assert np.count_nonzero(odds >= 0) == 250
    assert _shift(p, 0) == 0 and _shift(p, 1000) == 0


@pytest.mark.parametrize("columns", [(8, 10, 10), (10, 10, 8), (10, 8, 10)])
def test_a_scanner_makes_one_turn_whatever_columns_its_sweeps_have(clip, columns):
    nominal, sweeps = clip.rig.lidars["top"], []
    for count in columns:
        lidar = dataclasses.replace(nominal, azimuth_rad=np.pi - 2 * np.pi * np.arange(count) / count)
        beams = SimpleNamespace(lidar=lidar, point=np.full((len(lidar.elevation_rad), count), -1))
        sweeps.append(SimpleNamespace(beams=beams, seen_rad=lidar.elevation_rad, world_from_lidar=np.eye(4)[None],
                                      frame=SimpleNamespace(beam=np.zeros(0, np.int64))))  # fmt: skip
    scanner = found_scanner(nominal, sweeps)
    sensors.check_lidar(scanner)
    assert scanner.azimuth_rad == pytest.approx(np.pi - 2 * np.pi * np.arange(10) / 10)
