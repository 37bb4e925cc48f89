"""Broken, extreme and misplaced Gaussians, images of any size: frames are finite, in range, and otherwise right."""

import dataclasses

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from render_scenes import START_US, camera, cloud, gaussians, moved, psnr_db, request, scene, track

from nurec_sim import sensors
from nurec_sim.errors import TooLargeError
from nurec_sim.render import CpuRenderer, spec
from nurec_sim.render.requests import CAMERA_OUTPUTS
from nurec_sim.types import (
    CameraFrame,
    DynamicGaussians,
    Fisheye,
    FTheta,
    FThetaReference,
    Gaussians,
    Label,
    LidarModel,
    Shutter,
)

NAN, INF = float("nan"), float("inf")
WIDE_FISHEYE = Fisheye(8.0, 8.0, 18.0, 12.0, max_angle_rad=1.95)
FTHETA = FTheta(18.0, 12.0, FThetaReference.PIXELDIST_TO_ANGLE, (0.0, 0.08, 0.0, 2e-6), max_angle_rad=1.6)
SWEEP = sensors.lidar_model("VLP-16", np.eye(4), columns=60)
ASKED = [
    request(camera(36, 24)),
    request(camera(36, 24, shutter=Shutter.TOP_TO_BOTTOM), end_from_rig=moved()),
    request(camera(36, 24, WIDE_FISHEYE)),
    request(camera(36, 24, FTHETA, Shutter.LEFT_TO_RIGHT), end_from_rig=moved()),
    request(SWEEP),
    request(SWEEP, end_from_rig=moved()),
]
GOOD = cloud(150, 2, low=(1, -4, -2), high=(12, 4, 2), sh=3)


def everything(renderer, asked):
    """A frame with all that the renderer can give."""
    if isinstance(asked.sensor, LidarModel):
        return renderer.render_lidar(asked)
    return renderer.render_camera(asked, CAMERA_OUTPUTS)


def assert_sound(frame, world):
    """Everything of a frame is finite and in the range that its type promises."""
    if isinstance(frame, CameraFrame):
        assert frame.rgb.dtype == np.uint8 and frame.rgb.shape == (frame.camera.height_px, frame.camera.width_px, 3)
        assert (frame.alpha >= 0).all() and (frame.alpha <= 1).all()
        assert np.isfinite(frame.depth_m).all() and (frame.depth_m >= 0).all()
        present = {*world.static.label.tolist(), *world.dynamic.gaussians.label.tolist(), int(Label.SKY)}
        assert set(np.unique(frame.label).tolist()) <= present
        length = np.linalg.norm(frame.normal, axis=-1)
        assert (np.isclose(length, 1, atol=1e-3) | (length == 0)).all()
        return
    nearest, farthest = frame.lidar.range_m
    assert np.isfinite(frame.xyz_m).all() and (frame.range_m >= nearest).all() and (frame.range_m <= farthest).all()
    assert (frame.intensity >= 0).all() and (frame.intensity <= 1).all()
    beams = len(frame.lidar.elevation_rad) * len(frame.lidar.azimuth_rad)
    assert (np.diff(frame.beam) > 0).all() and (frame.beam >= 0).all() and (frame.beam < beams).all()


def all_frames(world, threads=2):
    renderer = CpuRenderer(world, threads=threads)
    return [everything(renderer, asked) for asked in ASKED]


def assert_same_frames(some, others):
    """Bit for bit."""
    for a, b in zip(some, others, strict=True):
        for field in dataclasses.fields(a):
            if isinstance(getattr(a, field.name), np.ndarray):
                assert np.array_equal(getattr(a, field.name), getattr(b, field.name)), field.name


# ------------------------------------------------------------------------------------------------ any broken Gaussians


def each(*values):
    return st.sampled_from(values)


