"""The CPU renderer against its float64 reference."""

import dataclasses

import numpy as np
import pytest
from render_scenes import (
    LENSES,
    LIDARS,
    START_US,
    camera,
    cloud,
    moved,
    moving_cloud,
    psnr_db,
    request,
    scene,
    track,
)

from nurec_sim import geometry
from nurec_sim.render import CpuRenderer, spec
from nurec_sim.render.requests import CAMERA_OUTPUTS
from nurec_sim.types import LidarFilter, Shutter, Windshield, WindshieldReference


def assert_same_image(world, asked, least_db=60.0):
    renderer, expected = CpuRenderer(world, threads=2), spec.render_camera(world, asked)
    got = renderer.render_camera(asked, CAMERA_OUTPUTS)
    assert psnr_db(got.rgb, expected.rgb) >= least_db
    assert psnr_db(renderer.render_camera(asked).rgb, expected.rgb) >= least_db
    # A hit right at the cut of 1/255 may fall to either side.
    error = np.abs(got.alpha - expected.alpha)
    assert error.max() < 0.006 and (error > 5e-4).mean() < 2e-3
    # Weights that are as good as equal may give either label.
    assert (got.label != expected.label).mean() < 2e-3
    both = (got.depth_m > 0) & (expected.depth_m > 0)
    assert (got.depth_m > 0).mean() == pytest.approx((expected.depth_m > 0).mean(), abs=2e-3)
    if both.any():
        error = np.abs(got.depth_m - expected.depth_m)[both]
        assert np.median(error) < 1e-3 and np.quantile(error / expected.depth_m[both], 0.99) < 5e-3
    assert_same_normals(got.normal, expected.normal)


def assert_same_normals(got, expected):
    length = np.linalg.norm(got, axis=-1)
    assert np.isin(np.round(length, 5), (0, 1)).all()
    assert ((length > 0) != (np.linalg.norm(expected, axis=-1) > 0)).mean() < 2e-3
    error = np.linalg.norm(got - expected, axis=-1)[length > 0]
    if len(error):
        assert np.median(error) < 1e-3 and np.quantile(error, 0.99) < 0.02


@pytest.mark.parametrize("shutter", list(Shutter))
@pytest.mark.parametrize("lens", list(LENSES))
def test_every_lens_and_shutter(lens, shutter):
    sky = np.random.default_rng(1).random((6, 4, 4, 3))
    asked = request(camera(lens=LENSES[lens], shutter=shutter), moved(0.02, 0.1, 0.0), moved(0.09, 0.7, 0.2))
    assert_same_image(scene(cloud(), sky=sky), asked)


def test_windshield():
    glass = Windshield(
        WindshieldReference.FORWARD, (0.002, 1.01, 0.0, 0.003, 0.0, 0.0), (-0.001, 0.0, 0.002, 0.99, 0.0, 0.0)
    )
    assert_same_image(scene(cloud()), request(camera(windshield=glass)))


@pytest.mark.parametrize("seed", range(4))
def test_large_gaussians_around_the_camera(seed):
    static = cloud(60, seed, low=(-3, -3, -3), high=(3, 3, 3))
    static = dataclasses.replace(static, scale_m=static.scale_m * 2)
    for lens in ("pinhole", "wide pinhole", "fisheye"):
        assert_same_image(scene(static), request(camera(lens=LENSES[lens]), moved(seed * 1.3)))


@pytest.mark.parametrize("k", [3, 8, 15])
def test_spherical_harmonics(k):
    assert_same_image(scene(cloud(sh=k)), request(camera(), moved(0.5, 1.0, -1.0)))


def test_isp_and_its_switch():
    isp = {"front": np.array([[0.8, 0.1, 0, 0.05], [0, 0.7, 0.1, 0], [0.1, 0, 0.9, -0.1]])}
    world, asked = scene(cloud(), isp=isp), request(camera())
    assert_same_image(world, asked)
    plain = CpuRenderer(world, apply_isp=False).render_camera(asked)
    assert psnr_db(plain.rgb, spec.render_camera(world, asked, apply_isp=False).rgb) >= 60
    assert np.array_equal(plain.rgb, CpuRenderer(world).render_camera(dataclasses.replace(asked, apply_isp=False)).rgb)
    assert psnr_db(plain.rgb, CpuRenderer(world).render_camera(asked).rgb) < 30
    other = CpuRenderer(world).render_camera(request(camera(id="rear")))
    assert np.array_equal(other.rgb, plain.rgb)


