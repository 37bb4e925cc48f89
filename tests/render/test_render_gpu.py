"""The CUDA back end against the float64 reference: on a GPU where there is one, and always on the CPU.

``gpu_on_cpu`` compiles the very sources of the kernels with g++ and runs them thread by thread, so everything but the
GPU itself is tested on any machine.
"""

import dataclasses

import numpy as np
import pytest
import torch
from gpu_on_cpu.emulator import EmulatedLauncher, compiler_missing
from gpu_on_cpu.places import PLACES, launcher_at
from render_scenes import LENSES, LIDARS, START_US, camera, cloud, moved, moving_cloud, psnr_db, request, scene, track

from nurec_sim import geometry
from nurec_sim.errors import NurecSimError, RequestError, TooLargeError
from nurec_sim.render import CpuRenderer, spec
from nurec_sim.render.gpu.moving import HIDDEN, NOT_ASKED, MovingLayer
from nurec_sim.render.gpu.pipeline import Room
from nurec_sim.render.gpu.renderer import GpuRenderer
from nurec_sim.render.requests import CAMERA_OUTPUTS
from nurec_sim.types import LidarFilter, LidarModel, Shutter, Windshield, WindshieldReference

SHUTTERS = {
    "pinhole": Shutter.TOP_TO_BOTTOM,
    "wide pinhole": Shutter.LEFT_TO_RIGHT,
    "distorted": Shutter.BOTTOM_TO_TOP,
    "fisheye": Shutter.RIGHT_TO_LEFT,
    "f-theta": Shutter.TOP_TO_BOTTOM,
}


@pytest.fixture(params=PLACES)
def launcher(request):
    return launcher_at(request.param)


def assert_same_image(launcher, world, asked):
    got, expected = GpuRenderer(world, launcher).render_camera(asked, CAMERA_OUTPUTS), spec.render_camera(world, asked)
    assert_same_frame(got, expected)


def assert_same_frame(got, expected):
    assert psnr_db(got.rgb, expected.rgb) >= 60
    # A hit right at the cut of 1/255 may fall to either side.
    error = np.abs(got.alpha - expected.alpha)
    assert error.max() < 0.006 and (error > 5e-4).mean() < 2e-3
    assert (got.label != expected.label).mean() < 2e-3
    assert ((got.depth_m > 0) != (expected.depth_m > 0)).mean() < 2e-3
    both = (got.depth_m > 0) & (expected.depth_m > 0)
    if both.any():
        assert np.median(np.abs(got.depth_m - expected.depth_m)[both]) < 1e-3
        assert np.median(np.linalg.norm(got.normal - expected.normal, axis=-1)[both]) < 1e-3


def assert_same_sweep(got, expected, least=300):
    _, mine, theirs = np.intersect1d(got.beam, expected.beam, return_indices=True)
    assert len(mine) >= max(least, 0.998 * max(len(got.beam), len(expected.beam)))
    error = np.abs(got.range_m[mine] - expected.range_m[theirs])
    assert np.median(error) < 1e-3 and np.quantile(error, 0.99) < 1e-2
    assert np.median(np.abs(got.xyz_m[mine] - expected.xyz_m[theirs])) < 1e-3
    assert np.quantile(np.abs(got.intensity[mine] - expected.intensity[theirs]), 0.99) < 1e-2


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("lens", list(LENSES))
def test_every_lens_still_and_moving(launcher, lens, moving):
    shutter = SHUTTERS[lens] if moving else Shutter.GLOBAL
    sky = np.random.default_rng(1).random((6, 4, 4, 3))
    asked = request(camera(lens=LENSES[lens], shutter=shutter), moved(0.02, 0.1, 0.0), moved(0.09, 0.7, 0.2))
    assert_same_image(launcher, scene(cloud(), sky=sky), asked)


def test_windshield(launcher):
    glass = Windshield(
        WindshieldReference.FORWARD, (0.002, 1.01, 0.0, 0.003, 0.0, 0.0), (-0.001, 0.0, 0.002, 0.99, 0.0, 0.0)
    )
    assert_same_image(launcher, scene(cloud()), request(camera(windshield=glass)))


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_large_gaussians_around_the_camera(launcher, lens):
    static = cloud(60, 2, low=(-3, -3, -3), high=(3, 3, 3))
    static = dataclasses.replace(static, scale_m=static.scale_m * 2)
    asked = request(camera(lens=LENSES[lens], shutter=Shutter.TOP_TO_BOTTOM), moved(2.6), moved(2.7, 0.4))
    assert_same_image(launcher, scene(static), asked)


