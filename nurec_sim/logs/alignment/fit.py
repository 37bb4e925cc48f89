"""Errors of beams, mountings and poses by which sweeps of a log see the same planes, and images the same points.

Along the normal of its plane, a recorded point is where the plane is, plus what the error of its beam, the turn of its
LiDAR and the error of its pose move it. The offsets of planes are eliminated. A point of a sweep that is followed from
an image to another is found as many pixels off as the errors of both poses move it. Both are linear in the errors, and
solved by least squares with Cauchy weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy import sparse
from scipy.spatial.transform import Rotation

from nurec_sim import geometry
from nurec_sim.logs.alignment.followed import FollowedPoints
from nurec_sim.logs.alignment.planes import PlanePoints
from nurec_sim.logs.alignment.products import Rows, add_products, median_apart, solved
from nurec_sim.logs.beam_errors import BeamErrors
from nurec_sim.types import Matrix4, Trajectory

KNOTS_RAD = np.radians(np.arange(-60.0, 30.01, 0.25))
"""Elevations at which errors of beams are solved for: finer than the beams of common scanners are apart."""
BEAM_RAD, STEP_RAD, TURN_RAD = np.radians(0.1), np.radians(0.03), np.radians(0.1)
"""Standard deviations of the error of a beam, of its change from one knot to the next, and of the mounting."""
SHIFT_M, TILT_RAD = 0.05, np.radians(0.1)
"""Standard deviations of errors of poses."""
WALK_US, SHIFT_WALK_M, TILT_WALK_RAD = 25_000, 0.01, np.radians(0.03)
"""Standard deviations of their change within such a time: a car shakes while a LiDAR turns once."""
SIGMA_M = 0.025
"""Standard deviation of points around their plane; those that are farther away count less."""
ALIKE = 10
"""So many points count as one: those near each other on a plane err alike."""
COMMON = 0.001
"""Weight of places as recorded against corrected ones. Where all is a plane, beams that are all lower look like a
sensor that is higher; this decides for neither, and takes 0.1 % of what points say."""
SIGMA_PX = 0.5
"""Standard deviation of a followed point around where it is expected; those that are farther away count less."""
ALIKE_PX = 40
"""So many of them count as one: those near each other in an image err alike."""
ROUNDS = 4


@dataclass(frozen=True, eq=False)
class Errors:
    """What was found.

    Attributes:
        beams: errors of the beams of each LiDAR, in the order of the rig.
        turns_rad: rotation vector from true to recorded directions of each LiDAR, in its frame.
        t_us: times of the corrections of poses.
        shift_m: recorded minus true position of the car then, in the world.
        tilt_rad: rotation vector from the true to the recorded pose then, about the axes of the world.
        apart_m: median distance of points from the median of their plane, as recorded and without these errors.
        apart_px: median distance of followed points from where they are expected, likewise; 0 if there are none.
    """

    beams: list[BeamErrors]
    turns_rad: Float64[np.ndarray, "lidars 3"]
    t_us: Int64[np.ndarray, " k"]
    shift_m: Float64[np.ndarray, "k 3"]
    tilt_rad: Float64[np.ndarray, "k 3"]
    apart_m: tuple[float, float]
    apart_px: tuple[float, float]

    def correction(self, ego: Trajectory) -> Trajectory:
        """``aligned_from_recorded`` in the world at ``t_us``; turns about the car."""
        at = ego.at(self.t_us)[:, :3, 3]
        poses = np.tile(np.eye(4), (len(at), 1, 1))
        poses[:, :3, :3] = Rotation.from_rotvec(-self.tilt_rad).as_matrix()
        poses[:, :3, 3] = at - self.shift_m - np.einsum("nij,nj->ni", poses[:, :3, :3], at)
        return Trajectory(self.t_us, poses)

    def mounting(self, lidar: int) -> Matrix4:
        """``recorded_from_true`` frame of a LiDAR: its recorded pose times this is its true one."""
        return geometry.pose(Rotation.from_rotvec(-self.turns_rad[lidar]).as_matrix(), np.zeros(3))


def errors_of(
    points: PlanePoints, followed: FollowedPoints, lidars: int, t_us: Int64[np.ndarray, " k"], ego: Trajectory
) -> Errors:
    """The errors that explain why sweeps disagree about planes, and images about where their points are.

    Args:
        points: points on planes.
        followed: points of images found in others.
        lidars: number of LiDARs.
        t_us: times at which poses are corrected, ascending; linear in between.
        ego: recorded poses of the car.
    """
    kinds = [_of_beams(points, lidars), _of_turns(points, lidars), _of_poses(points, t_us, ego)]
    rows = _rows(kinds, points.plane)
    columns, kind = rows.matrix, np.repeat(np.arange(len(kinds)), [each.width for each in kinds])
    alone = rows.products(np.ones(len(points))) * (kind[:, None] == kind)
    prior = _prior(lidars, t_us) + COMMON * alone
    images, off = _of_followed(followed, columns.shape[1], t_us, ego), followed.off_px.ravel()
    counts = ALIKE / ALIKE_PX * (SIGMA_M / SIGMA_PX) ** 2
    seen = np.ones(len(off))
    across = points.across_m
    weight, found = np.ones(len(points)), np.zeros(columns.shape[1])
    for _ in range(ROUNDS):
        total = np.bincount(points.plane, weight)
        mean = rows.means(weight, total)
        normal = rows.products(weight)
        add_products(normal, mean, -total)
        right = columns.T @ (weight * across) - mean.T @ np.bincount(points.plane, weight * across)
        add_products(normal, images, counts * seen)
        right += counts * (images.T @ (seen * off))
        normal += prior
        found = solved(normal, right)
        left = across - columns @ found
        left -= (np.bincount(points.plane, weight * left) / total)[points.plane]
        weight = 1 / (1 + (left / SIGMA_M) ** 2)
        seen = 1 / (1 + ((off - images @ found) / SIGMA_PX) ** 2)
    beams, turns, poses = np.split(found, np.cumsum([each.width for each in kinds])[:2])
    shift, tilt = poses.reshape(len(t_us), 2, 3).transpose(1, 0, 2)
    return Errors(
        beams=[BeamErrors(KNOTS_RAD, each) for each in beams.reshape(lidars, len(KNOTS_RAD))],
        turns_rad=turns.reshape(lidars, 3),
        t_us=t_us,
        shift_m=shift,
        tilt_rad=tilt,
        apart_m=(median_apart(across, points.plane), median_apart(across - columns @ found, points.plane)),
        apart_px=(_size(off), _size(off - images @ found)),
    )


@dataclass(frozen=True, eq=False)
class _Columns:
    """How points depend on unknowns of one kind.

    Attributes:
        values: for each entry of a row, the values of all points.
        columns: their columns.
        width: number of unknowns.
    """

    values: list[Float64[np.ndarray, " n"]]
    columns: list[Int64[np.ndarray, " n"]]
    width: int


def _rows(kinds: Sequence[_Columns], plane: Int64[np.ndarray, " n"]) -> Rows:
    """All kinds side by side."""
    before = np.cumsum([0, *(each.width for each in kinds)])
    values = np.stack([value for each in kinds for value in each.values], axis=1)
    columns = [column + first for each, first in zip(kinds, before, strict=False) for column in each.columns]
    return Rows(values, np.stack(columns, axis=1), int(before[-1]), plane)


def _of_beams(points: PlanePoints, lidars: int) -> _Columns:
    """Motion of each point along its normal by the unit error of each knot of each LiDAR."""
    xyz = points.beam_m
    level = np.maximum(np.hypot(xyz[:, 0], xyz[:, 1]), 1e-9)
    elevation = np.arctan2(xyz[:, 2], level)
    low = np.clip(np.searchsorted(KNOTS_RAD, elevation, side="right") - 1, 0, len(KNOTS_RAD) - 2)
    share = np.clip((elevation - KNOTS_RAD[low]) / np.diff(KNOTS_RAD)[low], 0, 1)
    # One radian more elevation moves a point along the meridian by its distance.
    raised = np.column_stack([-xyz[:, :2] * (xyz[:, 2] / level)[:, None], level])
    along = np.sum(raised * _normals(points), axis=1)
    column = points.lidar[points.sweep] * len(KNOTS_RAD) + low
    return _Columns([(1 - share) * along, share * along], [column, column + 1], lidars * len(KNOTS_RAD))


def _of_turns(points: PlanePoints, lidars: int) -> _Columns:
    """The same by a turn w of each LiDAR about each of its axes: ``n . (w x p) = w . (p x n)``."""
    turned = np.cross(points.beam_m, _normals(points))
    first = 3 * points.lidar[points.sweep]
    return _Columns(list(turned.T), [first + axis for axis in range(3)], 3 * lidars)


def _normals(points: PlanePoints) -> Float64[np.ndarray, "n 3"]:
    """Normals in the frames of the LiDARs."""
    return np.einsum("nji,nj->ni", points.turn[points.sweep], points.normal)


def _of_poses(points: PlanePoints, t_us: Int64[np.ndarray, " k"], ego: Trajectory) -> _Columns:
    """The same by a shift along and a turn about each axis of the world at each time."""
    car = ego.at(points.t_us)[points.sweep, :3, 3]
    return _moved(points.normal, points.xyz_m, car, points.at_us, t_us)


def _of_followed(
    followed: FollowedPoints, width: int, t_us: Int64[np.ndarray, " k"], ego: Trajectory
) -> sparse.csr_matrix:
    """Motion of each followed point in its second image, first to the right and then down, by the unit errors of all.

    An error of the first pose moves the point in the world; one of the second moves the point for the camera, the other
    way, so that it is found as much off as the second moves it, less the first.
    """
    direction, xyz = followed.by_xyz.reshape(-1, 3), followed.xyz_m.repeat(2, axis=0)
    first, second = (
        _matrix(_moved(direction, xyz, ego.at(times)[:, :3, 3].repeat(2, axis=0), times.repeat(2), t_us))
        for times in (followed.first_us, followed.second_us)
    )
    rows = sparse.hstack([sparse.csr_matrix((len(xyz), width - 6 * len(t_us))), second - first]).tocsr()
    rows.sort_indices()
    return rows


def _moved(
    direction: Float64[np.ndarray, "n 3"],
    xyz_m: Float64[np.ndarray, "n 3"],
    car_m: Float64[np.ndarray, "n 3"],
    at_us: Int64[np.ndarray, " n"],
    t_us: Int64[np.ndarray, " k"],
) -> _Columns:
    """Motion of points along directions by a shift along and a turn about each axis of the world at each time.

    Args:
        direction: what their motion is multiplied by.
        xyz_m: points in the world.
        car_m: where the car was, about which it turns.
        at_us: time of each.
        t_us: times of the errors, which are linear in between.
    """
    k = len(t_us)
    low = np.clip(np.searchsorted(t_us, at_us, side="right") - 1, 0, max(k - 2, 0))
    high = np.minimum(low + 1, k - 1)
    share = np.clip((at_us - t_us[low]) / np.maximum(t_us[high] - t_us[low], 1), 0, 1)
    parts = [*direction.T, *np.cross(xyz_m - car_m, direction).T]
    values = [part * each for part in parts for each in (1 - share, share)]
    return _Columns(values, [6 * each + number for number in range(6) for each in (low, high)], 6 * k)


def _matrix(kind: _Columns) -> sparse.csr_matrix:
    """A matrix with one row per point."""
    count, each = len(kind.values[0]), len(kind.values)
    starts = np.arange(0, (count + 1) * each, each)
    value, column = np.stack(kind.values, axis=1).ravel(), np.stack(kind.columns, axis=1).ravel()
    return sparse.csr_matrix((value, column, starts), shape=(count, kind.width))


def _prior(lidars: int, t_us: Int64[np.ndarray, " k"]) -> Float64[np.ndarray, "p p"]:
    """Inverse covariance of all errors, in units of that of a point."""
    k = len(KNOTS_RAD)
    steps = np.diff(np.eye(k), axis=0)
    beams = np.eye(k) / BEAM_RAD**2 + steps.T @ steps / STEP_RAD**2
    # Of poses, steps are a random walk: their variance grows with the time between.
    walk = np.diff(np.eye(len(t_us)), axis=0) / np.sqrt(np.diff(t_us) / WALK_US)[:, None]
    walk, still = walk.T @ walk, np.eye(len(t_us))
    shifts, tilts = still / SHIFT_M**2 + walk / SHIFT_WALK_M**2, still / TILT_RAD**2 + walk / TILT_WALK_RAD**2
    turns = np.eye(3) / TURN_RAD**2
    poses = np.kron(shifts, np.diag([1, 1, 1, 0, 0, 0])) + np.kron(tilts, np.diag([0, 0, 0, 1, 1, 1]))
    parts = [*[beams] * lidars, *[turns] * lidars, poses]
    return ALIKE * SIGMA_M**2 * sparse.block_diag(parts).toarray()


def _size(off_px: Float64[np.ndarray, " 2n"]) -> float:
    """Median length of offsets."""
    return float(np.median(np.linalg.norm(off_px.reshape(-1, 2), axis=1))) if len(off_px) else 0.0
