"""Frames do not depend on the number of threads or on who else renders; renderers leave nothing behind."""

import dataclasses
import gc
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from render_scenes import START_US, camera, cloud, moved, moving_cloud, request, scene, track

from nurec_sim import geometry, sensors
from nurec_sim.render import CpuRenderer, spec
from nurec_sim.render.cpu import pipeline, sensor_tables
from nurec_sim.render.cpu import renderer as renderer_module
from nurec_sim.render.cpu.grid import make_grid
from nurec_sim.sensors import camera as camera_rays
from nurec_sim.types import Fisheye, FTheta, FThetaReference, Pinhole, Shutter

pytestmark = pytest.mark.slow

LIDAR = sensors.lidar_model("VLP-16", np.eye(4), columns=240)
LENSES = [
    None,
    Pinhole(90.0, 90.0, 70.0, 45.0, (-0.2, 0.05, 0, 0, 0, 0)),
    Fisheye(45.0, 45.0, 70.0, 45.0, max_angle_rad=1.7),
    FTheta(70.0, 45.0, FThetaReference.PIXELDIST_TO_ANGLE, (0.0, 0.02, 0.0, 2e-7), max_angle_rad=1.6),
]
ACTORS = {"car": np.stack([geometry.pose_from_xyyaw(5.0, 1.0, 0.4), geometry.pose_from_xyyaw(5.5, 1.0, 0.4)])}


def mixture():
    """Cameras of all lenses, still and moving, LiDARs, other poses and times, an actor that is elsewhere."""
    for k, lens in enumerate(LENSES):
        yield request(camera(141, 90, lens), moved(0.1 * k))
        yield request(camera(141, 90, lens, Shutter.TOP_TO_BOTTOM), moved(0.2 * k), moved(0.2 * k + 0.05))
    yield request(LIDAR, moved(0.3), start_us=START_US + 10_000, end_us=START_US + 110_000)
    yield request(LIDAR, moved(0.3), moved(0.4), start_us=START_US + 10_000, end_us=START_US + 110_000)
    yield request(camera(141, 90), actors=ACTORS)
    yield request(LIDAR, actors=ACTORS)


def arrays(frame):
    """The arrays of a frame by name, those that it lacks left out."""
    values = {field.name: getattr(frame, field.name) for field in dataclasses.fields(frame)}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def assert_same_bytes(some, others):
    assert len(some) == len(others)
    for k, (a, b) in enumerate(zip(map(arrays, some), map(arrays, others), strict=True)):
        assert a.keys() == b.keys()
        for name in a:
            assert a[name].dtype == b[name].dtype and a[name].tobytes() == b[name].tobytes(), (k, name)


@pytest.fixture(scope="module")
def world():
    static = cloud(6000, sh=8, low=(-15, -15, -4), high=(25, 15, 6))
    moving = moving_cloud(800)
    rest = np.random.default_rng(9).normal(0, 0.1, (800, 8, 3)).astype(np.float32)
    moving = dataclasses.replace(moving, gaussians=dataclasses.replace(moving.gaussians, sh_rest=rest))
    return scene(static, moving, [track()], sky=np.random.default_rng(1).random((6, 8, 8, 3)))


@pytest.fixture(scope="module")
def alone(world):
    """Frames of the mixture from one thread, each by itself."""
    renderer = CpuRenderer(world, threads=1)
    return [renderer.sense([asked])[0] for asked in mixture()]


def test_the_mixture_has_something_to_see(alone):
    assert len({tuple(sorted((name, a.tobytes()) for name, a in arrays(frame).items())) for frame in alone}) == len(
        alone
    )
    for frame in alone:
        seen = arrays(frame)
        assert len(seen["beam"]) > 500 if "beam" in seen else seen["alpha"].mean() > 0.4


@pytest.mark.parametrize("threads", [1, 2, 3, 7])
def test_same_bytes_at_any_thread_count(world, alone, threads):
    assert_same_bytes(CpuRenderer(world, threads=threads).sense(list(mixture())), alone)


def test_tables_of_one_sensor_do_not_wait_for_those_of_another(monkeypatch):
    """A job that pauses while it makes tables goes on only when the job that runs meanwhile has ended."""
    paused, ended, tile_rays = threading.Event(), threading.Event(), sensor_tables.tile_rays

    def pause(grid):
        if threading.current_thread() is slow:
            paused.set()
            assert ended.wait(20)
        return tile_rays(grid)

    monkeypatch.setattr(sensor_tables, "tile_rays", pause)
    first, second = (sensor_tables.SensorTables(make_grid(camera(32, 16 * k))) for k in (1, 2))
    slow = threading.Thread(target=lambda: first.rays)
    quick = threading.Thread(target=lambda: (second.rays, ended.set()))
    slow.start()
    assert paused.wait(20)
    quick.start()
    quick.join(10)
    waited = not ended.is_set()
    ended.set()
    slow.join()
    quick.join()
    assert not waited
    assert first.rays is first.rays


