"""Poses, trajectories and tracks <-> messages.

The wire's poses are float32 position and ``wxyz`` quaternion; ours travel beside them in double precision
(``Pose.exact``), so that a remote rollout equals a local one bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry
from nurec_sim.compute.turns import rest
from nurec_sim.errors import RequestError
from nurec_sim.types import Track, Trajectory

_AT_ONCE = 1024
"""Poses read in a few milliseconds."""
QUAT_TOLERANCE = 1e-3
"""How far a quaternion's squared norm may be from 1; clients round to float32, AlpaSim itself allows 1e-4."""

MAX_TIME_US = 2**62
"""Times beyond this are rejected, so that sums of two still fit int64."""


def write_poses(poses: Float64[np.ndarray, "n 4 4"], messages: Sequence) -> None:
    """Fills one ``common.Pose`` message per pose."""
    quats = geometry.quat_from_matrix(poses[:, :3, :3]).tolist()
    for pose, (w, x, y, z), message in zip(poses, quats, messages, strict=True):
        message.vec.x, message.vec.y, message.vec.z = pose[:3, 3].tolist()
        message.quat.w, message.quat.x, message.quat.y, message.quat.z = w, x, y, z
        message.exact.extend(pose.ravel().tolist())


def read_poses(messages: Sequence, names: Sequence[str]) -> Float64[np.ndarray, "n 4 4"]:
    """Poses of ``common.Pose`` messages; ``names`` say in an error which one was wrong.

    Raises:
        RequestError: a value is not finite, a quaternion is not a unit one, or ``exact`` is not a rigid transform.
        CancelledError, DeadlinePassedError: see ``compute.turns.rest``.
    """
    parts = []
    for first in range(0, len(messages), _AT_ONCE):
        rest()
        parts.append(_read_some(messages[first : first + _AT_ONCE], names[first : first + _AT_ONCE]))
    return np.concatenate([np.zeros((0, 4, 4)), *parts])


def _read_some(messages: Sequence, names: Sequence[str]) -> Float64[np.ndarray, "n 4 4"]:
    position = np.array([(m.vec.x, m.vec.y, m.vec.z) for m in messages], np.float64).reshape(-1, 3)
    quat = np.array([(m.quat.w, m.quat.x, m.quat.y, m.quat.z) for m in messages], np.float64).reshape(-1, 4)
    norm2 = np.sum(quat * quat, axis=1)
    finite = np.isfinite(norm2 + np.sum(position * position, axis=1))  # squares of float32 do not overflow
    bad = np.flatnonzero(~(finite & (np.abs(norm2 - 1) <= QUAT_TOLERANCE)))
    if len(bad):
        i = int(bad[0])
        values = f"vec (x, y, z) = {_text(position[i])}, quat (w, x, y, z) = {_text(quat[i])}"
        if not finite[i]:
            raise RequestError(f"{names[i]} must be finite, got {values}")
        raise RequestError(
            f"{names[i]} must have a unit quaternion (squared norm 1 within {QUAT_TOLERANCE}), "
            f"got squared norm {norm2[i]:.6g}: {values}"
        )
    result = np.tile(np.eye(4), (len(messages), 1, 1))
    result[:, :3, 3] = position
    result[:, :3, :3] = geometry.matrix_from_quat(quat)
    given, exact = _read_exact(messages, names)
    # A client that copied a message of ours and edited `vec` or `quat` leaves a stale `exact` behind.
    turned = np.abs(exact[:, :3, :3] - result[given, :3, :3]).max(axis=(1, 2), initial=0)
    moved = np.abs(exact[:, :3, 3] - position[given]).max(axis=1, initial=0)
    fresh = (turned <= 1e-6) & (moved <= 1e-6 * np.maximum(1.0, np.abs(position[given]).max(axis=1, initial=0)))
    result[given[fresh]] = exact[fresh]
    return result


def _read_exact(
    messages: Sequence, names: Sequence[str]
) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, "k 4 4"]]:
    """Which messages have ``exact``, and it."""
    given: list[int] = []
    values: list[float] = []
    for i, message in enumerate(messages):
        count = len(message.exact)
        if count == 0:
            continue
        if count != 16:
            raise RequestError(f"{names[i]}.exact must have 16 values (a row-major 4x4) or none, got {count}")
        given.append(i)
        values.extend(message.exact)
    exact = np.array(values, np.float64).reshape(-1, 4, 4)
    sound = geometry.are_rotations(exact[:, :3, :3]) & np.isfinite(exact).all(axis=(1, 2))
    bad = np.flatnonzero(~(sound & (exact[:, 3] == (0, 0, 0, 1)).all(axis=1)))
    if len(bad):
        raise RequestError(
            f"{names[given[bad[0]]]}.exact must be a rigid transform with last row 0 0 0 1, "
            f"got {_text(exact[bad[0]].ravel())}"
        )
    return np.array(given, np.int64), exact


def _text(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in values) + ")"


def write_trajectory(trajectory: Trajectory, message) -> None:
    """Fills a ``common.Trajectory`` message."""
    samples = [message.poses.add(timestamp_us=t) for t in trajectory.t_us.tolist()]
    write_poses(trajectory.world_from_body, [sample.pose for sample in samples])


def read_trajectory(message, name: str) -> Trajectory:
    """The trajectory of a ``common.Trajectory`` message.

    Raises:
        RequestError: it is empty, a pose is malformed, or times do not increase.
    """
    poses = read_poses([s.pose for s in message.poses], [f"{name}[{i}]" for i in range(len(message.poses))])
    try:
        return Trajectory(np.array([s.timestamp_us for s in message.poses], np.int64), poses)
    except (ValueError, OverflowError) as error:
        raise RequestError(f"{name}: {error}") from error


def write_track(track: Track, message) -> None:
    """Fills a ``DynamicObjectTrack`` message."""
    message.id, message.semantic_class, message.asset_id = track.id, track.label, track.id
    message.object_size.size_x, message.object_size.size_y, message.object_size.size_z = track.size_m
    write_trajectory(track.path, message.trajectory)


def read_track(message) -> Track:
    """The track of a ``DynamicObjectTrack`` message.

    Raises:
        RequestError: its trajectory is malformed.
    """
    size = message.object_size
    path = read_trajectory(message.trajectory, f"track {message.id!r}")
    return Track(message.id, message.semantic_class, (size.size_x, size.size_y, size.size_z), path)


def check_interval(start_us: int, end_us: int) -> None:
    """Whether [start, end) is a valid frame.

    Raises:
        RequestError: it is empty or reversed, or a time is beyond any clock.
    """
    if end_us > MAX_TIME_US or start_us > MAX_TIME_US:
        raise RequestError(f"frame_start_us {start_us} and frame_end_us {end_us} must be microseconds below 2**62")
    if start_us >= end_us:
        raise RequestError(
            f"a frame is the half-open interval [frame_start_us, frame_end_us) and needs start < end, "
            f"got [{start_us}, {end_us}); an instant t is [t, t + 1)"
        )
