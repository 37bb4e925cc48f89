import dataclasses

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from nurec_sim import geometry, sensors
from nurec_sim.types import (
    CameraModel,
    Fisheye,
    FTheta,
    FThetaReference,
    Lens,
    Pinhole,
    Shutter,
    Windshield,
    WindshieldReference,
)

WIDTH, HEIGHT = 960, 540
SMALL = settings(max_examples=60, deadline=None)


def camera(lens: Lens, **changes) -> CameraModel:
    return dataclasses.replace(CameraModel("front", WIDTH, HEIGHT, lens, np.eye(4)), **changes)


def within(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


def tuples(*bounds: float) -> st.SearchStrategy[tuple[float, ...]]:
    return st.tuples(*(within(-bound, bound) for bound in bounds))


pinholes = st.builds(
    Pinhole,
    fx_px=within(300, 1500),
    fy_px=within(300, 1500),
    cx_px=within(400, 560),
    cy_px=within(200, 340),
    radial=tuples(0.45, 0.2, 0.05, 0.3, 0.1, 0.02),
    tangential=tuples(0.003, 0.003),
    thin_prism=tuples(0.002, 0.001, 0.002, 0.001),
)
fisheyes = st.builds(
    Fisheye,
    fx_px=within(200, 600),
    fy_px=within(200, 600),
    cx_px=within(400, 560),
    cy_px=within(200, 340),
    radial=tuples(0.1, 0.05, 0.02, 0.005),
    max_angle_rad=within(0.5, 1.9),
)
fthetas_by_angle = st.builds(
    lambda f, k, cde, cx, angle: FTheta(
        cx, 270.0, FThetaReference.ANGLE_TO_PIXELDIST, (), (0.0, f, *(f * c for c in k)), angle, cde
    ),
    within(200, 800),
    tuples(0.02, 0.1, 0.02, 0.01),
    st.tuples(within(0.9, 1.1), within(-0.01, 0.01), within(-0.01, 0.01)),
    within(400, 560),
    within(0.5, 1.7),
)
fthetas_by_distance = st.builds(
    lambda f, k, cx, angle: FTheta(
        cx,
        270.0,
        FThetaReference.PIXELDIST_TO_ANGLE,
        (0.0, 1 / f, *(c / f ** (power + 2) for power, c in enumerate(k))),
        (),
        angle,
    ),
    within(200, 800),
    tuples(0.02, 0.1, 0.02, 0.01),
    within(400, 560),
    within(0.5, 1.7),
)
lenses = st.one_of(pinholes, fisheyes, fthetas_by_angle, fthetas_by_distance)
near_identity = st.builds(
    lambda shift, gain, bend, cross: (shift, 1 + gain, bend, cross, bend / 2, bend / 3),
    within(-0.01, 0.01),
    within(-0.02, 0.02),
    within(-0.02, 0.02),
    within(-0.01, 0.01),
)
windshields = st.builds(
    lambda reference, h, v: Windshield(reference, *as_pair(reference, h, (v[0], v[3], v[2], v[1], v[4], v[5]))),
    st.sampled_from(list(WindshieldReference)),
    near_identity,
    near_identity,
)


def as_pair(reference: WindshieldReference, h: tuple, v: tuple) -> tuple:
    identity = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    return (h, v) if reference is WindshieldReference.FORWARD else (*identity, h, v)


def pixel_grid(step: int = 40) -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(0, WIDTH + 1, step), np.arange(0, HEIGHT + 1, step))
    return np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(np.float64)


@SMALL
@given(lens=lenses)
def test_projecting_a_pixels_ray_gives_the_pixel(lens):
    uv = pixel_grid()
    rays, valid = sensors.unproject(camera(lens), uv)
    again, seen = sensors.project(camera(lens), rays[valid])
    assert np.allclose(np.linalg.norm(rays[valid], axis=1), 1)
    # A ray at the very rim of the field may fall out of it by rounding, no other may.
    assert np.mean(seen) > 0.99 or not valid.any()
    assert np.abs(again[seen] - uv[valid][seen]).max(initial=0.0) < 1e-6
    assert np.isnan(rays[~valid]).all()


