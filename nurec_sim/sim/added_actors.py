"""Paths of actors that a scenario adds to a log: along the recorded drive, on its ground.

A path is a function of the recorded drive and of the scenario only, so it is the same in every reconstruction of a log
and in the world that it was recorded in. Height and tilt are those of the plane on which the recorded car stood at the
same place of its path, unless the caller knows the ground better.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float64, Int64

from nurec_sim import geometry
from nurec_sim.errors import ScenarioError
from nurec_sim.sim.actors import edited_actors
from nurec_sim.sim.policy_sensors import SceneFacts
from nurec_sim.sim.recorded import RecordedDrive
from nurec_sim.sim.rollout import STATE_US, timeline
from nurec_sim.sim.scenario import AddedActor, Perturbation, Scenario
from nurec_sim.types import Track, Trajectory

STEP_US, KEPT_EVERY = 10_000, 5
"""Speeds are integrated in steps of 10 ms; a path keeps every fifth pose."""
BEYOND_S = 5.0
"""Paths begin so long before the rollout and end so long after it, for delayed actors and for exposures."""
RAMP = 0.25
"""Part of a move in which the lateral speed rises, and part in which it falls."""
TANGENT_M, SHORTEST_M = 1.0, 5.0
"""Directions are over 2 m of the recorded path; one of less than 5 m has the heading of the car."""
STANDS_MPS = 0.05
UPRIGHT = ("person",)
"""Labels of actors that do not lean with the ground, and that may walk sideways."""

GroundHeight = Callable[[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]], Float64[np.ndarray, " n"]]
"""Heights (m) of the ground at points (x, y), from heights by the recorded drive."""


@dataclass(frozen=True)
class Body:
    """What an added actor is: a label of ``types.MOVABLE_LABELS``, and the length, width and height of its box."""

    label: str
    size_m: tuple[float, float, float]


def added_tracks(
    scenario: Scenario, facts: SceneFacts, bodies: Mapping[str, Body], ground: GroundHeight | None = None
) -> tuple[Track, ...]:
    """The tracks of a scenario's added actors.

    Args:
        scenario: what is driven.
        facts: recorded drive, tracks and time span of the scene, without the added actors.
        bodies: of the added actors, by id.
        ground: heights of the ground; None for those of the recorded drive.

    Raises:
        ScenarioError: an id is taken, the recording is too short, a vehicle would move sideways faster than forward, or
            an actor starts in the ego's place or at some time is in that of another actor.
    """
    if not scenario.added_actors:
        return ()
    times, drive = timeline(scenario, facts), RecordedDrive(facts.ego)
    added: list[Track] = []
    for name, actor in scenario.added_actors.items():
        if any(track.id == name for track in facts.tracks):
            raise ScenarioError(f"scenario '{scenario.name}' adds actor '{name}', but scene '{facts.id}' has one")
        body, reach = bodies[name], round(BEYOND_S * 1e6)
        t_us = np.arange(times.start_us - reach, times.end_us + reach + 1, STEP_US, dtype=np.int64)
        try:
            added.append(_track(name, actor, body, drive, t_us, times.start_us, ground))
        except ScenarioError as error:
            raise ScenarioError(f"scenario '{scenario.name}', added actor '{name}': {error}") from None
    _check_room(scenario, facts, added)
    return tuple(added)


def _track(
    name: str, actor: AddedActor, body: Body, drive: RecordedDrive, t_us: Int64[np.ndarray, " n"], start_us: int,
    ground: GroundHeight | None,
) -> Track:  # fmt: skip
    seconds = (t_us - start_us) / 1e6
    ahead_us = start_us + round(actor.ego_at_s * 1e6)
    if ahead_us > drive.ego.end_us:
        raise ScenarioError(
            f"ego_at_s is {actor.ego_at_s:g}, but the recording ends {(drive.ego.end_us - start_us) / 1e6:.1f} s after "
            "the start"
        )
    recorded = drive.speeds(np.clip(t_us, drive.ego.start_us, drive.ego.end_us))
    speed, driven = _driven(actor, seconds, recorded)
    station = drive.station_of_time(ahead_us) + actor.along_m + driven
    lateral = _lateral(actor, seconds)
    upright = body.label in UPRIGHT
    if not upright:
        slide = np.abs(np.gradient(lateral, seconds))
        if (fast := np.flatnonzero((slide > STANDS_MPS) & (slide > np.abs(speed)))).size:
            raise ScenarioError(
                f"{seconds[fast[0]]:.1f} s after the start it would move sideways at {slide[fast[0]]:.1f} m/s and "
                f"forward at {abs(speed[fast[0]]):.1f} m/s; only people can. Give the move more time, or more speed"
            )
    line = _Line(drive, start_us)
    xy, along = line.at(station, lateral)
    # Both directions of travel: an actor with a negative speed faces the recorded car.
    facing = along + (np.pi if speed.min() < -STANDS_MPS else 0.0)
    yaw = _headings(xy, facing, seconds)
    keep = slice(None, None, KEPT_EVERY)
    poses = line.on_ground(xy[keep], yaw[keep], station[keep], body.size_m[2] / 2, upright, ground)
    return Track(name, body.label, body.size_m, Trajectory(t_us[keep], poses))


def _driven(
    actor: AddedActor, seconds: Float64[np.ndarray, " n"], recorded_mps: Float64[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Speed (m/s) over time, and metres driven since second 0."""
    fixed, share = np.full(len(seconds), actor.speed_mps or 0.0), np.full(len(seconds), actor.speed_fraction or 0.0)
    for move in actor.moves:
        if move.changes_speed:
            done = np.clip((seconds - move.at_s) / move.over_s, 0.0, 1.0)
            # Both parts change together, so a fixed speed and a share of the recorded one can follow each other.
            fixed = fixed + done * ((move.speed_mps or 0.0) - fixed)
            share = share + done * ((move.speed_fraction or 0.0) - share)
    speed = fixed + share * recorded_mps
    driven = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(seconds))])
    return speed, driven - np.interp(0.0, seconds, driven)


