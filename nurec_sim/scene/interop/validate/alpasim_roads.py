"""AlpaSim's interpretation of ``map.xodr``: lanes under the recorded path, and off-road results."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.files.decoding import LIMITS
from nurec_sim.scene import codec
from nurec_sim.scene.interop.validate.alpasim_map import AlpasimMap
from nurec_sim.scene.interop.validate.contents import Contents, entry_of, numbers_of
from nurec_sim.scene.interop.validate.finding import Report
from nurec_sim.scene.interop.validate.map_agreement import LEAST_SHARE, MapAgreement, agreement, outlines
from nurec_sim.scene.interop.validate.shared import RIG
from nurec_sim.scene.opendrive.reader import ecef_from_map
from nurec_sim.scene.opendrive.road_area import drivable_area
from nurec_sim.types import RoadMap

XODR, FACTS = "map.xodr", "nurec_sim/scene.json"
PLACEMENTS = 200
MOST_POSES = 500
MIN_PATH_M = 10.0
"""A car that hardly moved has no places beside its path to compare."""


def check_roads(
    report: Report,
    contents: Contents,
    root: ElementTree.Element,
    document: dict[str, Any],
    world_from_rig: Float64[np.ndarray, "t 4 4"],
) -> None:
    """Adds findings on lanes and edges along the recorded path, as AlpaSim reads them.

    Args:
        report: collects the findings.
        contents: the archive.
        root: root element of its ``map.xodr``.
        document: contents of ``rig_trajectories.json``: ``T_world_base`` and the car's box.
        world_from_rig: [t,4,4] recorded poses of the rig.
    """
    import shapely

    with report.rule("xodr-lanes"):
        try:
            roads = AlpasimMap(root)
            poses = _in_map(contents, document, world_from_rig)[:: max(1, len(world_from_rig) // MOST_POSES)]
            away = int((~roads.on_lane(poses[:, :3, 3])).sum())
            if away:
                report.add("lane-under-path", f"{XODR}: no lane lies under {away} of {len(poses)} recorded poses")
            try:
                centre_m, size_m = _box(document)
            except ArchiveError:
                return  # the rule of the box tells
            _check_verdicts(report, roads, contents, poses, centre_m, size_m)
        except shapely.errors.ShapelyError as error:
            raise ArchiveError(f"{XODR}: its lanes are no polygons ({error})") from error


def _check_verdicts(
    report: Report, roads: AlpasimMap, contents: Contents, poses: np.ndarray, centre_m: np.ndarray, size_m: np.ndarray
) -> None:
    area = _area(contents) if np.ptp(poses[:, :2, 3], axis=0).max() >= MIN_PATH_M else None
    if area is None:
        middle, cars = outlines(poses, centre_m, size_m)
        alarms = int(roads.offroad(middle, cars).sum())
    else:
        found = agreement(roads, area, poses, centre_m, size_m, PLACEMENTS)
        alarms = found.alarms_on_path
        if found.judged and found.share < LEAST_SHARE:
            report.add("offroad-agrees", f"{XODR}: {_described(found)}")
    if alarms:
        report.add("offroad-on-path", f"{XODR}: {alarms} of {len(poses)} recorded poses are off the road by its lanes")


def _described(found: MapAgreement) -> str:
    return (
        f"on {found.share:.1%} of {found.judged} placements beside the path the verdict is that of the drivable area "
        f"({found.false_alarms} false alarms, {found.misses} misses)"
    )


def _in_map(contents: Contents, document: dict[str, Any], poses: Float64[np.ndarray, "t 4 4"]) -> np.ndarray:
    """Poses in the map's coordinates."""
    ecef_from_own = ecef_from_map(contents.read(XODR), XODR)
    base = document.get("T_world_base")
    if base is None or ecef_from_own is None:
        return poses
    ecef_from_world = numbers_of(base, f"{RIG}: T_world_base", 4, 4)
    return geometry.inverse(ecef_from_own) @ ecef_from_world @ poses


def _box(document: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    where = f"{RIG}: rig_trajectories[0]"
    box = entry_of(document["rig_trajectories"][0], "rig_bbox", where)
    centre, size = (numbers_of(entry_of(box, key, where), f"{where}.rig_bbox.{key}", 3) for key in ("centroid", "dim"))
    if not (size > 0).all():
        raise ArchiveError(f"{where}.rig_bbox has no size")
    return centre, size


def _area(contents: Contents) -> Any:
    """The drivable area that our own scenes know, else None."""
    if FACTS not in contents:
        return None
    try:
        facts = codec.load(contents.read(FACTS, LIMITS.json_bytes), FACTS)
        road_map = codec.from_json(codec.optional(codec.record(RoadMap)), facts["road_map"], "road_map")
    except (ArchiveError, KeyError, TypeError):
        return None  # our own reader's rules tell
    if road_map is None or not road_map.drivable:
        return None
    area = drivable_area(road_map)
    return None if area.is_empty else area
