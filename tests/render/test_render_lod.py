"""Levels of detail: merging keeps moments, choices draw everything once, and pictures stay close to full detail."""

import dataclasses

import numpy as np
import pytest
from render_scenes import camera, gaussians, psnr_db, request, scene

from nurec_sim import geometry
from nurec_sim.render import CpuRenderer
from nurec_sim.render.cpu.grid import make_grid
from nurec_sim.render.cpu.pack import BLOCK
from nurec_sim.render.lod import Detail, choose_blocks, merge_levels, ray_spacing
from nurec_sim.render.merging import GROUP, as_surfels, grouped, merge
from nurec_sim.sensors import lidar_model
from nurec_sim.types import Label, Pinhole


def wall(n=30_000, seed=0, far=20.0, sigma_m=0.05, **fields):
    """Overlapping flat Gaussians, a pixel or two wide, on a wall across the view and the road before it."""
    rng = np.random.default_rng(seed)
    upright = np.arange(n) < n // 2
    # Not quite a plane: the order of Gaussians at exactly one depth would depend on how they are stored.
    mean = np.stack([rng.normal(far, 0.02, n), rng.uniform(-12, 12, n), rng.uniform(-1.6, 6, n)], axis=1)
    mean[~upright, 0], mean[~upright, 2] = rng.uniform(3, far, n - n // 2), -1.6
    scale = np.repeat(sigma_m * np.exp(0.3 * rng.normal(size=(n, 1))), 3, axis=1)
    scale[upright, 0] *= 0.1
    scale[~upright, 2] *= 0.1
    bricks = (np.floor(mean / 4).sum(axis=1) % 2)[:, None]
    values = {
        "quat_wxyz": (np.array([1.0, 0, 0, 0]) + rng.normal(0, 0.02, (n, 4))).astype(np.float32),
        "scale_m": scale.astype(np.float32),
        "opacity": rng.uniform(0.3, 1, n).astype(np.float32),
        "rgb": np.clip(0.3 + 0.3 * bricks + rng.normal(0, 0.02, (n, 3)), 0, 1).astype(np.float32),
        "label": np.where(upright, Label.OTHER, Label.ROAD).astype(np.uint8),
    }
    return dataclasses.replace(gaussians(mean), **(values | fields))


def covariance(some):
    """Covariance matrices of Gaussians."""
    spread = geometry.matrix_from_quat(some.quat_wxyz) * some.scale_m[:, None].astype(np.float64)
    return spread @ spread.transpose(0, 2, 1)


def test_merging_keeps_mean_covariance_and_coverage():
    rng = np.random.default_rng(1)
    faint = wall(1000, opacity=rng.uniform(0.02, 0.1, 1000).astype(np.float32))
    surfels = as_surfels(faint, np.zeros(1000))
    groups = grouped(surfels, GROUP * BLOCK)
    merged = merge(surfels, groups).gaussians
    mass = faint.opacity.astype(np.float64) * surfels.area
    weight = mass[groups] / mass[groups].sum(axis=1, keepdims=True)
    mean = np.einsum("gk,gkc->gc", weight, faint.mean_m[groups])
    offset = faint.mean_m[groups] - mean[:, None]
    second = np.einsum("gk,gkij->gij", weight, covariance(faint)[groups] + offset[..., :, None] * offset[..., None, :])
    assert np.allclose(merged.mean_m, mean, atol=1e-5)
    assert np.allclose(covariance(merged), second, atol=1e-6)
    assert np.allclose(merged.rgb, np.einsum("gk,gkc->gc", weight, faint.rgb[groups]), atol=1e-6)
    # Faint Gaussians hardly hide each other, so that the opacities times areas add up.
    flat = (np.abs(surfels.axis[groups] @ [1, 0, 0]) > 0.99).all(axis=1)
    drawn = merged.opacity.astype(np.float64) * np.sort(merged.scale_m, axis=1)[:, 1:].prod(axis=1)
    assert flat.sum() > 50
    assert np.median(drawn[flat] / mass[groups[flat]].sum(axis=1)) == pytest.approx(1, abs=0.05)


def test_opaque_neighbours_merge_into_an_opaque_gaussian():
    four = gaussians(
        [(5, 0, 0), (5, 0.1, 0), (5, 0, 0.1), (5, 0.1, 0.1)], opacity=1.0, scale=np.float32([0.01, 0.2, 0.2])
    )
    surfels = as_surfels(four, np.zeros(4))
    merged = merge(surfels, np.arange(4)[None])
    assert merged.gaussians.opacity[0] == pytest.approx(0.99)
    assert np.sort(merged.gaussians.scale_m[0])[1:].min() > 0.2
    assert 0 < np.sqrt(merged.error_m2[0]) < 0.1


def test_other_fields_follow_the_mass():
    four = dataclasses.replace(
        gaussians(np.eye(4, 3) * 0.01 + (5, 0, 0), scale=0.1, opacity=[0.9, 0.3, 0.3, 0.2], label=[1, 2, 2, 2]),
        normal=np.float32([(1, 0, 0), (0, 1, 0), (0, 0, 0), (np.nan, 0, 0)]),
        intensity=np.float32([0.2, 0.6, np.nan, np.nan]),
        ray_drop=np.float32([1, 0, 0, 0]),
        sh_rest=np.arange(36, dtype=np.float32).reshape(4, 3, 3),
    )
    merged = merge(as_surfels(four, np.zeros(4)), np.arange(4)[None]).gaussians
    share = four.opacity / four.opacity.sum()
    assert merged.label[0] == 1
    assert merged.intensity[0] == pytest.approx(0.3)
    assert merged.ray_drop is not None and merged.ray_drop[0] == pytest.approx(share[0])
    assert merged.sh_rest is not None and np.allclose(merged.sh_rest[0], np.einsum("k,kjc->jc", share, four.sh_rest))
    assert np.allclose(merged.normal[0], np.array([3, 1, 0]) / np.sqrt(10), atol=1e-6)
    unknown = dataclasses.replace(four, intensity=np.full(4, np.nan, np.float32), normal=np.zeros((4, 3), np.float32))
    blank = merge(as_surfels(unknown, np.zeros(4)), np.arange(4)[None]).gaussians
    assert np.isnan(blank.intensity[0]) and not blank.normal.any()


@pytest.mark.parametrize("n", [0, 1, 5, 1024, 5000])
def test_every_level_has_a_quarter_of_the_one_below(n):
    levels = merge_levels(wall(5000)[:n])
    assert [len(level.gaussians) for level in levels] == [-(-n // 4**k) for k in range(4)]
    for level in levels:
        packed = level.packed
        assert len(packed) == len(level.error_m) == -(-len(level.gaussians) // BLOCK)
        assert np.array_equal(packed.index[: len(level.gaussians)], np.arange(len(level.gaussians)))
        assert np.isfinite(level.error_m).all()
    assert not levels[0].error_m.any()


def test_level_0_is_what_can_be_drawn():
    opacity = np.full(5000, 0.5, np.float32)
    opacity[::7] = 0.001
    level = merge_levels(wall(5000, opacity=opacity), levels=1)[0]
    assert len(level.gaussians) == (opacity > 0.01).sum()
    assert (level.gaussians.opacity == 0.5).all()


def test_extreme_gaussians_merge_into_finite_ones():
    strange = wall(3000)
    mean, scale, rgb = strange.mean_m.copy(), strange.scale_m.copy(), strange.rgb.copy()
    mean[::100], scale[50::100], scale[51::100] = 1e11, 1e9, 1e-12
    rgb[30::100], mean[70::200], scale[99::100, 0] = 1e10, np.nan, np.inf
    levels = merge_levels(dataclasses.replace(strange, mean_m=mean, scale_m=scale, rgb=rgb))
    assert len(levels[0].gaussians) == 3000 - 15 - 30
    for level in levels:
        assert np.isfinite(level.error_m).all() and (level.packed.index[: len(level.gaussians)] >= 0).all()
        for name in ("mean_m", "quat_wxyz", "scale_m", "opacity", "rgb"):
            assert np.isfinite(getattr(level.gaussians, name)).all()


@pytest.mark.parametrize("tolerance_px", [0.0, 0.02, 0.3, 3.0, 1e6])
def test_a_choice_draws_everything_exactly_once(tolerance_px):
    levels = merge_levels(wall())
    blocks = len(levels[0].packed)
    rng = np.random.default_rng(2)
    for _ in range(5):
        chosen = choose_blocks(levels, rng.uniform(-30, 30, 3), 0.01, tolerance_px)
        covered = [np.arange(b * GROUP**k, min((b + 1) * GROUP**k, blocks)) for k in range(4) for b in chosen[k]]
        assert np.array_equal(np.sort(np.concatenate(covered)), np.arange(blocks))
    if tolerance_px == 0:
        assert [len(c) for c in chosen] == [blocks, 0, 0, 0]
    if tolerance_px == 1e6:
        assert [len(c) for c in chosen] == [0, 0, 0, len(levels[3].error_m)]


def test_blocks_out_of_view_are_left_out_and_nearer_ones_are_finer():
    levels = merge_levels(wall())
    eye = np.array([0.0, 0, 0])
    whole = choose_blocks(levels, eye, 0.01, 0.3)
    seen = [np.flatnonzero(level.packed.block_centre[:, 1] > 0) for level in levels]
    half = choose_blocks(levels, eye, 0.01, 0.3, seen)
    for all_blocks, some, visible in zip(whole, half, seen, strict=True):
        assert np.array_equal(some, np.intersect1d(all_blocks, visible))
    drawn = [
        sum(len(blocks) for blocks in choose_blocks(levels, np.array([x, 0, 0]), 0.01, 0.3)) for x in (0, -30, -90)
    ]
    assert drawn[0] > drawn[1] > drawn[2]


def drawn(full, asked, detail_px, threads=2):
    """A picture at a level of detail, and how many Gaussians it took."""
    (picture,), (stats,) = CpuRenderer(scene(full), threads=threads, detail_px=detail_px).measure([asked])
    return picture, stats.visible


def test_fewer_gaussians_draw_nearly_the_same_picture():
    full, asked = wall(60_000, far=35.0, sigma_m=0.1), request(camera(240, 136))
    reference, all_visible = drawn(full, asked, 0.0)
    picture, visible = drawn(full, asked, 0.035)
    assert visible < 0.95 * all_visible
    assert psnr_db(picture.rgb, reference.rgb) >= 50
    assert (picture.label != reference.label).mean() < 0.01
    assert np.abs(picture.depth_m - reference.depth_m)[reference.alpha > 0.99].mean() < 0.05
    coarse, fewer = drawn(full, asked, 0.6)
    assert fewer < 0.6 * visible and 40 < psnr_db(coarse.rgb, reference.rgb) < psnr_db(picture.rgb, reference.rgb)
    again, _ = drawn(full, asked, 0.035, threads=1)
    assert np.array_equal(again.rgb, picture.rgb) and np.array_equal(again.depth_m, picture.depth_m)


def test_no_tolerance_draws_everything():
    full, asked = wall(5000), request(camera())
    detail = Detail.of(full, 0.0)
    layers = detail.layers(np.zeros(3), 0.01, lambda packed: np.arange(len(packed)))
    assert len(layers) == 1 and (layers[0][0].index >= 0).sum() == len(full)
    default = CpuRenderer(scene(full)).render_camera(asked)
    assert np.array_equal(drawn(full, asked, 0.0)[0].rgb, default.rgb)


def test_a_sweep_at_a_level_of_detail_finds_the_same_wall():
    world, asked = scene(wall(60_000, far=35.0, sigma_m=0.1)), request(lidar_model("VLP-16", np.eye(4), columns=360))
    full = CpuRenderer(world).render_lidar(asked)
    (some,), (stats,) = CpuRenderer(world, detail_px=0.3).measure([asked])
    assert stats.visible < 50_000
    _, mine, theirs = np.intersect1d(some.beam, full.beam, return_indices=True)
    assert len(mine) > 0.98 * len(full.beam)
    assert np.median(np.abs(some.range_m[mine] - full.range_m[theirs])) < 0.05


@pytest.mark.parametrize("detail_px", [-1.0, np.nan, np.inf])
def test_nonsense_tolerances_are_refused(detail_px):
    with pytest.raises(ValueError, match="detail_px must be finite and not negative, got"):
        CpuRenderer(scene(wall(10)), detail_px=detail_px)


def test_layers_hold_the_chosen_blocks_in_view():
    detail = Detail.of(wall(), 0.3)
    everywhere = detail.layers(np.zeros(3), 0.01, lambda packed: np.arange(len(packed)))
    chosen = choose_blocks(detail.levels, np.zeros(3), 0.01, 0.3)
    kept = [blocks for blocks in chosen if len(blocks)]
    assert len(kept) == len(everywhere) >= 2
    assert all(np.array_equal(blocks, some) for (_, blocks), some in zip(everywhere, kept, strict=True))
    assert detail.layers(np.zeros(3), 0.01, lambda packed: np.arange(0)) == []


def test_spacing_is_that_of_most_neighbours():
    direction = make_grid(camera(400, 400, Pinhole(2000.0, 2000.0, 200.0, 200.0))).direction
    assert ray_spacing(direction) == pytest.approx(1 / 2000, rel=0.01)
    assert ray_spacing(direction[:1, :1]) == 0.0


def test_merging_is_the_same_every_time():
    first, second = merge_levels(wall(5000)), merge_levels(wall(5000))
    for a, b in zip(first, second, strict=True):
        for name in ("mean_m", "quat_wxyz", "scale_m", "opacity", "rgb", "label"):
            assert np.array_equal(getattr(a.gaussians, name), getattr(b.gaussians, name))
        assert np.array_equal(a.error_m, b.error_m)
