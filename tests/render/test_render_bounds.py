"""Where projection says a Gaussian may be seen: never too little, not much too much, for every sensor and motion."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import render_scenes as scenes
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from nurec_sim import geometry, sensors
from nurec_sim.render.cpu.grid import LIDAR, PINHOLE, make_grid
from nurec_sim.render.cpu.pack import BLOCK, LayerBlocks, pack
from nurec_sim.render.cpu.project.general import lens_boxes, project_general
from nurec_sim.render.cpu.project.motion import LinePath
from nurec_sim.render.cpu.records import MACRO, RECORD, SCRATCH, Projected, place
from nurec_sim.render.cpu.simd import LANES
from nurec_sim.render.cpu.view import ExposureView
from nurec_sim.render.rays import ray_grid, reference_pose, world_rays
from nurec_sim.types import Fisheye, FTheta, FThetaReference, LidarModel, Pinhole, Shutter, Spin, Windshield
from nurec_sim.types import WindshieldReference as Exact

WIDTH, HEIGHT = 208, 144
MIDDLE = WIDTH / 2, HEIGHT / 2
FTHETA = FTheta(*MIDDLE, FThetaReference.ANGLE_TO_PIXELDIST, (), (0, 100.0, 0.0, -4.0), 1.2, (1.0, 0.002, -0.001))
GLASS = Windshield(Exact.FORWARD, (0.002, 1.01, 0.003, 0.004, -0.002, 0.02), (-0.001, 0.002, 0.003, 0.99, 0.01, -0.01))
CAMERAS = {
    "pinhole": scenes.camera(WIDTH, HEIGHT, Pinhole(110, 110, *MIDDLE)),
    "distorted": scenes.camera(WIDTH, HEIGHT, Pinhole(120, 122, 101, 70, (-0.3, 0.1, 0, 0, 0, 0), (0.001, 0.002))),
    "fisheye": scenes.camera(WIDTH, HEIGHT, Fisheye(42, 42, *MIDDLE, (0.01, -0.002, 0, 0), np.radians(95))),
    "ftheta": scenes.camera(WIDTH, HEIGHT, FTHETA),
    "windshield": scenes.camera(WIDTH, HEIGHT, FTHETA, windshield=GLASS),
}


def spinning(spin, offset=0.0, sector=False, columns=320):
    """A LiDAR of 36 rows; rows may be offset by up to some radians, and columns may cover 120 degrees only."""
    rng = np.random.default_rng(3)
    sign = -1 if spin is Spin.CLOCKWISE else 1
    azimuth = 1.0 + sign * (2 * np.pi / 3 if sector else 2 * np.pi) * np.arange(columns) / columns
    elevation = np.radians(np.linspace(15, -25, 36))
    return LidarModel("top", elevation, azimuth, rng.uniform(-offset, offset, 36), np.eye(4), spin)


LIDARS = {
    "clockwise": spinning(Spin.CLOCKWISE),
    "offsets": spinning(Spin.COUNTERCLOCKWISE, offset=0.06),
    "sector": spinning(Spin.CLOCKWISE, offset=0.02, sector=True, columns=160),
}
GRIDS = {name: make_grid(sensor) for name, sensor in {**CAMERAS, **LIDARS}.items()}


def cloud(rng, n, around):
    """Gaussians of any shape, 0.4 to 40 m away, in front or all around."""
    distance, azimuth = (
        np.exp(rng.uniform(np.log(0.4), np.log(40), n)),
        rng.uniform(-1, 1, n) * (np.pi if around else 1.6),
    )
    elevation = rng.uniform(-1, 1, n) * rng.choice([0.4, 1.0])
    flat = distance * np.cos(elevation)
    mean = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1)
    scale = np.exp(rng.uniform(np.log(0.001), np.log(0.15), (n, 1)) + rng.normal(0, 1, (n, 3))) * distance[:, None]
    return dataclasses.replace(
        scenes.gaussians(mean),
        quat_wxyz=unit(rng.normal(size=(n, 4))).astype(np.float32),
        scale_m=np.maximum(scale, 1e-4).astype(np.float32),
        opacity=np.exp(rng.uniform(np.log(0.005), 0, n)).astype(np.float32),
    )


def unit(x):
    """Rows of length 1."""
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def step(rng, turn, travel):
    """A random pose near the identity."""
    yaw, pitch, roll = rng.uniform(-1, 1, 3) * turn
    pose = geometry.pose_from_xyyaw(*(rng.uniform(-1, 1, 2) * travel), yaw)
    pose[:3, :3] = pose[:3, :3] @ geometry.matrix_from_quat(unit(np.array([[1, roll / 2, pitch / 2, 0]]))[0])
    pose[2, 3] = rng.uniform(-0.2, 0.2) * travel
    return pose


def project(grid, view, packed):
    """Row of each record's Gaussian, and its span of cells [n,4]."""
    most = 2 * BLOCK * len(packed)
    output = Projected(np.zeros((most, RECORD), np.float32), np.zeros(most, np.float32),
                       np.zeros((most, 4), np.int16), np.zeros(most, np.int32))  # fmt: skip
    layer = LayerBlocks(packed.fields, packed.sh_rest, np.arange(len(packed)))
    n = project_general(layer, 0, len(packed), view.parameters, grid.kind == LIDAR, grid.chart,
                        LinePath(view.lines, view.steps), output, 0)  # fmt: skip
    return packed.index[output.sources[:n]], output.spans[:n]


