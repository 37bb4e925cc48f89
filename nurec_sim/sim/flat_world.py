"""A flat synthetic world for testing policies: road, verge, boxes, and sensors ray-cast in numpy.

It provides scene facts and renderer: ``run_rollout(scenario, policy, world.sense, world)``. Frames are geometrically
exact with simple colours; all rays start at the pose of the end of the exposure.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from nurec_sim import geometry
from nurec_sim.sensors import beam_directions, lidar_model, pixel_rays
from nurec_sim.types import (
    CameraFrame,
    CameraModel,
    LidarFrame,
    LidarModel,
    Pinhole,
    Rig,
    SensorFrame,
    SensorRequest,
    Track,
    Trajectory,
)

START_US = 1_000_000
ROAD_RGB, MARK_RGB, VERGE_RGB, SKY_RGB = (88, 88, 92), (225, 225, 220), (84, 118, 58), (150, 185, 230)
LOG_STEP_US = 100_000


def demo_rig() -> Rig:
    """One forward 90-degree camera at 1.5 m and one 32-row LiDAR on the roof."""
    rig_from_camera = geometry.pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([1.7, 0.0, 1.5]))
    camera = CameraModel("front_wide", 640, 384, Pinhole(320.0, 320.0, 320.0, 192.0), rig_from_camera)
    rig_from_lidar = geometry.pose(np.eye(3), np.array([1.2, 0.0, 1.9]))
    return Rig({camera.id: camera}, {"top": lidar_model("HDL-32", rig_from_lidar, id="top", columns=720)})


@dataclass(frozen=True)
class FlatWorld:
    """Scene facts with a renderer. ``road_m`` is the centre line of the road; ``ego`` the ego trajectory."""

    id: str
    rig: Rig
    ego: Trajectory
    tracks: Sequence[Track]
    span_us: tuple[int, int]
    road_m: Float64[np.ndarray, "k 2"]
    road_width_m: float = 7.0
    camera_times_us: Mapping[str, Int64[np.ndarray, "frames 2"]] = field(default_factory=dict)

    def sense(self, requests: Sequence[SensorRequest]) -> list[SensorFrame]:
        """One frame per request."""
        return [self._camera(r) if isinstance(r.sensor, CameraModel) else self._lidar(r) for r in requests]

    def _camera(self, request: SensorRequest) -> CameraFrame:
        camera = request.sensor
        assert isinstance(camera, CameraModel)
        rays, _ = pixel_rays(camera)
        origin, ahead = request.world_from_sensor[1][:3, 3], request.world_from_sensor[1][:3, :3]
        directions = rays.reshape(-1, 3) @ ahead.T
        distance, hit = self._cast(origin, directions, request.end_us, request.actors)
        rgb = np.empty((len(directions), 3), np.uint8)
        rgb[hit == -2] = SKY_RGB
        ground = hit == -1
        rgb[ground] = self._ground_rgb(origin[:2] + distance[ground, None] * directions[ground, :2])
        for index, track in enumerate(self.tracks):
            shade = zlib.crc32(track.id.encode())
            rgb[hit == index] = (150 + shade % 60, 20 + shade // 64 % 50, 20 + shade // 4096 % 60)
        shape = (camera.height_px, camera.width_px)
        depth = np.where(hit == -2, 0.0, distance * rays.reshape(-1, 3)[:, 2]).astype(np.float32)
        return CameraFrame(camera, request.start_us, request.end_us, rgb.reshape(*shape, 3), depth.reshape(shape))

    def _lidar(self, request: SensorRequest) -> LidarFrame:
        lidar = request.sensor
        assert isinstance(lidar, LidarModel)
        local = beam_directions(lidar).reshape(-1, 3)
        pose = request.world_from_sensor[1]
        distance, hit = self._cast(pose[:3, 3], local @ pose[:3, :3].T, request.end_us, request.actors)
        seen = np.flatnonzero((hit != -2) & (distance >= lidar.range_m[0]) & (distance <= lidar.range_m[1]))
        intensity = np.where(hit[seen] == -1, 0.2, 0.6).astype(np.float32)
        xyz = (local[seen] * distance[seen, None]).astype(np.float32)
        ranges = distance[seen].astype(np.float32)
        return LidarFrame(lidar, request.start_us, request.end_us, xyz, ranges, intensity, seen.astype(np.int32))

    def _cast(
        self,
        origin: Float64[np.ndarray, " 3"],
        directions: Float64[np.ndarray, "n 3"],
        t_us: int,
        actors: Mapping[str, Float64[np.ndarray, "2 4 4"]],
    ) -> tuple[Float64[np.ndarray, " n"], np.ndarray]:
        """Distance along each unit ray and the object hit: an index of ``tracks``, -1 the ground, -2 nothing."""
        # Rays within 1e-6 of horizontal or above it never reach the ground plane z = 0.
        with np.errstate(divide="ignore"):
            distance = np.where(directions[:, 2] < -1e-6, -origin[2] / directions[:, 2], np.inf)
        hit = np.where(np.isfinite(distance), -1, -2)
        for index, track in enumerate(self.tracks):
            if track.id not in actors and not track.path.covers(t_us):
                continue
            box_from_world = geometry.inverse(actors[track.id][1] if track.id in actors else track.path.at(t_us))
            start = geometry.transform_points(box_from_world, origin)
            along = directions @ box_from_world[:3, :3].T
            half = np.asarray(track.size_m) / 2
            # Slab method: a ray is inside a box between its last entry into and its first exit from the three slabs.
            # Rays parallel to a slab give +-inf, or NaN in one of its planes, which restricts nothing.
            with np.errstate(divide="ignore", invalid="ignore"):
                sides = np.stack([(-half - start) / along, (half - start) / along])
            enter = np.nan_to_num(sides.min(axis=0), nan=-np.inf).max(axis=1)
            leave = np.nan_to_num(sides.max(axis=0), nan=np.inf).min(axis=1)
            nearer = (enter <= leave) & (enter > 0) & (enter < distance)
            distance = np.where(nearer, enter, distance)
            hit = np.where(nearer, index, hit)
        return np.where(hit == -2, 0.0, distance), hit

    def _ground_rgb(self, xy_m: Float64[np.ndarray, "n 2"]) -> UInt8[np.ndarray, "n 3"]:
        """Asphalt with a dashed centre line, grass beside it, and noise in cells of 0.25 m as texture."""
        station, lateral = geometry.project_to_polyline(xy_m, self.road_m)
        rgb = np.where((np.abs(lateral) < self.road_width_m / 2)[:, None], ROAD_RGB, VERGE_RGB).astype(np.float64)
        rgb[(np.abs(lateral) < 0.08) & (station % 9 < 3)] = MARK_RGB
        # Spatial hash (Teschner et al. 2003): noise that depends on the cell only, so it is the same in every view.
        cells = np.floor(np.clip(xy_m, -1e6, 1e6) * 4).astype(np.int64)
        grain = ((cells[:, 0] * 73_856_093) ^ (cells[:, 1] * 19_349_663)) % 17 - 8
        return np.clip(rgb + grain[:, None], 0, 255).astype(np.uint8)


def flat_world(
    world_id: str,
    line_m: Float64[np.ndarray, "k 2"],
    speed_mps: float | Float64[np.ndarray, " t"],
    duration_s: float = 8.0,
    tracks: Sequence[Track] = (),
    lane_offset_m: float = -1.75,
) -> FlatWorld:
    """A world whose ego drove along ``line_m`` on a parallel road.

    Args:
        world_id: id of the scene.
        line_m: path of the rig origin, k points (x, y), metres.
        speed_mps: one speed, or one per 0.1 s of the log including both ends.
        duration_s: length of the log.
        tracks: actors.
        lane_offset_m: lateral position of the ego on the road, left positive.
    """
    steps = int(round(duration_s * 1e6)) // LOG_STEP_US + 1
    speeds = np.broadcast_to(np.asarray(speed_mps, np.float64), (steps,))
    stations = np.concatenate([[0.0], np.cumsum((speeds[1:] + speeds[:-1]) / 2 * LOG_STEP_US / 1e6)])
    t_us = START_US + LOG_STEP_US * np.arange(steps, dtype=np.int64)
    ego = Trajectory(t_us, poses_along(line_m, stations))
    tangent = np.gradient(line_m, axis=0)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.linalg.norm(tangent, axis=1, keepdims=True)
    road = line_m - lane_offset_m * normal
    return FlatWorld(world_id, demo_rig(), ego, tuple(tracks), (START_US, int(t_us[-1]) + 1), road)


def poses_along(
    line_m: Float64[np.ndarray, "k 2"], station_m: Float64[np.ndarray, " t"], z_m: float = 0.0
) -> Float64[np.ndarray, "t 4 4"]:
    """Poses on a polyline, heading along it."""
    arc = geometry.arc_length(line_m)
    place = np.stack([np.interp(station_m, arc, line_m[:, i]) for i in range(2)], axis=1)
    yaw = np.unwrap(np.arctan2(*np.gradient(line_m, axis=0).T[::-1]))
    heading = np.interp(station_m, arc, yaw)
    return np.stack(
        [geometry.pose_from_xyyaw(x, y, h, z_m) for (x, y), h in zip(place, heading, strict=True)]
    )  # fmt: skip
