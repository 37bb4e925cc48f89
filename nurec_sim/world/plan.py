"""The street as pure data: everything that a seed decides, ready for JSON, before any mesh or texture exists.

World: metres, z up, the road surface is z = 0. Yaw is about z from the x axis. Times are integer microseconds.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.types import Track, Trajectory

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True)
class RoadPiece:
    """A stretch of centre line whose curvature (left positive) changes linearly from its start to its end."""

    length_m: float
    start_curvature_per_m: float = 0.0
    end_curvature_per_m: float = 0.0
    __pydantic_config__: ClassVar[ConfigDict] = _STRICT


@dataclass(frozen=True)
class Road:
    """One lane each way, parking strips, raised kerbs and sidewalks along a centre line; traffic keeps right."""

    x_m: float
    y_m: float
    yaw_rad: float
    pieces: tuple[RoadPiece, ...]
    lane_width_m: float = 3.5
    strip_width_m: float = 2.2
    kerb_width_m: float = 0.16
    kerb_height_m: float = 0.13
    sidewalk_width_m: float = 2.6
    zebra_station_m: float | None = None
    __pydantic_config__: ClassVar[ConfigDict] = _STRICT

    @property
    def half_width_m(self) -> float:
        """From the centre line to the foot of the kerb: the edge of the drivable area."""
        return self.lane_width_m + self.strip_width_m


@dataclass(frozen=True)
class Building:
    """A house; ``width_m`` runs along its street side, and ``yaw_rad`` is the heading of that side."""

    x_m: float
    y_m: float
    yaw_rad: float
    width_m: float
    depth_m: float
    floors: int
    floor_height_m: float
    facade: int
    shop: bool
    gable: bool
    tint: tuple[float, float, float]
    __pydantic_config__: ClassVar[ConfigDict] = _STRICT


@dataclass(frozen=True)
class Prop:
    """Street furniture: ``kind`` is ``tree``, ``bush``, ``lamp`` or ``sign``, standing at kerb height."""

    kind: str
    x_m: float
    y_m: float
    yaw_rad: float
    variant: int = 0
    scale: float = 1.0
    __pydantic_config__: ClassVar[ConfigDict] = _STRICT


@dataclass(frozen=True)
class Actor:
    """A car or a pedestrian. ``path`` holds (t_us, x, y, z, yaw) of its box centre; parked cars repeat one pose."""

    id: str
    kind: str
    size_m: tuple[float, float, float]
    colour: tuple[float, float, float]
    moves: bool
    path: tuple[tuple[int, float, float, float, float], ...]
    __pydantic_config__: ClassVar[ConfigDict] = _STRICT

    @property
    def label(self) -> str:
        """One of ``types.MOVABLE_LABELS``."""
        return {"pedestrian": "person", "truck": "heavy_truck"}.get(self.kind, "automobile")

    def track(self) -> Track:
        """The exact box over time."""
        poses = [geometry.pose_from_xyyaw(x, y, yaw, z) for _, x, y, z, yaw in self.path]
        times = np.array([point[0] for point in self.path], np.int64)
        return Track(self.id, self.label, self.size_m, Trajectory(times, np.array(poses)), controllable=self.moves)


@dataclass(frozen=True)
class StreetPlan:
    """One street and what happens on it in ``span_us`` [start, end). ``ego`` holds (t_us, x, y, yaw) of the rig.

    Make one with ``street_plan(seed)``; ``to_json`` and ``from_json`` keep every bit.
    """

    seed: int
    span_us: tuple[int, int]
    road: Road
    buildings: tuple[Building, ...]
    props: tuple[Prop, ...]
    actors: tuple[Actor, ...]
    ego: tuple[tuple[int, float, float, float], ...]
    sun_azimuth_rad: float
    sun_elevation_rad: float
    cloud_cover: float
    __pydantic_config__: ClassVar[ConfigDict] = _STRICT

    def ego_trajectory(self) -> Trajectory:
        """The recorded drive: rear axle on the ground."""
        times = np.array([point[0] for point in self.ego], np.int64)
        return Trajectory(times, np.array([geometry.pose_from_xyyaw(x, y, yaw) for _, x, y, yaw in self.ego]))

    def tracks(self) -> tuple[Track, ...]:
        """Every actor's exact box over time."""
        return tuple(actor.track() for actor in self.actors)

    def to_json(self) -> str:
        """The plan as text; the same plan gives the same bytes."""
        return TypeAdapter(StreetPlan).dump_json(self, indent=1).decode() + "\n"

    @staticmethod
    def from_json(text: str) -> StreetPlan:
        """A plan from its text.

        Raises:
            ClipError: a field is missing, misspelt or of the wrong kind.
        """
        try:
            return TypeAdapter(StreetPlan).validate_json(text)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"]) or "the text itself"
            known = ", ".join(field.name for field in fields(StreetPlan))
            raise ClipError(f"not a street plan: {where}: {first['msg']}; a plan has the fields {known}") from error
