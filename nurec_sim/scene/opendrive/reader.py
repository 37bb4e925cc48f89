"""Centre lines of driving lanes from an OpenDRIVE map (``map.xodr``), the counterpart of ``scene.opendrive.writer``.

Reference lines are sampled every ``STEP_M``; lanes lie beside them by their widths and the lane offset. Superelevation
and lane heights are not applied. Map coordinates are east, north, up around the origin of ``geoReference``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.scene.opendrive.xml import opendrive_root
from nurec_sim.types import RoadMap, Trajectory

STEP_M = 2.0
NEAR_M = 20.0
MAX_ROAD_M = 1e6
"""Total length of all roads; longer maps are refused."""
_A_M, _E2 = 6378137.0, 6.69437999014e-3  # WGS84: equatorial radius, eccentricity squared
Profile = Callable[[np.ndarray], np.ndarray]


def road_map_from(
    data: bytes, ecef_from_world: Float64[np.ndarray, "4 4"] | None, path: Trajectory, where: str
) -> tuple[RoadMap | None, str]:
    """Lanes in world coordinates, and a note about them; no map if the lanes are not where the car drove.

    Args:
        data: contents of the file.
        ecef_from_world: ``T_world_base``; without it, or without the map's geodetic origin, the map is in world axes.
        path: path of the car, of which at least half of the poses must be within ``NEAR_M`` of a lane.
        where: name of the file in texts.
    """
    from scipy.spatial import cKDTree

    try:
        lanes, ecef_from_own = lanes_from(data, where), ecef_from_map(data, where)
    except ArchiveError as error:
        return None, f"the map is not read: {error}"
    if not lanes:
        return None, "the map has no driving lanes"
    if ecef_from_world is not None and ecef_from_own is not None:
        world_from_map = geometry.inverse(ecef_from_world) @ ecef_from_own
        lanes = [geometry.transform_points(world_from_map, lane) for lane in lanes]
    away = cKDTree(np.concatenate(lanes)[:, :2]).query(path.position_m[:, :2])[0]
    if not np.median(away) <= NEAR_M:
        return None, f"the map is not used: its lanes lie {np.median(away):,.0f} m away from the path"
    return RoadMap((), tuple(lanes)), "the map gives lanes, but no drivable areas"


def lanes_from(data: bytes, where: str) -> list[Float64[np.ndarray, "k 3"]]:
    """Centre lines of all driving lanes, in map coordinates, in the direction of their roads.

    Raises:
        ArchiveError: not OpenDRIVE, damaged, too long, or with an unknown geometry.
    """
    root = opendrive_root(data, where)
    lines: list[np.ndarray] = []
    total = 0.0
    try:
        for road in root.iter("road"):
            total += sum(_value(each, "length") for each in road.iterfind("planView/geometry"))
            if not total <= MAX_ROAD_M:
                raise ValueError(f"roads of more than {MAX_ROAD_M:,.0f} m")
            lines += _lanes(road)
    except (ValueError, OverflowError) as error:
        raise ArchiveError(f"{where}: {error}") from error
    return [line for line in lines if np.isfinite(line).all()]


def ecef_from_map(data: bytes, where: str) -> Float64[np.ndarray, "4 4"] | None:
    """The map's pose in ECEF, from ``lat_0``, ``lon_0`` and ``alt_0`` of its geoReference; None without them."""
    text = " ".join(each.text or "" for each in opendrive_root(data, where).iter("geoReference"))
    # Also accepts the misspelling "+=alt_0".
    given = dict(re.findall(r"\+=?(lat_0|lon_0|alt_0)=([-+.\deE]+)", text.replace("+=alt", "+alt")))
    try:
        latitude, longitude = np.radians(float(given["lat_0"])), np.radians(float(given["lon_0"]))
        height = float(given.get("alt_0", 0.0))
    except (KeyError, ValueError):
        return None
    # Geodetic to ECEF on the WGS84 ellipsoid; ``normal_m`` is the radius of curvature in the prime vertical.
    sin, cos = np.sin(latitude), np.cos(latitude)
    normal_m = _A_M / np.sqrt(1 - _E2 * sin**2)
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    up = np.array([cos * np.cos(longitude), cos * np.sin(longitude), sin])
    origin = np.array([*(normal_m + height) * up[:2], (normal_m * (1 - _E2) + height) * sin])
    return geometry.pose(np.stack([east, np.cross(up, east), up], axis=1), origin)


def _value(element: ElementTree.Element, name: str, default: float | None = None) -> float:
    text = element.get(name)
    if text is None and default is not None:
        return default
    if text is None or not np.isfinite(float(text)):
        raise ValueError(f"<{element.tag}> needs a finite number as {name!r}, got {text!r:.40}")
    return float(text)


