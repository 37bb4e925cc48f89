"""What rendered frames contain, checked by hand; determinism and concurrency."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from render_scenes import START_US, camera, cloud, gaussians, moved, moving_cloud, request, scene, track

from nurec_sim import geometry, sensors
from nurec_sim.render import CpuRenderer, encode_image, spec
from nurec_sim.render.layers import moving_gaussians, sh_basis
from nurec_sim.types import DynamicGaussians, Gaussians, Label, LidarFilter, Shutter


def test_one_gaussian_is_where_it_should_be():
    world = scene(gaussians([[10.0, 1.0, 0.5]], scale=0.15, opacity=0.95, rgb=(1, 0, 0), label=2), sky=0.0)
    frame = CpuRenderer(world).render_camera(request(camera(101, 61)))
    weight = frame.rgb[..., 0].astype(float)
    rows, columns = np.mgrid[0:61, 0:101] + 0.5
    focal = 101 * 0.65
    assert (weight * columns).sum() / weight.sum() == pytest.approx(50.5 - focal * 0.1, abs=0.02)
    assert (weight * rows).sum() / weight.sum() == pytest.approx(30.5 - focal * 0.05, abs=0.02)
    v, u = np.unravel_index(frame.alpha.argmax(), frame.alpha.shape)
    assert frame.depth_m[v, u] == pytest.approx(10.0, abs=0.03)
    assert frame.label[v, u] == Label.MOVABLE
    assert frame.label[0, 0] == Label.SKY and frame.depth_m[0, 0] == 0 and frame.alpha[0, 0] == 0


@pytest.mark.parametrize("swap", [False, True])
def test_the_nearer_one_is_in_front(swap):
    both = gaussians([[5.0, 0, 0], [8.0, 0, 0]], scale=0.5, opacity=0.8)
    both = dataclasses.replace(both, rgb=np.float32([[1, 0, 0], [0, 1, 0]]))
    world = scene(both[np.array([1, 0])] if swap else both, sky=0.0)
    frame = CpuRenderer(world).render_camera(request(camera(33, 33)))
    assert tuple(frame.rgb[16, 16]) == (204, 41, 0)  # 0.8 red, then 0.8 of the rest green


def wall(distance=12.0, step=0.2):
    """A flat wall across x = distance."""
    y, z = np.meshgrid(np.arange(-12, 12, step), np.arange(-8, 8, step))
    mean = np.stack([np.full(y.size, distance), y.ravel(), z.ravel()], axis=-1)
    return gaussians(mean, scale=[0.005, 0.15, 0.15], opacity=0.9, label=1, intensity=0.25)


def test_a_flat_wall_has_flat_depth():
    frame = CpuRenderer(scene(wall())).render_camera(request(camera()))
    assert frame.alpha.min() > 0.98
    assert np.abs(frame.depth_m - 12.0).max() < 0.01
    assert (frame.label == Label.ROAD).all()


def test_lidar_measures_a_wall_while_driving():
    lidar = sensors.lidar_model("VLP-16", geometry.pose(np.eye(3), np.array([0, 0, 0.0])), columns=720)
    asked = request(lidar, np.eye(4), moved(0.1, 1.0, 0.2), end_us=START_US + 100_000)
    frame = CpuRenderer(scene(wall())).render_lidar(asked)
    assert len(frame.beam) > 500
    world = geometry.transform_points(asked.world_from_sensor[1], frame.xyz_m)
    assert np.abs(world[:, 0] - 12.0).max() < 0.02
    assert np.allclose(frame.intensity, 0.25, atol=1e-4)
    # Each beam left from where its own column fired.
    column = frame.beam % 720
    fired = geometry.interpolate_pose_pair(asked.world_from_sensor, column / 719)
    assert np.allclose(np.linalg.norm(world - fired[:, :3, 3], axis=1), frame.range_m, atol=1e-3)


def test_lidar_threshold_range_and_unknown_intensity():
    lidar = sensors.lidar_model("VLP-16", np.eye(4), columns=360)
    thin = dataclasses.replace(wall(), opacity=np.full(len(wall()), 0.12, np.float32))
    thin = dataclasses.replace(thin, intensity=np.full(len(thin), np.nan, np.float32))
    renderer = CpuRenderer(scene(thin))
    assert len(renderer.render_lidar(request(lidar), LidarFilter(opacity_threshold=0.9)).beam) == 0
    some = renderer.render_lidar(request(lidar), LidarFilter(opacity_threshold=0.05))
    assert len(some.beam) > 0 and (some.intensity == 0).all()
    short = dataclasses.replace(lidar, range_m=(0.5, 5.0))
    assert len(CpuRenderer(scene(wall())).render_lidar(request(short)).beam) == 0


@pytest.mark.slow
def test_lidar_reports_the_surface_and_no_mean_of_two():
    lidar = sensors.lidar_model("VLP-16", np.eye(4), columns=180)
    veil = dataclasses.replace(wall(6.0), opacity=np.full(len(wall()), 0.12, np.float32))
    both = scene(Gaussians.concatenate([veil, wall(12.0)]))
    for frame in (CpuRenderer(both).render_lidar(request(lidar)), spec.render_lidar(both, request(lidar))):
        ahead = frame.xyz_m[np.abs(frame.xyz_m[:, 1]) < 2.0]
        assert len(ahead) > 20
        assert np.abs(ahead[:, 0] - 12.0).max() < 0.05


def test_fade_and_motion_between_knots():
    layer = DynamicGaussians(
        gaussians([[5.0, 0, 0]], opacity=0.8),
        np.array([[START_US - 100_000, START_US, START_US + 200_000]]),
        np.array([[[4.0, 0, 0], [5.0, 0, 0], [7.0, 1, 0]]], np.float32),
        np.array([-1], np.int32),
    )

    def at(t_us):
        return moving_gaussians(layer, [], t_us, {}, np.zeros(3))

    assert np.allclose(at(START_US).mean_m, [[5, 0, 0]]) and np.allclose(at(START_US).opacity, 0.8)
    assert np.allclose(at(START_US + 100_000).mean_m, [[6, 0.5, 0]])
    assert np.allclose(at(START_US + 100_000).opacity, 0.8 * np.exp(-(0.5**10)))
    assert np.allclose(at(START_US + 200_000).opacity, 0.8 * np.exp(-1))
    assert np.allclose(at(START_US - 50_000).mean_m, [[4.5, 0, 0]])
    assert len(at(START_US - 100_001)) == 0 and len(at(START_US + 200_001)) == 0


def test_a_reposed_actor_carries_its_gaussians():
    layer, path = moving_cloud(), track()
    there = geometry.pose_from_xyyaw(20.0, -3.0, 1.0, 0.5)
    recorded = moving_gaussians(layer, [path], START_US, {}, np.zeros(3))
    posed = moving_gaussians(layer, [path], START_US, {"car": there}, np.zeros(3))
    motion = there @ geometry.inverse(path.path.at(START_US))
    assert np.allclose(posed.mean_m, geometry.transform_points(motion, recorded.mean_m), atol=1e-4)
    turned = motion[:3, :3] @ geometry.matrix_from_quat(recorded.quat_wxyz)
    assert np.allclose(geometry.matrix_from_quat(posed.quat_wxyz), turned, atol=1e-5)


def test_view_dependent_colour_turns_with_its_actor():
    layer, path = moving_cloud(), track()
    rng = np.random.default_rng(0)
    sh = dataclasses.replace(layer.gaussians, sh_rest=rng.normal(0, 0.2, (len(layer), 8, 3)).astype(np.float32))
    layer = dataclasses.replace(layer, gaussians=sh)
    motion = geometry.pose_from_xyyaw(3.0, 4.0, 2.0)
    eye = np.array([1.0, 2.0, 3.0])
    recorded = moving_gaussians(layer, [path], START_US, {}, eye)
    there = motion @ path.path.at(START_US)
    posed = moving_gaussians(layer, [path], START_US, {"car": there}, geometry.transform_points(motion, eye))
    assert np.allclose(posed.rgb, recorded.rgb, atol=1e-5)


def test_harmonics_are_orthonormal():
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(200_000, 3))
    basis = sh_basis(direction / np.linalg.norm(direction, axis=1, keepdims=True), 15)
    assert np.allclose(basis.T @ basis / len(basis) * 4 * np.pi, np.eye(15), atol=0.05)


def test_the_sky_is_looked_up_in_the_world():
    sky = geometry.cubemap_directions(64) * 0.5 + 0.5
    asked = request(camera(), geometry.pose_from_xyyaw(3, 4, 0.7))
    frame = CpuRenderer(scene(sky=sky)).render_camera(asked)
    rays, _ = sensors.pixel_rays(asked.sensor)
    world = rays @ asked.world_from_sensor[0, :3, :3].T
    assert np.abs(frame.rgb / 255 - (world * 0.5 + 0.5)).max() < 0.02


def test_same_bytes_at_any_thread_count():
    world = scene(cloud(3000, sh=3), moving_cloud(), [track()])
    asked = [
        request(camera(150, 90, shutter=Shutter.TOP_TO_BOTTOM), end_from_rig=moved()),
        request(camera(150, 90)),
        request(sensors.lidar_model("VLP-16", np.eye(4), columns=300), end_from_rig=moved()),
    ]
    one, many = CpuRenderer(world, threads=1).sense(asked), CpuRenderer(world, threads=5).sense(asked)
    for a, b in zip(one, many, strict=True):
        for field in dataclasses.fields(a):
            if isinstance(getattr(a, field.name), np.ndarray):
                assert np.array_equal(getattr(a, field.name), getattr(b, field.name)), field.name


def test_many_threads_share_a_renderer():
    world = scene(cloud(1000), moving_cloud(), [track()])
    renderer = CpuRenderer(world, threads=2)
    asked = [request(camera(60 + 8 * k, 40), moved(0.1 * k)) for k in range(6)]
    alone = [CpuRenderer(world, threads=1).render_camera(each).rgb for each in asked]
    with ThreadPoolExecutor(6) as pool:
        together = list(pool.map(lambda each: renderer.render_camera(each).rgb, asked * 4))
    for k, rgb in enumerate(together):
        assert np.array_equal(rgb, alone[k % 6])


def test_empty_and_broken_gaussians():
    asked = [request(camera()), request(sensors.lidar_model("VLP-16", np.eye(4), columns=90))]
    image, sweep = CpuRenderer(scene(sky=0.25)).sense(asked)
    assert (image.rgb == 64).all() and (image.label == Label.SKY).all() and len(sweep.beam) == 0
    broken = gaussians(np.tile([[5.0, 0, 0]], (6, 1)))
    broken.mean_m[0] = np.nan
    broken.quat_wxyz[1] = 0
    broken.scale_m[2] = np.inf
    broken.opacity[3:5] = (0.0, 0.003)
    broken.rgb[5] = np.nan
    image, sweep = CpuRenderer(scene(broken, sky=0.25)).sense(asked)
    assert (image.rgb == 64).all() and len(sweep.beam) == 0
    assert len(Gaussians.empty()) == 0


def test_planes_are_optional_and_colours_round_half_up():
    frame = CpuRenderer(scene(sky=0.5)).render_camera(request(camera()), outputs=("rgb",))
    assert frame.depth_m is None and frame.alpha is None and frame.label is None
    assert (frame.rgb == 128).all()
    assert spec.to_uint8(np.array([-1.0, 0.49 / 255, 0.5 / 255, 2.0])).tolist() == [0, 0, 1, 255]


@pytest.mark.parametrize("image_format", ["png", "jpeg", "rgb_planar"])
def test_encoding(image_format):
    import cv2

    rgb = CpuRenderer(scene(cloud())).render_camera(request(camera())).rgb
    data = encode_image(rgb, image_format)
    if image_format == "rgb_planar":
        assert np.array_equal(np.frombuffer(data, np.uint8).reshape(3, 48, 72)[0], rgb[..., 0])
    else:
        back = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        assert np.abs(back.astype(int) - rgb).mean() < (1e-9 if image_format == "png" else 4)
