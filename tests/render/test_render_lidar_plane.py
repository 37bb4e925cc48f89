"""A simulated LiDAR on flat ground measures what geometry says, at 5 to 60 m."""

import dataclasses

import numpy as np
import pytest
from render_scenes import START_US, request, scene
from repetition import slow_after

from nurec_sim import geometry, sensors
from nurec_sim.reconstruct.lift import surfaces
from nurec_sim.render import CpuRenderer
from nurec_sim.types import Label

HEIGHT_M = 1.9
NEAR_M, FAR_M, BESIDE_M = 5.0, 60.0, 3.5


def ground(xyz_m):
    """What the reconstruction's surfaces need to know of points of a horizontal plane."""
    n = len(xyz_m)
    return {
        "xyz_m": xyz_m,
        "normal": np.tile([0.0, 0.0, 1.0], (n, 1)),
        "rgb": np.full((n, 3), 0.4),
        "intensity": np.full(n, 0.3, np.float32),
        "label": np.full(n, Label.ROAD, np.uint8),
        "opacity": 0.9,
    }


def discs(spacing_m=0.15):
    """One disc per LiDAR point, at jittered places."""
    x, y = np.meshgrid(np.arange(3, 75, spacing_m), np.arange(-6, 6, spacing_m))
    xyz = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    xyz[:, :2] += np.random.default_rng(0).uniform(-0.4, 0.4, (len(xyz), 2)) * spacing_m
    return surfaces.discs(**ground(xyz), sigma_m=np.full(len(xyz), surfaces.DISC_SIGMA * spacing_m))


def footprints(focal_px=200.0, camera_height_m=1.5):
    """One footprint per pixel of a camera that drives along and looks ahead, a frame each metre."""
    u, v, frame = np.mgrid[-170.0:170.0, 33.0:60.0, 0.0:70.0].reshape(3, -1)
    ray = np.stack([np.full(u.size, focal_px), -u, -v], axis=-1)
    distance = camera_height_m / v * focal_px
    xyz = ray / focal_px * distance[:, None] + np.stack([frame - 3, 0 * frame, 0 * frame + camera_height_m], axis=-1)
    near = np.abs(xyz[:, 1]) < 1.2 * BESIDE_M
    xyz, ray, pixel_m = xyz[near], ray[near], distance[near] / focal_px
    return surfaces.footprints(**ground(xyz), ray=ray / np.linalg.norm(ray, axis=1, keepdims=True), pixel_m=pixel_m)


@pytest.fixture(scope="module", params=[discs, footprints])
def plane(request):
    """Flat Gaussians on the plane z = 0, as a reconstruction makes them of LiDAR points or of pixels."""
    return request.param()


@pytest.mark.parametrize("device", ["HDL-64", "PANDAR128"])
@pytest.mark.parametrize("thick_m", slow_after(2, [0.001, 0.005, 0.003]))
def test_ranges_on_flat_ground(plane, thick_m, device):
    scale = plane.scale_m.copy()
    scale[:, 2] = thick_m
    mount = geometry.pose(np.eye(3), np.array([0.0, 0.0, HEIGHT_M]))
    lidar = sensors.lidar_model(device, mount)
    world = scene(dataclasses.replace(plane, scale_m=scale))
    frame = CpuRenderer(world, threads=2).render_lidar(request(lidar, end_us=START_US + 100_000))

    direction = sensors.beam_directions(lidar).reshape(-1, 3)
    with np.errstate(divide="ignore"):
        true_m = np.where(direction[:, 2] < 0, HEIGHT_M / -direction[:, 2], np.inf)
    covered = (direction[:, 0] > 0) & (NEAR_M < true_m) & (true_m < FAR_M)
    covered[covered] &= np.abs(direction[covered, 1] * true_m[covered]) < BESIDE_M
    assert covered.sum() > 3000
    returned = covered[frame.beam]
    error = frame.range_m[returned] / true_m[frame.beam[returned]] - 1
    far = true_m[frame.beam[returned]] > 30
    print(
        f"{device} {1000 * thick_m:.0f} mm: {returned.sum() / covered.sum():.1%} of {covered.sum()} beams return, "
        f"median error {np.median(np.abs(error)):.3%}, median shortfall {-np.median(error):+.3%}, "
        f"beyond 30 m {-np.median(error[far]):+.3%}"
    )
    assert returned.sum() > 0.9 * covered.sum()
    assert np.median(np.abs(error)) <= 0.003
    assert abs(np.median(error)) <= 0.001
    if thick_m <= surfaces.THINNEST_M:  # a grazing beam meets a thicker ground a little early
        assert abs(np.median(error[far])) <= 0.002
