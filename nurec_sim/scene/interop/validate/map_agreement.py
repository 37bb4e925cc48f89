"""AlpaSim's off-road rule against a drivable area, at the recorded poses and beside them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from nurec_sim import geometry
from nurec_sim.scene.interop.validate.alpasim_map import AlpasimMap

PLACEMENTS = 900
ASIDE_M = 8.0
TURN_RAD = float(np.radians(6.0))
BORDER_M = 0.25
LEAST_SHARE = 0.98


@dataclass(frozen=True)
class MapAgreement:
    """Agreement of map and area.

    ``judged`` of ``placements`` have no corner within ``BORDER_M`` of reaching over the border. ``false_alarms`` are
    off-road by the map only, ``misses`` by the area only; ``misses_across`` of those still stand on the area with a
    corner (the rule cannot find cars that are wholly outside and touch no edge).
    ``alarms_on_path`` and ``poses_off_lanes`` count recorded poses that are inside the area.
    """

    placements: int
    judged: int
    false_alarms: int
    misses: int
    misses_across: int
    alarms_on_path: int
    poses_off_lanes: int

    @property
    def share(self) -> float:
        """Fraction of judged placements on which both agree; 1 without any."""
        return 1 - (self.false_alarms + self.misses) / max(self.judged, 1)


def outlines(
    world_from_rig: Float64[np.ndarray, "n 4 4"], centre_m: Float64[np.ndarray, " 3"], size_m: Float64[np.ndarray, " 3"]
) -> tuple[Float64[np.ndarray, "n 3"], np.ndarray]:
    """Centres of the car's box at rig poses, and its outlines as shapely polygons."""
    import shapely

    middle = world_from_rig[:, :3, 3] + world_from_rig[:, :3, :3] @ np.asarray(centre_m)
    boxes = np.array(world_from_rig)
    boxes[:, :3, 3] = middle
    return middle, shapely.polygons(geometry.box_corners_xy(boxes, float(size_m[0]), float(size_m[1])))


def placed(
    world_from_rig: Float64[np.ndarray, "n 4 4"], count: int = PLACEMENTS, seed: int = 0
) -> Float64[np.ndarray, "count 4 4"]:
    """Poses beside the path, evenly along it: up to 8 m lateral offset, rotated by up to 6 degrees."""
    draw = np.random.default_rng(seed)
    along = geometry.arc_length(world_from_rig[:, :2, 3])
    # Uniform in distance, not in time: a waiting car would get most of the samples.
    at = np.interp(draw.uniform(0, along[-1], count), along, np.arange(len(along)))
    poses = world_from_rig[np.clip(np.rint(at).astype(int), 0, len(along) - 1)].copy()
    poses[:, :3, 3] += draw.uniform(-ASIDE_M, ASIDE_M, count)[:, None] * poses[:, :3, 1]
    yaw = draw.uniform(-TURN_RAD, TURN_RAD, count)
    turn = np.tile(np.eye(3), (count, 1, 1))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(yaw)
    turn[:, 1, 0], turn[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
    poses[:, :3, :3] = poses[:, :3, :3] @ turn
    return poses


def agreement(
    roads: AlpasimMap,
    area: Any,
    world_from_rig: Float64[np.ndarray, "n 4 4"],
    centre_m: Float64[np.ndarray, " 3"],
    size_m: Float64[np.ndarray, " 3"],
    count: int = PLACEMENTS,
    seed: int = 0,
) -> MapAgreement:
    """Compares the off-road verdicts of map and area on random placements, and on the recorded poses.

    Args:
        roads: the map as AlpaSim reads it.
        area: the drivable area, shapely geometry in the same coordinates.
        world_from_rig: [n,4,4] recorded poses of the rig, in map coordinates.
        centre_m: centre of the car's box in the rig frame.
        size_m: length, width and height of the box.
        count: number of placements beside the path.
        seed: seed of the placements.
    """
    import shapely

    middle, cars = outlines(placed(world_from_rig, count, seed), centre_m, size_m)
    # Placements within BORDER_M of the border are ambiguous and not judged.
    inner, outer = shapely.buffer(area, -BORDER_M), shapely.buffer(area, BORDER_M)
    on, off = shapely.contains(inner, cars), ~shapely.contains(outer, cars)
    judged = on | off
    predicted: Bool[np.ndarray, " n"] = np.zeros(count, bool)
    predicted[judged] = roads.offroad(middle[judged], cars[judged])
    missed = judged & off & ~predicted
    path_middle, path_cars = outlines(world_from_rig, centre_m, size_m)
    at_home = shapely.contains(area, path_cars)
    alarms = roads.offroad(path_middle[at_home], path_cars[at_home])
    return MapAgreement(
        count,
        int(judged.sum()),
        int((on & predicted).sum()),
        int(missed.sum()),
        int(shapely.intersects(area, cars[missed]).sum()),
        int(alarms.sum()),
        int((~roads.on_lane(world_from_rig[at_home, :3, 3])).sum()),
    )