POSITIONS = each(0.0, 0.2, 1e-30, 3.0, -5.0, 1e4, -1e12, 1e30, -1e30, 3e38, NAN, INF, -INF)
SCALES = each(0.0, -1.0, 1e-40, 1e-12, 1e-6, 0.3, 50.0, 1e6, 1e12, 1e30, 3e38, NAN, INF)
ROW = st.fixed_dictionaries(
    {},
    optional={
        "mean_m": st.tuples(POSITIONS, POSITIONS, POSITIONS),
        "quat_wxyz": each(
            (0, 0, 0, 0), (3, 1, -2, 0.5), (1e-30, 0, 0, 0), (1e30, 0, 0, 1e30), (NAN, 0, 0, 0), [INF] * 4
        ),
        "scale_m": st.tuples(SCALES, SCALES, SCALES),
        "opacity": each(-1.0, 0.0, 1e-40, 1 / 255, 0.99, 1.0, 5.0, NAN, INF),
        "rgb": st.tuples(*[each(0.0, 1.0, -3.0, 1e6, -1e30, 3e38, NAN, INF)] * 3),
        "normal": st.tuples(*[each(0.0, 1.0, -1.0, 1e30, NAN, INF)] * 3),
        "label": each(3, 4, 255),
        "intensity": each(NAN, 0.0, 1.0, -2.0, 1e30, INF, -INF),
        "ray_drop": each(NAN, 0.0, 1.0, -1.0, INF),
        "sh_rest": st.lists(each(0.0, 0.4, -1e3, 1e30, -3e38, NAN, INF, -INF), min_size=9, max_size=9),
    },
)
TIMES = each(-(10**15), -200_000, -1, 0, 1, 15_000, 200_000, 10**15)
MOTION = st.tuples(
    ROW, st.tuples(TIMES, TIMES, TIMES), st.lists(POSITIONS, min_size=9, max_size=9), each(-1, 0, 1, 2**31 - 1)
)


def in_view(n):
    """Gaussians that fill much of the view, to be spoilt."""
    mean = np.stack([np.linspace(3, 9, n), np.linspace(-1, 1, n), np.zeros(n)], axis=1) if n else np.zeros((0, 3))
    result = gaussians(mean.reshape(n, 3), scale=0.4, opacity=0.8, intensity=0.5)
    return dataclasses.replace(result, sh_rest=np.zeros((n, 3, 3), np.float32), ray_drop=np.zeros(n, np.float32))


def spoilt(rows):
    """``in_view`` with the fields that each row names replaced."""
    result = in_view(len(rows))
    for i, row in enumerate(rows):
        for name, value in row.items():
            field = getattr(result, name)
            field[i] = np.reshape(value, field[i].shape)
    return result


@pytest.mark.slow
@settings(max_examples=50, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.sampled_from(ASKED), st.lists(ROW, max_size=8), st.lists(MOTION, max_size=4))
def test_any_mixture_of_broken_gaussians(asked, rows, motions):
    dynamic = DynamicGaussians(
        spoilt([row for row, _, _, _ in motions]),
        START_US + np.array([times for _, times, _, _ in motions], np.int64).reshape(-1, 3),
        np.array([knots for _, _, knots, _ in motions], np.float32).reshape(-1, 3, 3),
        np.array([owner for _, _, _, owner in motions], np.int32),
    )
    world = scene(Gaussians.concatenate([GOOD, spoilt(rows)]), dynamic, [track()])
    assert_sound(everything(CpuRenderer(world, threads=1), asked), world)


BROKEN = [
    *({"mean_m": (3.0, value, 0.0)} for value in (NAN, INF, -INF)),
    *({"scale_m": (0.3, value, 0.3)} for value in (NAN, INF, -1.0)),
    *({"quat_wxyz": value} for value in ((0, 0, 0, 0), (NAN, 0, 0, 1), (INF, 0, 0, 0))),
    *({"opacity": value} for value in (NAN, -1.0, 0.0, 1e-40)),
    *({"rgb": (0.0, value, 0.0)} for value in (NAN, INF)),
    *({"sh_rest": [0.0, value] + [0.0] * 7} for value in (NAN, INF)),
]


def test_broken_gaussians_are_left_out_and_change_nothing_else():
    rng = np.random.default_rng(0)
    both = Gaussians.concatenate([GOOD, spoilt(BROKEN)])
    order = rng.permutation(len(both))
    good_only = order[order < len(GOOD)]
    got, expected = (all_frames(scene(both[rows]), threads=2) for rows in (order, good_only))
    assert_same_frames(got, expected)
    assert got[0].alpha.mean() > 0.2 and len(got[4].beam) > 20