@SMALL
@given(lens=lenses, angles=st.lists(st.tuples(within(0, 1.2), within(-np.pi, np.pi)), min_size=1, max_size=20))
def test_the_ray_of_a_projected_point_leads_back_to_it(lens, angles):
    off, around = np.array(angles).T
    points = np.stack([np.sin(off) * np.cos(around), np.sin(off) * np.sin(around), np.cos(off)], axis=1)
    uv, valid = sensors.project(camera(lens), 7.0 * points)
    rays, seen = sensors.unproject(camera(lens), uv[valid])
    assert np.abs(rays[seen] - points[valid][seen]).max(initial=0.0) < 1e-6
    inner = off[valid] < 0.2
    assert seen[inner].all() and valid[off < 0.2].all()


@SMALL
@given(lens=lenses, glass=windshields)
def test_windshield_is_undone_by_its_other_direction(lens, glass):
    behind_glass = camera(lens, windshield=glass)
    uv = pixel_grid(60)
    rays, valid = sensors.unproject(behind_glass, uv)
    again, seen = sensors.project(behind_glass, rays[valid])
    assert np.abs(again[seen] - uv[valid][seen]).max(initial=0.0) < 1e-3
    centre = np.abs(uv[valid] - (480, 270)).max(axis=1) < 70
    assert seen[centre].all() and centre.any()


def test_windshield_bends_rays_by_its_polynomials_in_the_stated_order():
    # phi' = 0.01 + phi + 0.1 phi theta (powers: 1, phi, phi^2, theta, phi theta, theta^2), theta' = theta.
    glass = Windshield(WindshieldReference.FORWARD, (0.01, 1, 0, 0, 0.1, 0), (0, 0, 0, 1, 0, 0))
    phi, theta = 0.2, -0.1
    point = np.array([[np.sin(phi), np.sin(theta), np.sqrt(1 - np.sin(phi) ** 2 - np.sin(theta) ** 2)]])
    bent = 0.01 + phi + 0.1 * phi * theta
    inner = np.array([np.sin(bent), np.sin(theta), np.sqrt(1 - np.sin(bent) ** 2 - np.sin(theta) ** 2)])
    lens = Pinhole(500.0, 500.0, 480.0, 270.0)
    uv, _ = sensors.project(camera(lens, windshield=glass), 12 * point)
    assert np.allclose(uv[0], (480 + 500 * inner[0] / inner[2], 270 + 500 * inner[1] / inner[2]))


def test_pinhole_agrees_with_opencv():
    lens = Pinhole(
        700, 710, 470, 260, (-0.3, 0.1, -0.02, 0.05, 0.01, 0.002), (0.001, -0.002), (0.001, 0.002, -0.001, 0)
    )
    points = np.random.default_rng(1).uniform((-0.6, -0.4, 1), (0.6, 0.4, 1), (200, 3))
    matrix = np.array([[700, 0, 470], [0, 710, 260], [0, 0, 1.0]])
    coefficients = np.array([*lens.radial[:2], *lens.tangential, *lens.radial[2:], *lens.thin_prism])
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]
    ours, valid = sensors.project(camera(lens), points)
    assert valid.all()
    assert np.abs(ours - theirs).max() < 1e-9


def test_fisheye_agrees_with_opencv():
    lens = Fisheye(300, 310, 480, 270, (0.05, -0.01, 0.003, -0.001))
    points = np.random.default_rng(2).uniform((-2, -2, 1), (2, 2, 1), (200, 3))
    matrix = np.array([[300, 0, 480], [0, 310, 270], [0, 0, 1.0]])
    theirs = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(lens.radial))[0]
    ours, valid = sensors.project(camera(lens), points)
    assert valid.all()
    assert np.abs(ours - theirs[:, 0]).max() < 1e-9


def test_ftheta_follows_its_reference_polynomial_and_matrix():
    lens = FTheta(
        480.0, 270.0, FThetaReference.ANGLE_TO_PIXELDIST, (0.0, 99.0), (0.0, 400.0, 10.0), 1.5, (1.1, 0.01, 0.02)
    )
    angle, around = 0.5, 0.7
    point = [[np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)]]
    r = 400 * angle + 10 * angle**2
    u, v = r * np.cos(around), r * np.sin(around)
    uv, _ = sensors.project(camera(lens), np.array(point))
    assert np.allclose(uv[0], (1.1 * u + 0.01 * v + 480, 0.02 * u + v + 270))


