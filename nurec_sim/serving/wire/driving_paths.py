"""Routes, recorded futures and plans <-> messages of the egodriver interface.

Our policies and our loop see paths from above: x and y in level axes that have the car's heading, at its rear axle.
The wire has routes and recorded futures in the rig frame, which pitches and rolls with the car, and plans in the
session's local frame. What we write lies in the plane on which the car stands.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry
from nurec_sim.errors import RequestError
from nurec_sim.serving.wire.driving import MAX_POSES, check_time
from nurec_sim.serving.wire.requests import read_poses, write_poses
from nurec_sim.types import EgoState, Matrix4, Plan

LEAST_UPRIGHT = 0.2
"""Cosine of the steepest tilt: beyond it, a top view of the car is undefined."""

FARTHEST = 1e9
"""No distance, angle or speed on the wire is larger."""

Points2 = Float64[np.ndarray, "k 2"]
Poses2 = Float64[np.ndarray, "k 3"]


class Placed(Protocol):
    """Where the car is at a time: an ``EgoState``, or a ``ReportedState``."""

    @property
    def t_us(self) -> int:
        """Microseconds."""

    @property
    def world_from_rig(self) -> Matrix4:
        """Its rig pose."""


def level_frame(world_from_rig: Matrix4) -> Matrix4:
    """``world_from_level``: the frame that policies see from above; only its heading and place are the rig's."""
    x, y, z = world_from_rig[:3, 3]
    return geometry.pose_from_xyyaw(x, y, float(geometry.yaw_of(world_from_rig)), z)


def _level_from_rig(world_from_rig: Matrix4) -> Float64[np.ndarray, "3 3"]:
    """Pitch and roll.

    Raises:
        RequestError: the car lies on its side.
    """
    tilt = (geometry.inverse(level_frame(world_from_rig)) @ world_from_rig)[:3, :3]
    if tilt[2, 2] < LEAST_UPRIGHT:
        raise RequestError(f"the ego must stand upright; the cosine of its tilt is {tilt[2, 2]:.3g}")
    return tilt


def _standing_poses(tilt: Float64[np.ndarray, "3 3"], xyyaw: Poses2) -> Float64[np.ndarray, "k 4 4"]:
    """Poses seen from above as poses in the level frame, on the plane of the rig and tilted like it."""
    in_plane = np.linalg.solve(tilt[:2, :2], xyyaw[:, :2].T).T
    return np.array([
        geometry.pose(geometry.rotation_from_yaw(yaw) @ tilt, np.array([x, y, tilt[2, :2] @ ab]))
        for (x, y, yaw), ab in zip(xyyaw, in_plane, strict=True)
    ]).reshape(-1, 4, 4)  # fmt: skip


def _from_above(level_poses: Float64[np.ndarray, "k 4 4"]) -> Poses2:
    return np.column_stack([level_poses[:, :2, 3], geometry.yaw_of(level_poses)])


def moved(xyyaw: Poses2, then: Placed, now: Placed) -> Poses2:
    """Poses seen from above by the car of ``then``, as the car of ``now`` sees them."""
    if then.t_us == now.t_us:
        return xyyaw
    now_from_then = geometry.inverse(level_frame(now.world_from_rig)) @ level_frame(then.world_from_rig)
    x, y, yaw = np.asarray(xyyaw).T
    place = np.column_stack([x, y]) @ now_from_then[:2, :2].T + now_from_then[:2, 3]
    return np.column_stack([place, geometry.wrap_angle(yaw + geometry.yaw_of(now_from_then))])


# ------------------------------------------------------------------------------------------------------------- routes


@dataclass(frozen=True)
class RouteWaypoints:
    """Way points in the rig frame of ``t_us`` (0: of now); exact and with speeds only where the client says so."""

    t_us: int
    xyz_m: Float64[np.ndarray, "k 3"]
    exact_xy: Points2 | None = None
    speed_mps: Float64[np.ndarray, " k"] | None = None

    def seen_from_above(self, ego: Placed) -> Points2:
        """The way points as the car of the route's time sees them."""
        if self.exact_xy is not None:
            return self.exact_xy
        return (self.xyz_m @ _level_from_rig(ego.world_from_rig).T)[:, :2]


def write_route(ego: EgoState, route_m: Points2, speed_mps: Float64[np.ndarray, " k"], message) -> None:
    """Fills a ``Route``.

    Args:
        ego: the current state, whose rig frame the way points get.
        route_m: way points [k,2] in level axes with the car's heading, metres.
        speed_mps: speed at each.
        message: to be filled.
    """
    message.timestamp_us = ego.t_us
    for a, b in np.linalg.solve(_level_from_rig(ego.world_from_rig)[:2, :2], route_m.T).T.tolist():
        message.waypoints.add(x=a, y=b)
    message.exact_xy.extend(np.asarray(route_m, np.float64).ravel().tolist())
    message.speed_mps.extend(np.asarray(speed_mps, np.float64).tolist())


def read_route(message) -> RouteWaypoints:
    """The route of a ``Route``, without the way points at its end that are not a number.

    AlpaSim pads to 20 points with them once less way is left. All of them is no route: no way points.

    Raises:
        RequestError: too long, not finite, or additions of another length.
    """
    if len(message.waypoints) > MAX_POSES:
        raise RequestError(f"a route may have {MAX_POSES} way points, got {len(message.waypoints)}")
    check_time("route.timestamp_us", message.timestamp_us)
    xyz = np.array([(p.x, p.y, p.z) for p in message.waypoints], np.float64).reshape(-1, 3)
    told = np.flatnonzero(~np.isnan(xyz[:, :2]).all(axis=1))
    count = int(told[-1]) + 1 if len(told) else 0
    xyz = xyz[:count]
    good = (np.abs(xyz) < FARTHEST).all(axis=1)  # false for what is not finite
    if not good.all():
        bad = int(np.argmin(good))
        raise RequestError(
            f"route.waypoints[{bad}] must lie within {FARTHEST:g} m, got {xyz[bad].tolist()}; "
            "only at the end of a route, points may be not a number"
        )
    exact, speed = (
        _exact(message.exact_xy, count, 2, "route.exact_xy"),
        _exact(message.speed_mps, count, 1, "speed_mps"),
    )
    return RouteWaypoints(message.timestamp_us, xyz, exact, None if speed is None else speed[:, 0])