OUT_OF_SIGHT = {
    "behind": {"mean": [-6.0, 0, 0]},
    "at the eye": {"mean": [0.0, 0, 0], "scale": 0.01},
    "nearer than the near plane": {"mean": [0.1, 0, 0], "scale": 0.01},
    "beyond the image": {"mean": [1.0, 60, 0], "scale": 0.5},
    "too small and far away": {"mean": [1e9, 1e9, 1e9], "scale": 1e-3},
    "far away, along no axis": {"mean": [-1e30, 1e30, 1e30]},
    "without extent": {"mean": [5.0, 0.01, 0.02], "scale": 0.0},
}


@pytest.mark.parametrize("where", list(OUT_OF_SIGHT))
def test_gaussians_out_of_sight_change_nothing(where):
    unseen = gaussians(**OUT_OF_SIGHT[where])
    good = dataclasses.replace(GOOD, sh_rest=None)
    for asked in ASKED[:2]:
        without = CpuRenderer(scene(good)).render_camera(asked)
        got = CpuRenderer(scene(Gaussians.concatenate([unseen, good]))).render_camera(asked)
        assert np.abs(got.rgb.astype(int) - without.rgb).max() <= 1
        assert np.abs(got.alpha - without.alpha).max() <= 2e-4
        assert (got.label == without.label).all()


# --------------------------------------------------------------------------------------------- extreme but well defined


def assert_close_to_spec(static, asked, least_db=60.0):
    world = scene(static)
    frame = everything(CpuRenderer(world, threads=2), asked)
    assert_sound(frame, world)
    assert psnr_db(frame.rgb, spec.render_camera(world, asked).rgb) >= least_db
    return frame


def test_the_camera_inside_of_a_gaussian():
    around = gaussians([[0.5, 0.1, 0.0]], scale=[2.0, 1.0, 3.0], opacity=0.7, rgb=(1, 0, 0))
    for asked in ASKED[:4]:
        frame = assert_close_to_spec(around, asked)
        assert frame.alpha.max() > 0.5


@pytest.mark.parametrize("x", [0.0, 0.1, np.nextafter(np.float32(0.2), np.float32(0)), 0.2, 0.2000001, 0.21])
def test_a_gaussian_at_the_eye_or_at_the_near_plane(x):
    for scale in (1e-3, 0.05, 1.0):
        static = gaussians([[x, 0.0, 0.0]], scale=scale, opacity=0.9)
        if abs(x - 0.2) > 1e-6:
            assert_close_to_spec(static, ASKED[0])
        renderer = CpuRenderer(scene(static), threads=2)
        for asked in (ASKED[0], ASKED[1], ASKED[4]):
            assert_sound(everything(renderer, asked), scene(static))


def test_thousands_at_one_depth():
    rng = np.random.default_rng(4)
    mean = np.zeros((4000, 3)) + (5.0, 0, 0)
    mean[1000:, 1:] = rng.uniform(-2, 2, (3000, 2))
    static = gaussians(
        mean, scale=[0.01, 0.1, 0.1], opacity=rng.uniform(0.01, 1.0, 4000), rgb=(0.2, 0.4, 0.6), intensity=0.5
    )
    world = scene(static)
    frames = all_frames(world, threads=1)
    for frame in frames:
        assert_sound(frame, world)
    assert_same_frames(frames, all_frames(world, threads=3))
    covered = frames[0].alpha > 0.999
    assert covered.any() and (np.abs(frames[0].depth_m[covered] - 5.0) < 0.02).all()
    assert (
        np.abs(frames[0].rgb[covered].astype(int) - (51, 102, 153)) <= 1
    ).all()  # all of one colour: no order to see


@pytest.mark.parametrize("scale", [(1e-5, 10, 10), (10, 1e-5, 10), (10, 10, 1e-5), (1e-5, 1e-5, 10), (1e6, 0.5, 0.5)])
def test_plates_and_needles_of_extreme_aspect(scale):
    rng = np.random.default_rng(1)
    static = gaussians(rng.uniform((3, -3, -2), (12, 3, 2), (12, 3)), scale=list(scale), opacity=0.6)
    static = dataclasses.replace(
        static, quat_wxyz=rng.normal(size=(12, 4)).astype(np.float32), rgb=rng.random((12, 3)).astype(np.float32)
    )
    assert_close_to_spec(static, ASKED[0], least_db=40)  # float32 holds such matrices to about a level
    world = scene(static)
    for frame in all_frames(world):
        assert_sound(frame, world)


