"""The packed moving layer puts Gaussians exactly where the readable one does."""

import dataclasses

import numpy as np
import pytest
from render_scenes import START_US, moved, moving_cloud, track

from nurec_sim import geometry
from nurec_sim.render.cpu.moving import PackedMoving
from nurec_sim.render.cpu.pack import (
    COLOUR,
    DROP,
    INTENSITY,
    KNOWN,
    LABEL,
    LOG_OPACITY,
    MAX_OPACITY,
    MEAN,
    NORMAL,
    QUAT,
    REACH,
    SCALE,
)
from nurec_sim.render.cpu.workers import Buffers, Workers
from nurec_sim.render.layers import moving_gaussians
from nurec_sim.types import DynamicGaussians, Gaussians

EYE = np.array([1.0, -2.0, 1.5])
TRACKS = [dataclasses.replace(track(), id=name) for name in ("near", "far", "empty")]


def layer(n=400, sh=0, seed=3):
    """Gaussians of two tracks and of none, with normals, in no particular order."""
    rng = np.random.default_rng(seed)
    parts = [moving_cloud(n, seed + k, track=k) for k in (-1, 0, 1)]
    order = rng.permutation(3 * n)
    gaussians = Gaussians.concatenate([part.gaussians for part in parts])[order]
    normal = rng.normal(size=(3 * n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal[rng.random(3 * n) < 0.1] = 0
    rest = rng.normal(0, 0.3, (3 * n, sh, 3)).astype(np.float32) if sh else None
    drop = rng.random(3 * n).astype(np.float32)
    gaussians = dataclasses.replace(gaussians, normal=normal.astype(np.float32), sh_rest=rest, ray_drop=drop)
    knot_t_us, knot_m, owner = (
        np.concatenate([getattr(part, name) for part in parts])[order] for name in ("knot_t_us", "knot_m", "track")
    )
    return DynamicGaussians(gaussians, knot_t_us, knot_m, owner)


def placed(dynamic, t_us, actors, threads=2):
    """The packed layer at an instant, its arrays copied."""
    with Buffers().lend() as array:
        result = PackedMoving.of(dynamic, TRACKS).at(t_us, actors, frozenset(), EYE, Workers(threads), array)
        return dataclasses.replace(result, fields=result.fields.copy())


def alive_rows(packed):
    """Rows of the layer that are alive, and their fields [n,21]."""
    fields = packed.fields.transpose(0, 2, 1).reshape(-1, packed.fields.shape[1])
    alive = np.flatnonzero(fields[:, LOG_OPACITY] > -1e8)
    order = np.argsort(packed.index[alive])
    return packed.index[alive][order], fields[alive][order]


def expected(dynamic, t_us, actors):
    """What the readable layer gives, and the rows of those that it keeps."""
    numbered = dataclasses.replace(
        dynamic,
        gaussians=dataclasses.replace(dynamic.gaussians, intensity=np.arange(len(dynamic), dtype=np.float32)),
    )
    result = moving_gaussians(numbered, TRACKS, t_us, actors, EYE)
    rows = result.intensity.astype(int)
    return rows, dataclasses.replace(result, intensity=dynamic.gaussians.intensity[rows])


def check(dynamic, t_us, actors=None):
    """Compare every field of every Gaussian; returns how many are alive."""
    actors = actors or {}
    rows, fields = alive_rows(placed(dynamic, t_us, actors))
    wanted_rows, wanted = expected(dynamic, t_us, actors)
    assert np.array_equal(rows, wanted_rows)
    quat = wanted.quat_wxyz / np.linalg.norm(wanted.quat_wxyz, axis=1, keepdims=True)
    drop = np.zeros(len(rows)) if wanted.ray_drop is None else wanted.ray_drop
    for first, values in (
        (MEAN, wanted.mean_m),
        (SCALE, wanted.scale_m),
        (QUAT, quat),
        (COLOUR, wanted.rgb),
        (NORMAL, wanted.normal),
        (LABEL, wanted.label[:, None]),
        (DROP, drop[:, None]),
        (INTENSITY, np.nan_to_num(wanted.intensity)[:, None]),
        (KNOWN, np.isfinite(wanted.intensity)[:, None]),
    ):
        got = fields[:, first : first + values.shape[1]]
        assert np.abs(got - values).max(initial=0) <= 1e-5, first
    opacity = np.exp(fields[:, LOG_OPACITY].astype(np.float64))
    assert np.abs(opacity - np.minimum(wanted.opacity, MAX_OPACITY)).max(initial=0) <= 1e-5
    return len(rows)


@pytest.mark.parametrize("t_us", [START_US, START_US - 70_000, START_US + 50_000, START_US + 150_000])
def test_same_as_the_readable_layer_over_time(t_us):
    dynamic = layer()
    assert 50 < check(dynamic, t_us) < len(dynamic)


@pytest.mark.parametrize("sh", [0, 3, 8, 15])
def test_reposed_actors_carry_rotation_normals_and_seen_colours(sh):
    dynamic = layer(sh=sh)
    actors = {"near": moved(1.1, 20, -3), "unknown": np.eye(4), "empty": np.eye(4)}
    actors["near"][:3, :3] = actors["near"][:3, :3] @ geometry.matrix_from_quat(np.array([0.9, 0.3, -0.2, 0.1]))
    assert check(dynamic, START_US, actors) > 50
    rows, fields = alive_rows(placed(dynamic, START_US, actors))
    still_rows, still = alive_rows(placed(dynamic, START_US, {}))
    assert np.array_equal(rows, still_rows)
    shift = np.linalg.norm(fields[:, :3] - still[:, :3], axis=1)
    owner = dynamic.track[rows]
    assert (shift[owner == 0] > 5).all() and (shift[owner != 0] == 0).all()


def test_every_instant_between_the_knots():
    knots = np.array([[0, 100_000, 300_000]]) + START_US
    positions = np.array([[[5, 0, 0], [6, 0, 0], [6, 4, 0]]], np.float32)
    one = moving_cloud(1)
    one = dataclasses.replace(
        one,
        gaussians=dataclasses.replace(one.gaussians, opacity=np.ones(1, np.float32)),
        knot_t_us=knots,
        knot_m=positions,
    )
    for t_us, where in ((0, None), (50_000, (5.5, 0, 0)), (100_000, (6, 0, 0)), (200_000, (6, 2, 0)), (300_001, None)):
        rows, fields = alive_rows(placed(one, START_US + t_us, {}))
        if where is not None:
            assert np.allclose(fields[0, MEAN : MEAN + 3], where, atol=1e-6)
        elif t_us > 300_000:
            assert len(rows) == 0
        check(one, START_US + t_us)


def test_nothing_before_and_after_life_or_in_an_empty_layer():
    dynamic = layer()
    for t_us in (START_US - 10_000_000, START_US + 10_000_000):
        assert len(placed(dynamic, t_us, {})) == 0
    assert len(placed(DynamicGaussians.empty(), START_US, {"near": np.eye(4)})) == 0


def test_blocks_hold_what_is_alive_and_are_skipped_in_time():
    early, late = moving_cloud(3000, 1), moving_cloud(3000, 2)
    both = DynamicGaussians(
        Gaussians.concatenate([early.gaussians, late.gaussians]),
        np.concatenate([early.knot_t_us, late.knot_t_us + 2_000_000]),
        np.concatenate([early.knot_m, late.knot_m]),
        np.concatenate([early.track, late.track]),
    )
    packed = placed(both, START_US + 10_000, {"near": moved(0.4, 30, 2)})
    assert len(packed) < len(PackedMoving.of(both, TRACKS)) * 0.6
    fields = packed.fields.astype(np.float64)
    for block in range(len(packed)):
        alive = fields[block, LOG_OPACITY] > -1e8
        offset = np.linalg.norm(fields[block, :3, alive] - packed.block_centre[block], axis=1)
        reach = fields[block, SCALE : SCALE + 3, alive].max(axis=1) * REACH
        assert (offset + reach <= packed.block_radius[block] * (1 + 1e-6)).all()


def test_broken_gaussians_are_left_out():
    dynamic = layer(50)
    knots, scale = dynamic.knot_m.copy(), dynamic.gaussians.scale_m.copy()
    knots[3, 2], scale[7] = np.nan, np.inf
    packed = PackedMoving.of(
        dataclasses.replace(dynamic, gaussians=dataclasses.replace(dynamic.gaussians, scale_m=scale), knot_m=knots),
        TRACKS,
    )
    visible = dynamic.gaussians.opacity >= np.float32(1 / 255)
    assert set(packed.index[packed.index >= 0]) == set(np.flatnonzero(visible)) - {3, 7}
    assert np.isfinite(packed.fields).all() and np.isfinite(packed.knot_m).all()


def test_the_same_bytes_for_any_number_of_threads():
    dynamic = layer(2000, sh=3)
    actors = {"far": moved(0.2, 1, 1)}
    one, three = (placed(dynamic, START_US, actors, threads) for threads in (1, 3))
    assert np.array_equal(one.fields, three.fields) and np.array_equal(one.index, three.index)
    assert np.array_equal(one.block_centre, three.block_centre) and np.array_equal(one.block_radius, three.block_radius)
