"""Bird's-eye grid of road, non-road and unknown cells from road-class Gaussians.

``build_offroad_grid`` follows docs/metrics.md step by step: ground heights, evidence, adaptive bandwidth,
specks, driven corridor, closing, holes, two distance fields. Cells are [row along y, column along x]; a cell's index is
``floor((xy - origin) / cell)``.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from nurec_sim import geometry
from nurec_sim.errors import ReconstructError
from nurec_sim.metrics.ground import GroundHeights, fit_ground
from nurec_sim.types import Box, Gaussians, GaussianScene, Label, RoadMap, Trajectory

FAR_M = 1e6
"""Distance to a class that does not occur in the grid."""


class Cell(enum.IntEnum):
    """Cell class."""

    UNKNOWN = 0
    ROAD = 1
    NONROAD = 2


@dataclass(frozen=True)
class GridSettings:
    """Parameters of the grid (``docs/metrics.md``).

    ``reach_m``: beyond this distance from the driven path non-road is unknown, because reconstructions label road only
    up to there.
    """

    cell_m: float = 0.1
    coarse_cell_m: float = 0.2
    max_fine_cells: int = 6_000_000
    margin_m: float = 20.0
    reach_m: float = 12.0
    below_ground_m: float = 0.4
    above_ground_m: float = 0.6
    min_opacity: float = 0.05
    bandwidth_m: tuple[float, float] = (0.1, 0.5)
    bandwidth_factor: float = 0.7
    density_band_m: float = 3.0
    min_mass: float = 1.5
    road_speck_m2: float = 1.0
    nonroad_speck_m2: float = 0.3
    corridor_m: float = 1.0
    closing_m: float = 0.4
    hole_m2: float = 12.0


@dataclass(frozen=True)
class OffroadGrid:
    """The grid and its two distance fields in metres, 0 inside and increasing outwards.

    ``beyond_possible_m`` is the distance to the nearest cell that is road or unknown, ``beyond_known_m`` the distance
    to the nearest road cell. ``overruled_frac`` is the fraction of the driven corridor labelled non-road: a measure of
    label quality.
    """

    origin_m: tuple[float, float]
    cell_m: float
    state: UInt8[np.ndarray, "rows columns"]
    beyond_possible_m: Float32[np.ndarray, "rows columns"]
    beyond_known_m: Float32[np.ndarray, "rows columns"]
    bandwidth_m: float
    overruled_frac: float

    @classmethod
    def from_state(
        cls, origin_m: tuple[float, float], cell_m: float, state: np.ndarray, bandwidth_m: float, overruled: float
    ) -> OffroadGrid:
        """A grid from its cells; computes the distance fields.

        Args:
            origin_m: lower corner (x, y) of the grid in the world.
            cell_m: side length of a cell.
            state: ``Cell`` values [rows, columns].
            bandwidth_m: bandwidth of the evidence that the cells were decided with.
            overruled: fraction of the driven corridor that was labelled non-road.
        """
        possible = distance_to(state != Cell.NONROAD, cell_m)
        known = distance_to(state == Cell.ROAD, cell_m)
        return cls(origin_m, cell_m, state.astype(np.uint8), possible, known, bandwidth_m, overruled)

    def look_up(
        self, xy_m: Float64[np.ndarray, "*n 2"]
    ) -> tuple[Float64[np.ndarray, "*n"], Float64[np.ndarray, "*n"], Bool[np.ndarray, "*n"]]:
        """Both distances at points, bilinear between cell centres, and whether the points lie on the grid."""
        rows, columns = self.state.shape
        place = (np.asarray(xy_m, np.float64) - np.asarray(self.origin_m)) / self.cell_m
        inside = np.all((place >= 0) & (place < np.array([columns, rows])), axis=-1)
        # Cell k is sampled at its centre k + 0.5; within half a cell of the border the value is constant.
        column = np.clip(place[..., 0] - 0.5, 0, columns - 1)
        row = np.clip(place[..., 1] - 0.5, 0, rows - 1)
        column0, row0 = np.minimum(column.astype(np.int64), columns - 2), np.minimum(row.astype(np.int64), rows - 2)
        fc, fr = column - column0, row - row0
        corner = row0 * columns + column0

        def sample(field: np.ndarray) -> np.ndarray:
            flat = field.reshape(-1)
            upper = flat[corner] * (1 - fc) + flat[corner + 1] * fc
            return upper * (1 - fr) + (flat[corner + columns] * (1 - fc) + flat[corner + columns + 1] * fc) * fr

        return sample(self.beyond_possible_m), sample(self.beyond_known_m), inside


def build_offroad_grid(
    static: Gaussians, ego: Trajectory, body: Box, settings: GridSettings | None = None
) -> OffroadGrid:
    """The grid around a recorded path.

    Args:
        static: the static layer; only labels ROAD and OTHER are used, not movable objects.
        ego: recorded rig poses; the rig's origin lies on the ground.
        body: box of the recorded car; its front and rear extend the driven corridor at the ends.
        settings: parameters.

    Raises:
        ReconstructError: no Gaussian is labelled road.
    """
    settings = settings or GridSettings()
    path = driven_path(ego, body)
    low, high = path[:, :2].min(axis=0) - settings.margin_m, path[:, :2].max(axis=0) + settings.margin_m
    fine = float(np.prod((high - low) / settings.cell_m)) <= settings.max_fine_cells
    cell = settings.cell_m if fine else settings.coarse_cell_m
    columns, rows = (np.ceil((high - low) / cell)).astype(int)

    mean = static.mean_m.astype(np.float64)
    inside = np.all((mean[:, :2] >= low) & (mean[:, :2] < low + np.array([columns, rows]) * cell), axis=1)
    usable = inside & (static.opacity > settings.min_opacity) & np.isin(static.label, (Label.ROAD, Label.OTHER))
    mean, opacity, is_road = mean[usable], static.opacity[usable], static.label[usable] == Label.ROAD
    if not is_road.any():
        raise ReconstructError(
            f"no Gaussian near the recorded path is labelled road ({len(static)} Gaussians, {int(usable.sum())} of "
            "them opaque and within reach): off-road is unknown"
        )
    ground = fit_ground(mean[is_road], path, (low[0], low[1]), (high[0], high[1]))
    layer = _near_ground(mean, ground, settings)
    mean, opacity, is_road = mean[layer], opacity[layer], is_road[layer]

    index = np.floor((mean[:, :2] - low) / cell).astype(np.int64)
    flat = index[:, 1] * columns + index[:, 0]
    evidence = [
        np.bincount(flat[chosen], opacity[chosen], rows * columns).reshape(rows, columns).astype(np.float32)
        for chosen in (is_road, ~is_road)
    ]
    # The driven path is road by definition: the recorded car was there.
    path_cells = np.floor((path[:, :2] - low) / cell).astype(np.int64)
    on_path = np.zeros((rows, columns), bool)
    on_path[path_cells[:, 1], path_cells[:, 0]] = True
    from_path = distance_to(on_path, cell)

    # Mean spacing of the Gaussians near the path is 1 / sqrt(density). The bandwidth must span it, otherwise gaps
    # between Gaussians become unknown cells; a larger one blurs the road edge.
    band = from_path < settings.density_band_m
    density = int(np.count_nonzero(band.reshape(-1)[flat])) / (int(np.count_nonzero(band)) * cell**2)
    bandwidth = float(np.clip(settings.bandwidth_factor / np.sqrt(max(float(density), 1e-6)), *settings.bandwidth_m))
    state = _decide(evidence[0], evidence[1], cell, bandwidth, settings)
    _drop_specks(state, cell, settings)
    # Measured before the corridor is overwritten, as a diagnostic of the labels.
    corridor = from_path <= settings.corridor_m
    overruled = float(np.mean(state[corridor] == Cell.NONROAD))
    state[corridor] = Cell.ROAD
    _close(state, cell, settings)
    _fill_holes(state, cell, settings)
    state[(from_path > settings.reach_m) & (state == Cell.NONROAD)] = Cell.UNKNOWN
    return OffroadGrid.from_state((float(low[0]), float(low[1])), cell, state, bandwidth, overruled)


def scene_offroad_grid(scene: GaussianScene, settings: GridSettings | None = None) -> OffroadGrid:
    """The grid of a reconstructed scene; see ``build_offroad_grid``."""
    return build_offroad_grid(scene.static, scene.ego, scene.rig.body, settings)


def road_map_of_grid(grid: OffroadGrid, smooth_m: float = 0.2) -> RoadMap:
    """The road cells as drivable polygons with smoothed outlines, without lanes; unknown cells are not drivable."""
    import shapely

    # Runs of road cells along each row as rectangles: far fewer polygons to unite than cells.
    road = np.pad((grid.state == Cell.ROAD).astype(np.int8), ((0, 0), (1, 1)))
    row, start = np.nonzero(np.diff(road, axis=1) == 1)
    _, stop = np.nonzero(np.diff(road, axis=1) == -1)
    x0, y0 = grid.origin_m
    cell = grid.cell_m
    area = shapely.union_all(shapely.box(x0 + start * cell, y0 + row * cell, x0 + stop * cell, y0 + (row + 1) * cell))
    # Morphological opening rounds the staircase of cells and removes slivers thinner than 2 smooth_m.
    area = shapely.buffer(shapely.buffer(area, -smooth_m), smooth_m).simplify(cell / 2)
    polygons = [polygon for polygon in shapely.get_parts(area) if polygon.geom_type == "Polygon"]
    rings = [(polygon.exterior, *polygon.interiors) for polygon in polygons]
    return RoadMap(tuple(tuple(np.array(ring.coords)[:-1, :2] for ring in each) for each in rings))


def driven_path(ego: Trajectory, body: Box, step_m: float = 0.05) -> Float64[np.ndarray, "k 3"]:
    """Ground points under the car's centre line, from its rear at the first pose to its front at the last one."""
    nose = body.center_m[0] + body.size_m[0] / 2
    tail = body.center_m[0] - body.size_m[0] / 2
    poses = ego.world_from_body
    ends = [poses[0] @ np.array([tail, 0, 0, 1.0]), poses[-1] @ np.array([nose, 0, 0, 1.0])]
    points = np.concatenate([[ends[0][:3]], poses[:, :3, 3], [ends[1][:3]]])
    length = geometry.arc_length(points)
    # Interpolation over arc length needs strictly increasing stations; repeated poses of a standing car are dropped.
    moved = np.concatenate([[True], np.diff(length) > 1e-9])
    points, length = points[moved], length[moved]
    at = np.linspace(0.0, length[-1], max(int(np.ceil(length[-1] / step_m)), 1) + 1)
    return np.stack([np.interp(at, length, points[:, axis]) for axis in range(3)], axis=1)