@pytest.mark.parametrize("angle, seen", [(1.19, True), (1.21, False)])
def test_angles_beyond_the_maximum_are_not_seen(angle, seen):
    point = np.array([[np.sin(angle), 0, np.cos(angle)]])
    by_angle = FTheta(480, 270, FThetaReference.ANGLE_TO_PIXELDIST, (), (0, 400.0), 1.2)
    by_distance = FTheta(480, 270, FThetaReference.PIXELDIST_TO_ANGLE, (0, 1 / 400.0), (), 1.2)
    for lens in (by_angle, by_distance, Fisheye(400, 400, 480, 270, max_angle_rad=1.2)):
        uv, valid = sensors.project(camera(lens), point)
        assert valid[0] == seen
        assert np.isnan(uv).all() != seen
        assert sensors.unproject(camera(lens), np.array([[480 + 400 * angle, 270]]))[1][0] == seen


def test_a_fold_of_the_distortion_draws_no_ghosts():
    lens = Pinhole(500, 500, 480, 270, (-0.35, 0, 0, 0, 0, 0))  # r - 0.35 r^3 turns at r = 0.976
    slope = lambda r: 1 - 3 * 0.35 * r**2  # noqa: E731
    r = np.linspace(0, 5, 400)
    _, valid = sensors.project(camera(lens), np.stack([r, 0 * r, 1 + 0 * r], axis=1))
    assert np.array_equal(valid, slope(r) >= 0.05)


def test_points_behind_or_not_finite_are_not_valid():
    points = np.array([[0, 0, -1], [0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 1], [0, 0, 1.0]])
    uv, valid = sensors.project(camera(Pinhole(500, 500, 480, 270, (-0.1, 0, 0, 0, 0, 0))), points)
    assert valid.tolist() == [False, False, False, False, True]
    assert np.isnan(uv[:4]).all() and np.allclose(uv[4], (480, 270))


def test_pixel_rays_pass_through_pixel_centres():
    rays, valid = sensors.pixel_rays(camera(Pinhole(500, 400, 480, 270)))
    assert rays.shape == (HEIGHT, WIDTH, 3) and valid.all()
    expected = np.array([(100.5 - 480) / 500, (20.5 - 270) / 400, 1])
    assert np.allclose(rays[20, 100], expected / np.linalg.norm(expected))


def test_in_image_is_half_open():
    uv = np.array([[0, 0], [959.99, 539.99], [960, 10], [10, 540], [-0.01, 5], [np.nan, 5]])
    seen = sensors.in_image(camera(Pinhole(500, 500, 480, 270)), uv)
    assert seen.tolist() == [True, True, False, False, False, False]


def test_shutter_fractions_of_all_directions():
    uv = np.array([[0.5, 0.5], [WIDTH - 0.5, 0.5], [0.5, HEIGHT - 0.5]])
    lens = Pinhole(500, 500, 480, 270)
    expected = {
        Shutter.GLOBAL: [0, 0, 0],
        Shutter.TOP_TO_BOTTOM: [0, 0, 1],
        Shutter.BOTTOM_TO_TOP: [1, 1, 0],
        Shutter.LEFT_TO_RIGHT: [0, 1, 0],
        Shutter.RIGHT_TO_LEFT: [1, 0, 1],
    }
    for shutter, values in expected.items():
        assert sensors.shutter_fraction(camera(lens, shutter=shutter), uv).tolist() == values
    row = sensors.shutter_fraction(camera(lens, shutter=Shutter.TOP_TO_BOTTOM), np.array([[3.0, 100.99]]))
    assert row[0] == 100 / (HEIGHT - 1)
    one_row = camera(lens, height_px=1, shutter=Shutter.BOTTOM_TO_TOP)
    assert np.isfinite(sensors.shutter_fraction(one_row, uv)).all()


