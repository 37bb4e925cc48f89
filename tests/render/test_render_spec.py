"""The renderer's reference against numbers worked out by hand."""

import dataclasses

import numpy as np
import pytest
from render_scenes import LENSES, START_US, camera, cloud, gaussians, moved, request, row_of_walls, scene, track

from nurec_sim import geometry, sensors
from nurec_sim.render import spec
from nurec_sim.render.layers import drawable
from nurec_sim.render.unscented import unscented_projection
from nurec_sim.types import CameraModel, DynamicGaussians, Label, Pinhole, Shutter

AHEAD = (np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]))
"""Origin and direction of one ray along x."""
ONE_PIXEL = Pinhole(10.0, 10.0, 0.5, 0.5)


def blend(world, origin=AHEAD[0], direction=AHEAD[1], features=None, near_m=0.2):
    """Sums of rays through Gaussians that are given front to back."""
    features = world.rgb if features is None else features
    return spec.blend_rays(world, features, np.arange(len(world)), origin, direction, near_m)


def pixel(world, **kwargs):
    """The frame of a camera of one pixel that looks along x, over a black sky."""
    return spec.render_camera(scene(world, sky=0.0), request(camera(1, 1, ONE_PIXEL), **kwargs))


# ------------------------------------------------------------------------------------------------------------ response


@pytest.mark.parametrize("opacity, wanted", [(0.6, 0.6), (0.99, 0.99), (1.0, 0.99), (0.0039, 0.0), (0.004, 0.004)])
def test_the_centre_of_a_gaussian_shows_its_opacity_up_to_the_cap(opacity, wanted):
    sums = blend(gaussians([[10, 0, 0]], opacity=opacity))
    assert sums.alpha[0] == pytest.approx(wanted, rel=1e-6)
    assert sums.distance[0] == pytest.approx(10 * wanted)


def test_the_cap_is_on_the_opacity_and_not_on_the_response():
    beside = np.array([[0.0, 0.1, 0.0]])  # one standard deviation off
    assert blend(gaussians([[10, 0, 0]], opacity=1.0), beside).alpha[0] == pytest.approx(0.99 * np.exp(-0.5))


def test_the_response_falls_like_a_gaussian_in_the_axes_of_the_ellipsoid():
    turn = geometry.quat_from_matrix(geometry.rotation_from_yaw(0.4))
    world = gaussians([[10, 1, 0]], scale=(0.5, 0.2, 0.3), opacity=0.9, quat=turn)
    direction = np.array([[10, 1.1, 0.3]]) / np.linalg.norm([10, 1.1, 0.3])
    sums = blend(world, direction=direction)
    # The peak of the density along the ray, found by walking along it.
    t = np.linspace(9, 11, 200_001)
    offset = (t[:, None] * direction - [10, 1, 0]) @ geometry.rotation_from_yaw(0.4)
    q = ((offset / world.scale_m[0].astype(float)) ** 2).sum(axis=1)
    assert sums.alpha[0] == pytest.approx(0.9 * np.exp(-q.min() / 2), rel=1e-6)
    assert sums.distance[0] / sums.alpha[0] == pytest.approx(t[q.argmin()], abs=2e-5)


def test_hits_fainter_than_one_step_of_a_pixel_do_not_count():
    at = [np.sqrt(2 * np.log(255 * 0.9)) * 0.1 * factor for factor in (0.999, 1.001)]
    origin = np.array([[0, y, 0] for y in at])
    alpha = blend(gaussians([[10, 0, 0]], opacity=0.9), origin, np.repeat(AHEAD[1], 2, axis=0)).alpha
    assert alpha[0] == pytest.approx(1 / 255, rel=0.02) and alpha[1] == 0


def test_a_disc_is_as_thin_as_it_says_down_to_a_hundredth_of_a_millimetre():
    """Rays along it, one standard deviation above its middle; the thinnest counts as 0.01 mm."""
    for thickness_m, sigma_m in ((2e-5, 2e-5), (1e-6, 1e-5)):
        disc = gaussians([[10, 0, 0]], scale=(0.5, 0.5, thickness_m), opacity=0.9)
        assert blend(disc, np.array([[0.0, 0.0, sigma_m]])).alpha[0] == pytest.approx(0.9 * np.exp(-0.5), rel=1e-4)


