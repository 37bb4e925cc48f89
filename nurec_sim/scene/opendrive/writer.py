"""An OpenDRIVE map (``map.xodr``) of a scene's drivable area and lanes, in ``<line>`` and ``<arc>`` only.

``opendrive.layout`` determines the roads; their widths are constant, their elevation is piecewise linear. Map
coordinates equal world coordinates: the geo-reference names the same origin as ``T_world_base`` of
``rig_trajectories.json``. Logs have no geodetic position, so that origin is latitude 0, longitude 0.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from jaxtyping import Float64

from nurec_sim.scene.opendrive.curves import resampled, sampled
from nurec_sim.scene.opendrive.road import LANE_WIDTH_M, SEAL_M, LaidRoad
from nurec_sim.scene.opendrive.road_area import drivable_area
from nurec_sim.types import RoadMap, Trajectory

HEIGHT_KNOT_M = 5.0
HEIGHT_NEIGHBOURS = 4
JOINT_M = 1e-6
"""Pieces end this much before the next one starts: rounding must not make borders run backwards at a joint."""
GEO_REFERENCE = "+proj=tmerc +lat_0=0 +lon_0=0 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +alt_0=0 +no_defs"
_WGS84_RADIUS_M = 6378137.0
Heights = Callable[[Float64[np.ndarray, "n 2"]], Float64[np.ndarray, " n"]]


def world_to_ecef() -> Float64[np.ndarray, "4 4"]:
    """ECEF from the world: x east, y north, z up at latitude 0, longitude 0, height 0."""
    return np.array(
        [[0.0, 0.0, 1.0, _WGS84_RADIUS_M], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    )


def opendrive_map(name: str, road_map: RoadMap, ego: Trajectory) -> bytes | None:
    """``map.xodr`` in UTF-8; None if no road can be derived from the map.

    Args:
        name: name of the scene.
        road_map: without drivable areas, lanes are ``LANE_WIDTH_M`` wide; without lanes, the recorded path is one.
        ego: the recorded path, with its origin on the ground.
    """
    from nurec_sim.scene.opendrive.layout import laid_out  # importing shapely is slow

    lanes = [lane for lane in road_map.lanes if len(lane) > 1 and np.ptp(lane[:, :2], axis=0).max() > 0]
    area = drivable_area(road_map) if road_map.drivable else _area_of_lanes(lanes)
    path = ego.position_m
    if not lanes and np.ptp(path[:, :2], axis=0).max() > 0:
        lanes = [path]
    roads = laid_out(area, lanes, path) if area is not None and not area.is_empty else []
    if not roads:
        return None
    heights = _heights([*lanes, path])
    root = Element("OpenDRIVE")
    west, south, east, north = area.bounds
    header = SubElement(root, "header", revMajor="1", revMinor="6", name=_plain(name), vendor="nurec_sim",
                        north=_text(north), south=_text(south), east=_text(east), west=_text(west))  # fmt: skip
    SubElement(header, "geoReference").text = GEO_REFERENCE
    for number, road in enumerate(roads):
        _add_road(root, str(number), road, heights)
    ElementTree.indent(root)
    xml = ElementTree.tostring(root, encoding="unicode")
    # ElementTree cannot write CDATA, which the standard uses for the projection string.
    xml = xml.replace(GEO_REFERENCE, f"<![CDATA[{GEO_REFERENCE}]]>")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{xml}\n'.encode()


def _area_of_lanes(lanes: list[Float64[np.ndarray, "k 3"]]):
    """The union of lanes of the usual width."""
    import shapely

    bands = [shapely.LineString(lane[:, :2]).buffer(LANE_WIDTH_M / 2, cap_style="flat") for lane in lanes]
    return shapely.union_all(bands) if bands else None


def _heights(lines: list[Float64[np.ndarray, "k 3"]]) -> Heights:
    """Ground height at any point: mean of the nearest known ones, weighted by inverse squared distance."""
    from scipy.spatial import cKDTree

    known = np.concatenate([resampled(line, 1.0) if len(line) > 1 else line for line in lines])
    tree = cKDTree(known[:, :2])

    def heights(xy: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, " n"]:
        distance, index = tree.query(xy, k=min(HEIGHT_NEIGHBOURS, len(known)))
        # The offset (1 cm squared) keeps the weight finite on a known point.
        weight = 1 / (distance.reshape(len(xy), -1) ** 2 + 1e-4)
        return (known[index, 2].reshape(len(xy), -1) * weight).sum(axis=1) / weight.sum(axis=1)

    return heights


def _add_road(root: Element, number: str, laid: LaidRoad, heights: Heights) -> None:
    total = _text(laid.length_m)
    road = SubElement(root, "road", name=f"{laid.lane} {number}", length=total, id=number, junction="-1")
    SubElement(road, "type", s="0", type="town")
    plan = SubElement(road, "planView")
    s = 0.0
    for piece in laid.reference:
        (x, y), heading = piece.xy, piece.heading_rad
        place = {"s": s, "x": x, "y": y, "hdg": heading, "length": piece.length_m - JOINT_M}
        geometry = SubElement(plan, "geometry", {key: _text(value) for key, value in place.items()})
        if piece.curvature_per_m == 0.0:
            SubElement(geometry, "line")
        else:
            SubElement(geometry, "arc", curvature=_text(piece.curvature_per_m))
        s += piece.length_m
    _add_heights(SubElement(road, "elevationProfile"), laid, heights)
    lanes = SubElement(SubElement(road, "lanes"), "laneSection", s="0")
    sealed_left, sealed_right = laid.sealed
    if sealed_left:
        _add_lane(SubElement(lanes, "left"), 1, "none", SEAL_M)
    SubElement(SubElement(lanes, "center"), "lane", id="0", type="none", level="false")
    right = SubElement(lanes, "right")
    _add_lane(right, -1, laid.lane, laid.width_m)
    if sealed_right:
        _add_lane(right, -2, "none", SEAL_M)


def _add_heights(profile: Element, laid: LaidRoad, heights: Heights) -> None:
    """Elevation along the middle of the lane, linear between knots."""
    xy, yaw = sampled(laid.reference)
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    knots = np.linspace(0.0, laid.length_m, max(2, int(np.ceil(laid.length_m / HEIGHT_KNOT_M)) + 1))
    # The reference line is the lane's left border; OpenDRIVE has one elevation across the road.
    right = laid.width_m / 2 * np.stack([np.sin(yaw), -np.cos(yaw)], axis=1)
    middle = np.stack([np.interp(knots, s, (xy + right)[:, axis]) for axis in range(2)], axis=1)
    z = heights(middle)
    slope = np.append(np.diff(z) / np.diff(knots), 0.0)
    for start, height, rise in zip(knots, z, slope, strict=True):
        SubElement(profile, "elevation", s=_text(start), a=_text(height), b=_text(rise), c="0", d="0")


def _add_lane(side: Element, number: int, kind: str, width_m: float) -> None:
    lane = SubElement(side, "lane", id=str(number), type=kind, level="false")
    SubElement(lane, "width", sOffset="0", a=_text(width_m), b="0", c="0", d="0")
    SubElement(lane, "roadMark", sOffset="0", type="none", material="standard", color="white")


def _text(value: float) -> str:
    """A number with 12 decimals; curvatures need them over long arcs."""
    return f"{float(value):.12f}"


def _plain(name: str) -> str:
    """A name without characters that XML does not allow."""
    return re.sub(r"[^\w .@:+-]", "_", name)