@pytest.mark.parametrize("k", [3, 8, 15])
def test_spherical_harmonics(launcher, k):
    assert_same_image(launcher, scene(cloud(sh=k)), request(camera(), moved(0.5, 1.0, -1.0)))


def test_isp_and_its_switch(launcher):
    isp = {"front": np.array([[0.8, 0.1, 0, 0.05], [0, 0.7, 0.1, 0], [0.1, 0, 0.9, -0.1]])}
    world, asked = scene(cloud(), isp=isp), request(camera())
    assert_same_image(launcher, world, asked)
    plain = GpuRenderer(world, launcher, apply_isp=False).render_camera(asked)
    assert psnr_db(plain.rgb, spec.render_camera(world, asked, apply_isp=False).rgb) >= 60
    asked_for = GpuRenderer(world, launcher).render_camera(dataclasses.replace(asked, apply_isp=False))
    assert np.array_equal(asked_for.rgb, plain.rgb)


def test_moving_actors(launcher):
    world = scene(cloud(), moving_cloud(), [track()])
    pose = geometry.pose_from_xyyaw(5.0, 1.0, 1.2)
    actors = {"car": np.stack([pose, moved() @ pose]), "unknown": np.stack([np.eye(4)] * 2)}
    asked = request(camera(shutter=Shutter.TOP_TO_BOTTOM), end_from_rig=moved(), actors=actors)
    assert_same_image(launcher, world, asked)
    assert_same_image(launcher, world, dataclasses.replace(asked, hidden=frozenset({"car"})))


@pytest.mark.parametrize("name", list(LIDARS))
def test_lidar(launcher, name):
    static = cloud(400, 3, low=(-12, -12, -3), high=(12, 12, 3), drop=True)
    world = scene(static, moving_cloud(), [track()])
    asked = request(LIDARS[name], moved(0.3), moved(0.42, 1.2, 0.3), end_us=START_US + 100_000)
    assert_same_sweep(GpuRenderer(world, launcher).render_lidar(asked), spec.render_lidar(world, asked), least=200)


def test_lidar_filters(launcher):
    world = scene(cloud(400, 3, low=(-12, -12, -3), high=(12, 12, 3), drop=True))
    asked, renderer, returns = request(LIDARS["sector"]), GpuRenderer(world, launcher), []
    for filter in (LidarFilter(1.0, 0.2), LidarFilter(0.6, 0.2), LidarFilter(0.6, 0.2, 0.05)):
        got = renderer.render_lidar(asked, filter)
        assert_same_sweep(got, spec.render_lidar(world, asked, filter))
        returns.append(len(got.beam))
    assert returns[0] > returns[1] > returns[2]


def test_sensors_of_a_batch_do_not_mix(launcher):
    world = scene(cloud(sh=3), dataclasses.replace(moving_cloud(), gaussians=cloud(60, 5, sh=3)), [track()])
    poses = (moved(0.3), moved(0.42, 1.2, 0.3))
    asked = [
        request(camera(shutter=Shutter.LEFT_TO_RIGHT), *poses),
        request(LIDARS["other way"], *poses, end_us=START_US + 100_000),
        request(camera(40, 30, lens=LENSES["fisheye"]), moved(2.0)),
    ]
    renderer = GpuRenderer(world, launcher)
    together = renderer.sense(asked)
    for frame, single in zip(together, asked, strict=True):
        (alone,) = renderer.sense([single])
        for name in ("rgb", "depth_m", "alpha", "label") if hasattr(alone, "rgb") else ("xyz_m", "intensity", "beam"):
            assert np.array_equal(getattr(frame, name), getattr(alone, name))
    assert_same_sweep(together[1], spec.render_lidar(world, asked[1]), least=200)
    assert renderer.sense([]) == []


def test_memory_that_does_not_suffice_is_the_requests_fault(launcher, monkeypatch):
    def full(*arguments, **options):
        raise torch.OutOfMemoryError("no more")

    monkeypatch.setattr("nurec_sim.render.gpu.renderer.draw", full)
    with pytest.raises(TooLargeError, match="1 sensors at once are too many for the GPU: no more"):
        GpuRenderer(scene(cloud(5)), launcher).render_camera(request(camera()))


