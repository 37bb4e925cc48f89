"""A town as pure, JSON-serialisable data, before any mesh or texture exists.

World: metres, z up; the road surface is the terrain's height, sidewalks and everything beyond lie a kerb higher. Yaw is
about z from the x axis. Times are integer microseconds. Traffic keeps right. Lanes are numbered as in OpenDRIVE: -1, -2
from the centre line to the right, driving with growing stations; 1, 2 to the left, driving against them.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError

from nurec_sim.errors import ClipError
from nurec_sim.types import Track, Trajectory
from nurec_sim.world.plan.parts import plan_part
from nurec_sim.world.plan.splits import Split
from nurec_sim.world.plan.terrain import FLAT, Terrain

Positive = Annotated[float, Field(gt=0)]
EGO_MIDDLE_M = 1.4
"""Distance from the ego's rear axle to the centre of its wheelbase, where the slope is evaluated."""

PropKind = Literal[
    "tree", "bush", "hedge", "lamp", "sign", "traffic_light", "bin", "bench", "bus_stop", "fence", "cone", "billboard",
    "bollard", "hydrant",
]  # fmt: skip
SIGNS = ("speed", "stop", "yield", "priority", "crossing", "narrow", "no_parking", "roundabout")
"""Sign types, in the order of ``Prop.variant``."""
Rule = Literal["priority", "yield", "stop", "red", "green"]
ActorKind = Literal[
    "hatch", "sedan", "wagon", "suv", "van", "pickup", "truck", "bus", "sports", "minivan", "cyclist", "pedestrian"
]
LABEL_OF_KIND = {"pedestrian": "person", "cyclist": "rider", "truck": "heavy_truck", "bus": "bus"}


@plan_part
class RoadPiece:
    """A stretch of centre line whose curvature (left positive) changes linearly: line, arc or clothoid."""

    length_m: Positive
    start_curvature_per_m: float = 0.0
    end_curvature_per_m: float = 0.0


@plan_part
class Narrowing:
    """Other widths between two stations; they ease in over ``taper_m`` before and out over ``taper_m`` after."""

    start_m: float
    end_m: float
    taper_m: Positive
    lane_width_m: float
    left_strip_m: float
    right_strip_m: float


@plan_part
class Road:
    """Lanes and parking strips along a centre line, up to the mouths of the junctions at its ends.

    ``lanes_forward`` lie to the right of the centre line, ``lanes_backward`` to its left (0: a one-way road).
    """

    id: str
    x_m: float
    y_m: float
    yaw_rad: float
    pieces: Annotated[tuple[RoadPiece, ...], Field(min_length=1)]
    lanes_forward: int = 1
    lanes_backward: int = 1
    lane_width_m: float = 3.5
    left_strip_m: float = 0.0
    right_strip_m: float = 0.0
    speed_limit_mps: float = 13.9
    centre_line: Literal["none", "dashed", "solid", "double"] = "dashed"
    edge_lines: bool = True
    narrowing: Narrowing | None = None

    @property
    def length_m(self) -> float:
        """Length of the centre line."""
        return float(sum(piece.length_m for piece in self.pieces))


@plan_part
class Arm:
    """A road's end in a junction, with its traffic control (lights are constant during a clip)."""

    road: str
    end: Literal["start", "end"]
    rule: Rule = "priority"


@plan_part
class Connection:
    """A path through a junction from one lane to another; lanes are ``<road id>:<lane number>``."""

    id: str
    from_lane: str
    to_lane: str
    turn: Literal["straight", "left", "right"]
    x_m: float
    y_m: float
    yaw_rad: float
    pieces: Annotated[tuple[RoadPiece, ...], Field(min_length=1)]


@plan_part
class Junction:
    """A junction, drivable between the mouths of its arms; its corners are rounded by ``corner_radius_m``.

    A roundabout has a ring of ``ring_radius_m`` (middle of its lane) and ``ring_width_m`` around a raised island.
    """

    id: str
    kind: Literal["crossing", "roundabout", "fork"]
    x_m: float
    y_m: float
    corner_radius_m: float
    arms: tuple[Arm, ...]
    connections: tuple[Connection, ...]
    ring_radius_m: float = 0.0
    ring_width_m: float = 0.0


@plan_part
class Crossing:
    """A pedestrian crossing: ``depth_m`` long from ``station_m`` on, with or without zebra stripes."""

    road: str
    station_m: float
    depth_m: float
    zebra: bool


@plan_part
class StopLine:
    """A line across the lanes of one driving direction; drivers stop with their front bumper at ``station_m``."""

    road: str
    station_m: float
    forward: bool


@plan_part
class Building:
    """A house; ``width_m`` runs along its street side, and ``yaw_rad`` is the heading of that side.

    ``family`` is one of ``splits.FACADES``, ``facade`` a variant in it.
    """

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
    family: str = "plaster"


@plan_part
class Prop:
    """Street furniture or a plant on the ground, ``on_road`` or a kerb higher; it faces ``yaw_rad``.

    Hedges and fences are ``length_m`` long, along their own y axis. A sign's variant is its place in ``SIGNS``, a
    traffic light's is 0 red or 1 green.
    """

    kind: PropKind
    x_m: float
    y_m: float
    yaw_rad: float
    variant: int = 0
    scale: float = 1.0
    length_m: float = 0.0
    on_road: bool = False