def test_hits_nearer_than_near_do_not_count():
    slanted = geometry.quat_from_matrix(geometry.rotation_from_yaw(np.radians(80)))
    world = gaussians([[0.5, 0.4, 0]], scale=(0.5, 0.01, 0.5), quat=slanted)  # met at 0.43 m
    assert blend(world, near_m=0.4).alpha[0] > 0.5 and blend(world, near_m=0.45).alpha[0] == 0
    assert blend(gaussians([[-1, 0, 0]], scale=0.2)).alpha[0] == 0


# --------------------------------------------------------------------------------------------------------- compositing


def test_two_gaussians_blend_front_to_back():
    world = row_of_walls([5, 8], opacity=[0.4, 0.7], rgb=[[1, 0, 0], [0, 1, 0]], label=[1, 2])
    sums = blend(world)
    assert sums.features[0] == pytest.approx([0.4, 0.6 * 0.7, 0])
    assert sums.alpha[0] == pytest.approx(0.82)
    assert sums.distance[0] == pytest.approx(0.4 * 5 + 0.42 * 8)
    assert sums.half[0] == pytest.approx(8)
    assert sums.label[0] == 2
    frame = pixel(world)
    assert frame.rgb[0, 0].tolist() == [102, 107, 0]
    assert frame.depth_m[0, 0] == pytest.approx((0.4 * 5 + 0.42 * 8) / 0.82, rel=1e-5)
    assert frame.label[0, 0] == 2 and frame.alpha[0, 0] == pytest.approx(0.82)


def test_half_is_the_first_surface_that_stops_half_of_the_ray():
    assert blend(row_of_walls([5, 8], opacity=[0.5, 0.9])).half[0] == pytest.approx(5)
    assert blend(row_of_walls([5, 8], opacity=[0.3, 0.25])).half[0] == 0


def test_a_ray_ends_with_the_hit_that_leaves_a_ten_thousandth():
    opacity = [0.99, 0.9, 0.91, 0.9]  # transmittance 0.01, 0.001, 0.00009
    sums = blend(row_of_walls([2, 3, 4, 5], opacity=opacity), features=np.eye(4))
    assert sums.features[0] == pytest.approx([0.99, 0.009, 0.00091, 0], rel=1e-4)
    assert sums.alpha[0] == pytest.approx(1 - 0.00009, abs=1e-9)


def test_order_is_by_z_for_pinholes_and_by_distance_for_fisheyes():
    # The second lies deeper, but to the side the first is farther away.
    world = gaussians([[4, 4, 0], [5, 0, 0]], scale=20.0, opacity=0.5, rgb=[[1, 0, 0], [0, 1, 0]])
    for lens, first in ((LENSES["pinhole"], 0), (LENSES["fisheye"], 1), (LENSES["f-theta"], 1)):
        asked = request(camera(lens=lens))
        _, order = spec.visible_gaussians(scene(world), asked, spec.ray_grid(asked.sensor))
        assert order[0] == first


def test_centres_before_the_near_plane_are_culled():
    world = gaussians([[0.19, 0, 0], [0.1, 3, 0], [0.21, 0, 0]], scale=0.01)
    for lens, drawn in ((LENSES["pinhole"], [2]), (LENSES["fisheye"], [2, 1])):
        asked = request(camera(lens=lens))
        assert spec.visible_gaussians(scene(world), asked, spec.ray_grid(asked.sensor))[1].tolist() == drawn


def test_broken_gaussians_are_not_drawn():
    world = cloud(12)
    for row, name in enumerate(("mean_m", "quat_wxyz", "scale_m", "rgb", "opacity")):
        getattr(world, name)[row] = np.nan
    world.scale_m[5, 1], world.opacity[6], world.mean_m[7], world.quat_wxyz[8] = 0, 0, np.inf, 0
    asked = request(camera())
    frame = spec.render_camera(scene(world), asked)
    same = spec.render_camera(scene(world[9:]), asked)
    assert np.array_equal(frame.rgb, same.rgb) and np.array_equal(frame.depth_m, same.depth_m)


# ------------------------------------------------------------------------------------------------------ camera outputs