def _lanes(road: ElementTree.Element) -> Iterator[np.ndarray]:
    s, xy, heading = _reference_line(road)
    if len(s) < 2:
        return
    z = _profile(road.findall("elevationProfile/elevation"), "s")(s)
    offset = _profile(road.findall("lanes/laneOffset"), "s")(s)
    left = np.stack([-np.sin(heading), np.cos(heading)], axis=1)
    sections = road.findall("lanes/laneSection")
    # A lane section ends where the next one starts.
    starts = [_value(section, "s") for section in sections] + [np.inf]
    for section, first, last in zip(sections, starts, starts[1:], strict=False):
        rows = np.flatnonzero((s >= first - 1e-6) & (s <= last + 1e-6))
        if len(rows) < 2:
            continue
        for side, sign in (("left", 1.0), ("right", -1.0)):
            border = offset[rows]
            # Lanes stack outwards from the centre in the order of their numbers, each by its width.
            for lane in sorted(section.findall(f"{side}/lane"), key=lambda lane: abs(_value(lane, "id"))):
                width = _profile(lane.findall("width"), "sOffset")(s[rows] - first)
                middle, border = border + sign * width / 2, border + sign * width
                if lane.get("type") == "driving":
                    yield np.column_stack([xy[rows] + left[rows] * middle[:, None], z[rows]])


def _profile(pieces: list[ElementTree.Element], start: str) -> Profile:
    """A piecewise cubic a + b ds + c ds^2 + d ds^3 along a road; zero without pieces."""
    table = sorted([_value(piece, start), *(_value(piece, name) for name in "abcd")] for piece in pieces)

    def at(s: np.ndarray) -> np.ndarray:
        if not table:
            return np.zeros(len(s))
        rows = np.array(table)[np.maximum(np.searchsorted([row[0] for row in table], s, side="right") - 1, 0)]
        ds = s - rows[:, 0]
        return rows[:, 1] + ds * (rows[:, 2] + ds * (rows[:, 3] + ds * rows[:, 4]))

    return at


def _reference_line(road: ElementTree.Element) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Arc lengths [k], points [k,2] and headings [k]."""
    parts = [(np.zeros(0), np.zeros((0, 2)), np.zeros(0))]
    for piece in road.iterfind("planView/geometry"):
        length, turn = _value(piece, "length"), _value(piece, "hdg")
        if length < 0:
            raise ValueError(f"a geometry of {length} m")
        t = np.linspace(0, length, max(2, int(np.ceil(length / STEP_M)) + 1))
        u, v, heading = _shape(piece, t, length)
        x = _value(piece, "x") + np.cos(turn) * u - np.sin(turn) * v
        y = _value(piece, "y") + np.sin(turn) * u + np.cos(turn) * v
        parts.append((_value(piece, "s") + t, np.stack([x, y], axis=1), turn + heading))
    s, xy, heading = (np.concatenate(each) for each in zip(*parts, strict=True))
    keep = np.concatenate([np.diff(s) > 1e-6, np.ones(min(1, len(s)), bool)])  # pieces share their ends
    return s[keep], xy[keep], heading[keep]


def _shape(piece: ElementTree.Element, t: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points and headings of a piece in the frame of its start, at distances ``t`` along it."""
    kind = next(iter(piece), None)
    if kind is None or kind.tag == "line":
        return t, np.zeros_like(t), np.zeros_like(t)
    if kind.tag in ("arc", "spiral"):
        first = _value(kind, "curvature" if kind.tag == "arc" else "curvStart")
        last = first if kind.tag == "arc" else _value(kind, "curvEnd")
        fine = np.linspace(0, 1, 16 * (len(t) - 1) + 1) * length
        # Curvature is linear in arc length (a clothoid), so the heading is quadratic; positions have no closed form and
        # are integrated over 16 steps per sample.
        heading = first * fine + (last - first) * fine**2 / max(2 * length, 1e-12)
        step, middle = np.diff(fine), (heading[1:] + heading[:-1]) / 2
        u, v = (np.concatenate([[0.0], np.cumsum(step * f(middle))])[::16] for f in (np.cos, np.sin))
        return u, v, heading[::16]
    if kind.tag not in ("poly3", "paramPoly3"):
        raise ValueError(f"a geometry <{kind.tag:.40}> is not known")
    if kind.tag == "poly3":
        v, dv = _cubic([_value(kind, name) for name in "abcd"], t)
        return t, v, np.arctan2(dv, np.ones_like(t))
    # The parameter runs over the length or, by default, over 0..1.
    p = t if kind.get("pRange") == "arcLength" else t / max(length, 1e-12)
    u, du = _cubic([_value(kind, f"{name}U") for name in "abcd"], p)
    v, dv = _cubic([_value(kind, f"{name}V") for name in "abcd"], p)
    return u, v, np.arctan2(dv, du)


def _cubic(c: list[float], p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A cubic and its derivative."""
    return c[0] + p * (c[1] + p * (c[2] + p * c[3])), c[1] + p * (2 * c[2] + 3 * p * c[3])