def _lateral(actor: AddedActor, seconds: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Metres to the left of the recorded path over time."""
    place = np.full(len(seconds), actor.lateral_m)
    now = actor.lateral_m
    for move in actor.moves:
        if move.lateral_m is None:
            continue
        u = np.clip((seconds - move.at_s) / move.over_s, 0.0, 1.0)
        # The integral of a trapezoid of height 1 / (1 - RAMP), and its mirror image in the second half.
        rising = np.where(u < RAMP, u**2 / (2 * RAMP), u - RAMP / 2) / (1 - RAMP)
        falling = 1 - np.where(1 - u < RAMP, (1 - u) ** 2 / (2 * RAMP), 1 - u - RAMP / 2) / (1 - RAMP)
        place += (move.lateral_m - now) * np.where(u < 0.5, rising, falling)
        now = move.lateral_m
    return place


def _headings(
    xy: Float64[np.ndarray, "n 2"], facing: Float64[np.ndarray, " n"], seconds: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Directions of motion; where it stands that of its last or, before it has moved, its next motion."""
    velocity = np.gradient(xy, seconds, axis=0)
    moving = np.flatnonzero(np.linalg.norm(velocity, axis=1) > STANDS_MPS)
    if not len(moving):
        return facing
    yaw = np.arctan2(velocity[moving, 1], velocity[moving, 0])
    return yaw[np.maximum(np.searchsorted(moving, np.arange(len(xy)), side="right") - 1, 0)]


class _Line:
    """The recorded path as a line that goes on straight beyond both ends, and the ground below it."""

    def __init__(self, drive: RecordedDrive, t_us: int) -> None:
        self.drive = drive
        if drive.length_m < SHORTEST_M:
            pose = drive.ego.at(t_us)
            yaw = float(geometry.yaw_of(pose))
            here = pose[:2, 3] - drive.station_of_time(t_us) * np.array([np.cos(yaw), np.sin(yaw)])
            self.station_m, self.line_m = np.array([0.0, 1.0]), here + np.outer([0, 1], [np.cos(yaw), np.sin(yaw)])
        else:
            self.station_m, self.line_m = drive.station_m, drive.line_m

    def _points(self, station_m: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 2"]:
        first, last = self.station_m[[0, -1]]
        inside = np.clip(station_m, first, last)
        points = np.stack([np.interp(inside, self.station_m, axis) for axis in self.line_m.T], axis=1)
        ends = np.clip([first + 2 * TANGENT_M, last - 2 * TANGENT_M], first, last)
        near = np.stack([np.interp(ends, self.station_m, axis) for axis in self.line_m.T], axis=1)
        for end, inner, beyond in (
            (self.line_m[0], near[0], np.minimum(station_m - first, 0.0)),
            (self.line_m[-1], near[1], np.maximum(station_m - last, 0.0)),
        ):
            step = (end - inner) / max(float(np.linalg.norm(end - inner)), 1e-9)
            points += np.abs(beyond)[:, None] * step
        return points

    def at(
        self, station_m: Float64[np.ndarray, " n"], lateral_m: Float64[np.ndarray, " n"]
    ) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
        """Points beside the line, and the line's direction (rad) there."""
        step = self._points(station_m + TANGENT_M) - self._points(station_m - TANGENT_M)
        yaw = np.arctan2(step[:, 1], step[:, 0])
        left = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
        return self._points(station_m) + lateral_m[:, None] * left, yaw

    def on_ground(
        self, xy: Float64[np.ndarray, "n 2"], yaw: Float64[np.ndarray, " n"], station_m: Float64[np.ndarray, " n"],
        above_m: float, upright: bool, ground: GroundHeight | None,
    ) -> Float64[np.ndarray, "n 4 4"]:  # fmt: skip
        """Poses of boxes whose centres are ``above_m`` over the ground."""
        drive = self.drive
        stood = drive.ego.at(np.array([drive.time_at(float(station)) for station in station_m]))
        up, origin = stood[:, :3, 2], stood[:, :3, 3]
        # The plane through the rear axle of the recorded car, square to its z axis.
        height = origin[:, 2] - ((xy - origin[:, :2]) * up[:, :2]).sum(axis=1) / up[:, 2]
        if ground is not None:
            height = ground(xy, height)
        if upright:
            up = np.tile([0.0, 0.0, 1.0], (len(xy), 1))
        c, s = np.cos(yaw), np.sin(yaw)
        forward = np.stack([c, s, -(c * up[:, 0] + s * up[:, 1]) / up[:, 2]], axis=1)
        forward /= np.linalg.norm(forward, axis=1, keepdims=True)
        poses = np.tile(np.eye(4), (len(xy), 1, 1))
        poses[:, :3, 0], poses[:, :3, 1], poses[:, :3, 2] = forward, np.cross(up, forward), up
        poses[:, :3, 3] = np.column_stack([xy, height]) + above_m * up
        return poses


def _check_room(scenario: Scenario, facts: SceneFacts, added: list[Track]) -> None:
    """Raises if an added actor is where the ego starts, or where another actor is at any time of the rollout."""
    times = timeline(scenario, facts)
    t_us = np.arange(times.start_us, times.end_us + 1, STATE_US, dtype=np.int64)
    nominal = scenario.model_copy(update={"perturbation": Perturbation(), "added_actors": {}})
    others = edited_actors(nominal, facts.id, facts.ego, facts.tracks, times.start_us, 0)
    warm_up = t_us[t_us <= times.first_closed_us]
    body = facts.rig.body
    ego = facts.ego.at(warm_up) @ geometry.pose(np.eye(3), np.asarray(body.center_m, np.float64))
    taken = [("the recorded car before the policy drives", ego, body.size_m)]
    taken += [(f"actor '{name}'", others.poses(name, t_us), track.size_m) for name, track in others.tracks.items()]
    for track in added:
        own = track.path.at(t_us)
        for whose, poses, size_m in taken:
            if len(met := _overlaps(own[: len(poses)], track.size_m, poses, size_m)):
                raise ScenarioError(
                    f"scenario '{scenario.name}': added actor '{track.id}' is in the place of {whose} "
                    f"{met[0] * STATE_US / 1e6:.1f} s after the start"
                )
        taken.append((f"added actor '{track.id}'", own, track.size_m))


def _overlaps(
    world_from_a: Float64[np.ndarray, "n 4 4"], size_a_m: tuple[float, float, float],
    world_from_b: Float64[np.ndarray, "n 4 4"], size_b_m: tuple[float, float, float],
) -> Int64[np.ndarray, " k"]:  # fmt: skip
    """Indices at which two boxes overlap, seen from above and in height; a box that is absent has NaN poses."""
    apart = np.abs(world_from_a[:, 2, 3] - world_from_b[:, 2, 3]) >= (size_a_m[2] + size_b_m[2]) / 2
    near = np.flatnonzero(np.isfinite(world_from_b[:, 0, 0]) & ~apart)
    a = shapely.polygons(geometry.box_corners_xy(world_from_a[near], *size_a_m[:2]))
    b = shapely.polygons(geometry.box_corners_xy(world_from_b[near], *size_b_m[:2]))
    return near[shapely.intersects(a, b)]