def test_labels_are_those_of_the_largest_weight():
    three = row_of_walls([5, 6, 7], opacity=[0.3, 0.6, 0.9], label=[1, 2, 0])  # weights 0.3, 0.42, 0.252
    assert pixel(three).label[0, 0] == 2
    assert pixel(row_of_walls([5], opacity=0.45, label=1)).label[0, 0] == Label.SKY


def test_depth_is_along_the_axis_and_only_where_there_is_a_surface():
    asked = request(camera(9, 9, Pinhole(4.0, 4.0, 4.5, 4.5)))
    frame = spec.render_camera(scene(row_of_walls([7], opacity=0.8)), asked)
    assert frame.depth_m == pytest.approx(np.full((9, 9), 7.0), rel=1e-5)
    assert not spec.render_camera(scene(row_of_walls([7], opacity=0.4)), asked).depth_m.any()


def test_normals_face_the_camera_in_the_world():
    world = row_of_walls([5, 6], opacity=[0.4, 0.9])
    towards, away = np.array([-0.6, 0.8, 0]), np.array([0.8, 0, 0.6])
    world.normal[:] = [towards, away]
    wanted = 0.4 * towards - 0.54 * away
    assert pixel(world).normal[0, 0] == pytest.approx(wanted / np.linalg.norm(wanted), abs=1e-6)
    # From a turned car the same surface has the same normal: the frame of normals is the world.
    turned = request(camera(1, 1, ONE_PIXEL), geometry.pose_from_xyyaw(10.0, 0.0, np.pi))
    seen = spec.render_camera(scene(world), turned).normal[0, 0]
    back = 0.9 * away - 0.1 * 0.4 * towards
    assert seen == pytest.approx(back / np.linalg.norm(back), abs=1e-6)


def test_no_normal_where_none_is_known_or_nothing_is_there():
    world = row_of_walls([5, 6], opacity=[0.6, 0.9])
    assert not pixel(world).normal.any()
    world.normal[1] = (-1, 0, 0)
    assert pixel(world).normal[0, 0].tolist() == [-1, 0, 0]
    assert not pixel(dataclasses.replace(world, opacity=np.float32([0.1, 0.3]))).normal.any()


def test_the_sky_fills_the_rest_and_the_colour_correction_comes_last():
    world = row_of_walls([5], opacity=0.25, rgb=(0.8, 0.4, 0.0))
    isp = {"front": np.array([[0.5, 0, 0, 0.1], [0, 1, 0.5, 0], [0, 0, 1, 0]])}
    asked = request(camera(1, 1, ONE_PIXEL))
    plain = 0.25 * np.array([0.8, 0.4, 0]) + 0.75 * 0.4
    shown = [0.5 * plain[0] + 0.1, plain[1] + 0.5 * plain[2], plain[2]]
    frame = spec.render_camera(scene(world, sky=0.4, isp=isp), asked)
    assert frame.rgb[0, 0].tolist() == spec.to_uint8(np.array(shown)).tolist()
    frame = spec.render_camera(scene(world, sky=0.4, isp=isp), asked, apply_isp=False)
    assert frame.rgb[0, 0].tolist() == spec.to_uint8(plain).tolist()


def test_pixels_outside_of_the_lens_are_black():
    lens = dataclasses.replace(LENSES["fisheye"], max_angle_rad=0.5)
    frame = spec.render_camera(scene(row_of_walls([5]), sky=1.0), request(camera(lens=lens)))
    assert not frame.rgb[0, 0].any() and frame.alpha[0, 0] == 0 and frame.label[0, 0] == Label.SKY
    assert frame.alpha[24, 36] > 0.8


@pytest.mark.parametrize("lens", list(LENSES))
def test_chosen_pixels_are_those_of_the_whole_image(lens):
    asked = request(camera(lens=LENSES[lens], shutter=Shutter.TOP_TO_BOTTOM), moved(0.02), moved(0.09, 0.7, 0.2))
    world = scene(cloud(), sky=np.random.default_rng(1).random((6, 4, 4, 3)))
    whole = spec.render_camera(world, asked)
    pixels = np.random.default_rng(2).choice(72 * 48, 60, replace=False)
    some = spec.render_camera(world, asked, pixels=pixels)
    for name in ("rgb", "depth_m", "alpha", "label", "normal"):
        plane = getattr(whole, name)
        assert np.array_equal(getattr(some, name)[0], plane.reshape(-1, *plane.shape[2:])[pixels])