def tick(world, count=3):
    """Cameras and a LiDAR that move, all actors posed anew."""
    poses = (moved(0.3), moved(0.42, 1.2, 0.3))
    sensors = [camera(40, 30, id=str(k), shutter=Shutter.TOP_TO_BOTTOM) for k in range(count - 1)]
    return [
        request(sensor, *poses, end_us=START_US + 100_000, actors={each.id: np.stack(poses) for each in world.tracks})
        for sensor in (*sensors, LIDARS["sector"])
    ]


class Counting(EmulatedLauncher):
    """Counts what the host asks of the device."""

    def __init__(self):
        super().__init__()
        self.launches, self.uploads, self.reads = [], 0, 0

    def launch(self, kernel, grid, *arguments):
        self.launches.append(kernel)
        super().launch(kernel, grid, *arguments)

    def upload(self, data):
        self.uploads += 1
        return super().upload(data)

    def read(self, tensor):
        self.reads += 1
        return super().read(tensor)


def test_sensors_of_a_batch_move_actors_of_their_own():
    """Pairs of poses are numbered over all requests: 0 is the first one's "b", 1 to 3 are those of the second."""
    layer = MovingLayer.of(moving_cloud(), [track("a"), track("b")], torch.device("cpu"))
    still = np.stack([np.eye(4)] * 2)
    actors = [{"b": still}, {"unknown": still, "b": still, "a": still}, {}, {"a": still}]
    asked = [request(camera(), actors=each) for each in actors]
    asked[2] = dataclasses.replace(asked[2], hidden=frozenset({"b"}))
    assert layer.asked(asked).tolist() == [[NOT_ASKED, 0], [3, 2], [NOT_ASKED, HIDDEN], [4, NOT_ASKED]]


@pytest.mark.parametrize("sensors", [2, 4])
def test_the_host_waits_once_per_batch(sensors):
    if why := compiler_missing():
        pytest.skip(why)
    world, counts = scene(cloud(), moving_cloud(), [track()]), Counting()
    renderer, asked = GpuRenderer(world, counts), tick(scene(tracks=[track()]), sensors)
    renderer.sense(asked)
    counts.launches, counts.uploads, counts.reads = [], 0, 0
    renderer.sense(asked)
    assert (counts.reads, counts.uploads) == (1, 1)
    assert len(counts.launches) == len(set(counts.launches)) == 14  # whatever the number of sensors and actors


def test_a_batch_that_needs_more_room_is_drawn_again(launcher, monkeypatch):
    world, asked = scene(cloud()), request(camera(64, 48))
    enough = GpuRenderer(world, launcher).render_camera(asked)
    tried = []
    first = Room.first
    monkeypatch.setattr(Room, "first", lambda gaussians: tried.append(gaussians) or Room(7, 5))
    renderer = GpuRenderer(world, launcher)
    assert np.array_equal(renderer.render_camera(asked).rgb, enough.rgb)
    (room,) = renderer._rooms._known.values()
    assert room.records > 7 and room.pairs > 5 and tried
    assert first(0) == Room(1, 4) and not Room(7, 5).holds(np.array([8, 0])) and Room(7, 5).holds(np.array([7, 5]))
    assert np.array_equal(renderer.render_camera(asked).rgb, enough.rgb)


def test_levels_of_detail_are_those_of_the_cpu(launcher):
    rng = np.random.default_rng(3)
    mean = np.stack([rng.uniform(30, 31, 8000), *rng.uniform(-12, 12, (2, 8000))], axis=1).astype(np.float32)
    many = dataclasses.replace(cloud(8000), mean_m=mean, scale_m=np.full((8000, 3), 0.3, np.float32), normal=mean * 0)
    world = scene(many)
    for asked in (request(camera(48, 32)), request(LIDARS["sector"])):
        frames = [
            make(world, device, detail_px=detail_px).sense([asked])[0]
            for make, device, detail_px in ((CpuRenderer, 2, 0.0), (CpuRenderer, 2, 2.0), (GpuRenderer, launcher, 2.0))
        ]
        full, coarse, ours = frames
        if isinstance(asked.sensor, LidarModel):
            assert_same_sweep(ours, coarse, least=20)
            continue
        assert psnr_db(ours.rgb, coarse.rgb) >= 60 > psnr_db(full.rgb, coarse.rgb)
    with pytest.raises(ValueError, match="detail_px must be finite"):
        GpuRenderer(world, launcher, detail_px=-1.0)


