"""An OpenDRIVE map (``map.xodr``): one single-lane road per lane centre line, or along the recorded path.

Reference lines are chains of cubic pieces (``paramPoly3``, parameter 0..1) through points of the line, so positions
and headings are continuous; heights are cubic pieces in arc length. Map coordinates equal world coordinates: the
geo-reference names the same origin as ``T_world_base`` of ``rig_trajectories.json``. Logs carry no geodetic position,
so that origin is latitude 0, longitude 0.
"""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64

from nurec_sim.geometry import arc_length
from nurec_sim.types import GaussianScene

LANE_WIDTH_M = 3.5
KNOT_SPACING_M = 2.0
MIN_ROAD_M = 10.0
GEO_REFERENCE = "+proj=tmerc +lat_0=0 +lon_0=0 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +alt_0=0 +no_defs"
_WGS84_RADIUS_M = 6378137.0


def world_to_ecef() -> Float64[np.ndarray, "4 4"]:
    """ECEF from the world, for a world whose x is east, y north, z up at latitude 0, longitude 0, height 0."""
    return np.array(
        [[0.0, 0.0, 1.0, _WGS84_RADIUS_M], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    )


def opendrive_map(scene: GaussianScene) -> bytes:
    """``map.xodr`` of a scene, in UTF-8."""
    lanes = scene.road_map.lanes if scene.road_map is not None else ()
    lines = [
        line for line in (_clean_line(lane) for lane in lanes if len(lane)) if arc_length(line)[-1] >= KNOT_SPACING_M
    ]
    if not lines:
        lines = [recorded_path(scene)]
    root = ElementTree.Element("OpenDRIVE")
    corners = np.concatenate(lines)
    bounds = {
        "north": corners[:, 1].max(), "south": corners[:, 1].min(),
        "east": corners[:, 0].max(), "west": corners[:, 0].min(),
    }  # fmt: skip
    title = {"revMajor": "1", "revMinor": "6", "name": _plain(scene.id), "vendor": "nurec_sim"}
    header = ElementTree.SubElement(root, "header", title | {name: _text(value) for name, value in bounds.items()})
    ElementTree.SubElement(header, "geoReference").text = GEO_REFERENCE
    for number, line in enumerate(lines):
        _add_road(root, str(number), line)
    ElementTree.indent(root)
    xml = ElementTree.tostring(root, encoding="unicode")
    xml = xml.replace(GEO_REFERENCE, f"<![CDATA[{GEO_REFERENCE}]]>")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{xml}\n'.encode()


def recorded_path(scene: GaussianScene) -> Float64[np.ndarray, "k 3"]:
    """The path of the rig; a car that hardly moved gets a straight road through where it stands."""
    line = _clean_line(scene.ego.position_m)
    length = arc_length(line)[-1]
    if length >= MIN_ROAD_M:
        return line
    if length < KNOT_SPACING_M:
        pose = scene.ego.world_from_body[0]
        along = np.array([-MIN_ROAD_M / 2, 0.0, MIN_ROAD_M / 2])
        return pose[:3, 3] + along[:, None] * pose[:3, 0]
    step = line[-1] - line[-2]
    ahead = line[-1] + step / np.linalg.norm(step) * (MIN_ROAD_M - length)
    return np.concatenate([line, ahead[None]])


def _clean_line(line: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "k 3"]:
    """Points at least ``KNOT_SPACING_M`` apart: standing still and jitter leave no knots."""
    points = np.asarray(line, np.float64)
    kept = [0]
    for index in range(1, len(points)):
        if np.linalg.norm(points[index, :2] - points[kept[-1], :2]) >= KNOT_SPACING_M:
            kept.append(index)
    last = len(points) - 1
    if len(kept) > 1 and kept[-1] != last:
        kept[-1] = last  # end where the line ends
    return points[kept]


def _headings(line: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, " k"]:
    """Heading at every point: that of the circle through it and its neighbours."""
    step = np.diff(line[:, :2], axis=0)
    chord = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    if len(chord) == 1:
        return np.repeat(chord, 2)
    length = np.linalg.norm(step, axis=1)
    inner = (chord[:-1] * length[1:] + chord[1:] * length[:-1]) / (length[:-1] + length[1:])
    return np.concatenate([[2 * chord[0] - inner[0]], inner, [2 * chord[-1] - inner[-1]]])


def _add_road(root: ElementTree.Element, number: str, line: Float64[np.ndarray, "k 3"]) -> None:
    headings = _headings(line)
    pieces = [_cubic(line[i, :2], line[i + 1, :2], headings[i], headings[i + 1]) for i in range(len(line) - 1)]
    lengths = np.array([length for _, _, length in pieces])
    start_m = np.concatenate([[0.0], np.cumsum(lengths)])

    total = _text(start_m[-1])
    road = ElementTree.SubElement(root, "road", name=f"road {number}", length=total, id=number, junction="-1")
    ElementTree.SubElement(road, "type", s="0", type="town")
    plan = ElementTree.SubElement(road, "planView")
    for (u, v, length), s, point, heading in zip(pieces, start_m, line, headings, strict=False):
        place = {"s": s, "x": point[0], "y": point[1], "hdg": heading, "length": length}
        geometry = ElementTree.SubElement(plan, "geometry", {key: _text(value) for key, value in place.items()})
        coefficients = {f"{letter}U": value for letter, value in zip("abcd", u, strict=True)}
        coefficients |= {f"{letter}V": value for letter, value in zip("abcd", v, strict=True)}
        poly = {key: _text(value) for key, value in coefficients.items()}
        ElementTree.SubElement(geometry, "paramPoly3", poly | {"pRange": "normalized"})

    profile = ElementTree.SubElement(road, "elevationProfile")
    slope = np.gradient(line[:, 2], start_m)
    for i, length in enumerate(lengths):
        rise, s0, s1 = line[i + 1, 2] - line[i, 2], slope[i], slope[i + 1]
        c, d = (3 * rise / length - 2 * s0 - s1) / length, (s0 + s1 - 2 * rise / length) / length**2
        values = {"s": start_m[i], "a": line[i, 2], "b": s0, "c": c, "d": d}
        ElementTree.SubElement(profile, "elevation", {key: _text(value) for key, value in values.items()})
    _add_lane(road)


def _add_lane(road: ElementTree.Element) -> None:
    """One driving lane (-1) whose middle is the reference line: the lane offset moves its left border aside."""
    lanes = ElementTree.SubElement(road, "lanes")
    ElementTree.SubElement(lanes, "laneOffset", s="0", a=_text(LANE_WIDTH_M / 2), b="0", c="0", d="0")
    section = ElementTree.SubElement(lanes, "laneSection", s="0")
    for side, number, kind in (("center", "0", "none"), ("right", "-1", "driving")):
        lane = ElementTree.SubElement(
            ElementTree.SubElement(section, side), "lane", id=number, type=kind, level="false"
        )
        if kind == "driving":
            ElementTree.SubElement(lane, "width", sOffset="0", a=_text(LANE_WIDTH_M), b="0", c="0", d="0")
        ElementTree.SubElement(lane, "roadMark", sOffset="0", type="none", material="standard", color="white")


def _cubic(
    start: np.ndarray, end: np.ndarray, heading0: float, heading1: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Hermite cubic between two points: coefficients of u and v in the frame of the start, and its arc length."""
    cos, sin = np.cos(heading0), np.sin(heading0)
    du, dv = np.array([[cos, sin], [-sin, cos]]) @ (end - start)
    chord = float(np.hypot(du, dv))
    turn = heading1 - heading0
    # The tangent length of a circular arc's cubic: its arc length to second order in the turn.
    tangent = chord * (1 + turn**2 / 24)
    end_u, end_v = tangent * np.cos(turn), tangent * np.sin(turn)
    u = np.array([0.0, tangent, 3 * du - 2 * tangent - end_u, tangent + end_u - 2 * du])
    v = np.array([0.0, 0.0, 3 * dv - end_v, end_v - 2 * dv])
    nodes, weights = np.polynomial.legendre.leggauss(8)
    p = (nodes + 1) / 2
    speed = np.hypot(u[1] + 2 * u[2] * p + 3 * u[3] * p**2, v[1] + 2 * v[2] * p + 3 * v[3] * p**2)
    return u, v, float(speed @ weights / 2)


def _text(value: float) -> str:
    """A number with nanometre resolution."""
    return f"{float(value):.9f}"


def _plain(name: str) -> str:
    """A name free of characters that XML does not allow."""
    return re.sub(r"[^\w .@:+-]", "_", name)