def hits(grid, sensor, request, gaussians):
    """Cells [n,h,w] whose ray has a response of 1/255 in float64, of Gaussians that are not culled."""
    rays = ray_grid(sensor)
    origin, direction = world_rays(request, rays)
    valid = rays.valid
    if grid.beam is not None:
        origin, direction = origin.reshape(-1, 3)[grid.beam], direction.reshape(-1, 3)[grid.beam]
    pose, _ = reference_pose(request, rays.reference)
    centre = geometry.transform_points(geometry.inverse(pose), gaussians.mean_m.astype(np.float64))
    depth = np.linalg.norm(centre, axis=1) if rays.by_range else centre[:, 2]
    rotation = geometry.matrix_from_quat(unit(gaussians.quat_wxyz.astype(np.float64)))
    seen = np.zeros((len(depth), *valid.shape), bool)
    origin, direction = (np.ascontiguousarray(np.broadcast_to(x, (*valid.shape, 3))) for x in (origin, direction))
    for i in np.flatnonzero(depth >= rays.near_m * (1 + 1e-5)):
        rim = 2 * np.log(255 * min(0.99, float(gaussians.opacity[i])) * (1 - 1e-4))
        canonical = rotation[i] / gaussians.scale_m[i].astype(np.float64)
        mark_hits(
            origin, direction, valid, gaussians.mean_m[i].astype(np.float64), canonical, rim, rays.near_m, seen[i]
        )
    return seen


@njit(nogil=True)
def mark_hits(origin, direction, valid, mean, canonical, rim, near_m, seen):
    """The rays that pass within a squared Mahalanobis distance ``rim`` of a Gaussian, nearest beyond ``near_m``."""
    for y in range(valid.shape[0]):
        for x in range(valid.shape[1]):
            dd = od = oo = 0.0
            for k in range(3):
                o = d = 0.0
                for j in range(3):
                    o += (origin[y, x, j] - mean[j]) * canonical[j, k]
                    d += direction[y, x, j] * canonical[j, k]
                dd, od, oo = dd + d * d, od + o * d, oo + o * o
            seen[y, x] = valid[y, x] and oo - od * od / dd <= rim and -od / dd >= near_m


