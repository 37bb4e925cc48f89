"""Bird's-eye projection of one image, classified by road colour, for ``camera_road_follower``.

Grids ``[x, y]`` lie in the rig frame: rows ahead from the rear axle, columns from the right (-SIDE_M) to the left.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from nurec_sim import geometry
from nurec_sim.types import CameraFrame, CameraModel

CELL_M, AHEAD_M, SIDE_M = 0.25, 32.0, 10.0
TINT_TOLERANCE, DARKER, BRIGHTER = 0.09, -0.9, 0.28
"""Maximum difference of road from its known colour in log colour ratios, and in log brightness."""
SUNLIGHT, SUN_TOLERANCE, SUN_SPREAD, SUN_STEP, SUN_RANGE = (0.11, -0.14), 0.03, 0.05, (0.45, 0.9), 2.0
"""Change of log r/g and log b/g of asphalt from shade (lit by the sky) to sun, per log brightness."""
PAINT_TOLERANCE, PAINT_CELLS = 0.08, 2
ISLAND_M = 3.5
SEED_LENGTH_M, SEED_HALF_WIDTH_M = 4.0, 1.0
SHADE, SHADE_SHARE = 0.4, 0.015
"""Minimum difference of sun and shade in log brightness; fraction of shaded view that indicates sunshine."""


class RoadColour:
    """Road appearance model, updated at every plan from the seed: the ground right ahead of the car."""

    def __init__(self) -> None:
        self.road: Float64[np.ndarray, " 3"] | None = None
        self.sunlit = False

    def blocked(self, seen: Bool[np.ndarray, "x y"], colours: Float64[np.ndarray, "x y 3"]) -> Bool[np.ndarray, "x y"]:
        """Visible ground cells that do not match the road colour."""
        middle, half = seen.shape[1] // 2, int(SEED_HALF_WIDTH_M / CELL_M)
        first = int(np.argmax(seen[:, middle]))
        ahead = np.zeros_like(seen)
        ahead[first : first + int(SEED_LENGTH_M / CELL_M), middle - half : middle + half] = True
        if not (ahead & seen).any():
            return seen
        road = self.learn(colours[ahead & seen], colours[seen])
        return without_paint(seen & ~looks_like(colours, road, self.sunlit), colours, road) & seen

    def learn(self, seed: Float64[np.ndarray, "n 3"], view: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, " 3"]:
        """Follows the seed while it matches, adapting to sun at once, never to shade."""
        here = np.median(seed, axis=0)
        road = here if self.road is None else self.road
        brighter = here[2] - road[2]
        if looks_like(seed, road, sunlit=False).mean() > 0.5 and brighter > -SHADE:
            self.sunlit |= bool(brighter > SHADE)
            road = road + (1.0 if brighter > SHADE else 0.3) * (here - road)
        difference = view - road
        # Shade is lit by the sky, so it is bluer; merely darker patches may be a tyre or wet asphalt.
        bluer = (difference[:, 0] < 0.05 * difference[:, 2]) & (difference[:, 1] > -0.05 * difference[:, 2])
        shaded = looks_like(view, road, sunlit=True) & (difference[:, 2] < -SHADE) & bluer
        self.sunlit |= bool(shaded.mean() > SHADE_SHARE)
        self.road = road
        return road


def ground_view(frame: CameraFrame) -> tuple[Bool[np.ndarray, "x y"], Float64[np.ndarray, "x y 3"]]:
    """Projects the image to the ground: visible cells, and their (log r/g, log b/g, log brightness)."""
    pixels = ground_pixels(frame.camera)
    seen = pixels[..., 0] >= 0
    rgb = smoothed(frame.rgb)[pixels[..., 1], pixels[..., 0]]
    logs = np.log(rgb + 4.0)
    return seen, np.stack([logs[..., 0] - logs[..., 1], logs[..., 2] - logs[..., 1], logs.mean(axis=-1)], axis=-1)


def ground_pixels(camera: CameraModel) -> np.ndarray:
    """Image column and row [x, y, 2] at which an ideal pinhole sees each ground cell; -1 where invisible."""
    x = (np.arange(int(AHEAD_M / CELL_M)) + 0.5) * CELL_M
    y = (np.arange(int(2 * SIDE_M / CELL_M)) + 0.5) * CELL_M - SIDE_M
    ground = np.stack(np.broadcast_arrays(x[:, None], y[None, :], 0.0), axis=-1)
    inside_camera = geometry.transform_points(geometry.inverse(camera.rig_from_camera), ground)
    depth = np.maximum(inside_camera[..., 2], 0.1)
    lens = camera.ideal_pinhole
    assert lens is not None, "the loop gives policies ideal pinholes"
    u = np.floor(lens.fx_px * inside_camera[..., 0] / depth + lens.cx_px)
    v = np.floor(lens.fy_px * inside_camera[..., 1] / depth + lens.cy_px)
    good = (inside_camera[..., 2] > 0.5) & (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px)
    return np.where(good[..., None], np.stack([u, v], axis=-1), -1).astype(np.int64)


def smoothed(rgb: UInt8[np.ndarray, "h w 3"]) -> Float64[np.ndarray, "h w 3"]:
    """Mean over 3 x 3 pixels."""
    padded = np.pad(rgb.astype(np.float64), ((1, 1), (1, 1), (0, 0)), mode="edge")
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 9


def looks_like(
    colours: Float64[np.ndarray, "*n 3"], road: Float64[np.ndarray, " 3"], sunlit: bool
) -> Bool[np.ndarray, "*n"]:
    """Whether log colours match the road: same tint and brightness, or the same asphalt in shade or sun.

    Sun brightens by at least ``SUN_STEP``, a sidewalk by less; the threshold is higher once the road is sunlit.
    """
    difference = colours - road
    brighter = difference[..., 2]
    tint = np.abs(difference[..., :2]).max(axis=-1)
    alike = (tint < TINT_TOLERANCE) & (brighter > DARKER) & (brighter < BRIGHTER)
    unsunned = np.abs(difference[..., :2] - brighter[..., None] * SUNLIGHT).max(axis=-1)
    lit = (brighter > SUN_STEP[sunlit]) & (brighter < SUN_RANGE)
    relit = unsunned < SUN_TOLERANCE + SUN_SPREAD * np.abs(brighter)
    return alike | (relit & (lit | ((brighter > -SUN_RANGE) & (brighter < 0.0))))


def without_paint(
    blocked: Bool[np.ndarray, "x y"], colours: Float64[np.ndarray, "x y 3"], road: Float64[np.ndarray, " 3"]
) -> Bool[np.ndarray, "x y"]:
    """Blocked cells without thin structures: cracks and single pixels up to 0.5 m, white paint up to 1 m."""
    difference = colours - road
    paint = (np.abs(difference[..., :2]).max(axis=-1) < PAINT_TOLERANCE) & (difference[..., 2] > 0)
    return opened(blocked & ~paint, 1) | opened(blocked, PAINT_CELLS)


def borders(seen: Bool[np.ndarray, "x y"], blocked: Bool[np.ndarray, "x y"]) -> Bool[np.ndarray, "x y"]:
    """Blocked cells that bound the road: all but islands up to 3.5 m wide with road on their right and their left.

    Islands are cars and pedestrians: a reason to brake, not a road boundary.
    """
    right, left = room_beside(opened(seen & ~blocked, 2), np.inf)
    return blocked & (right + left > ISLAND_M)


def opened(mask: Bool[np.ndarray, "x y"], cells: int) -> Bool[np.ndarray, "x y"]:
    """Morphological opening: removes parts no wider than 2 ``cells``."""
    return grown(~grown(~mask, cells), cells)


def grown(mask: Bool[np.ndarray, "x y"], cells: int) -> Bool[np.ndarray, "x y"]:
    """A mask widened by ``cells`` on every side."""
    padded = np.pad(mask, cells)
    n, m = mask.shape
    across = np.logical_or.reduce([padded[:, j : j + m] for j in range(2 * cells + 1)])
    return np.logical_or.reduce([across[i : i + n] for i in range(2 * cells + 1)])


def distance_to(blocked: Bool[np.ndarray, "x y"], limit_m: float) -> Float64[np.ndarray, "x y"]:
    """Metres to the next blocked cell, up to ``limit_m``, in steps of one cell (octagonal neighbourhoods)."""
    near, distance = blocked, np.zeros(blocked.shape)
    for i in range(int(limit_m / CELL_M) + 1):
        distance += ~near * CELL_M
        padded = np.pad(near, 1)
        cross = padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:] | near
        near = grown(near, 1) if i % 2 else cross
    return distance


def room_beside(mask: Bool[np.ndarray, "x y"], limit_m: float) -> Float64[np.ndarray, "2 x y"]:
    """Metres from each cell to the next marked one on its right and on its left, ``limit_m`` where there is none."""
    columns = np.arange(mask.shape[1])
    right = np.maximum.accumulate(np.where(mask, columns, -10_000), axis=1)
    left = np.minimum.accumulate(np.where(mask, columns, 10_000)[:, ::-1], axis=1)[:, ::-1]
    return np.minimum(np.stack([columns - right, left - columns]) * CELL_M, limit_m)
