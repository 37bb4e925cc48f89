"""The returns of many sweeps on one moving object, registered together.

Each sweep gets a small shift and a turn about the vertical in the frame of the object's box. They are solved for by
Gauss-Newton: returns lie on the planes around their neighbours of other sweeps (Chen and Medioni 1992; weights after
Geman and McClure), no vehicle changes its speed at once, and labels are not far off.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64, Int64
from scipy.linalg import solve
from scipy.spatial import cKDTree

from nurec_sim.compute.kernels import kernel

PLANE_POINTS, FLATNESS = 8, 0.3
"""A plane is told by as many returns of one sweep, if it is thinner than this share of its extent."""
NEAREST, GROUPS = 16, 8
"""Partners of each return: the nearest of all, many of which are in sweeps with like errors, and the nearest in each
group of sweeps one after the other."""
FACING = 0.3
"""Planes that rays meet at a smaller sine do not count. The returns of one beam on a bent surface lie in such a plane,
which holds the ray: beams far apart would be pulled onto each other."""
REACH_M = (0.6, 0.3, 0.15)
"""Largest distances between returns of two sweeps that may show one surface, one after the other."""
ROUNDS, STILL = 4, 0.01
"""Steps with each reach at most; they end when none is larger than this in standard deviations of labels."""
NOISE_M = 0.03
EVIDENCE = 0.1
"""Weight of a pair of returns: one return has many partners, and their errors are alike."""
ACCELERATION = (2.0, 2.0, 1.0, np.radians(40.0))
"""Standard deviations of accelerations, metres and radians per second squared."""
MOST_TIMES = 300
"""Longer tracks are corrected in parts, which bounds time and memory."""
DISAGREE_M = 0.05
"""Returns this far from each other's planes disagree by half."""


@dataclass(frozen=True, eq=False)
class Returns:
    """The returns of all sweeps on one object, in the frame of its box as it was labelled.

    Attributes:
        t_us: [k] mean times of the returns of each sweep, and the times of labels between and around them, ascending.
        xyz_m: [n,3] returns.
        sweep: [n] the sweep of each, by its place in ``t_us``, ascending.
        ray: [n,3] unit vectors from the LiDAR to them.
    """

    t_us: Int64[np.ndarray, " k"]
    xyz_m: Float64[np.ndarray, "n 3"]
    sweep: Int64[np.ndarray, " n"]
    ray: Float64[np.ndarray, "n 3"]

    @cached_property
    def planes(self) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"]]:
        """Normals of the planes around returns among those of their own sweep, and how flat it is there, 0 to 1."""
        normal, flat = np.zeros_like(self.xyz_m), np.zeros(len(self.xyz_m))
        ends = np.searchsorted(self.sweep, np.arange(len(self.t_us) + 1))
        for first, last in zip(ends[:-1], ends[1:], strict=True):
            xyz = self.xyz_m[first:last]
            if len(xyz) < PLANE_POINTS:
                continue
            around = xyz[cKDTree(xyz).query(xyz, PLANE_POINTS)[1]]
            around = around - around.mean(axis=1, keepdims=True)
            spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around) / PLANE_POINTS)
            thin = np.sqrt(np.maximum(spread[:, 0], 0) / np.maximum(spread[:, 2], 1e-12))
            # The returns of one beam lie on a line, which has no plane: its second extent vanishes as well.
            facing = np.abs((axes[:, :, 0] * self.ray[first:last]).sum(axis=1))
            plane = (spread[:, 1] > 4 * spread[:, 0]) & (facing > FACING)
            normal[first:last] = axes[:, :, 0]
            flat[first:last] = np.where(plane, np.clip(1 - thin / FLATNESS, 0, 1), 0)
        return normal, flat


