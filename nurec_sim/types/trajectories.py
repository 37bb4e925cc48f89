"""Poses over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry

Matrix4 = Float64[np.ndarray, "4 4"]


@dataclass(frozen=True)
class Trajectory:
    """Poses of a rigid body over time, strictly increasing in time.

    Raises:
        ValueError: shapes differ, times do not increase, or a value is not finite.
    """

    t_us: Int64[np.ndarray, " t"]
    world_from_body: Float64[np.ndarray, "t 4 4"]

    def __post_init__(self) -> None:
        t_us = np.ascontiguousarray(self.t_us, dtype=np.int64)
        poses = np.ascontiguousarray(self.world_from_body, dtype=np.float64)
        if t_us.ndim != 1 or len(t_us) == 0 or poses.shape != (len(t_us), 4, 4):
            raise ValueError(f"a trajectory needs times [t] and poses [t,4,4], t >= 1; got {t_us.shape}, {poses.shape}")
        if np.any(np.diff(t_us) <= 0):
            raise ValueError("trajectory times must increase strictly")
        if not np.isfinite(poses).all():
            raise ValueError("trajectory poses must be finite")
        object.__setattr__(self, "t_us", t_us)
        object.__setattr__(self, "world_from_body", poses)

    def __repr__(self) -> str:
        return f"Trajectory({len(self.t_us)} poses from {self.start_us} to {self.end_us} us)"

    @property
    def start_us(self) -> int:
        """First time."""
        return int(self.t_us[0])

    @property
    def end_us(self) -> int:
        """Last time (inclusive)."""
        return int(self.t_us[-1])

    @property
    def position_m(self) -> Float64[np.ndarray, "t 3"]:
        """Body origins in the world."""
        return self.world_from_body[:, :3, 3]

    def covers(self, t_us: int) -> bool:
        """Whether ``t_us`` lies between the first and the last time, both included."""
        return self.start_us <= t_us <= self.end_us

    def at(self, t_us: int | Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "*n 4 4"]:
        """Poses at ``t_us``: linear in position, slerp in rotation; constant before the first and after the last."""
        return geometry.interpolate_poses(self.t_us, self.world_from_body, t_us)