@pytest.mark.parametrize("actors", [{}, {"car": geometry.pose_from_xyyaw(5.0, 1.0, 1.2)}, {"unknown": np.eye(4)}])
def test_moving_actors(actors):
    world = scene(cloud(), moving_cloud(), [track()])
    pairs = {name: np.stack([pose, moved() @ pose]) for name, pose in actors.items()}
    asked = request(camera(shutter=Shutter.TOP_TO_BOTTOM), end_from_rig=moved(), actors=pairs)
    assert_same_image(world, asked)
    without = CpuRenderer(scene(cloud())).render_camera(asked)
    assert psnr_db(without.rgb, CpuRenderer(world).render_camera(asked).rgb) < 40


def same_sweeps(world, asked, filter=None):
    """Both sweeps at the beams that return from both; all but 1 in 500 must."""
    got, expected = CpuRenderer(world, threads=2).render_lidar(asked, filter), spec.render_lidar(world, asked, filter)
    _, mine, theirs = np.intersect1d(got.beam, expected.beam, return_indices=True)
    assert len(mine) > 300
    assert len(mine) >= 0.998 * max(len(got.beam), len(expected.beam))
    for name in ("xyz_m", "range_m", "intensity", "beam"):
        yield getattr(got, name)[mine], getattr(expected, name)[theirs]


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("name", list(LIDARS))
def test_lidar(name, moving):
    static = cloud(400, 3, low=(-12, -12, -3), high=(12, 12, 3))
    world = scene(static, moving_cloud(), [track()])
    asked = request(
        LIDARS[name], moved(0.3), moved(0.42, 1.2, 0.3) if moving else moved(0.3), end_us=START_US + 100_000
    )
    xyz, distance, intensity, _ = same_sweeps(world, asked)
    error = np.abs(distance[0] - distance[1])
    assert np.median(error) < 1e-3 and np.quantile(error, 0.99) < 1e-2
    assert np.median(np.abs(xyz[0] - xyz[1])) < 1e-3
    assert np.quantile(np.abs(intensity[0] - intensity[1]), 0.99) < 1e-2


@pytest.mark.parametrize(
    "filter",
    [
        LidarFilter(),
        LidarFilter(raydrop_threshold=0.4),
        LidarFilter(opacity_threshold=0.2),
        LidarFilter(opacity_threshold=0.4, distance_threshold_m=0.7),
    ],
)
def test_lidar_filters(filter):
    """Every filter takes some beams, and the same ones as in the reference."""
    world = scene(cloud(1500, 3, low=(-12, -12, -3), high=(12, 12, 3), drop=True))
    asked = request(LIDARS["full"], moved(0.3), moved(0.42, 1.2, 0.3), end_us=START_US + 100_000)
    _, distance, _, beam = same_sweeps(world, asked, filter)
    assert np.median(np.abs(distance[0] - distance[1])) < 1e-3
    everything = LidarFilter(raydrop_threshold=1.0, opacity_threshold=0.01)
    assert len(beam[0]) < 0.9 * len(CpuRenderer(world).render_lidar(asked, everything).beam)


def test_small_gaussians_are_found_while_the_shutter_rolls():
    """Gaussians of about two pixels, which boxes that are too small by as much would lose."""
    world = cloud(300, 5, low=(4, -3, -2), high=(8, 3, 2))
    world = scene(dataclasses.replace(world, scale_m=np.full_like(world.scale_m, 0.04)))
    asked = request(camera(shutter=Shutter.TOP_TO_BOTTOM), moved(0.0, 0.0, 0.0), moved(0.002, 0.05, 0.0))
    got, expected = CpuRenderer(world).render_camera(asked), spec.render_camera(world, asked)
    assert (expected.alpha > 0.3).sum() > 100
    assert (np.abs(got.alpha - expected.alpha) > 0.02).sum() == 0


def test_a_frame_has_the_response_of_its_instant():
    """Half way between a frame shown as it is and one shown at half its brightness: three quarters."""
    times_us = np.array([[START_US, START_US], [START_US + 100_000, START_US + 100_000]])
    plain = scene(cloud())
    world = dataclasses.replace(
        plain,
        exposures={"front": np.stack([np.eye(3, 4), 0.5 * np.eye(3, 4)])},
        camera_times_us={"front": times_us},
    )
    asked = request(camera(), start_us=START_US + 40_000, end_us=START_US + 60_000)
    assert_same_image(world, asked)
    shown, full = (CpuRenderer(each).render_camera(asked).rgb.astype(float) for each in (world, plain))
    assert np.abs(shown - 0.75 * full).max() <= 1
    late = request(camera(), start_us=START_US + 900_000, end_us=START_US + 900_000)
    assert np.array_equal(world.response("front", late.middle_us), 0.5 * np.eye(3, 4))