def corrections(
    returns: Returns, world_from_box: Float64[np.ndarray, "k 4 4"], sigma: Float64[np.ndarray, " 4"]
) -> Float64[np.ndarray, "k 4"]:
    """Shift (metres) and turn about the vertical (radians) of each sweep's returns in the frame of the box.

    Args:
        returns: of the object.
        world_from_box: poses of its box at the times of the returns, as labelled.
        sigma: standard deviations of labels: three shifts and a turn.
    """
    parts = []
    for times in np.array_split(np.arange(len(returns.t_us)), -(-len(returns.t_us) // MOST_TIMES)):
        rows = slice(*np.searchsorted(returns.sweep, [times[0], times[-1] + 1]))
        part = Returns(returns.t_us[times], returns.xyz_m[rows], returns.sweep[rows] - times[0], returns.ray[rows])
        parts.append(_solved(part, world_from_box[times], sigma))
    return np.concatenate(parts)


def _solved(
    returns: Returns, world_from_box: Float64[np.ndarray, "k 4 4"], sigma: Float64[np.ndarray, " 4"]
) -> Float64[np.ndarray, "k 4"]:
    """The corrections of one part of a track."""
    count = len(returns.t_us)
    if not len(returns.xyz_m):
        return np.zeros((count, 4))
    normal, flat = returns.planes
    values = np.zeros((count, 4))
    smooth, offset = _accelerations(returns.t_us, world_from_box)
    prior, pull = smooth.T @ smooth + np.diag(np.tile(1 / sigma**2, count)), smooth.T @ offset
    for reach in REACH_M:
        for _ in range(ROUNDS):
            turned, shift = _turned(returns, values), values[returns.sweep, :3]
            near = _neighbours(turned + shift, returns.sweep, reach)
            information, gradient = np.zeros((4 * count, 4 * count)), np.zeros(4 * count)
            _add_pairs(near, turned, shift, normal, flat, returns.sweep, reach / 3, information, gradient)
            information = information * EVIDENCE / NOISE_M**2 + prior
            gradient = gradient * EVIDENCE / NOISE_M**2 + prior @ values.reshape(-1) + pull
            step = solve(information, gradient, assume_a="pos").reshape(count, 4)
            values -= step
            if np.abs(step / sigma).max() < STILL:
                break
    return values


def disagreement(returns: Returns, values: Float64[np.ndarray, "k 4"]) -> float:
    """How far returns are from the planes of other sweeps: 0 on them, 1 if all are farther away than ``DISAGREE_M``."""
    normal, flat = returns.planes
    xyz = moved(returns, values)
    near = _neighbours(xyz, returns.sweep, REACH_M[1])
    weight = np.where((near >= 0) & (returns.sweep[near] != returns.sweep[:, None]), flat[near], 0.0)
    square = np.einsum("nmc,nmc->nm", normal[near], xyz[:, None] - xyz[near]) ** 2
    return float((weight * square / (square + DISAGREE_M**2)).sum() / max(weight.sum(), 1e-9))


def moved(returns: Returns, values: Float64[np.ndarray, "k 4"]) -> Float64[np.ndarray, "n 3"]:
    """Returns where corrections put them, in the frame of the box."""
    return _turned(returns, values) + values[returns.sweep, :3]


def _turned(returns: Returns, values: Float64[np.ndarray, "k 4"]) -> Float64[np.ndarray, "n 3"]:
    cos, sin = np.cos(values[returns.sweep, 3]), np.sin(values[returns.sweep, 3])
    x, y, z = returns.xyz_m.T
    return np.column_stack([cos * x - sin * y, sin * x + cos * y, z])


def _neighbours(xyz_m: Float64[np.ndarray, "n 3"], sweep: Int64[np.ndarray, " n"], reach: float) -> np.ndarray:
    """Rows [n,m] of the points nearest to each, of all and in every group of sweeps; -1 where none is in reach."""
    near = []
    ends = np.searchsorted(sweep, np.linspace(0, sweep[-1] + 1, GROUPS + 1).astype(int))
    for first, last, count in [
        (0, len(xyz_m), NEAREST),
        *((*pair, 1) for pair in zip(ends[:-1], ends[1:], strict=True)),
    ]:
        if last > first:
            tree = cKDTree(xyz_m[first:last])
            distance, row = tree.query(xyz_m, range(1, count + 1), distance_upper_bound=reach)
            near.append(np.where(np.isfinite(distance), row + first, -1))
    return np.concatenate(near, axis=1)


def _accelerations(
    t_us: Int64[np.ndarray, " k"], world_from_box: Float64[np.ndarray, "k 4 4"]
) -> tuple[Float64[np.ndarray, "m n"], Float64[np.ndarray, " m"]]:
    """Accelerations between three sweeps each, in standard deviations: ``matrix @ corrections + offset``."""
    count = len(t_us)
    t_s = (t_us - t_us[0]) / 1e6
    turn = world_from_box[:, :3, :3]
    heading = np.unwrap(np.arctan2(turn[:, 1, 0], turn[:, 0, 0]))
    matrix, offset = np.zeros((4 * max(count - 2, 0), 4 * count)), np.zeros(4 * max(count - 2, 0))
    for k in range(1, count - 1):
        before, after = t_s[k] - t_s[k - 1], t_s[k + 1] - t_s[k]
        share = 2 / (before + after) * np.array([1 / before, -1 / before - 1 / after, 1 / after])
        rows = slice(4 * (k - 1), 4 * k)
        for weight, other in zip(share, range(k - 1, k + 2), strict=True):
            block = np.zeros((4, 4))
            block[:3, :3], block[3, 3] = -turn[other], -1.0
            scale = weight / np.array(ACCELERATION)
            matrix[rows, 4 * other : 4 * other + 4] = scale[:, None] * block
            offset[rows] += scale * np.array([*world_from_box[other, :3, 3], heading[other]])
    return matrix, offset


@kernel
def _add_pairs(near, turned, shift, normal, flat, sweep, kernel_m, information, gradient):
    """Add the normal equations of all pairs of neighbours of different sweeps.

    The distance of x_i from the plane of x_j is r = n_j . (x_i - x_j); a shift d and a turn a of the sweep of x move it
    by d + a (-y, x, 0), with x as turned so far.

    Args:
        near: [n,m] neighbours, -1 none.
        turned: [n,3] returns, turned about the vertical axis of the box.
        shift: [n,3] how far they are moved then.
        normal: [n,3] planes.
        flat: [n] how much they count.
        sweep: [n] of each return.
        kernel_m: residuals larger than this count little.
        information: [4k,4k] output, added to.
        gradient: [4k] output, added to.
    """
    row = np.empty(8)
    for i in range(len(near)):
        for m in range(near.shape[1]):
            j = near[i, m]
            if j < 0 or sweep[j] == sweep[i] or flat[j] == 0:
                continue
            residual = 0.0
            for c in range(3):
                residual += normal[j, c] * (turned[i, c] + shift[i, c] - turned[j, c] - shift[j, c])
                row[c], row[4 + c] = normal[j, c], -normal[j, c]
            row[3] = normal[j, 1] * turned[i, 0] - normal[j, 0] * turned[i, 1]
            row[7] = -(normal[j, 1] * turned[j, 0] - normal[j, 0] * turned[j, 1])
            share = kernel_m * kernel_m / (kernel_m * kernel_m + residual * residual)
            weight = flat[j] * share * share
            for a in range(8):
                at = 4 * sweep[i] + a if a < 4 else 4 * sweep[j] + a - 4
                gradient[at] += weight * residual * row[a]
                for b in range(8):
                    to = 4 * sweep[i] + b if b < 4 else 4 * sweep[j] + b - 4
                    information[at, to] += weight * row[a] * row[b]
