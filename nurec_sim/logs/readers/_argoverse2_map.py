"""The vector map of an Argoverse 2 log: drivable areas and the middle of lanes."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.logs import fields
from nurec_sim.logs.storage import Storage
from nurec_sim.types import RoadMap

CARS = ("VEHICLE", "BUS")
SPACING_M = 2.0


def read_map(storage: Storage, name: str, origin_m: Float64[np.ndarray, " 3"]) -> RoadMap:
    """The map in the world of the clip, whose origin in the city is ``origin_m``.

    Raises:
        ClipError: a field is missing or wrong.
    """
    value = storage.read_json(name)
    areas = []
    for key, row in fields.of_kind(name, value, "drivable_areas", dict).items():
        ring = _points(f"{name}: drivable area {key}", row, "area_boundary") - origin_m
        if len(ring) < 3:
            raise ClipError(f"{name}: drivable area {key} needs at least 3 points, got {len(ring)}")
        areas.append((ring[:, :2],))
    lanes = []
    for key, row in fields.of_kind(name, value, "lane_segments", dict).items():
        where = f"{name}: lane segment {key}"
        if fields.of_kind(where, row, "lane_type", str) in CARS:
            sides = [_points(where, row, f"{side}_lane_boundary") - origin_m for side in ("left", "right")]
            if min(len(side) for side in sides) < 2:
                raise ClipError(f"{where}: a boundary needs at least 2 points")
            lanes.append(_middle(*sides))
    return RoadMap(tuple(areas), tuple(lanes))


def _points(where: str, row: Any, key: str) -> Float64[np.ndarray, "k 3"]:
    points = fields.of_kind(where, row, key, list)
    return np.array([[fields.number(f"{where}: {key}", point, axis) for axis in "xyz"] for point in points])


def _middle(left: Float64[np.ndarray, "j 3"], right: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, "n 3"]:
    """Mean of both boundaries at equal shares of their lengths."""
    lengths = [geometry.arc_length(side) for side in (left, right)]
    share = np.linspace(0.0, 1.0, max(2, round(max(length[-1] for length in lengths) / SPACING_M) + 1))
    sides = [
        np.stack([np.interp(share * length[-1], length, side[:, axis]) for axis in range(3)], axis=1)
        for side, length in zip((left, right), lengths, strict=True)
    ]
    return (sides[0] + sides[1]) / 2
