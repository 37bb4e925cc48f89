"""The recorded drive in the closed loop: ground height, route ahead, and recorded motion."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry
from nurec_sim.types import Matrix4, Trajectory

VERTEX_SPACING_M = 0.1
ROUTE_SPACING_M, ROUTE_POINTS = 4.0, 20
FUTURE_STEP_US, FUTURE_POINTS = 100_000, 50
SPEED_WINDOW_US = 250_000
SEARCH_M = (10.0, 40.0)
"""Search range around the last arc length, so that self-crossing paths stay unambiguous."""


class RecordedDrive:
    """A recorded ego trajectory with arc length; a stationary one has a single vertex and zero length."""

    def __init__(self, ego: Trajectory) -> None:
        self.ego = ego
        # Vertices less than 0.1 m apart are dropped: at a standstill, localisation noise would add arc length and
        # random tangents.
        keep, last = [0], ego.position_m[0, :2]
        for i, place in enumerate(ego.position_m[:, :2]):
            if np.linalg.norm(place - last) >= VERTEX_SPACING_M:
                keep.append(i)
                last = place
        self.t_us = ego.t_us[keep]
        self.line_m = ego.position_m[keep, :2]
        self.station_m = geometry.arc_length(self.line_m)
        self.speed_mps = self.speeds(self.t_us)

    @property
    def length_m(self) -> float:
        """Metres driven in the log."""
        return float(self.station_m[-1])

    def station(self, x_m: float, y_m: float, near_m: float | None = None) -> float:
        """Arc length of the nearest point on the recorded path, searched around ``near_m`` if given."""
        if len(self.line_m) < 2:
            return 0.0
        low, high = 0, len(self.line_m)
        if near_m is not None:
            # One vertex more on either side, so that the segments containing both ends of the range take part.
            low = max(0, int(np.searchsorted(self.station_m, near_m - SEARCH_M[0])) - 1)
            high = max(low + 2, int(np.searchsorted(self.station_m, near_m + SEARCH_M[1])) + 1)
            low = min(low, len(self.line_m) - 2)
        along, _ = geometry.project_to_polyline(np.array([[x_m, y_m]]), self.line_m[low:high])
        return float(self.station_m[low] + along[0])

    def time_at(self, station_m: float) -> int:
        """Time at which the log reached a station (the first time if it stopped there)."""
        if len(self.line_m) < 2:
            return int(self.t_us[0])
        since = np.interp(station_m, self.station_m, (self.t_us - self.t_us[0]).astype(np.float64))
        return int(self.t_us[0]) + int(round(float(since)))

    def station_of_time(self, t_us: int) -> float:
        """Recorded arc length at ``t_us``."""
        return float(np.interp(t_us - self.t_us[0], self.t_us - self.t_us[0], self.station_m))

    def on_ground(self, x_m: float, y_m: float, yaw_rad: float, station_m: float) -> Matrix4:
        """A rig pose at a planar pose: height, pitch and roll of the recorded car at ``station_m``, rotated to ``yaw``.

        Cameras thus keep their height above a sloping road. Across the path the ground is assumed level: a car 3 m
        beside the recorded path of a road banked by 2 degrees is 0.1 m too high or too low.

        Args:
            x_m: position of the rig origin in the world.
            y_m: position of the rig origin in the world.
            yaw_rad: heading in the world.
            station_m: arc length on the recorded path whose ground is used.

        Returns:
            the world-from-rig pose.
        """
        recorded = self.ego.at(self.time_at(station_m))
        turn = geometry.rotation_from_yaw(yaw_rad - float(geometry.yaw_of(recorded)))
        return geometry.pose(turn @ recorded[:3, :3], np.array([x_m, y_m, recorded[2, 3]]))

    def motion(self, t_us: int) -> tuple[float, float, float]:
        """Speed along x (m/s, never negative), acceleration (m/s^2) and yaw rate (rad/s) of the log, over 0.5 s."""
        low, high = self._window(np.array([t_us]))
        elapsed_s = float(high[0] - low[0]) / 1e6
        if elapsed_s <= 0:
            return 0.0, 0.0, 0.0
        times = np.array([low[0], t_us, high[0]])
        before, now, after = self.speeds(times)
        yaw = geometry.yaw_of(self.ego.at(times))
        yaw_rate = float(geometry.wrap_angle(yaw[2] - yaw[0])) / elapsed_s
        return float(now), float(after - before) / elapsed_s, yaw_rate

    def _window(self, t_us: Int64[np.ndarray, " n"]) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
        return (
            np.maximum(t_us - SPEED_WINDOW_US, self.ego.start_us),
            np.minimum(t_us + SPEED_WINDOW_US, self.ego.end_us),
        )

    def speeds(self, t_us: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """Recorded speeds along x (m/s, never negative) over 0.5 s; 0 outside of the recording."""
        low, high = self._window(t_us)
        # Differences over 0.5 s average localisation noise; projected on the heading, sideways noise at a standstill
        # is no speed.
        moved = self.ego.at(high)[:, :2, 3] - self.ego.at(low)[:, :2, 3]
        forward = self.ego.at(t_us)[:, :2, 0]
        forward = forward / np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-9)
        along = np.sum(moved * forward, axis=1) / np.maximum((high - low) / 1e6, 1e-6)
        return np.where(high > low, np.maximum(along, 0.0), 0.0)

    def route(
        self, x_m: float, y_m: float, yaw_rad: float, station_m: float
    ) -> tuple[Float64[np.ndarray, "k 2"], Float64[np.ndarray, " k"]]:
        """Up to 20 waypoints every 4 m of the recorded path ahead, in the rig frame, and the recorded speed at each.

        The end of the recording is the last one; beyond it, and for a stationary recording, there are none.

        Args:
            x_m: position of the car in the world.
            y_m: position of the car in the world.
            yaw_rad: heading of the car in the world.
            station_m: arc length of the car on the recorded path.

        Returns:
            waypoints (x, y) in metres, and speeds in m/s.
        """
        wanted = station_m + ROUTE_SPACING_M * np.arange(1, ROUTE_POINTS + 1)
        ahead = wanted[wanted < self.length_m]
        if len(ahead) < ROUTE_POINTS and station_m < self.length_m:
            ahead = np.append(ahead, self.length_m)
        if len(ahead) == 0:
            return np.zeros((0, 2)), np.zeros(0)
        world = np.stack([np.interp(ahead, self.station_m, self.line_m[:, i]) for i in range(2)], axis=1)
        return to_local(world, x_m, y_m, yaw_rad), np.interp(ahead, self.station_m, self.speed_mps)

    def future(
        self, t_us: int, x_m: float, y_m: float, yaw_rad: float
    ) -> tuple[Int64[np.ndarray, " m"], Float64[np.ndarray, "m 3"]]:
        """The log's next 5 s every 0.1 s as (x, y, yaw) in the rig frame; shorter at the end of the recording.

        Args:
            t_us: the present, microseconds.
            x_m: position of the car in the world.
            y_m: position of the car in the world.
            yaw_rad: heading of the car in the world.

        Returns:
            times in microseconds, and poses in metres and radians.
        """
        times = t_us + FUTURE_STEP_US * np.arange(1, FUTURE_POINTS + 1, dtype=np.int64)
        times = times[times <= self.ego.end_us]
        poses = self.ego.at(times)
        place = to_local(poses[:, :2, 3], x_m, y_m, yaw_rad)
        yaw = geometry.wrap_angle(geometry.yaw_of(poses) - yaw_rad)
        return times, np.column_stack([place, yaw])


def to_local(world_m: Float64[np.ndarray, "k 2"], x_m: float, y_m: float, yaw_rad: float) -> Float64[np.ndarray, "k 2"]:
    """World points in the frame of a car.

    Args:
        world_m: k points (x, y).
        x_m: position of the car in the world.
        y_m: position of the car in the world.
        yaw_rad: heading of the car in the world.
    """
    # Row vectors times R(yaw) equal column vectors under its transpose, the rotation from world to car axes.
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return (world_m - [x_m, y_m]) @ np.array([[c, -s], [s, c]])
