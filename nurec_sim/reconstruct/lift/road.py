"""The road in a height grid: grown from the driven path up to the kerbs."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from nurec_sim.compute.cores import usable_cores
from nurec_sim.geometry import arc_length
from nurec_sim.reconstruct.lift.settings import GroundSettings

FILL_M = 3.0
"""Holes are filled up to this far from measured ground."""
SEEN_M, SURE_M = 0.4, 0.15
"""Ground this close to a measured cell counts as seen: where the road may grow, and where its edge is certain."""
DRIVEN_M = 1.2
"""Ground this close to the driven path counts as seen: the car drove there."""
ISLAND_M2 = 2.0
"""Parts within the road of which less was seen are road: uneven asphalt, and what lies under a standing car. Islands
for pedestrians are larger."""
ALONG, BEYOND_M = 0.1, 60.0
"""Distances along the drive count like this share of those across it; it goes on straight so far beyond its ends."""


def grow_road(
    height_m: Float32[np.ndarray, "rows columns"],
    known: Bool[np.ndarray, "rows columns"],
    tall: Bool[np.ndarray, "rows columns"],
    distance_m: Float32[np.ndarray, "rows columns"],
    corner_m: Float64[np.ndarray, " 2"],
    cell_m: float,
    world_from_rig: Float64[np.ndarray, "k 4 4"],
    settings: GroundSettings,
) -> Bool[np.ndarray, "rows columns"]:
    """Where a car can drive to from the path without meeting a step or an upright object.

    Args:
        height_m: of the ground, without holes.
        known: where it was measured.
        tall: cells with an upright object.
        distance_m: of each cell from the driven path.
        corner_m: x, y at which row and column 0 start.
        cell_m: edge of a cell.
        world_from_rig: the driven path.
        settings: steps, openings and reach of a road.
    """
    from_known = cv2.distanceTransform((~known).astype(np.uint8), cv2.DIST_L2, 5) * cell_m
    free = ~_steps(height_m, cell_m, settings) & ~tall & (from_known <= FILL_M)
    free &= distance_m <= settings.road_reach_m
    seen = (from_known <= SEEN_M) | (distance_m < DRIVEN_M)
    road = _grow(free, seen, height_m, distance_m, cell_m, settings)
    sure = (from_known <= SURE_M) | (distance_m < DRIVEN_M)
    hidden = ~sure & (from_known <= FILL_M) & (distance_m <= settings.road_reach_m)
    return _without_islands(_continued(road, sure, hidden, corner_m, cell_m, world_from_rig), seen, cell_m)


def _steps(height: np.ndarray, cell_m: float, settings: GroundSettings) -> np.ndarray:
    """Cells with a height step across 0.4 m in any of four directions."""
    reach = max(int(round(0.2 / cell_m)), 1)
    limit = settings.step_m + settings.slope * 2 * reach * cell_m
    steps = np.zeros(height.shape, bool)
    for dy, dx, stretch in ((0, reach, 1.0), (reach, 0, 1.0), (reach, reach, 1.4), (reach, -reach, 1.4)):
        rise = np.roll(height, (-dy, -dx), (0, 1)) - np.roll(height, (dy, dx), (0, 1))
        steps |= np.abs(rise) > (limit if stretch == 1.0 else settings.step_m + settings.slope * 2.8 * reach * cell_m)
    return steps


def _grow(
    free: np.ndarray,
    seen: np.ndarray,
    height: np.ndarray,
    distance: np.ndarray,
    cell_m: float,
    settings: GroundSettings,
) -> np.ndarray:
    """The part of the free cells that the path reaches, out to the kerb.

    Through seen cells only, because interpolation under a parked car turns a kerb into a ramp; through gaps wider than
    twice the opening; and no cell may lie far above or below the road beside it, which stops what leaks all the same.
    """
    driven = distance < 0.9
    room = cv2.distanceTransform((free & seen | driven).astype(np.uint8), cv2.DIST_L2, 5) * cell_m
    wide = (room > settings.opening_m) | driven
    reached = driven.copy()
    ring = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * max(round(0.4 / cell_m), 1) + 1,) * 2)
    for _ in range(round(settings.road_reach_m / 0.4)):
        # Compared with the road already reached beside it, not with the path: roads have crowns and ramps.
        level = _beside(height, reached, 0.5 / cell_m)
        grown = wide & (cv2.dilate(reached.astype(np.uint8), ring) > 0) & (np.abs(height - level) < settings.step_m)
        if not (grown & ~reached).any():
            break
        reached |= grown
    away = cv2.distanceTransform((~reached).astype(np.uint8), cv2.DIST_L2, 5) * cell_m
    road = reached | (free & seen & (away <= settings.opening_m + 1.5 * cell_m))
    # The step test reaches 0.2 m across the kerb: give back what still lies as low as the road beside it.
    away = cv2.distanceTransform((~road).astype(np.uint8), cv2.DIST_L2, 5) * cell_m
    road |= seen & (away <= 0.3) & (np.abs(height - _beside(height, road, 0.15 / cell_m)) < settings.step_m)
    return road


def _continued(
    road: Bool[np.ndarray, "rows columns"],
    sure: Bool[np.ndarray, "rows columns"],
    hidden: Bool[np.ndarray, "rows columns"],
    corner_m: Float64[np.ndarray, " 2"],
    cell_m: float,
    world_from_rig: Float64[np.ndarray, "k 4 4"],
) -> Bool[np.ndarray, "rows columns"]:
    """The road with what is hidden: it belongs to what is sure next to it along the drive, rather than across.

    A parked car hides the kerb beside it, which goes on as it does before and behind the car.
    """
    from scipy.spatial import cKDTree

    border = np.nonzero(sure & (cv2.erode(sure.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0))
    within = np.nonzero(hidden)
    road = road & sure
    if len(border[0]):
        beside_border, beside_hidden = (
            _along_and_across(corner_m + (np.column_stack(cells[::-1]) + 0.5) * cell_m, world_from_rig) * (ALONG, 1.0)
            for cells in (border, within)
        )
        road[within] = road[border][cKDTree(beside_border).query(beside_hidden, workers=usable_cores())[1]]
    return road


def _without_islands(road: np.ndarray, seen: np.ndarray, cell_m: float) -> np.ndarray:
    """The road with the parts within it of which less than ``ISLAND_M2`` was seen."""
    count, part = cv2.connectedComponents((~road).astype(np.uint8), connectivity=4)
    small = np.bincount(part[seen], minlength=count) * cell_m**2 < ISLAND_M2
    return road | small[part]


def _along_and_across(
    xy_m: Float64[np.ndarray, "n 2"], world_from_rig: Float64[np.ndarray, "k 4 4"]
) -> Float64[np.ndarray, "n 2"]:
    """Metres along the driven path, which goes on straight beyond its ends, and to its left.

    ``geometry.project_to_polyline`` for hundreds of thousands of points: the nearest of samples a metre apart decides,
    and not the nearest of all segments.
    """
    from scipy.spatial import cKDTree

    driven, ends = world_from_rig[:, :2, 3], world_from_rig[[0, -1], :2, 0] * BEYOND_M
    corners = np.concatenate([driven[:1] - ends[:1], driven, driven[-1:] + ends[1:]])
    length = arc_length(corners)
    at = np.arange(0.0, length[-1])
    line = np.column_stack([np.interp(at, length, corners[:, k]) for k in (0, 1)])
    ahead = np.gradient(line, axis=0)
    # It is zero where the car turned back on its own track.
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    nearest = cKDTree(line).query(xy_m, workers=usable_cores())[1]
    offset, ahead = xy_m - line[nearest], ahead[nearest]
    return np.column_stack(
        [at[nearest] + (offset * ahead).sum(axis=1), ahead[:, 0] * offset[:, 1] - ahead[:, 1] * offset[:, 0]]
    )


def _beside(height: np.ndarray, part: np.ndarray, sigma: float) -> np.ndarray:
    """Height of the nearest cells of a part: their mean under a Gaussian, infinite where none is near."""
    weight = part.astype(np.float32)
    total = cv2.GaussianBlur(np.where(part, height, 0).astype(np.float32), (0, 0), sigma)
    mass = cv2.GaussianBlur(weight, (0, 0), sigma)
    return np.where(mass > 1e-3, total / np.maximum(mass, 1e-3), np.inf)