def test_how_many_rays_are_looked_at_together_changes_nothing(monkeypatch):
    asked = request(camera(), moved(0.3))
    whole = spec.render_camera(scene(cloud()), asked)
    monkeypatch.setattr(spec, "PAIRS_AT_ONCE", 5000)
    pieces = spec.render_camera(scene(cloud()), asked)
    assert np.array_equal(whole.rgb, pieces.rgb) and np.allclose(whole.depth_m, pieces.depth_m, atol=1e-5)


def test_rays_that_cannot_meet_a_gaussian_are_skipped_without_loss():
    """Far from the origin, for tiny and huge Gaussians alike: what the cull leaves out has no weight."""
    rng = np.random.default_rng(4)
    world = cloud(300, 4)
    world.scale_m[::7] *= 40
    world.scale_m[::11] *= 0.05
    world = dataclasses.replace(world, mean_m=world.mean_m + np.float32([5000, -3000, 100]))
    origin = [5000.0, -3000.0, 100.0] + rng.normal(size=(200, 3))
    direction = spec.unit(rng.normal(size=(200, 3)))
    rotation = geometry.matrix_from_quat(world.quat_wxyz)
    canonical = np.swapaxes(rotation, 1, 2) / world.scale_m.astype(np.float64)[:, :, None]
    reach = world.scale_m.max(axis=1) * np.sqrt(np.maximum(2 * np.log(255 * world.opacity.astype(np.float64)), 0))
    near = spec.lines_near(origin, direction, world.mean_m.astype(np.float64), reach)
    for ray in range(len(origin)):
        o, d = (np.broadcast_to(v[ray], (len(world), 3)) for v in (origin, direction))
        alpha, _ = spec.response(o, d, world.mean_m.astype(np.float64), canonical, world.opacity.astype(np.float64))
        assert not (alpha >= 1 / 255)[~near[ray]].any()
    assert 0.01 < near.mean() < 0.5


# ---------------------------------------------------------------------------------------------------------------- time


def test_moving_gaussians_fade_between_their_knots():
    wall = row_of_walls([5], opacity=0.8)
    times = START_US + np.array([[-100_000, 0, 100_000]])
    knots = np.float32([[[4, 0, 0], [5, 0, 0], [7, 0, 0]]])
    layer = DynamicGaussians(wall, times, knots, np.full(1, -1, np.int32))
    for at_us, x, fade in ((-60_000, 4.4, 0.6), (50_000, 6.0, 0.5), (95_000, 6.9, 0.95)):
        start = START_US + at_us
        asked = request(camera(1, 1, ONE_PIXEL), start_us=start, end_us=start + 10)
        world = dataclasses.replace(scene(dynamic=layer, sky=0.0), span_us=(START_US - 200_000, START_US + 200_000))
        frame = spec.render_camera(world, asked)
        assert frame.alpha[0, 0] == pytest.approx(0.8 * np.exp(-(fade**10)), rel=1e-5)
        assert frame.depth_m[0, 0] == pytest.approx(x, rel=1e-4) if frame.alpha[0, 0] >= 0.5 else True


def test_an_actor_is_where_the_request_says():
    wall = gaussians([[6, 0, 0]], scale=(0.001, 1.0, 1.0), opacity=0.9)
    wall.normal[:] = (-1, 0, 0)
    times = START_US + np.array([[-400_000, 0, 400_000]])
    layer = DynamicGaussians(wall, times, wall.mean_m[:, None].repeat(3, axis=1), np.zeros(1, np.int32))
    car = track()
    there = geometry.pose_from_xyyaw(3.0, 0.0, 0.2 + np.pi / 3)  # recorded at (6, 0) with yaw 0.2
    asked = request(camera(1, 1, ONE_PIXEL), end_us=START_US + 2, actors={"car": np.stack([there, there])})
    frame = spec.render_camera(scene(dynamic=layer, tracks=[car]), asked)
    assert frame.depth_m[0, 0] == pytest.approx(3.0, abs=1e-3)
    assert frame.normal[0, 0] == pytest.approx([-0.5, -np.sqrt(0.75), 0], abs=1e-5)


