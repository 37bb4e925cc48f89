"""How LiDAR intensity falls off with incidence, learnt from what several sweeps measured of the same surfaces."""

import dataclasses

import numpy as np
import pytest
from reconstruct_street import Street

from nurec_sim.reconstruct import reconstruct
from nurec_sim.reconstruct.incidence import _cosines, at_normal, best_falloff, with_incidence
from nurec_sim.types import Gaussians, Sweep

HELD = 3
FALLOFF = 0.6


class Slanted(Street):
    """The street whose surfaces return less light at a slant; road and pavement are level, the walls along x."""

    def sweep(self, lidar_id: str, index: int) -> Sweep:
        full = super().sweep(lidar_id, index)
        ray = full.xyz_world_m - full.world_from_lidar[:3, 3]
        axis = np.where(np.abs(full.xyz_world_m[:, 1]) > 5.9, 1, 2)
        cosine = np.abs(ray[np.arange(len(ray)), axis]) / np.linalg.norm(ray, axis=1)
        kept = 1 - FALLOFF * (1 - cosine)
        return dataclasses.replace(full, intensity=(full.intensity * kept).astype(np.float32))


@pytest.fixture(scope="module")
def scene():
    return reconstruct(Slanted(frames=7, speed_mps=10.0), "lift", cameras=[], hold_out_sweeps=[HELD])


def test_the_falloff_of_a_street_is_found(scene):
    assert scene.provenance["incidence"]["falloff"] == pytest.approx(FALLOFF, abs=0.1)
    assert set(np.unique(scene.static.falloff)) <= {np.float32(0), np.float32(np.float16(scene.static.falloff.max()))}
    # The street paints roads 0.2; away from kerbs that is what the sweeps say of them at normal incidence.
    road = (np.abs(scene.static.mean_m[:, 1]) < 3) & (scene.static.falloff > 0)
    assert road.sum() > 100 and np.median(scene.static.intensity[road]) == pytest.approx(0.2, abs=0.02)


def test_a_street_without_falloff_stays_as_it_is():
    clip = Street(frames=7, speed_mps=10.0)
    scene = reconstruct(clip, "lift", cameras=[], hold_out_sweeps=[HELD])
    assert scene.static.falloff is None and "incidence" not in scene.provenance
    assert with_incidence(scene, clip, {HELD}) is scene


def test_held_out_sweeps_are_not_read(scene):
    class Broken(Slanted):
        def sweep(self, lidar_id: str, index: int) -> Sweep:
            assert index != HELD
            return super().sweep(lidar_id, index)

    plain = dataclasses.replace(scene, static=dataclasses.replace(scene.static, falloff=None))
    assert with_incidence(plain, Broken(frames=7, speed_mps=10.0), {HELD}).static.falloff is not None


def test_intensity_at_normal_incidence_is_a_least_squares_fit():
    # One surface of intensity 0.8 with falloff 0.5, met at cosines 1 and 0.2: 0.8 and 0.8 (1 - 0.5 * 0.8) = 0.48.
    shown, cosine, weight = np.array([[0.8, 0.48, 9.0]]), np.array([[1.0, 0.2, 0.5]]), np.array([[1.0, 3.0, 0.0]])
    straight, error = at_normal(shown, cosine, weight, 0.5)
    assert straight == pytest.approx([0.8]) and error == pytest.approx([0], abs=1e-9)
    # Without falloff the mean (0.8 + 3 * 0.48) / 4 = 0.56 is left, off by 0.24 once and by 0.08 three times.
    straight, error = at_normal(shown, cosine, weight, 0.0)
    assert straight == pytest.approx([0.56]) and error == pytest.approx([0.12])
    assert best_falloff(shown, cosine, weight) == (0.5, pytest.approx(1.0))
    assert best_falloff(shown[:, :1], cosine[:, :1], weight[:, :1]) == (0.0, 0.0)  # one angle tells nothing


def test_cosines_are_those_between_normals_and_the_ways_to_where_returns_were_seen_from():
    up = np.tile(np.float32([0, 0, 1]), (2, 1))
    surfaces = dataclasses.replace(Gaussians.empty(2), mean_m=np.float32([[0, 0, 0], [3, 0, 0]]), normal=up)
    eye = np.float32([[0, 0, 5], [3, 4, 0], [0, 0, -4], [0, 0, 0]])
    # From above, along the surface, from below, and from where the Gaussian itself is.
    wanted = [[1, 0, 1, 0], [5 / np.hypot(3, 5), 0, 0.8, 0]]
    np.testing.assert_allclose(_cosines(surfaces, eye, np.tile(np.arange(4), (2, 1))), wanted, atol=1e-7)