@pytest.mark.parametrize("shutter", list(Shutter))
def test_rolling_projection_is_consistent_with_the_pose_of_its_own_row(shutter):
    lens = Fisheye(300, 300, 480, 270, (0.02, 0, 0, 0))
    moving = camera(lens, shutter=shutter)
    start = geometry.pose(np.eye(3), np.zeros(3))
    end = geometry.pose(geometry.rotation_from_yaw(0.02), np.array([0.3, -0.1, 0.5]))
    points = np.random.default_rng(3).uniform((-6, -4, 4), (6, 4, 20), (500, 3))
    uv, valid, fraction = sensors.project_rolling(moving, np.stack([start, end]), points)
    assert valid.mean() > 0.9
    assert np.array_equal(fraction[valid], sensors.shutter_fraction(moving, uv[valid]))
    for index in np.flatnonzero(valid)[::25]:
        pose = geometry.interpolate_pose_pair(np.stack([start, end]), fraction[index])
        expected, _ = sensors.project(
            moving, geometry.transform_points(geometry.inverse(pose), points[index : index + 1])
        )
        # The pose is constant along a row: a point between two rows may be drawn by either of them.
        assert np.abs(expected[0] - uv[index]).max() < 0.3


def test_a_point_that_only_the_end_pose_sees_is_projected():
    ahead = geometry.pose(np.eye(3), np.array([0, 0, -3.0]))
    moving = camera(Pinhole(500, 500, 480, 270), shutter=Shutter.TOP_TO_BOTTOM)
    below = np.array([[0.0, 1.0, -0.2]])
    uv, valid, fraction = sensors.project_rolling(moving, np.stack([np.eye(4), ahead]), below)
    assert valid[0] and 0 < fraction[0] <= 1 and np.isfinite(uv).all()


@SMALL
@given(lens=lenses, width=st.integers(30, 2000), height=st.integers(30, 2000))
def test_scaling_keeps_the_field_of_view(lens, width, height):
    full = camera(lens)
    scaled = sensors.scaled_camera(full, width, height)
    points = np.random.default_rng(0).uniform((-1, -1, 1), (1, 1, 3), (50, 3))
    before, seen_before = sensors.project(full, points)
    after, seen_after = sensors.project(scaled, points)
    both = seen_before & seen_after
    assert (seen_before == seen_after).mean() > 0.95
    assert np.allclose(after[both], before[both] * (width / WIDTH, height / HEIGHT), atol=1e-6 * max(width, height))


@pytest.mark.slow
@SMALL
@given(lens=st.one_of(fthetas_by_angle, fthetas_by_distance))
def test_fill_ftheta_adds_the_missing_polynomial(lens):
    distance = np.linspace(0, 300, 25)
    rays, valid = sensors.unproject(camera(lens), np.stack([lens.cx_px + 0 * distance, 270 + distance], axis=1))
    slope = np.diff(np.arccos(np.clip(rays[valid, 2], -1, 1)))
    # At the fold of a lens the inverse is vertical: a polynomial of few coefficients does not follow it.
    assume(slope.min() > 0.3 * slope[0])
    filled = sensors.fill_ftheta(lens, 300.0)
    assert len(filled.pixeldist_to_angle) >= 6 and len(filled.angle_to_pixeldist) >= 6
    distance = np.linspace(0, 250, 20)
    rays, valid = sensors.unproject(camera(lens), np.stack([lens.cx_px + 0 * distance, 270 + distance], axis=1))
    angle = np.arccos(np.clip(rays[valid, 2], -1, 1))
    again = np.polynomial.polynomial.polyval(angle, filled.angle_to_pixeldist)
    c, d, _ = lens.linear_cde
    stretched = np.hypot(d / (c - d * lens.linear_cde[2]), c / (c - d * lens.linear_cde[2])) * distance[valid]
    assert np.abs(again - stretched).max(initial=0.0) < 3.0
    assert sensors.fill_ftheta(filled, 300.0) is filled


