"""Reading LiDAR files: millimetre points, intensities, times; and undoing the car's motion during a turn."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry, sensors
from nurec_sim.errors import ClipError
from nurec_sim.files.decoding import LIMITS
from nurec_sim.logs.storage import Storage
from nurec_sim.types import Matrix4, Spin, Sweep, Trajectory

INSTANT_US = 20


@dataclass(frozen=True, eq=False)
class SweepRecord:
    """One sweep of a LiDAR: where its file is, when it was measured, from where, and how the file stores it.

    ``lidar_from_file`` turns the axes of the file to ours (x forward); ``compensated`` says whether the points are
    already where they would be at ``t_us``.
    """

    file: str
    t_us: int
    start_us: int
    end_us: int
    world_from_lidar: Matrix4
    intensity_scale: float
    compensated: bool
    lidar_from_file: Matrix4 = field(default_factory=lambda: np.eye(4))


def encode_points(xyz_m: Float64[np.ndarray, "n 3"]) -> np.ndarray:
    """Points as whole millimetres, each coordinate as the difference to the point before (``dxyz_mm``, int32)."""
    millimetres = np.rint(np.asarray(xyz_m, np.float64) * 1000.0).astype(np.int64).T
    return np.diff(millimetres, axis=1, prepend=0).astype(np.int32)


def read_sweep(storage: Storage, record: SweepRecord, spin: Spin, ego: Trajectory) -> Sweep:
    """One sweep, motion compensated to its reference time.

    Raises:
        ClipError: the file is missing, broken, or its arrays do not fit together.
    """
    arrays = _checked_arrays(storage, record.file)
    xyz = np.cumsum(arrays["dxyz_mm"], axis=1, dtype=np.int64).T / 1000.0
    xyz = geometry.transform_points(record.lidar_from_file, xyz)
    point_t_us = _point_times(spin, record, arrays, xyz)
    if not record.compensated:
        xyz = _compensated(ego, record, xyz, point_t_us)
    intensity = None
    if "intensity" in arrays:
        intensity = np.clip(arrays["intensity"] / record.intensity_scale, 0.0, 1.0).astype(np.float32)
        intensity.setflags(write=False)
    xyz.setflags(write=False)
    point_t_us.setflags(write=False)
    return Sweep(
        record.t_us, record.start_us, record.end_us, record.world_from_lidar.copy(), xyz, intensity, point_t_us
    )


def _checked_arrays(storage: Storage, file: str) -> dict[str, np.ndarray]:
    arrays = storage.read_arrays(file)
    points = arrays.get("dxyz_mm")
    if points is None or points.ndim != 2 or points.shape[0] != 3 or points.dtype.kind not in "iu":
        found = "nothing" if points is None else f"{points.dtype} {points.shape}"
        raise ClipError(f"{storage.path.name}: {file} needs whole numbers dxyz_mm [3,n], got {found}")
    if points.shape[1] > LIMITS.sweep_points:
        raise ClipError(
            f"{storage.path.name}: {file} has {points.shape[1]:,} points; a sweep may have {LIMITS.sweep_points:,}"
        )
    for name in ("intensity", "dt_us"):
        if name in arrays and arrays[name].shape != points.shape[1:]:
            raise ClipError(
                f"{storage.path.name}: {file} has {points.shape[1]} points but {name} of shape {arrays[name].shape}"
            )
    return arrays


def _point_times(
    spin: Spin, record: SweepRecord, arrays: dict[str, np.ndarray], xyz: Float64[np.ndarray, "n 3"]
) -> Int64[np.ndarray, " n"]:
    """When each point was measured: as stored, else by its azimuth in a raw turn, else the sweep's one time."""
    if "dt_us" in arrays:
        return record.start_us + arrays["dt_us"].astype(np.int64)
    if record.compensated or record.end_us <= record.start_us:
        return np.full(len(xyz), record.t_us, np.int64)
    # The turn begins and ends behind the car and looks straight ahead at the reference time.
    sign = -1.0 if spin is Spin.CLOCKWISE else 1.0
    turn = sign * np.arctan2(xyz[:, 1], xyz[:, 0]) / (2 * np.pi)
    return record.t_us + np.rint(turn * (record.end_us - record.start_us)).astype(np.int64)


def _compensated(
    ego: Trajectory, record: SweepRecord, xyz: Float64[np.ndarray, "n 3"], point_t_us: Int64[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 3"]:
    """Points at the reference time, by the ego's own motion; unchanged where the log knows no motion."""
    longer = prolonged(ego, record.end_us - record.start_us)
    if longer is None or (point_t_us == record.t_us).all():
        return xyz
    lidar_from_rig = geometry.inverse(ego.at(record.t_us)) @ record.world_from_lidar
    # Poses at instants 20 us apart: at 50 m/s that errs by half a millimetre, the grain of the files, and costs a
    # twentieth of a pose for each point.
    instants, place = np.unique(point_t_us // INSTANT_US, return_inverse=True)
    poses = longer.at(instants * INSTANT_US + INSTANT_US // 2) @ lidar_from_rig
    return sensors.compensate_sweep(xyz, poses[place], record.world_from_lidar)


def prolonged(ego: Trajectory, margin_us: int) -> Trajectory | None:
    """A trajectory carried on at constant velocity before its first and after its last pose; None of a single pose."""
    if len(ego.t_us) < 2:
        return None

    def carried(near: int, far: int) -> Float64[np.ndarray, "4 4"]:
        # The motion from `far` to `near`, scaled to the margin and applied once more at `near`.
        step = geometry.inverse(ego.world_from_body[far]) @ ego.world_from_body[near]
        share = margin_us / abs(int(ego.t_us[near] - ego.t_us[far]))
        whole = np.floor(share)
        part = geometry.interpolate_pose_pair(np.stack([np.eye(4), step]), np.array([share - whole]))[0]
        return ego.world_from_body[near] @ np.linalg.matrix_power(step, int(whole)) @ part

    if margin_us <= 0:
        return ego
    times = np.concatenate([[ego.start_us - margin_us], ego.t_us, [ego.end_us + margin_us]])
    return Trajectory(times, np.concatenate([[carried(0, 1)], ego.world_from_body, [carried(-1, -2)]]))
