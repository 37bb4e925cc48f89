"""The drivable area of a road map as one shapely geometry."""

from __future__ import annotations

from typing import Any

import numpy as np

from nurec_sim.types import RoadMap


def drivable_area(road_map: RoadMap) -> Any:
    """The union of the map's drivable polygons."""
    import shapely

    polygons = [shapely.Polygon(rings[0], rings[1:]) for rings in road_map.drivable]
    return shapely.union_all(shapely.make_valid(np.array(polygons, dtype=object)))
