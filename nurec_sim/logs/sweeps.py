"""LiDAR sweeps: validation of a reader's output, point times, and motion compensation."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.files.decoding import LIMITS
from nurec_sim.logs.beam_errors import BeamErrors
from nurec_sim.logs.points import instants_of, moved_points, turn_times_us
from nurec_sim.types import LidarModel, Matrix4, Spin, Sweep, SweepPoints, Trajectory


@dataclass(frozen=True, eq=False)
class SweepRecord:
    """One sweep of a LiDAR: where it is stored, when it was measured, and from where.

    Attributes:
        file: where it is stored, for messages.
        t_us: the instant to which its points belong, within ``start_us`` to ``end_us``.
        start_us: start of the turn.
        end_us: end of the turn; equal to the start if the log has a single time per sweep.
        world_from_lidar: pose of the LiDAR at ``t_us``.
        compensated: whether the points are already where they would be at ``t_us``; if not, they are moved by the ego's
            own motion between their time and ``t_us``.
        origin_m: where its beams start in the axes of the stored points, if not at their origin (``logs.origins``);
            ``world_from_lidar`` is the pose there.
        beam_errors: what its points are off by, if that was found (``logs.alignment``).
    """

    file: str
    t_us: int
    start_us: int
    end_us: int
    world_from_lidar: Matrix4
    compensated: bool = True
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    beam_errors: BeamErrors | None = None

    def from_origin(self, origin_m: Float64[np.ndarray, " 3"]) -> SweepRecord:
        """The sweep with its LiDAR moved to where its beams start, given in its present frame."""
        x, y, z = np.add(self.origin_m, origin_m).tolist()
        pose = self.world_from_lidar @ geometry.pose(np.eye(3), origin_m)
        return dataclasses.replace(self, world_from_lidar=pose, origin_m=(x, y, z))


def compensated_sweep(record: SweepRecord, stored: SweepPoints, lidar: LidarModel, ego: Trajectory) -> Sweep:
    """A sweep, motion compensated to its reference time; its arrays are read-only.

    Args:
        record: its times and pose.
        stored: its points as the log stores them.
        lidar: its sense of rotation gives the times of points that have none.
        ego: trajectory of the car.

    Raises:
        ClipError: the arrays do not fit together, or hold too many points.
    """
    xyz_m, intensity, dt_us = _checked(stored)
    xyz_m = xyz_m - record.origin_m if any(record.origin_m) else xyz_m
    point_t_us = _point_times(lidar, record, dt_us, xyz_m)
    if record.beam_errors is not None:
        xyz_m = record.beam_errors.removed(xyz_m)
    if not record.compensated:
        xyz_m = _compensated(ego, record, xyz_m, point_t_us)
    xyz_m, point_t_us = _read_only(xyz_m), _read_only(point_t_us)
    intensity = None if intensity is None else _read_only(intensity)
    return Sweep(
        record.t_us, record.start_us, record.end_us, record.world_from_lidar.copy(), xyz_m, intensity, point_t_us
    )


def _read_only(array: np.ndarray) -> np.ndarray:
    view = array.view()
    view.setflags(write=False)
    return view


def _checked(stored: SweepPoints) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Points [n,3], intensities and times [n], validated and converted to the types used here."""
    xyz_m = np.asarray(stored.xyz_m, np.float64)
    if xyz_m.ndim != 2 or xyz_m.shape[1] != 3 or not np.isfinite(xyz_m).all():
        raise ClipError(f"points must be finite numbers [n,3], got {xyz_m.dtype} {xyz_m.shape}")
    if len(xyz_m) > LIMITS.sweep_points:
        raise ClipError(f"{len(xyz_m):,} points; a sweep may have {LIMITS.sweep_points:,}")
    for name in ("intensity", "dt_us"):
        array = getattr(stored, name)
        if array is not None and np.shape(array) != xyz_m.shape[:1]:
            raise ClipError(f"{len(xyz_m)} points but {name} of shape {np.shape(array)}")
    intensity = None if stored.intensity is None else np.asarray(stored.intensity, np.float32)
    if intensity is not None and not ((intensity >= 0) & (intensity <= 1)).all():
        raise ClipError(f"intensities must lie in 0..1, got {intensity.min():g} to {intensity.max():g}")
    return xyz_m, intensity, None if stored.dt_us is None else np.asarray(stored.dt_us).astype(np.int64)


def _point_times(
    lidar: LidarModel, record: SweepRecord, dt_us: Int64[np.ndarray, " n"] | None, xyz: Float64[np.ndarray, "n 3"]
) -> Int64[np.ndarray, " n"]:
    """Time of each point: as stored, else from its azimuth in an uncompensated turn, else the sweep's single time."""
    if dt_us is not None:
        return record.start_us + dt_us
    if record.compensated or record.end_us <= record.start_us:
        return np.full(len(xyz), record.t_us, np.int64)
    # The turn begins and ends behind the car and looks straight ahead at the reference time.
    sign = -1.0 if lidar.spin is Spin.CLOCKWISE else 1.0
    return record.t_us + turn_times_us(xyz, sign * (record.end_us - record.start_us))


def _compensated(
    ego: Trajectory, record: SweepRecord, xyz: Float64[np.ndarray, "n 3"], point_t_us: Int64[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 3"]:
    """Points at the reference time, compensated by the ego's motion; unchanged if the log has no motion."""
    longer = prolonged(ego, record.end_us - record.start_us)
    if longer is None or (point_t_us == record.t_us).all():
        return xyz
    lidar_from_rig = geometry.inverse(ego.at(record.t_us)) @ record.world_from_lidar
    instants = instants_of(point_t_us, longer)
    fired = longer.at(instants) @ lidar_from_rig
    # As ``sensors.compensate_sweep`` does, with the poses multiplied before they are repeated for each point.
    return moved_points(xyz, point_t_us, instants, geometry.inverse(record.world_from_lidar) @ fired)


def prolonged(ego: Trajectory, margin_us: int) -> Trajectory | None:
    """A trajectory extrapolated at constant velocity at both ends; None for a single pose, which has no velocity."""
    if len(ego.t_us) < 2:
        return None

    def carried(near: int, far: int) -> Matrix4:
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