def test_opacity_of_one_and_more_is_opaque_to_the_limit():
    for opacity in (0.99, 1.0, 5.0):
        opaque = scene(gaussians([[5.0, 0, 0]], scale=5.0, opacity=opacity), sky=0.0)
        frame = CpuRenderer(opaque).render_camera(ASKED[0])
        assert frame.alpha[12, 18] == pytest.approx(0.99, abs=1e-3)


# --------------------------------------------------------------------------------------------------------- any size


@pytest.mark.parametrize("width, height", [(1, 1), (1, 8192), (8192, 1), (7, 3), (33, 65)])
def test_images_of_any_size(width, height):
    size = max(width, height)
    for shutter in (Shutter.GLOBAL, Shutter.TOP_TO_BOTTOM):
        for lens in (
            None,
            dataclasses.replace(WIDE_FISHEYE, fx_px=size * 0.3, fy_px=size * 0.3, cx_px=width / 2, cy_px=height / 2),
        ):
            asked = request(camera(width, height, lens, shutter), end_from_rig=moved())
            assert_sound(everything(CpuRenderer(scene(GOOD), threads=2), asked), scene(GOOD))


@pytest.mark.parametrize("width, height", [(1, 1), (1, 40), (40, 1), (7, 3)])
def test_small_images_that_move(width, height):
    for shutter in Shutter:
        for lens in (None, dataclasses.replace(WIDE_FISHEYE, cx_px=width / 2, cy_px=height / 2)):
            asked = request(camera(width, height, lens, shutter), moved(0.0), moved(0.3, 1.0, 0.5))
            assert_close_to_spec(GOOD, asked)


def test_a_scene_of_nothing():
    for frame in all_frames(scene(sky=0.25)):
        assert_sound(frame, scene())
        if isinstance(frame, CameraFrame):
            assert set(np.unique(frame.rgb).tolist()) <= {0, 64} and not frame.alpha.any()
        else:
            assert len(frame.beam) == 0


def test_a_fisheye_sees_behind_itself():
    static = gaussians([[-0.5, 3.0, 0.0]], scale=0.4, opacity=0.95)
    frame = assert_close_to_spec(static, ASKED[2])
    assert frame.alpha.max() > 0.8


@pytest.mark.parametrize("rows, columns", [(1, 1), (1, 90), (8, 1)])
def test_lidars_of_few_beams(rows, columns):
    full = sensors.lidar_model("VLP-16", np.eye(4), columns=90)
    few = LidarModel(
        "few", np.linspace(0.05, -0.05, rows) if rows > 1 else np.zeros(1),
        full.azimuth_rad[:columns] if columns > 1 else np.zeros(1), np.zeros(rows), np.eye(4)
    )  # fmt: skip
    wall = gaussians([[8.0, 0, 0]], scale=[0.01, 3.0, 3.0], opacity=0.95)
    for asked in (request(few), request(few, end_from_rig=moved(0.0, 0.2, 0.0))):
        got, expected = CpuRenderer(scene(wall)).render_lidar(asked), spec.render_lidar(scene(wall), asked)
        assert_sound(got, scene(wall))
        assert len(got.beam) > 0 and np.array_equal(got.beam, expected.beam)
        assert np.abs(got.range_m - expected.range_m).max() < 2e-3


@pytest.mark.slow
def test_an_8k_image():
    ultra = camera(7680, 4320)
    renderer = CpuRenderer(scene(GOOD), threads=2)
    frame = everything(renderer, request(ultra))
    assert_sound(frame, scene(GOOD))
    small = renderer.render_camera(request(camera(480, 270)))
    # Centres of every 16th pixel of the large image, shifted by half a large pixel at most, are those of the small one.
    assert np.abs(frame.alpha[8::16, 8::16] - small.alpha).mean() < 0.01


def test_no_image_is_larger_than_8k():
    renderer = CpuRenderer(scene(GOOD), threads=2)
    with pytest.raises(TooLargeError, match="8193 x 1 pixels are too many"):
        renderer.render_camera(request(camera(8193, 1)))
    with pytest.raises(TooLargeError, match="10000 x 10000 pixels are too many"):
        renderer.render_camera(request(camera(10_000, 10_000)))
    with pytest.raises(TooLargeError, match="8192 x 8192 pixels are too many"):
        renderer.render_camera(request(camera(8192, 8192)))
