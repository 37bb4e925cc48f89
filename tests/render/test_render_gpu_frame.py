"""Frames of an optimisation drawn by the CUDA back end against those of the CPU; see ``test_render_gpu``."""

import numpy as np
import pytest
from gpu_on_cpu.places import PLACES, launcher_at
from render_scenes import LENSES, camera, cloud, moved, request

from nurec_sim.render.cpu.backward.frame import SENSORS, Frame, zeros_by_gaussian
from nurec_sim.render.cpu.backward.repack import RawGaussians, repack
from nurec_sim.render.cpu.pack import BLOCK, FIELDS
from nurec_sim.render.gpu.frame import GpuFrames
from nurec_sim.types import Shutter

COUNT = 300
CAMERAS = {
    "pinhole": camera(50, 38),
    "rolling pinhole": camera(50, 38, shutter=Shutter.TOP_TO_BOTTOM),
    "rolling fisheye": camera(50, 38, LENSES["fisheye"], Shutter.LEFT_TO_RIGHT),
}
PAIR = request(CAMERAS["pinhole"], moved(0.02, 0.1, 0.0), moved(0.09, 0.7, 0.2)).world_from_sensor


@pytest.fixture(params=PLACES)
def launcher(request):
    return launcher_at(request.param)


@pytest.fixture
def gaussians():
    """Some before the camera and some behind it, in two blocks, the second of which is not full."""
    static = cloud(COUNT, 0, low=(2, -3, -2), high=(9, 3, 2))
    static.mean_m[-30:, 0] *= -1
    quat = static.quat_wxyz / np.linalg.norm(static.quat_wxyz, axis=1, keepdims=True)
    opacity = np.clip(static.opacity, 0.1, 0.97).astype(np.float32)
    opacity[::10] = 0.995  # above the cap, where it has no gradient
    return RawGaussians(static.mean_m, quat, np.maximum(static.scale_m, 0.02), opacity, static.rgb)


def packed_of(gaussians):
    packed = np.empty((-(-COUNT // BLOCK), FIELDS, BLOCK), np.float32)
    repack(0, len(packed), gaussians, False, packed)
    return packed


def both(gaussians, name, launcher):
    """Frames by the CPU and by the kernels, drawn, with the planes of the image alone."""
    frames = Frame(SENSORS.tables(CAMERAS[name]), PAIR, False), GpuFrames(launcher)(CAMERAS[name], PAIR)
    return [(frame, frame.draw_packed(packed_of(gaussians))[:, :38, :50]) for frame in frames]


@pytest.mark.parametrize("name", list(CAMERAS))
def test_planes_are_those_of_the_cpu(gaussians, launcher, name):
    (cpu, wanted), (gpu, got) = both(gaussians, name, launcher)
    assert wanted.shape == got.shape
    assert np.abs(got[:4] - wanted[:4]).max() < 1e-3
    # Distances along rays, or along the axis of the camera: as each frame says.
    depths = [plane[4] * (1 if frame.ray_z is None else frame.ray_z) for frame, plane in ((cpu, wanted), (gpu, got))]
    assert np.abs(depths[1] - depths[0]).max() < 0.01
    assert got[0].max() > 0.9


@pytest.mark.parametrize("name", list(CAMERAS))
def test_gradients_are_those_of_the_cpu(gaussians, launcher, name):
    results, weights = [], np.random.default_rng(3).normal(size=(6, 38, 50)).astype(np.float32)
    weights[5] = 0
    for frame, _ in both(gaussians, name, launcher):
        by_planes, into = frame.empty_planes(), zeros_by_gaussian(COUNT)
        by_planes[:, :38, :50] = weights * (frame.sensor.grid.valid > 0)
        # The loss is of depth along the axis; by distances along rays it has their share of that.
        by_planes[4, :38, :50] *= 0.1 * (1 if frame.ray_z is None else frame.ray_z)
        for array in into:
            array[:] = 1.0
        *_, pose = frame.draw_back(*gaussians[:4], by_planes, into)
        for array in into:
            array[:] -= 1.0
        changed = np.flatnonzero(into.features.any(axis=1))
        assert 0 < len(changed) < COUNT - 30
        assert np.isin(changed, frame.drawn_rows).all()
        assert len(frame.drawn_rows) <= COUNT - 30
        assert into.features[::10].any()
        assert np.all(np.diff(frame.drawn_rows) > 0)
        results.append([*into, pose])
    for part, wanted, got in zip([*RawGaussians._fields, "pose"], *results, strict=True):
        assert np.linalg.norm(got - wanted) < 1e-3 * np.linalg.norm(wanted) != 0, part
    assert not results[1][3][::10].any()


def test_the_same_frame_twice(gaussians, launcher):
    parts = []
    for _ in range(2):
        frame = GpuFrames(launcher)(CAMERAS["rolling pinhole"], PAIR)
        planes = frame.draw_packed(packed_of(gaussians))
        parts.append([planes, *frame.draw_back(*gaussians[:4], np.ones_like(planes))])
    for one, other in zip(*parts, strict=True):
        assert np.array_equal(one, other)