@plan_part
class Actor:
    """A vehicle, a cyclist or a pedestrian.

    ``path`` holds (t_us, x, y, z, yaw): the ground point below its box and the height of the box's centre above the
    terrain there (half its height on the road, a kerb more on the sidewalk). Parked cars repeat one pose.
    """

    id: str
    kind: ActorKind
    size_m: tuple[float, float, float]
    colour: tuple[float, float, float]
    moves: bool
    path: Annotated[tuple[tuple[int, float, float, float, float], ...], Field(min_length=1)]

    @property
    def label(self) -> str:
        """One of ``types.MOVABLE_LABELS``."""
        return LABEL_OF_KIND.get(self.kind, "automobile")

    def track(self, terrain: Terrain = FLAT) -> Track:
        """The exact box over time; vehicles follow the slope, pedestrians stay upright."""
        times = np.array([point[0] for point in self.path], np.int64)
        x, y, z, yaw = np.array([point[1:] for point in self.path], np.float64).T
        poses = terrain.poses(np.stack([x, y], axis=1), yaw, z, upright=self.kind == "pedestrian")
        return Track(self.id, self.label, self.size_m, Trajectory(times, poses), controllable=self.moves)


@plan_part
class Kerb:
    """The edge of every road, and the sidewalk behind it."""

    width_m: float = 0.16
    height_m: float = 0.13
    sidewalk_width_m: float = 2.6


@plan_part
class Style:
    """Asset names from ``splits`` and the texture seed."""

    district: Literal["urban", "suburb", "mixed"]
    facades: tuple[str, ...]
    asphalt: str
    paving: str
    foliages: tuple[str, ...]
    yellow_lines: bool
    texture_seed: int


@plan_part
class Weather:
    """Light and air. ``preset`` is one of ``splits.SKIES``; ``cloud_cover``, ``wetness`` and ``dusk`` are 0..1.

    Fog leaves ``exp(-fog_per_m * distance)`` of the light of what is seen.
    """

    preset: str
    sun_azimuth_rad: float
    sun_elevation_rad: float
    cloud_cover: float
    fog_per_m: float
    wetness: float
    dusk: float


@plan_part
class TownPlan:
    """A town with its traffic in ``span_us`` [start, end). ``ego`` holds (t_us, x, y, yaw) of the rig.

    Created by ``town_plan(seed)``; ``to_json`` and ``from_json`` are lossless.
    """

    seed: int
    split: Split
    template: str
    span_us: tuple[int, int]
    style: Style
    weather: Weather
    terrain: Terrain
    kerb: Kerb
    roads: tuple[Road, ...]
    junctions: tuple[Junction, ...]
    crossings: tuple[Crossing, ...]
    stop_lines: tuple[StopLine, ...]
    buildings: tuple[Building, ...]
    props: tuple[Prop, ...]
    actors: tuple[Actor, ...] = ()
    ego: tuple[tuple[int, float, float, float], ...] = ()

    def ego_trajectory(self) -> Trajectory:
        """The recorded drive: rear axle on the ground, tilted by the slope under the centre of the car."""
        times = np.array([point[0] for point in self.ego], np.int64)
        x, y, yaw = np.array([point[1:] for point in self.ego], np.float64).T
        # The body is placed by the slope under its centre, then moved back along its own axis to the rear axle.
        ahead = EGO_MIDDLE_M * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        poses = self.terrain.poses(np.stack([x, y], axis=1) + ahead, yaw, np.zeros(len(yaw)))
        poses[:, :3, 3] -= poses[:, :3, 0] * EGO_MIDDLE_M
        return Trajectory(times, poses)

    def tracks(self) -> tuple[Track, ...]:
        """Every actor's exact box over time."""
        return tuple(actor.track(self.terrain) for actor in self.actors)

    def to_json(self) -> str:
        """The plan as text; the same plan gives the same bytes."""
        return TypeAdapter(TownPlan).dump_json(self, indent=1).decode() + "\n"

    @staticmethod
    def from_json(text: str) -> TownPlan:
        """A plan from its text.

        Raises:
            ClipError: a field is missing, misspelt or of the wrong kind, or a name does not exist.
        """
        try:
            plan = TypeAdapter(TownPlan).validate_json(text)
        except ValidationError as error:
            # One error is enough to act on; all of them would fill pages.
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"]) or "the text itself"
            known = ", ".join(field.name for field in fields(TownPlan))
            raise ClipError(f"not a town plan: {where}: {first['msg']}; a plan has the fields {known}") from error
        _check_names(plan)
        return plan


def _check_names(plan: TownPlan) -> None:
    """Raises for duplicate road or actor names and for unknown roads and lanes."""
    roads = {road.id: road for road in plan.roads}
    for what, items in (("road", plan.roads), ("actor", plan.actors)):
        names = [item.id for item in items]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ClipError(f"not a town plan: two {what}s are called {twice[0]!r}")
    lanes = {
        f"{road.id}:{number}"
        for road in plan.roads
        for number in (*range(-road.lanes_forward, 0), *range(1, road.lanes_backward + 1))
    }
    arms = [arm for junction in plan.junctions for arm in junction.arms]
    paths = [path for junction in plan.junctions for path in junction.connections]
    for name in [item.road for group in (arms, plan.crossings, plan.stop_lines) for item in group]:
        if name not in roads:
            raise ClipError(f"not a town plan: no road {name!r}; have {', '.join(sorted(roads))}")
    for name in [lane for path in paths for lane in (path.from_lane, path.to_lane)]:
        if name not in lanes:
            raise ClipError(f"not a town plan: no lane {name!r}; have {', '.join(sorted(lanes))}")