@pytest.mark.parametrize(
    "lens, error_px",
    [
        (Pinhole(900, 905, 470, 280), 0.05),
        (Pinhole(700, 700, 480, 270, (-0.2, 0.05, 0, 0, 0, 0)), 0.5),
        (Fisheye(400, 400, 480, 270, (0.03, -0.01, 0, 0)), 0.1),
        (FTheta(480, 270, FThetaReference.ANGLE_TO_PIXELDIST, (), (0, 500, 3, -10), 1.4), 1e-6),
    ],
)
def test_fit_ftheta_stands_in_for_any_lens(lens, error_px):
    fitted = sensors.fit_ftheta(camera(lens))
    rays, valid = sensors.pixel_rays(camera(lens))
    uv, seen = sensors.project(camera(fitted), rays[::20, ::20].reshape(-1, 3))
    expected, _ = sensors.project(camera(lens), rays[::20, ::20].reshape(-1, 3))
    assert seen.mean() > 0.99
    assert np.abs(uv[seen] - expected[seen]).max() < error_px
    sensors.check_camera(camera(fitted))


@pytest.mark.parametrize(
    "changes, text",
    [
        ({"width_px": 0}, "camera 'front': an image needs at least 1 x 1 pixels, got 0 x 540"),
        ({"lens": Pinhole(-1, 500, 480, 270)}, "focal lengths must be positive, got -1, 500"),
        ({"lens": Pinhole(500, 500, np.nan, 270)}, "focal length and principal point must be finite"),
        ({"lens": Pinhole(500, 500, 480, 270, (0.1,))}, "radial needs 6 coefficients, got 1"),
        ({"lens": Fisheye(500, 500, 480, 270, (0.1,) * 6)}, "radial needs 4 coefficients, got 6"),
        ({"lens": Fisheye(500, 500, 480, 270, max_angle_rad=4.0)}, "max_angle_rad must lie in \\(0, pi\\], got 4.0"),
        ({"lens": FTheta(480, 270, FThetaReference.ANGLE_TO_PIXELDIST)}, "needs pixeldist_to_angle or angle_to"),
        ({"lens": FTheta(1, 1, FThetaReference.ANGLE_TO_PIXELDIST, (), (0, -1))}, "must rise from the axis outwards"),
        ({"lens": FTheta(1, 1, FThetaReference.ANGLE_TO_PIXELDIST, (), (0, 9), 1, (1, 1, 1))}, "without an inverse"),
        ({"lens": "pinhole"}, "the lens, a str, lacks kind, perspective, cx_px"),
        ({"rig_from_camera": np.diag([1.0, 1, -1, 1])}, "rig_from_camera has a 3 x 3 part that is not a rotation"),
        ({"rig_from_camera": np.full((4, 4), np.nan)}, "rig_from_camera must be finite"),
        ({"rig_from_camera": np.eye(3)}, "rig_from_camera must be 4 x 4, got 3 x 3"),
        ({"windshield": Windshield(WindshieldReference.FORWARD, (0, 1), (0, 0, 1))}, "1, 3, 6, 10, 15 or 21"),
        ({"windshield": Windshield(WindshieldReference.FORWARD, (0, 1, 0), (0, 0, 1), (0, 1, 0))}, "both inverse"),
        ({"windshield": Windshield(WindshieldReference.FORWARD, (0, np.inf, 0), (0, 0, 1))}, "must be finite"),
    ],
)
def test_check_camera_says_what_is_wrong(changes, text):
    with pytest.raises(ValueError, match=text):
        sensors.check_camera(camera(**{"lens": Pinhole(500, 500, 480, 270), **changes}))


def test_no_points_are_no_trouble():
    for lens in (
        Pinhole(5, 5, 2, 2, (0.1,) * 6),
        Fisheye(5, 5, 2, 2),
        FTheta(1, 1, FThetaReference.ANGLE_TO_PIXELDIST, (), (0, 9)),
    ):
        glass = Windshield(WindshieldReference.BACKWARD, (0, 1, 0), (0, 0, 1), (0, 1, 0), (0, 0, 1))
        empty = camera(lens, windshield=glass, shutter=Shutter.TOP_TO_BOTTOM)
        assert sensors.project(empty, np.zeros((0, 3)))[0].shape == (0, 2)
        assert sensors.unproject(empty, np.zeros((0, 2)))[0].shape == (0, 3)
        pair = np.stack([np.eye(4), geometry.pose_from_xyyaw(1, 0, 0)])
        assert len(sensors.project_rolling(empty, pair, np.zeros((0, 3)))[2]) == 0