def test_degenerate_gaussians(launcher):
    static = cloud(40, 4)
    values = {name: getattr(static, name).copy() for name in ("mean_m", "scale_m", "quat_wxyz", "opacity", "rgb")}
    values["mean_m"][0] = np.nan
    values["scale_m"][1] = 0
    values["scale_m"][2] = 1e9
    values["quat_wxyz"][3] = 0
    values["opacity"][4:7] = 0, 1, np.nan
    values["rgb"][7] = np.inf
    values["scale_m"][8] = 1e-7
    values["mean_m"][9] = 0
    world = scene(dataclasses.replace(static, **values))
    for asked in (request(camera(33, 17)), request(camera(1, 1)), request(camera(20, 20, lens=LENSES["fisheye"]))):
        got = GpuRenderer(world, launcher).render_camera(asked, CAMERA_OUTPUTS)
        expected = spec.render_camera(world, asked)
        assert psnr_db(got.rgb, expected.rgb) >= 60
        assert np.isfinite(got.depth_m).all() and np.isfinite(got.normal).all()
    assert np.isfinite(GpuRenderer(world, launcher).render_lidar(request(LIDARS["full"])).xyz_m).all()
    empty = GpuRenderer(scene(sky=0.25), launcher).render_camera(request(camera(20, 10)))
    assert (empty.rgb == 64).all() and (empty.alpha == 0).all()


def test_requests_are_checked(launcher):
    renderer = GpuRenderer(scene(cloud(5)), launcher)
    with pytest.raises(RequestError, match="unknown outputs"):
        renderer.render_camera(request(camera()), outputs=["colour"])
    with pytest.raises(RequestError, match="needs a LiDAR"):
        renderer.render_lidar(request(camera()))
    with pytest.raises(RequestError, match="needs a camera"):
        renderer.render_camera(request(LIDARS["full"]))


def test_poses_of_a_batch_are_checked_together(launcher):
    world = scene(cloud(5), moving_cloud(), [track()])
    renderer, good = GpuRenderer(world, launcher), tick(world)
    renderer.sense(good)  # from now on the sensors are known
    skewed, far, long = np.stack([np.eye(4)] * 2), np.stack([np.eye(4)] * 2), np.stack([np.eye(4)] * 3)
    skewed[1, 0, 1], far[0, 0, 3] = 0.5, np.nan
    wrong = {
        r"actor 'car': world_from_box has a 3 x 3 part that is not a rotation": {"actors": {"car": skewed}},
        r"actor 'unknown': world_from_box must be finite": {"actors": {"unknown": far}},
        r"actor 'car': world_from_box must be two 4 x 4 poses": {"actors": {"car": long}},
        r"sensor 'lidar': world_from_sensor must be finite": {"world_from_sensor": far},
        r"an exposure must end after it starts": {"end_us": good[-1].start_us},
        r"covers \[": {"start_us": 1, "end_us": 2},
    }
    for text, change in wrong.items():
        with pytest.raises(NurecSimError, match=text.replace("'lidar'", repr(good[-1].sensor.id))):
            renderer.sense([*good[:-1], dataclasses.replace(good[-1], **change)])
    assert len(renderer.sense(good)) == 3


@pytest.mark.needs_gpu
def test_a_million_pixels_against_the_cpu():
    """Sizes that the emulator and the reference are too slow for."""
    launcher = launcher_at("on a GPU")
    static = cloud(50_000, 1, low=(-40, -40, -5), high=(60, 40, 15))
    world = scene(dataclasses.replace(static, scale_m=static.scale_m * 0.3))
    asked = request(camera(1280, 800, shutter=Shutter.TOP_TO_BOTTOM), moved(0.02, 0.1), moved(0.05, 0.5, 0.1))
    renderer = GpuRenderer(world, launcher)
    got = renderer.render_camera(asked)
    assert psnr_db(got.rgb, CpuRenderer(world).render_camera(asked).rgb) >= 60
    assert np.array_equal(got.rgb, renderer.render_camera(asked).rgb)