def test_rows_of_a_rolling_shutter_start_from_their_own_poses():
    asked = request(camera(1, 5, Pinhole(1e4, 1e4, 0.5, 2.5), Shutter.TOP_TO_BOTTOM), end_from_rig=moved(0.0, 1.0, 0.0))
    frame = spec.render_camera(scene(row_of_walls([9])), asked)
    assert frame.depth_m[:, 0] == pytest.approx([9, 8.75, 8.5, 8.25, 8], abs=1e-4)


# ------------------------------------------------------------------------------------------------- unscented projection


@pytest.mark.parametrize("shutter", [Shutter.GLOBAL, Shutter.TOP_TO_BOTTOM, Shutter.RIGHT_TO_LEFT])
@pytest.mark.parametrize("lens", list(LENSES))
def test_the_unscented_projection_is_that_of_many_points(lens, shutter):
    rng = np.random.default_rng(6)
    sensor = camera(lens=LENSES[lens], shutter=shutter)
    poses = request(sensor, moved(0, 0, 0), moved(0.2, 1.0, 0.2)).world_from_sensor
    mean = np.array([[8.0, 1.5, 0.8], [6.0, -2.0, -0.5], [12.0, 0.0, 0.0]])
    rotation = geometry.matrix_from_quat(rng.normal(size=(3, 4)))
    scale = np.array([[0.6, 0.3, 0.02], [0.4, 0.4, 0.1], [0.8, 0.01, 0.3]])
    covariance = np.einsum("nij,nj,nkj->nik", rotation, scale**2, rotation)
    uv, spread, valid = unscented_projection(sensor, poses, mean, covariance)
    assert valid.all()
    for k in range(len(mean)):
        points = mean[k] + rng.normal(size=(20_000, 3)) * scale[k] @ rotation[k].T
        seen = sensors.project_rolling(sensor, poses, points)[0]
        sampled = np.cov(seen.T)
        assert np.abs(uv[k] - seen.mean(axis=0)).max() < 0.04 * np.sqrt(np.trace(sampled)) + 0.02
        # The rows of a 48 px image are coarse steps for a Gaussian of a few pixels.
        assert np.linalg.norm(spread[k] - sampled) < 0.12 * np.linalg.norm(sampled) + 0.02


def test_a_gaussian_that_the_lens_does_not_hold_has_no_image():
    sensor = camera()
    poses = request(sensor).world_from_sensor
    uv, spread, valid = unscented_projection(
        sensor, poses, np.array([[5.0, 0, 0], [-5, 0, 0]]), np.stack([np.eye(3) * 0.01] * 2)
    )
    assert valid.tolist() == [True, False]
    assert uv[0] == pytest.approx([36, 24], abs=1e-9) and np.isnan(uv[1]).all() and np.isnan(spread[1]).all()


def test_the_unscented_covariance_weighs_the_mean_twice():
    """A Gaussian at 10 m, as long as +-5 m at its points along the axis: u = 0.5 f, f / 3 and f beside its four others.

    In units of f its mean is (1/3 + 1 + 4/2) / 6 = 5/9, its variance 2 (1/18)^2 + (4 (1/18)^2 + (2/9)^2 + (4/9)^2) / 6.
    """
    lens = Pinhole(100.0, 100.0, 500.0, 500.0)
    sensor = CameraModel("front", 1000, 1000, lens, np.eye(4), Shutter.GLOBAL)
    covariance = np.diag([0.0, 0.0, 25 / 3])[None]
    uv, spread, _ = unscented_projection(sensor, np.stack([np.eye(4)] * 2), np.array([[5.0, 0.0, 10.0]]), covariance)
    assert uv[0] == pytest.approx([500 + 100 * 5 / 9, 500])
    assert spread[0, 0, 0] == pytest.approx(1e4 * (2 / 324 + (4 / 324 + 4 / 81 + 16 / 81) / 6))


def test_values_beyond_a_million_million_are_not_drawn():
    made = gaussians([[5e11, 0, 0], [2e12, 0, 0], [5, 0, 0], [5, 0, 0]])
    made.scale_m[2] = 2e12
    made.rgb[3] = 5e11
    assert drawable(made).tolist() == [True, False, False, True]
