"""Rules about LiDAR sweeps."""

from __future__ import annotations

import grpc
import numpy as np

from nurec_sim import geometry
from nurec_sim.serving.conformance.kit import check
from nurec_sim.serving.conformance.target import Skipped, Target, expect, place
from nurec_sim.serving.wire import sensorsim

_MOUNTING = geometry.pose(np.eye(3), np.array([1.0, 0.0, 1.9]))


def _sweep(target: Target, lidar_type: int = 1, end=None):
    """A request for a sweep from the roof of the recording car; AT128 has the fewer beams."""
    t_us = target.middle_us
    message = sensorsim.LidarRenderRequest(scene_id=target.scene_id, frame_start_us=t_us, frame_end_us=t_us + 100_000)
    message.frame_end_us = min(message.frame_end_us, target.path.end_us + 1)
    message.lidar_config.lidar_type = lidar_type
    place(message.sensor_pose, target.path.at(t_us) @ _MOUNTING, end)
    return message


def _points(reply) -> np.ndarray:
    return np.frombuffer(reply.point_xyzs_buffer, "<f4").reshape(-1, 3).astype(np.float64)


@check("lidar-buffers", optional=True)
def buffers(target: Target) -> str:
    """The buffers hold num_points points as little-endian float32, finite, with intensities of 0 to 1."""
    reply = target.call("render_lidar", _sweep(target))
    n = reply.num_points
    expect(len(reply.point_xyzs_buffer) == 12 * n, f"{n} points, {len(reply.point_xyzs_buffer)} bytes of coordinates")
    expect(len(reply.point_intensities_buffer) == 4 * n, f"{n} points, {len(reply.point_intensities_buffer)} bytes")
    expect(len(reply.point_xyzs) in (0, 3 * n), f"{n} points, {len(reply.point_xyzs)} repeated coordinates")
    expect(len(reply.point_intensities) in (0, n), f"{n} points, {len(reply.point_intensities)} repeated intensities")
    intensity = np.frombuffer(reply.point_intensities_buffer, "<f4")
    expect(np.isfinite(_points(reply)).all(), "a coordinate is not finite")
    expect(((intensity >= 0) & (intensity <= 1)).all(), "an intensity is not in 0..1")
    expect(n > 0, "no beam returns")
    return f"{n:,} points"


@check("lidar-types", optional=True)
def types(target: Target) -> str:
    """PANDAR128 and AT128 both give points."""
    counts = [target.call("render_lidar", _sweep(target, number)).num_points for number in (0, 1)]
    expect(min(counts) > 0, f"PANDAR128 gives {counts[0]} points, AT128 {counts[1]}")
    return f"PANDAR128 {counts[0]:,} points, AT128 {counts[1]:,}"


@check("lidar-type-unknown", optional=True)
def type_unknown(target: Target) -> str:
    """A LiDAR that does not exist is INVALID_ARGUMENT."""
    target.call("render_lidar", _sweep(target))
    return target.refused("render_lidar", _sweep(target, 77), grpc.StatusCode.INVALID_ARGUMENT)


@check("lidar-end-frame", optional=True)
def end_frame(target: Target) -> str:
    """Points are in the LiDAR's frame at the end of the spin."""
    from scipy.spatial import cKDTree

    start = target.path.at(target.middle_us) @ _MOUNTING
    end = start @ geometry.pose(geometry.rotation_from_yaw(0.3), np.array([0.5, 0.0, 0.0]))
    still = geometry.transform_points(start, _points(target.call("render_lidar", _sweep(target))))
    moved = _points(target.call("render_lidar", _sweep(target, end=end)))
    if min(len(still), len(moved)) < 100:
        raise Skipped("too few points to tell")
    tree = cKDTree(still)
    by_end, by_start = (
        float(np.median(tree.query(geometry.transform_points(pose, moved))[0])) for pose in (end, start)
    )
    expect(by_end < by_start, f"points fit the end's frame to {by_end:.2f} m, the start's to {by_start:.2f} m")
    return f"points fit the end's frame to {by_end:.2f} m, the start's to {by_start:.2f} m"


@check("lidar-filter", optional=True)
def filter_(target: Target) -> str:
    """A higher opacity_threshold lets no more beams return."""
    counts = []
    for threshold in (0.0, 0.99):
        request = _sweep(target)
        request.render_filter.opacity_threshold = threshold
        counts.append(target.call("render_lidar", request).num_points)
    expect(counts[0] >= counts[1], f"{counts[0]} points at threshold 0, {counts[1]} at 0.99")
    return f"{counts[0]:,} points at threshold 0, {counts[1]:,} at 0.99"


@check("lidar-time", optional=True)
def time_range(target: Target) -> str:
    """A sweep long after the recording is OUT_OF_RANGE, an empty one INVALID_ARGUMENT."""
    target.call("render_lidar", _sweep(target))
    empty, late = _sweep(target), _sweep(target)
    empty.frame_end_us = empty.frame_start_us
    late.frame_start_us, late.frame_end_us = target.path.end_us + 60_000_000, target.path.end_us + 60_100_000
    target.refused("render_lidar", empty, grpc.StatusCode.INVALID_ARGUMENT)
    return target.refused("render_lidar", late, grpc.StatusCode.OUT_OF_RANGE)
