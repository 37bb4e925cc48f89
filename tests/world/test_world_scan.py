"""LiDAR turns of the true world: exact rays, drawn sectors, and lost echoes."""

import dataclasses

import numpy as np
import pytest
from sensor_worlds import painted_world, request_at, true_world

from nurec_sim import geometry, sensors
from nurec_sim.types import Spin
from nurec_sim.world import SurfaceClass
from nurec_sim.world.sense.scan import LidarResponse, drop_probability, measured_points
from nurec_sim.world.sense.stage import Quality

MOUNT = geometry.pose(np.eye(3), np.array([1.1, 0.0, 1.9]))
LIDARS = {
    "HDL-32": sensors.lidar_model("HDL-32", MOUNT, columns=240),
    "AT128": sensors.lidar_model("AT128", MOUNT, columns=60),
}
LIDARS["counterclockwise"] = dataclasses.replace(
    LIDARS["HDL-32"], spin=Spin.COUNTERCLOCKWISE, azimuth_rad=LIDARS["HDL-32"].azimuth_rad[::-1].copy()
)


@pytest.mark.needs_gl
@pytest.mark.parametrize("name", LIDARS)
def test_rasterised_turns_agree_with_rays(plan, rays, name):
    request = request_at(plan, LIDARS[name], 5.0, 100_000)
    assert np.linalg.norm(np.diff(request.world_from_sensor[:, :3, 3], axis=0)) > 0.2
    cast = rays.scan(request)
    with painted_world(plan, quality=Quality(lidar="rasterised")) as world:
        drawn = world.scan(request)
    assert np.mean((drawn.range_m > 0) == (cast.range_m > 0)) > 0.99
    same = (drawn.surface == cast.surface) & (drawn.instance == cast.instance)
    assert same.mean() > 0.97
    both = same & (drawn.range_m > 0) & (cast.range_m > 0)
    error = np.abs(drawn.range_m - cast.range_m)[both]
    assert np.median(error) < 1e-3 and np.quantile(error, 0.9) < 0.02
    assert np.quantile(np.abs(drawn.intensity - cast.intensity)[both], 0.9) < 0.02


def test_rays_backends_never_draw(plan):
    with true_world(plan, "rays", quality=Quality(lidar="rasterised")) as world:
        assert (world.scan(request_at(plan, LIDARS["AT128"], 1.0)).range_m > 0).any()


def test_faint_echoes_are_lost_more_often():
    far = drop_probability(np.full(5, 0.3), np.full(5, 0.7), np.array([5.0, 30.0, 60.0, 120.0, 240.0]))
    assert (np.diff(far) >= 0).all() and far[0] < 0.001 < 0.3 < far[-1]
    grazing = drop_probability(np.full(4, 0.12), np.array([1.0, 0.3, 0.1, 0.01]), np.full(4, 30.0))
    assert (np.diff(grazing) > 0).all()
    road = drop_probability(np.full(2, 0.12), np.array([1.9 / 20, 1.9 / 50]), np.array([20.0, 50.0]))
    assert road[0] < 0.05 and 0.3 < road[1] < 0.7
    glass, wall = drop_probability(np.array([0.03, 0.35]), np.ones(2), np.full(2, 10.0))
    assert glass > 0.7 and wall < 1e-6


def test_a_response_loses_beams_by_seed_and_keeps_the_others(plan, rays):
    lidar = LIDARS["HDL-32"]
    request = request_at(plan, lidar, 2.0, 100_000)
    ideal = rays.scan(request)
    with true_world(plan, "rays", responses={lidar.id: LidarResponse()}) as world:
        first, again = world.scan(request), world.scan(request)
        later = world.scan(request_at(plan, lidar, 2.5, 100_000))
    assert first.range_m.tobytes() == again.range_m.tobytes()
    lost = (ideal.range_m > 0) & (first.range_m == 0)
    assert 0.005 < lost.sum() / (ideal.range_m > 0).sum() < 0.5
    kept = first.range_m > 0
    np.testing.assert_array_equal(first.range_m[kept], ideal.range_m[kept])
    np.testing.assert_array_equal(first.intensity[kept], ideal.intensity[kept])
    assert (first.surface[lost] == SurfaceClass.SKY).all() and (first.intensity[lost] == 0).all()
    assert ideal.range_m[lost].mean() > ideal.range_m[kept].mean()
    assert ((later.range_m > 0) != kept).any()


def test_range_noise_has_its_size_and_no_response_has_none(plan, rays):
    lidar = LIDARS["AT128"]
    request = request_at(plan, lidar, 2.0)
    ideal = rays.scan(request)
    with true_world(plan, "rays", responses={lidar.id: LidarResponse(drop=0.0, range_noise_m=0.05)}) as world:
        noisy = world.scan(request)
    both = (ideal.range_m > lidar.range_m[0] + 0.5) & (noisy.range_m > 0)
    np.testing.assert_allclose((noisy.range_m - ideal.range_m)[both].std(), 0.05, rtol=0.1)
    assert ((noisy.range_m > 0) == (ideal.range_m > 0)).all()


def test_measured_points_are_beams_times_ranges(plan, rays):
    lidar = LIDARS["counterclockwise"]
    scan = rays.scan(request_at(plan, lidar, 2.0, 100_000))
    xyz, intensity, beam = measured_points(lidar, scan)
    rows, columns = np.unravel_index(beam, scan.range_m.shape)
    np.testing.assert_allclose(np.linalg.norm(xyz, axis=1), scan.range_m[rows, columns])
    np.testing.assert_allclose(np.arctan2(xyz[:, 2], np.hypot(*xyz[:, :2].T)), lidar.elevation_rad[rows], atol=1e-9)
    np.testing.assert_array_equal(intensity, scan.intensity[rows, columns])


@pytest.mark.parametrize("wrong", [{"drop": -1.0}, {"range_noise_m": np.inf}])
def test_impossible_lidars_are_refused(wrong):
    with pytest.raises(ValueError, match="drop and range_noise_m must be finite and not negative"):
        LidarResponse(**wrong)
    with pytest.raises(ValueError, match="lidar 'rays' or 'rasterised'; got 3, 2048, 'rays'"):
        Quality(samples=3)