# --------------------------------------------------------------------------------------------------- recorded futures


@dataclass(frozen=True)
class RecordedFuture:
    """Poses that the log drove, in the rig frame of ``t_us`` (0: of now)."""

    t_us: int
    pose_t_us: Int64[np.ndarray, " m"]
    rig_from_pose: Float64[np.ndarray, "m 4 4"]
    exact_xyyaw: Poses2 | None = None

    def seen_from_above(self, ego: Placed) -> Poses2:
        """The poses as the car of the message's time sees them."""
        if self.exact_xyyaw is not None:
            return self.exact_xyyaw
        tilt = geometry.pose(_level_from_rig(ego.world_from_rig), np.zeros(3))
        return _from_above(tilt @ self.rig_from_pose)


def write_recorded(ego: EgoState, t_us: Int64[np.ndarray, " m"], xyyaw: Poses2, message) -> None:
    """Fills a ``GroundTruth``.

    Args:
        ego: the current state, whose rig frame the poses get.
        t_us: times [m].
        xyyaw: recorded poses [m,3] in level axes with the car's heading, metres and radians.
        message: to be filled.
    """
    message.timestamp_us = ego.t_us
    samples = [message.trajectory.poses.add(timestamp_us=t) for t in t_us.tolist()]
    tilt = _level_from_rig(ego.world_from_rig)
    rig_from_pose = geometry.pose(tilt.T, np.zeros(3)) @ _standing_poses(tilt, xyyaw)
    write_poses(rig_from_pose, [sample.pose for sample in samples])
    message.exact_xyyaw.extend(xyyaw.ravel().tolist())


def read_recorded(message) -> RecordedFuture:
    """The recorded future of a ``GroundTruth``.

    Raises:
        RequestError: too long, a pose or a time is malformed, or additions of another length.
    """
    check_time("ground_truth.timestamp_us", message.timestamp_us)
    t_us, poses = _read_timed_poses(message.trajectory, "ground_truth.trajectory")
    exact = _exact(message.exact_xyyaw, len(t_us), 3, "ground_truth.exact_xyyaw")
    return RecordedFuture(message.timestamp_us, t_us, poses, exact)


# --------------------------------------------------------------------------------------------------------------- plans


def write_plan(ego: EgoState, plan: Plan, message) -> None:
    """Fills a ``DriveResponse``: poses of now (unless the plan begins earlier) and of the plan, in the local frame."""
    t_us, xyyaw = plan.t_us, plan.pose
    if t_us[0] > ego.t_us:
        t_us, xyyaw = np.concatenate([[ego.t_us], t_us]), np.concatenate([np.zeros((1, 3)), xyyaw])
    samples = [message.trajectory.poses.add(timestamp_us=t) for t in t_us.tolist()]
    level_poses = _standing_poses(_level_from_rig(ego.world_from_rig), xyyaw)
    write_poses(level_frame(ego.world_from_rig) @ level_poses, [sample.pose for sample in samples])
    message.exact_xyyaw.extend(xyyaw.ravel().tolist())
    message.terminate_session = plan.stop_session


def read_plan(ego: EgoState, message) -> Plan:
    """The plan of a ``DriveResponse`` to a car at ``ego``; poses up to the current time are left out.

    Raises:
        RequestError: a pose or a time is malformed, or additions of another length.
    """
    t_us, poses = _read_timed_poses(message.trajectory, "trajectory")
    exact = _exact(message.exact_xyyaw, len(t_us), 3, "exact_xyyaw")
    if exact is None:
        exact = _from_above(geometry.inverse(level_frame(ego.world_from_rig)) @ poses)
    future = t_us > ego.t_us
    return Plan(t_us[future], exact[future], bool(message.terminate_session))


def _read_timed_poses(trajectory, name: str) -> tuple[Int64[np.ndarray, " m"], Float64[np.ndarray, "m 4 4"]]:
    count = len(trajectory.poses)
    if count > MAX_POSES:
        raise RequestError(f"{name} may have {MAX_POSES} poses, got {count}")
    for i, sample in enumerate(trajectory.poses):
        check_time(f"{name}[{i}].timestamp_us", sample.timestamp_us)
    t_us = np.array([sample.timestamp_us for sample in trajectory.poses], np.int64)
    if (np.diff(t_us) <= 0).any():
        bad = int(np.flatnonzero(np.diff(t_us) <= 0)[0])
        raise RequestError(f"times of {name} must increase; {t_us[bad]} is followed by {t_us[bad + 1]}")
    return t_us, read_poses([s.pose for s in trajectory.poses], [f"{name}[{i}]" for i in range(count)])


def _exact(values, count: int, each: int, name: str) -> Float64[np.ndarray, "k n"] | None:
    """An addition of ours: ``each`` doubles for every pose, or none at all."""
    if not len(values):
        return None
    array = np.array(values, np.float64)
    if len(array) != count * each or not (np.abs(array) < FARTHEST).all():
        raise RequestError(
            f"{name} must have {each} values below {FARTHEST:g} for each of {count} poses, got {len(array)} values"
        )
    return array.reshape(count, each)
