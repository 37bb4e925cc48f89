"""Costs of depths by the neighbours of a view, and their sums along paths, against the plain formulas."""

import numpy as np
import pytest

from nurec_sim import geometry
from nurec_sim.network.stereo.paths import FORWARDS, add_paths, brightness_steps
from nurec_sim.reconstruct.lift import smoothing
from nurec_sim.reconstruct.lift.matching import NEUTRAL_COST, census, open_costs
from nurec_sim.reconstruct.lift.smoothing import PRIOR_CAP, PRIOR_COST, UNIT
from nurec_sim.reconstruct.lift.views import Tile, WorkingView

SHAPE = (12, 20)
LEVELS = np.linspace(0, 0.4, 19) ** 1.5


def view_at(xyz_m, rgb, drift_m=(0.0, 0.0, 0.0), fraction=(0.0, 0.0, 0.0)):
    height, width = rgb.shape[:2]
    tile = Tile(width, height, 18.0, (width / 2, height / 2), np.eye(3), 1, None, np.ones((height, width), bool),
                np.array(fraction))  # fmt: skip
    pose = geometry.pose(geometry.rotation_from_yaw(0.1 * xyz_m[0]), np.array(xyz_m, float))
    return WorkingView("front", 0, 0, True, tile, pose, np.array(drift_m), rgb)


def gray_of(rgb):
    return rgb.mean(axis=-1).astype(np.uint8)


def costs_of(view, others, open_pixels):
    around = [(other.packed, other.rgb, census(gray_of(other.rgb))) for other in others]
    codes = census(gray_of(view.rgb))
    return open_costs(view.packed, view.world_from_view, view.rgb, codes, open_pixels, around, LEVELS) / UNIT


def expected_cost(view, others, row, column):
    """All levels of one pixel: points at their depths, projected one by one; means of the two that fit best."""
    code = int(census(gray_of(view.rgb))[row, column])
    seen = [[] for _ in LEVELS]
    for k, w in enumerate(LEVELS):
        w = max(w, 1e-9)
        uv = np.array([column + 0.5, row + 0.5, 1.0])
        shutter = lambda each, uv: each.drift_m * np.clip(each.tile.fraction @ uv, -0.5, 0.5)  # noqa: E731
        ray = np.array([(uv[0] - view.tile.center_px[0]) / 18, (uv[1] - view.tile.center_px[1]) / 18, 1])
        point = geometry.transform_points(view.world_from_view, ray / w + shutter(view, uv))
        for other in others:
            middle, size = np.array(other.tile.center_px), (other.tile.width, other.tile.height)
            local = geometry.transform_points(geometry.inverse(other.world_from_view), point)
            if local[2] <= 0:
                continue
            moved = local - shutter(other, np.array([*(18 * local[:2] / local[2] + middle), 1.0]))
            u, v = 18 * moved[:2] / moved[2] + middle
            if 0 <= u < size[0] and 0 <= v < size[1]:
                colour = np.abs(other.rgb[int(v), int(u)].astype(int) - view.rgb[row, column]).sum()
                bits = (code ^ int(census(gray_of(other.rgb))[int(v), int(u)])).bit_count()
                seen[k].append(min(0.6 * colour, 50) + min(2 * bits, 50))
    best = [np.mean(sorted(values)[:2]) if values else np.nan for values in seen]
    return np.where(np.isnan(best), max(24.0, np.nanmean(best)), best)


@pytest.mark.parametrize("fraction", [(0.0, 0.0, 0.0), (0.0, 1 / 12, -0.5)])
def test_costs_are_those_of_points_projected_one_by_one(fraction):
    """Four neighbours, one of another size; the last is far ahead, so that near points lie behind it."""
    rng = np.random.default_rng(1)
    smooth = np.add.outer(np.arange(15), np.arange(24))[..., None]
    pictures = [(7 * smooth + rng.integers(0, 60, (15, 24, 3))).astype(np.uint8) for _ in range(5)]
    pictures = [rgb if k == 2 else rgb[:12, :20] for k, rgb in enumerate(pictures)]
    drift = (0.3, 0.1, 0.4) if any(fraction) else (0.0, 0.0, 0.0)
    places = [(0, 0, 0), (0.5, 0, 0.2), (-0.8, 0.1, 0.5), (0.1, 0.3, -1), (1, 0, 30)]
    view, *others = (view_at(xyz, rgb, drift, fraction) for xyz, rgb in zip(places, pictures, strict=True))
    open_pixels = np.ones(SHAPE, bool)
    open_pixels[3, 4:9] = False
    found = costs_of(view, others, open_pixels)
    expected = np.array([expected_cost(view, others, *pixel) for pixel in np.argwhere(open_pixels)])
    assert found.shape == (12 * 20 - 5, len(LEVELS))
    # A point on the border of two pixels may fall in either.
    same = np.isclose(found, expected, atol=0.5 / UNIT + 1e-9)
    assert same.mean() > 0.995


def test_without_neighbours_all_depths_fit_alike():
    view = view_at((0, 0, 0), np.zeros((*SHAPE, 3), np.uint8))
    assert (costs_of(view, [], np.ones(SHAPE, bool)) * UNIT == NEUTRAL_COST).all()


def given(seed=2):
    """Costs of an image in which some pixels are measured, in whole numbers, and the same of all pixels."""
    rng = np.random.default_rng(seed)
    gray = rng.integers(0, 255, SHAPE, np.uint8)
    measured = np.where(rng.random(SHAPE) < 0.5, rng.integers(0, 18 * PRIOR_COST, SHAPE), -1).astype(np.int32)
    whole = np.minimum(np.abs(np.arange(19) * PRIOR_COST - measured[..., None]), PRIOR_CAP).astype(np.int16)
    whole[measured < 0] = rng.integers(0, 160 * UNIT, (np.count_nonzero(measured < 0), 19))
    return gray, measured, whole


def test_sums_are_those_of_the_paths_in_floating_point_to_the_bit():
    gray, measured, whole = given()
    jumps, small = np.rint(np.maximum(80 / (1 + np.arange(256) / 8), 11) * UNIT).astype(np.int16), np.int16(10 * UNIT)
    total, result = np.zeros(whole.shape, np.uint16), np.zeros(SHAPE, np.float32)
    expected = np.zeros(whole.shape, np.float32)
    for sign in (1, -1):
        directions = sign * np.array(FORWARDS)
        steps = np.stack([brightness_steps(gray.astype(np.float32), *each) for each in directions]).astype(int)
        add_paths(whole.astype(np.float32), jumps[steps].astype(np.float32), np.float32(small), directions, expected)
        smoothing.sum_paths(whole[measured < 0], measured, gray, jumps, small, LEVELS, sign > 0, total, result)
        if sign > 0:
            assert np.array_equal(total, expected)
    best = expected.argmin(axis=-1)
    assert (np.abs(np.interp(result, LEVELS, np.arange(19)) - best) <= 0.51).all()
    assert np.array_equal(smoothing.smooth_depth(whole[measured < 0], measured, gray, LEVELS), result)


def test_the_greatest_sums_fit_16_bits():
    assert 8 * (PRIOR_CAP + smoothing.SMOOTH_MANY * UNIT) < 1 << 16