def distance_to(mask: Bool[np.ndarray, "rows columns"], cell_m: float) -> Float32[np.ndarray, "rows columns"]:
    """Distance in metres from every cell to the edge of a mask, 0 inside; ``FAR_M`` if the mask is empty."""
    import cv2

    if not mask.any():
        return np.full(mask.shape, FAR_M, np.float32)
    cells = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Distances are to cell centres; the mask's edge is half a cell nearer.
    return np.maximum((cells - 0.5) * np.float32(cell_m), 0).astype(np.float32)


def _near_ground(mean_m: np.ndarray, ground: GroundHeights, settings: GridSettings) -> np.ndarray:
    height = mean_m[:, 2] - ground.at(mean_m[:, :2])
    return (height > -settings.below_ground_m) & (height < settings.above_ground_m)


def _decide(road: np.ndarray, other: np.ndarray, cell: float, bandwidth: float, settings: GridSettings) -> np.ndarray:
    """Classifies cells with the smaller of two bandwidths that has enough opacity; the rest is unknown."""
    from scipy.ndimage import gaussian_filter

    state = np.zeros(road.shape, np.uint8)
    for sigma_m in (bandwidth, 1.5 * bandwidth):
        sigma = sigma_m / cell
        # The normalised kernel times its area peaks at one, so that it sums the opacities around.
        peak = 2 * np.pi * sigma**2
        smooth_road = gaussian_filter(road, sigma, mode="constant", truncate=3.0) * peak
        smooth_other = gaussian_filter(other, sigma, mode="constant", truncate=3.0) * peak
        decided = (state == Cell.UNKNOWN) & (smooth_road + smooth_other > settings.min_mass)
        state[decided] = np.where(smooth_road > smooth_other, Cell.ROAD, Cell.NONROAD)[decided]
    return state


