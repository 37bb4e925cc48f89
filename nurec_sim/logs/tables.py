"""Trajectories, tracks and maps as JSON and back."""

from __future__ import annotations

from typing import Any

import numpy as np

from nurec_sim.errors import ClipError
from nurec_sim.logs import fields
from nurec_sim.logs.labels import is_movable, our_label
from nurec_sim.types import RoadMap, Track, Trajectory


def track_to_json(track: Track) -> dict[str, Any]:
    """One entry of tracks.json."""
    return {
        "id": track.id,
        "label": track.label,
        "size_lwh": [float(value) for value in track.size_m],
        "controllable": track.controllable,
        "t_us": track.path.t_us.tolist(),
        "T_world_box": track.path.world_from_body.tolist(),
    }


def trajectory_from_json(where: str, row: Any, pose_key: str) -> Trajectory:
    """A trajectory from times ``t_us`` and poses.

    Raises:
        ClipError: a field is missing or wrong, or the times do not increase.
    """
    times = fields.of_kind(where, row, "t_us", list)
    if not times:
        raise ClipError(f"{where}: 't_us' must be a list of whole microseconds with at least one entry")
    for time in times:
        fields.integer(where, {"t_us": time}, "t_us")
    poses = fields.array(where, row, pose_key, (len(times), 4, 4))
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        raise ClipError(f"{where}: t_us goes back or stands still at pose {back[0] + 1} ({times[back[0] + 1]} us)")
    return Trajectory(np.array(times, np.int64), poses)


def track_from_json(index: int, row: Any) -> Track:
    """One entry of tracks.json.

    Raises:
        ClipError: a field is missing or wrong.
    """
    where = f"tracks.json: track {index}"
    size = fields.array(where, row, "size_lwh", (3,))
    if (size <= 0).any():
        raise ClipError(f"{where}: size_lwh must be positive, got {size.tolist()}")
    label = our_label(fields.of_kind(where, row, "label", str))
    return Track(
        id=fields.of_kind(where, row, "id", str),
        label=label,
        size_m=(float(size[0]), float(size[1]), float(size[2])),
        path=trajectory_from_json(where, row, "T_world_box"),
        controllable=fields.of_kind(where, row, "controllable", bool, default=is_movable(label)),
    )


def map_to_json(road_map: RoadMap) -> dict[str, Any]:
    """map.json."""
    return {
        "drivable": [
            {"outer": area[0].tolist(), "holes": [hole.tolist() for hole in area[1:]]} for area in road_map.drivable
        ],
        "lanes": [lane.tolist() for lane in road_map.lanes],
    }


def map_from_json(row: dict[str, Any]) -> RoadMap:
    """A map from map.json.

    Raises:
        ClipError: a ring or a lane is not a list of points.
    """
    areas, lanes = [], []
    for index, area in enumerate(fields.of_kind("map.json", row, "drivable", list, default=[])):
        where = f"map.json: drivable area {index}"
        holes = dict(enumerate(fields.of_kind(where, area, "holes", list, default=[])))
        rings = [fields.array(where, area, "outer", (None, 2))]
        rings += [
            fields.array(f"{where}: hole {number}", {"hole": hole}, "hole", (None, 2)) for number, hole in holes.items()
        ]
        if any(len(ring) < 3 for ring in rings):
            raise ClipError(f"{where}: a ring needs at least 3 points")
        areas.append(tuple(rings))
    for index, lane in enumerate(fields.of_kind("map.json", row, "lanes", list, default=[])):
        line = fields.array(f"map.json: lane {index}", {"lane": lane}, "lane", (None, 3))
        if len(line) < 2:
            raise ClipError(f"map.json: lane {index} needs at least 2 points, got {len(line)}")
        lanes.append(line)
    return RoadMap(tuple(areas), tuple(lanes))
