"""Reducing Gaussians to a budget by merging those that share a voxel."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from render_scenes import camera, cloud, gaussians, psnr_db, request, scene

from nurec_sim import geometry
from nurec_sim.reconstruct.budget import (
    FILL,
    MAX_GROWTH,
    merge_voxels,
    reduce_to_budget,
    voxel_keys,
)
from nurec_sim.render import CpuRenderer
from nurec_sim.types import GAUSSIAN_FIELDS, OPTIONAL_GAUSSIAN_FIELDS, Gaussians

SMALL = settings(max_examples=25, deadline=None)


def street(n=20_000, seed=0):
    """A road and a wall beside it, denser near the origin, as pixels lifted from images are."""
    rng = np.random.default_rng(seed)
    x = 60 * rng.random(n) ** 3
    road = rng.random(n) < 0.6
    y = np.where(road, rng.uniform(-4, 4, n), 4 + rng.normal(0, 0.02, n))
    z = np.where(road, rng.normal(0, 0.02, n), rng.uniform(0, 5, n))
    base = cloud(n, seed)
    return dataclasses.replace(
        base, mean_m=np.stack([x, y, z], axis=1).astype(np.float32), label=road.astype(np.uint8),
        scale_m=(base.scale_m * 0.1).astype(np.float32),
    )  # fmt: skip


def covariance(g: Gaussians):
    spread = geometry.matrix_from_quat(g.quat_wxyz) * g.scale_m[:, None].astype(np.float64)
    return spread @ spread.transpose(0, 2, 1)


def mass(g: Gaussians):
    return g.opacity.astype(np.float64) * np.sort(g.scale_m.astype(np.float64), axis=1)[:, 1:].prod(axis=1)


def same(a: Gaussians, b: Gaussians):
    for name in (*GAUSSIAN_FIELDS, *OPTIONAL_GAUSSIAN_FIELDS):
        x, y = getattr(a, name), getattr(b, name)
        assert (x is None) == (y is None)
        if x is not None:
            assert x.dtype == y.dtype and x.tobytes() == y.tobytes(), name


@SMALL
@given(seed=st.integers(0, 10_000), n=st.integers(2, 40), offset=st.sampled_from([0.0, -3000.0, 20_000.0]))
def test_a_merged_gaussian_has_the_moments_of_its_members(seed, n, offset):
    g = cloud(n, seed, low=(-0.4, -0.4, -0.4), high=(0.4, 0.4, 0.4), sh=3, drop=True)
    # So transparent that all of them together are not opaque, which would make the merged one wider (test below).
    g = dataclasses.replace(
        g, label=np.ones(n, np.uint8), mean_m=g.mean_m + np.float32(offset), opacity=g.opacity / np.float32(n)
    )
    merged = merge_voxels(g, 100_000.0)
    assert len(merged) == 1

    weight = mass(g) / mass(g).sum()
    mean = weight @ g.mean_m.astype(np.float64)
    away = g.mean_m - mean
    expected = np.einsum("n,nij->ij", weight, covariance(g) + away[:, :, None] * away[:, None, :])
    assert np.allclose(merged.mean_m[0], mean, atol=1e-6 + 1e-7 * abs(offset))
    assert np.allclose(covariance(merged)[0], expected, rtol=1e-4, atol=1e-5)
    assert np.allclose(merged.rgb[0], weight @ g.rgb, atol=1e-5)
    assert np.allclose(merged.sh_rest[0], np.einsum("n,nkc->kc", weight, g.sh_rest), atol=1e-5)
    assert np.allclose(merged.ray_drop[0], weight @ g.ray_drop, atol=1e-5)
    known = np.isfinite(g.intensity)
    if known.any():
        assert np.isclose(merged.intensity[0], weight[known] @ g.intensity[known] / weight[known].sum(), atol=1e-5)
    else:
        assert np.isnan(merged.intensity[0])
    assert np.isclose(np.linalg.norm(merged.quat_wxyz[0]), 1, atol=1e-6)


def test_equal_gaussians_are_merged_as_with_uniform_weights():
    """Where nothing tells Gaussians apart but their places, the mean and covariance are those of the release."""
    places = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.0, 0.2, 0], [0.02, 0.1, 0.05]])
    g = gaussians(places, scale=(0.02, 0.03, 0.01), opacity=0.1, rgb=(0.2, 0.4, 0.6))
    merged = merge_voxels(g, 10.0)
    assert np.allclose(merged.mean_m[0], places.mean(axis=0), atol=1e-6)
    away = places - places.mean(axis=0)
    expected = np.diag([0.02, 0.03, 0.01]) ** 2 + away.T @ away / 4
    assert np.allclose(covariance(merged)[0], expected, atol=1e-7)


def optical_depth(g: Gaussians, reach=12.0, step=0.02):
    """Integral over the yz plane of what flat Gaussians of zero mean and rotation lay over it, square metres."""
    axis = np.arange(-reach, reach, step) * float(g.scale_m.max())
    y, z = np.meshgrid(axis, axis)
    total = np.zeros_like(y)
    for scale, opacity in zip(g.scale_m.astype(np.float64), g.opacity.astype(np.float64), strict=True):
        total -= np.log1p(-opacity * np.exp(-0.5 * ((y / scale[1]) ** 2 + (z / scale[2]) ** 2)))
    return total.sum() * (axis[1] - axis[0]) ** 2


def test_opacity_conserves_optical_depth():
    g = gaussians(np.zeros((3, 3)), scale=(0.01, 0.2, 0.1), opacity=[0.5, 0.2, 0.4])
    merged = merge_voxels(g, 1.0)
    assert np.allclose(np.sort(merged.scale_m[0]), [0.01, 0.1, 0.2], rtol=1e-5)
    merged = dataclasses.replace(merged, scale_m=np.float32([[0.01, 0.2, 0.1]]))
    assert np.isclose(optical_depth(merged), optical_depth(g), rtol=1e-3)


def test_opaque_gaussians_become_wider_but_not_thicker_or_without_end():
    opaque = gaussians(np.zeros((2, 3)), scale=(0.01, 0.2, 0.1), opacity=0.9)
    merged = merge_voxels(opaque, 1.0)
    small, middle, large = np.sort(merged.scale_m[0])
    assert np.isclose(small, 0.01, rtol=1e-5) and np.isclose(large / middle, 2.0, rtol=1e-5)
    assert 1.1 < large / 0.2 < MAX_GROWTH and merged.opacity[0] > 0.99
    many = merge_voxels(opaque[np.zeros(50, int)], 1.0)
    assert np.allclose(np.sort(many.scale_m[0]), [0.01, 0.1 * MAX_GROWTH, 0.2 * MAX_GROWTH], rtol=1e-5)


def test_a_wall_of_tiles_stays_as_opaque_as_it_was():
    y, z = np.meshgrid(np.arange(-40, 40) * 0.05 + 0.025, np.arange(-40, 40) * 0.05 + 0.025)
    places = np.stack([np.full(y.size, 4.0), y.ravel(), z.ravel()], axis=1)
    shade = 0.5 + 0.3 * np.sin(places[:, 1:2] * 2)
    wall = gaussians(places, scale=(0.002, 0.04, 0.04), opacity=0.6)
    wall = dataclasses.replace(wall, rgb=np.repeat(shade, 3, axis=1).astype(np.float32))
    merged = merge_voxels(wall, 0.1)
    assert len(merged) < len(wall) / 3
    view = request(camera())
    before, after = (CpuRenderer(scene(g, sky=1.0)).render_camera(view, ("rgb", "alpha")) for g in (wall, merged))
    middle = np.s_[14:34, 26:46]
    assert before.alpha[middle].min() > 0.9
    assert np.abs(after.alpha[middle] - before.alpha[middle]).mean() < 0.05
    assert psnr_db(after.rgb[middle], before.rgb[middle]) > 30


def test_labels_do_not_mix():
    g = street(5000)
    merged = merge_voxels(g, 0.5)
    assert np.unique(voxel_keys(g, 0.5)).size == len(merged) < len(g)
    for label in (0, 1):
        alone = merge_voxels(g[g.label == label], 0.5)
        assert (merged.label == label).sum() == len(alone)
    assert mass(merged[merged.label == 1]).sum() > 0


def test_what_is_alone_in_its_voxel_stays_as_it_is():
    g = cloud(300, sh=3, drop=True)
    merged = merge_voxels(g, 1e-4)
    assert len(merged) == len(g)
    order = np.argsort(voxel_keys(g, 1e-4), kind="stable")
    same(merged, g[order])


@pytest.mark.parametrize("share", [0.9, 0.5, 0.1, 0.01])
def test_a_budget_is_used_and_kept(share):
    g = street()
    budget = int(share * len(g))
    merged, voxel_m = reduce_to_budget(g, budget)
    assert FILL * budget <= len(merged) <= budget
    assert voxel_m > 0
    # The same input gives the same bytes, and the size that was found is the size that was used.
    same(merged, reduce_to_budget(g, budget)[0])
    same(merged, merge_voxels(g, voxel_m))
    again = voxel_keys(g, voxel_m)
    assert np.unique(again).size == len(merged)


def test_a_budget_that_holds_already_changes_nothing():
    g = cloud(50)
    for budget in (None, 50, 1000):
        result, voxel_m = reduce_to_budget(g, budget)
        assert result is g and voxel_m is None
    nothing = Gaussians.empty()
    assert reduce_to_budget(nothing, 5)[0] is nothing


def test_impossible_budgets_are_refused():
    with pytest.raises(ValueError, match="a budget must allow at least 1 Gaussian, got 0"):
        reduce_to_budget(cloud(10), 0)
    g = dataclasses.replace(cloud(30), label=np.repeat(np.arange(3), 10).astype(np.uint8))
    with pytest.raises(ValueError, match="a budget of 2 is less than the number of labels, 3"):
        reduce_to_budget(g, 2)
    assert len(reduce_to_budget(g, 3)[0]) == 3


def test_copies_in_one_place_merge_at_any_size():
    """No voxel is small enough to leave more than the places there are."""
    g = cloud(40)
    rows = np.repeat(np.arange(4), 10)
    g = dataclasses.replace(g, mean_m=g.mean_m[rows], label=np.zeros(40, np.uint8))
    assert len(reduce_to_budget(g, 20)[0]) == 4


def test_mass_stays_sane():
    g = street()
    merged, _ = reduce_to_budget(g, len(g) // 2)
    ratio = mass(merged).sum() / mass(g).sum()
    # Gaussians that overlap cover less than their sum; wide ones never more than about what their members cover.
    assert 0.5 < ratio < 1.5
    assert (merged.opacity > 0).all() and (merged.opacity <= 1).all()
    assert np.isfinite(merged.mean_m).all() and (merged.scale_m > 0).all()
    low, high = g.mean_m.min(axis=0), g.mean_m.max(axis=0)
    assert (merged.mean_m >= low - 1e-4).all() and (merged.mean_m <= high + 1e-4).all()


@SMALL
@given(seed=st.integers(0, 1000))
def test_the_order_of_the_input_does_not_matter(seed):
    g = street(400, seed)
    shuffled = g[np.random.default_rng(seed).permutation(len(g))]
    a, b = merge_voxels(g, 1.5), merge_voxels(shuffled, 1.5)
    # The origin of the grid is a whole number of voxels, so the voxels are the same; their order too.
    assert len(a) == len(b)
    assert np.allclose(a.mean_m, b.mean_m, atol=1e-4)
    assert np.allclose(a.opacity, b.opacity, atol=1e-5)
    assert np.allclose(covariance(a), covariance(b), atol=1e-4)


def test_degenerate_input_gives_sound_output():
    flat = gaussians([[0, 0, 0], [0.01, 0, 0], [5e8, 0, 0], [6e8, 0.01, 0]], scale=(1e-5, 1e-5, 1e-5), opacity=1.0)
    normal = np.array([[0, 0, 1], [0, 0, -1], [0, 0, 0], [0, 0, 1]], np.float32)
    merged = merge_voxels(dataclasses.replace(flat, normal=normal), 0.1)
    assert len(merged) == 2
    # Opposite normals say nothing; an unknown one does not count.
    assert sorted(np.linalg.norm(merged.normal, axis=1).tolist()) == [0.0, 1.0]
    assert (merged.scale_m >= np.float32(1e-3)).all() and np.isfinite(merged.scale_m).all()
    assert np.isfinite(merged.opacity).all() and (merged.opacity < 1).all()
    assert np.isnan(merged.intensity).all()
