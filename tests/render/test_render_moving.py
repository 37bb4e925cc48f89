"""The packed moving layer puts Gaussians exactly where the readable one does."""

import dataclasses

import numpy as np
import pytest
from moving_layers import TRACKS, alive_rows, assert_packed_is_readable, layer, placed
from render_scenes import START_US, moved, moving_cloud

from nurec_sim import geometry
from nurec_sim.render.cpu.moving import PackedMoving
from nurec_sim.render.cpu.pack import (
    LOG_OPACITY,
    MEAN,
    REACH,
    SCALE,
)
from nurec_sim.types import DynamicGaussians, Gaussians


@pytest.mark.parametrize("t_us", [START_US, START_US - 70_000, START_US + 50_000, START_US + 150_000])
def test_same_as_the_readable_layer_over_time(t_us):
    dynamic = layer()
    assert 50 < assert_packed_is_readable(dynamic, t_us) < len(dynamic)


@pytest.mark.parametrize("sh", [0, 3, 8, 15])
def test_reposed_actors_carry_rotation_normals_and_seen_colours(sh):
    dynamic = layer(sh=sh)
    actors = {"near": moved(1.1, 20, -3), "unknown": np.eye(4), "empty": np.eye(4)}
    actors["near"][:3, :3] = actors["near"][:3, :3] @ geometry.matrix_from_quat(np.array([0.9, 0.3, -0.2, 0.1]))
    assert assert_packed_is_readable(dynamic, START_US, actors) > 50
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
        assert_packed_is_readable(one, START_US + t_us)


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
