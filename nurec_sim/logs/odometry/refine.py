"""Poses refined by LiDAR odometry, smoothed with the recorded ones as a prior; no loops are closed.

Each sweep is registered with the surfaces of those before it, starting at the motion that was recorded in between. The
chain of poses then follows the LiDAR over tens of metres, the IMU in roll and pitch, and GPS over kilometres.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.logs.clip import Clip
from nurec_sim.logs.moved import corrected
from nurec_sim.logs.odometry.agreement import agreement_m
from nurec_sim.logs.odometry.register import Registration, Surface, register, surface_of
from nurec_sim.logs.odometry.static_points import moving_tracks, static_points, thinned
from nurec_sim.types import Trajectory

MAP_CELL_M, SWEEP_CELL_M = 0.4, 0.8
MAP_SWEEPS = 40
MAP_LENGTH_M = 60.0
PASSES = 2
"""The second one compensates sweeps with the motion that the first one found."""
DRIFT_M, DRIFT_RAD = 0.03, np.radians(0.01)
"""Standard deviations of the odometry: per square root of a metre driven, and per square root of a sweep."""
GPS_M, YAW_RAD, GPS_S = 1.0, np.radians(0.5), 10.0
"""Standard deviations of recorded positions and headings, whose errors persist for some seconds."""
STILL_M = 1e-3
LEVEL_RAD, LEVEL_S = np.radians(0.1), 1.0
"""The same for roll and pitch, which an IMU knows by gravity."""
FEWEST_PARTNERS = 0.2

Report = Callable[[str, float], None]
Poses = Float64[np.ndarray, "n 4 4"]


@dataclass(frozen=True)
class PoseReport:
    """How well poses were refined.

    Attributes:
        lidar_id: the LiDAR that was used.
        sweeps: how many sweeps it has.
        lost: sweeps that did not fit to those before, and follow the recorded motion.
        residual_m: median distance of points from the surfaces of earlier sweeps; None if no sweep fitted.
        correction_m: largest and median distance between refined and recorded poses.
        agreement_m: ``odometry.agreement_m`` with recorded and with refined poses; None if the car drove too little.
    """

    lidar_id: str
    sweeps: int
    lost: int
    residual_m: float | None
    correction_m: tuple[float, float]
    agreement_m: tuple[float | None, float | None]

    @property
    def rows(self) -> list[tuple[str, str]]:
        """The report as rows of a table."""
        off = self.residual_m
        before, after = ("not known, less than 22 m driven" if x is None else f"{x:.2f} m" for x in self.agreement_m)
        return [
            ("sweeps registered", f"{self.sweeps - self.lost} of {self.sweeps} of {self.lidar_id!r}"),
            ("points off earlier surfaces, median", "not known" if off is None else f"{off:.3f} m"),
            ("poses moved", f"{self.correction_m[1]:.2f} m in the median, {self.correction_m[0]:.2f} m at most"),
            ("surfaces ahead and later behind, recorded poses", before),
            ("surfaces ahead and later behind, refined poses", after),
        ]


def refine_poses(clip: Clip, progress: Report = lambda stage, done: None) -> tuple[Clip, PoseReport]:
    """The log with poses refined by its LiDAR; the recorded ones are the prior.

    Tracks move with the poses, from which they were seen; a map stays where it is.

    Args:
        clip: a log with a LiDAR.
        progress: called with (stage, fraction done).

    Raises:
        ClipError: there is no LiDAR with two sweeps, or a sweep cannot be read.
    """
    names = [name for name in clip.rig.lidars if clip.sweep_count(name) > 1]
    if not names:
        raise ClipError(f"poses cannot be refined: {clip.id!r} has no LiDAR with two sweeps or more")
    lidar_id = max(names, key=clip.sweep_count)
    times = np.array([record.t_us for record in clip.sweep_records(lidar_id)], np.int64)
    refined = clip
    found: list[Registration] = []
    for number in range(PASSES):

        def step(done: float, number: int = number) -> None:
            progress("poses from the LiDAR", (number + done) / PASSES)

        found = _odometry(refined, lidar_id, clip.ego.at(times), step)
        poses = _smoothed(times, clip.ego.at(times), np.array([each.pose for each in found]))
        refined = corrected(clip, Trajectory(times, poses @ geometry.inverse(clip.ego.at(times))))
    fitted = [each.residual_m for each in found[1:] if each.share >= FEWEST_PARTNERS]
    moved = np.linalg.norm(refined.ego.at(times)[:, :3, 3] - clip.ego.at(times)[:, :3, 3], axis=1)
    report = PoseReport(
        lidar_id=lidar_id,
        sweeps=len(times),
        lost=len(found) - 1 - len(fitted),
        residual_m=float(np.median(fitted)) if fitted else None,
        correction_m=(float(moved.max()), float(np.median(moved))),
        agreement_m=(agreement_m(clip, lidar_id), agreement_m(refined, lidar_id)),
    )
    refined.facts["poses"] = f"refined by LiDAR odometry; recorded: {clip.facts.get('poses', 'as in the log')}"
    return refined, report


def _odometry(clip: Clip, lidar_id: str, recorded: Poses, progress: Callable[[float], None]) -> list[Registration]:
    """Poses of the rig at the sweeps, each registered with the sweeps before; the first one is as recorded."""
    moving = moving_tracks(clip)
    surfaces: deque[Surface] = deque(maxlen=MAP_SWEEPS)
    places: deque[np.ndarray] = deque(maxlen=MAP_SWEEPS)
    found: list[Registration] = []
    for index, pose in enumerate(recorded):
        points = static_points(clip, lidar_id, index, moving)
        if not found:
            result = Registration(pose, 0.0, 1.0)
        else:
            guess = found[-1].pose @ geometry.inverse(recorded[index - 1]) @ pose
            near = [
                s for s, at in zip(surfaces, places, strict=True) if np.linalg.norm(at - guess[:3, 3]) < MAP_LENGTH_M
            ]
            target = Surface(np.concatenate([s.points for s in near]), np.concatenate([s.normals for s in near]))
            result = register(thinned(points, SWEEP_CELL_M), target, guess)
            if result.share < FEWEST_PARTNERS:
                result = Registration(guess, result.residual_m, result.share)
        found.append(result)
        surfaces.append(surface_of(points, thinned(points, MAP_CELL_M)).moved(result.pose))
        places.append(result.pose[:3, 3])
        progress((index + 1) / len(recorded))
    return found


def _smoothed(t_us: Int64[np.ndarray, " n"], recorded: Poses, odometry: Poses) -> Poses:
    """Poses between odometry and recording: corrections of the odometry vary little, and bring it near the recording.

    Minimises ``sum |c[k+1] - c[k]|^2 / drift^2 + sum |c[k] - d[k]|^2 / sigma^2`` with d from odometry to recording:
    first for rotation vectors, which turn the motion between sweeps as well, then for positions.
    """
    step_s = max(float(np.median(np.diff(t_us))) / 1e6, 1e-3)

    def pull(sigma: float, seconds: float) -> float:
        # Errors of recorded poses persist: all sweeps of that time together count as one observation.
        return 1 / (sigma**2 * max(seconds / step_s, 1.0))

    turn = Rotation.from_matrix(recorded[:, :3, :3] @ np.swapaxes(odometry[:, :3, :3], 1, 2)).as_rotvec()
    stiff = np.full(len(t_us) - 1, 1 / DRIFT_RAD**2)
    level = _tridiagonal(stiff, pull(LEVEL_RAD, LEVEL_S), turn[:, :2])
    yaw = _tridiagonal(stiff, pull(YAW_RAD, GPS_S), turn[:, 2:])
    turned = Rotation.from_rotvec(np.concatenate([level, yaw], axis=1)).as_matrix()
    poses = odometry.copy()
    poses[:, :3, :3] = turned @ odometry[:, :3, :3]
    motion = np.diff(odometry[:, :3, 3], axis=0)
    poses[1:, :3, 3] = poses[0, :3, 3] + np.cumsum(np.einsum("nij,nj->ni", turned[:-1], motion), axis=0)
    # A vehicle that stands hardly drifts.
    stiff = 1 / (DRIFT_M**2 * np.linalg.norm(motion, axis=1) + STILL_M**2)
    poses[:, :3, 3] += _tridiagonal(stiff, pull(GPS_M, GPS_S), recorded[:, :3, 3] - poses[:, :3, 3])
    return poses


def _tridiagonal(
    stiff: Float64[np.ndarray, " n-1"], pull: float, wanted: Float64[np.ndarray, "n d"]
) -> Float64[np.ndarray, "n d"]:
    """The corrections c that minimise ``sum stiff |c[k+1] - c[k]|^2 + sum pull |c[k] - wanted[k]|^2``."""
    bands = np.zeros((2, len(wanted)))
    bands[1] = pull
    bands[1, :-1] += stiff
    bands[1, 1:] += stiff
    bands[0, 1:] = -stiff
    return solveh_banded(bands, pull * wanted)