def test_a_batch_gives_what_one_by_one_gives_in_any_order(world, alone):
    renderer, asked = CpuRenderer(world, threads=2), list(mixture())
    order = np.random.default_rng(3).permutation(2 * len(asked)) % len(asked)
    frames = renderer.sense([asked[k] for k in order])
    assert_same_bytes(frames, [alone[k] for k in order])
    assert_same_bytes([renderer.render_camera(asked[0]), renderer.render_lidar(asked[-1])], [alone[0], alone[-1]])
    assert renderer.sense([]) == []


def test_groups_slices_and_strips_do_not_change_a_byte(world, alone, monkeypatch):
    """As large images are drawn: tables by strips of rows, frames in groups, kernels in many short calls."""
    monkeypatch.setattr(camera_rays, "KEPT_PIXELS", 0)
    monkeypatch.setattr(camera_rays, "PIXELS_AT_ONCE", 1000)
    monkeypatch.setattr(renderer_module, "GROUP_BYTES", 3_000_000)
    monkeypatch.setattr(renderer_module, "SLICE_RAYS", 141 * 16)
    for name in ("SLICE_PAIRS", "SLICE_BLOCKS"):
        monkeypatch.setattr(pipeline, name, 5)
    drawn, draw = [], renderer_module.draw
    monkeypatch.setattr(
        renderer_module, "draw", lambda group, workers: drawn.append(len(group)) or draw(group, workers)
    )
    assert_same_bytes(CpuRenderer(world, threads=1).sense(list(mixture())), alone)
    assert len(drawn) > 3 and sum(drawn) == len(alone)


def test_memory_of_many_frames_does_not_grow_with_their_number(world, monkeypatch):
    """Scratch memory is that of a group, and reused by the next one."""
    monkeypatch.setattr(renderer_module, "GROUP_BYTES", 1)
    renderer = CpuRenderer(world, threads=1)
    lent = []
    lend = renderer._buffers.lend
    monkeypatch.setattr(renderer._buffers, "lend", lambda: lent.append(1) or lend())
    assert len(renderer.sense([request(camera(141, 90), moved(0.1 * k)) for k in range(20)], ("rgb",))) == 20
    assert len(lent) == 1


@pytest.mark.parametrize("boxed", [False, True])
def test_hidden_tracks_are_not_drawn(world, boxed):
    if boxed:
        world = dataclasses.replace(world, dynamic=dataclasses.replace(world.dynamic, in_box=world.dynamic.track >= 0))
    without = dataclasses.replace(
        world, dynamic=dataclasses.replace(world.dynamic, knot_m=np.where(
            (world.dynamic.track == 0)[:, None, None], np.float32(1e9), world.dynamic.knot_m)),
    )  # fmt: skip
    small = camera(47, 30)
    asked = request(small, actors=ACTORS)
    hidden = dataclasses.replace(asked, hidden=frozenset({"car", "unknown"}))
    expected = CpuRenderer(without).render_camera(request(small)).rgb
    assert np.array_equal(CpuRenderer(world).render_camera(hidden).rgb, expected)
    assert not np.array_equal(CpuRenderer(world).render_camera(asked).rgb, expected)
    assert np.abs(spec.render_camera(world, hidden).rgb.astype(int) - expected).max() <= 2


@pytest.mark.slow
def test_sixteen_threads_share_a_renderer(world, alone):
    """Also on its first frames, when tables and buffers are made."""
    renderer, asked = CpuRenderer(world, threads=2), list(mixture())
    begin = threading.Barrier(16)

    def client(seed):
        order = np.random.default_rng(seed).permutation(len(asked))
        begin.wait(30)
        order = order[:5]
        return order, renderer.sense([asked[k] for k in order[:3]]) + [renderer.sense([asked[k]])[0] for k in order[3:]]

    with ThreadPoolExecutor(16) as pool:
        for order, frames in pool.map(client, range(16)):
            assert_same_bytes(frames, [alone[k] for k in order])


def test_frames_are_not_overwritten_by_later_ones(world, alone):
    renderer = CpuRenderer(world, threads=2)
    first = renderer.sense(list(mixture()))
    renderer.sense([request(camera(141, 90), moved(2.0)), request(LIDAR, moved(2.0))])
    assert_same_bytes(first, alone)


def test_renderers_that_are_dropped_leave_no_threads(world):
    before = set(threading.enumerate())
    for _ in range(3):
        renderer = CpuRenderer(world, threads=4)
        renderer.sense(list(mixture())[:2])
        assert len(threading.enumerate()) < len(before) + 8
        del renderer
        gc.collect()
    end = time.monotonic() + 10
    while set(threading.enumerate()) - before and time.monotonic() < end:
        time.sleep(0.01)
    assert set(threading.enumerate()) <= before


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the memory of a process is read from /proc")
def test_renderers_that_are_dropped_leave_no_memory(world):
    asked = [next(mixture()), request(LIDAR)]
    static = cloud(60_000, low=(-15, -15, -4), high=(25, 15, 6))  # about 10 MB packed and unpacked

    def resident_mb(times):
        for _ in range(times):
            CpuRenderer(scene(static), threads=2).sense(asked)
        gc.collect()
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6

    before = resident_mb(2)
    assert resident_mb(6) - before < 30