def check(sensor, grid, first, last, gaussians):
    """Every seen cell lies in one of the spans, no two of which share a tile; numbers of tiles spanned and needed."""
    request = scenes.request(sensor, first, last)
    view = ExposureView.of(grid, request.world_from_sensor)
    rows, spans = project(grid, view, pack(gaussians))
    height, width = grid.valid.shape
    covered = np.zeros((len(gaussians.mean_m), height, width), bool)
    tiles = np.zeros((len(covered), -(-height // MACRO), -(-width // MACRO)), np.int64)
    for row, (left, right, top, bottom) in zip(rows, spans.astype(int), strict=True):
        covered[row, top : bottom + 1, left : right + 1] = True
        tiles[row, top // MACRO : bottom // MACRO + 1, left // MACRO : right // MACRO + 1] += 1
    assert tiles.max(initial=0) <= 1, "a Gaussian has two records in one tile"
    seen = hits(grid, sensor, request, gaussians)
    missed = np.flatnonzero((seen & ~covered).any(axis=(1, 2)))
    assert len(missed) == 0, f"Gaussians {missed} are seen outside of their spans"
    padded = np.pad(seen, ((0, 0), (0, -height % MACRO), (0, -width % MACRO)))
    needed = padded.reshape(len(seen), tiles.shape[1], MACRO, tiles.shape[2], MACRO).any(axis=(2, 4))
    return tiles.sum(), needed.sum()


@pytest.mark.parametrize("name", [name for name in CAMERAS if name != "pinhole"])
@settings(max_examples=4, derandomize=True, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_lenses_miss_nothing(name, seed):
    rng = np.random.default_rng(seed)
    pose = step(rng, 0.3, 1.0)
    check(CAMERAS[name], GRIDS[name], pose, pose, cloud(rng, 60, around=False))


@pytest.mark.parametrize("shutter", [Shutter.TOP_TO_BOTTOM, Shutter.RIGHT_TO_LEFT])
@pytest.mark.parametrize("name", list(CAMERAS))
@settings(max_examples=3, derandomize=True, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_rolling_lenses_miss_nothing(name, shutter, seed):
    rng = np.random.default_rng(seed)
    sensor = dataclasses.replace(CAMERAS[name], shutter=shutter)
    pose = step(rng, 0.3, 1.0)
    check(sensor, rolling_grid(name, shutter), pose, pose @ step(rng, 0.06, 1.2), cloud(rng, 60, around=False))


ROLLING_GRIDS = {}


def rolling_grid(name, shutter):
    """Grid of a camera with another shutter, made once."""
    if (name, shutter) not in ROLLING_GRIDS:
        ROLLING_GRIDS[name, shutter] = make_grid(dataclasses.replace(CAMERAS[name], shutter=shutter))
    return ROLLING_GRIDS[name, shutter]


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("name", list(LIDARS))
@settings(max_examples=6, derandomize=True, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_lidars_miss_nothing(name, moving, seed):
    rng = np.random.default_rng(seed)
    pose = step(rng, 0.3, 1.0)
    last = pose @ step(rng, 0.15, 2.5) if moving else pose
    check(LIDARS[name], GRIDS[name], pose, last, cloud(rng, 100, around=True))


@pytest.mark.parametrize("name", [*CAMERAS, *LIDARS])
def test_boxes_are_tight(name):
    """Small Gaussians some way off, seen in motion as well: few tiles that see nothing."""
    rng = np.random.default_rng(11)
    sensor, grid = {**CAMERAS, **LIDARS}[name], GRIDS[name]
    gaussians = cloud(rng, 400, around=name in LIDARS)
    far = np.linalg.norm(gaussians.mean_m, axis=1)[:, None]
    scale = np.exp(rng.normal(np.log(0.01), 0.7, gaussians.scale_m.shape)) * far
    gaussians = dataclasses.replace(gaussians, scale_m=scale.astype(np.float32))
    if grid.kind != LIDAR:
        sensor, grid = (
            dataclasses.replace(sensor, shutter=Shutter.TOP_TO_BOTTOM),
            rolling_grid(name, Shutter.TOP_TO_BOTTOM),
        )
    for last in (None, scenes.moved(yaw=0.01, x=0.3, y=0.02)):
        spanned, needed = check(sensor, grid, None, last, gaussians)
        assert needed > 100
        assert spanned <= (4 if name == "distorted" else 2.2) * needed


@njit
def boxes(block, view, params, places, bends, box):
    """Cells of the first ``LANES`` Gaussians of a block."""
    scratch = np.empty((SCRATCH, LANES), np.float32)
    place(block.ctypes.data, view.ctypes.data, scratch.ctypes.data)
    return lens_boxes(scratch.ctypes.data, params.ctypes.data, places.ctypes.data, bends.ctypes.data, box.ctypes.data)


@pytest.mark.parametrize("name", [name for name, grid in GRIDS.items() if grid.kind not in (PINHOLE, LIDAR)])
def test_cells_of_lenses_are_bounded(name):
    """Boxes hold every cell and exceed them by a few cells at most where all is small."""
    rng = np.random.default_rng(5)
    sensor, grid = CAMERAS[name], GRIDS[name]
    excess = []
    for _ in range(8):
        n = 8
        gaussians = cloud(rng, n, around=False)
        far = np.linalg.norm(gaussians.mean_m, axis=1)[:, None]
        scale = np.exp(rng.normal(np.log(0.02), 0.5, (n, 3))) * far
        gaussians = dataclasses.replace(
            gaussians, scale_m=scale.astype(np.float32), opacity=np.full(n, 0.9, np.float32)
        )
        request = scenes.request(sensor)
        packed, box = pack(gaussians, sort=False), np.empty((4, LANES), np.float32)
        mask = boxes(packed.fields[0], ExposureView.of(grid, request.world_from_sensor).parameters, grid.chart.params,
                     grid.chart.places, grid.chart.bends, box)  # fmt: skip
        for lane, seen in enumerate(hits(grid, sensor, request, gaussians)):
            rows, columns = np.nonzero(seen)
            if len(rows) == 0:
                continue
            left, right, top, bottom = box[:, lane] - 0.5
            assert mask >> lane & 1
            assert left <= columns.min() and columns.max() <= right and top <= rows.min() and rows.max() <= bottom
            inside = columns.min() > 0 and rows.min() > 0 and columns.max() < WIDTH - 1 and rows.max() < HEIGHT - 1
            if inside and grid.valid.all():
                excess.append(max(columns.min() - left, right - columns.max(), rows.min() - top, bottom - rows.max()))
    assert np.median(excess or [0]) < 4


def test_a_lidar_splits_at_its_seam():
    """A Gaussian in front of the seam of a full turn has a record on either side of the grid."""
    sensor, grid = LIDARS["clockwise"], GRIDS["clockwise"]
    azimuth = sensor.azimuth_rad[0] + 0.5 * (sensor.azimuth_rad[0] - sensor.azimuth_rad[1])
    gaussians = scenes.gaussians([[10 * np.cos(azimuth), 10 * np.sin(azimuth), 0]], scale=0.3)
    view = ExposureView.of(grid, scenes.request(sensor).world_from_sensor)
    _, spans = project(grid, view, pack(gaussians))
    spans = spans[np.argsort(spans[:, 0])]
    assert (spans[0, 0], spans[1, 1]) == (0, grid.valid.shape[1] - 1)
    assert (spans[:, 1] - spans[:, 0] < 10).all()


def test_a_gaussian_around_the_sensor_covers_everything():
    for name in ("fisheye", "clockwise"):
        sensor, grid = {**CAMERAS, **LIDARS}[name], GRIDS[name]
        view = ExposureView.of(grid, scenes.request(sensor).world_from_sensor)
        _, spans = project(grid, view, pack(scenes.gaussians([[1.0, 0.2, 0.1]], scale=5.0)))
        height, width = grid.valid.shape
        assert spans.tolist() == [[0, width - 1, 0, height - 1]]


def test_what_lies_behind_a_lens_is_left_out():
    sensor, grid = CAMERAS["ftheta"], GRIDS["ftheta"]
    view = ExposureView.of(grid, scenes.request(sensor).world_from_sensor)
    _, spans = project(grid, view, pack(scenes.gaussians([[-5.0, 0.5, 0.2], [5.0, 0.5, 0.2]], scale=0.1)))
    assert len(spans) == 1


def test_charts_know_their_lidar():
    """Rows of a LiDAR chart agree with the sensor model."""
    grid = make_grid(sensors.lidar_model("PANDAR128", np.eye(4)))
    rows = grid.chart.places[0, :, 0]
    assert (np.diff(rows) <= 0).all()
    sine = np.sin(np.asarray(sensors.lidar_model("PANDAR128", np.eye(4)).elevation_rad))
    looked_up = np.interp(sine, np.linspace(-1, 1, len(rows)), rows)
    np.testing.assert_allclose(looked_up, np.arange(128) + 0.5, atol=0.06)