def _drop_specks(state: np.ndarray, cell: float, settings: GridSettings) -> None:
    """Small islands of a class become unknown, not the other class."""
    from scipy.ndimage import label

    for kind, area_m2 in ((Cell.ROAD, settings.road_speck_m2), (Cell.NONROAD, settings.nonroad_speck_m2)):
        islands, count = label(state == kind)
        small = np.bincount(islands.reshape(-1), minlength=count + 1) * cell**2 < area_m2
        small[0] = False
        state[small[islands]] = Cell.UNKNOWN


def _close(state: np.ndarray, cell: float, settings: GridSettings) -> None:
    """Morphological closing of the road, without overwriting observed non-road."""
    grown = distance_to(state == Cell.ROAD, cell) <= settings.closing_m
    closed = distance_to(~grown, cell) > settings.closing_m
    state[closed & (state == Cell.UNKNOWN)] = Cell.ROAD


def _fill_holes(state: np.ndarray, cell: float, settings: GridSettings) -> None:
    """Fills small unknown holes inside the road (such as under a parked car)."""
    from scipy.ndimage import binary_dilation, label

    holes, count = label(state == Cell.UNKNOWN)
    fill = np.bincount(holes.reshape(-1), minlength=count + 1) * cell**2 < settings.hole_m2
    fill[0] = False
    # A hole that touches non-road or the grid's border may continue beyond what was seen, so it stays unknown.
    fill[np.unique(holes[binary_dilation(state == Cell.NONROAD)])] = False
    for border in (holes[0], holes[-1], holes[:, 0], holes[:, -1]):
        fill[np.unique(border)] = False
    state[fill[holes]] = Cell.ROAD
