"""Triangulates areas of a plan finely enough to follow the terrain.

All areas are split along one lattice, so that neighbouring surfaces meet without gaps and paint stays above asphalt:
the plane through a triangle's corners lies within 4 mm of the smooth terrain (waves of 140 m and more, slopes up to 6
%).
"""

from __future__ import annotations

import numpy as np
import shapely
from jaxtyping import Float64

from nurec_sim.world.plan.terrain import Terrain

STEP_M = 2.5
TILE_STEPS = 8
_SMALLEST_M2 = 1e-6


def ground_triangles(area: shapely.Geometry, step_m: float = STEP_M) -> Float64[np.ndarray, "n 3 2"]:
    """Triangles (counter-clockwise, seen from above) that cover an area exactly, none larger than half a lattice cell.

    Areas with different steps do not meet exactly: extend the coarser one below the finer one.
    """
    found = []
    for tile in _tiles(area, step_m * TILE_STEPS):
        # Clipping to tiles first keeps the polygons of the lattice step small.
        inside = shapely.intersection(area, tile)
        for polygon in shapely.get_parts(inside):
            if polygon.geom_type == "Polygon" and polygon.area > _SMALLEST_M2:
                found.append(_cut(polygon, step_m))
    return np.concatenate(found) if found else np.zeros((0, 3, 2))


def on_ground(
    triangles_xy: Float64[np.ndarray, "n 3 2"], terrain: Terrain, lift_m: float
) -> Float64[np.ndarray, "n 3 3"]:
    """The same triangles ``lift_m`` above the terrain."""
    return np.concatenate([triangles_xy, terrain.height_m(triangles_xy)[..., None] + lift_m], axis=2)


def _tiles(area: shapely.Geometry, size_m: float) -> np.ndarray:
    """Lattice squares that intersect an area."""
    low_x, low_y, high_x, high_y = np.asarray(area.bounds) / size_m
    x, y = np.meshgrid(np.arange(np.floor(low_x), np.ceil(high_x)), np.arange(np.floor(low_y), np.ceil(high_y)))
    x, y = x.ravel() * size_m, y.ravel() * size_m
    boxes = shapely.box(x, y, x + size_m, y + size_m)
    shapely.prepare(area)
    return boxes[shapely.intersects(area, boxes)]


def _cut(polygon: shapely.Polygon, step_m: float) -> Float64[np.ndarray, "n 3 2"]:
    """A polygon within one tile, cut along the lattice."""
    low_x, low_y, high_x, high_y = np.asarray(polygon.bounds) / step_m
    x, y = np.meshgrid(np.arange(np.floor(low_x), np.ceil(high_x)), np.arange(np.floor(low_y), np.ceil(high_y)))
    corner = np.stack([x.ravel(), y.ravel()], axis=1)[:, None]
    # Cells are divided along x - y = const, also on all other surfaces, so that edges coincide.
    halves = (np.array([[0, 0], [1, 0], [1, 1]]), np.array([[0, 0], [1, 1], [0, 1]]))
    cells = np.concatenate([corner + half for half in halves]) * step_m
    shapes = shapely.polygons(cells)
    shapely.prepare(polygon)
    # Most half cells lie inside and are used as they are; only those on the border are intersected.
    whole = shapely.contains(polygon, shapes)
    cut = shapely.intersection(polygon, shapes[~whole & shapely.intersects(polygon, shapes)])
    parts = shapely.get_parts(cut)
    parts = shapely.get_parts(parts)  # an intersection may be a collection of polygons, lines and points
    parts = parts[(shapely.get_type_id(parts) == 3) & (shapely.area(parts) > _SMALLEST_M2)]
    pieces = shapely.get_parts(shapely.constrained_delaunay_triangles(parts))
    pieces = pieces[shapely.area(pieces) > _SMALLEST_M2]
    # Closed rings repeat their first corner.
    small = shapely.get_coordinates(shapely.orient_polygons(pieces)).reshape(-1, 4, 2)[:, :3]
    return np.concatenate([cells[whole], small])
