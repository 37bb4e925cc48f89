"""Where beams start, if a log has its points in the car's own axes: it names the rear axle on the road as their LiDAR.

No scanner is mounted there, and the points show it: beams from there would have passed through what others of the same
sweep returned from. They are taken to start above the middle of the car, at the height nearest to its roof from which
they do not contradict each other. A cloud merged from several scanners gets one origin for all.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.logs.clip import Clip
from nurec_sim.logs.moved import remounted

LOWEST_M = 0.3
"""LiDARs lower than this over the road are not where the log has them, if the points agree."""
HEIGHTS_M = np.arange(1.0, 2.7, 0.2)
"""Heights over the road that are tried: cars' bumpers to lorries' roofs."""
NEAR_M, FAR_M = 3.0, 60.0
"""Points in this distance of the car are used."""
APART = 0.5
"""Two beams have one direction if their angle is less than this part of that between neighbouring beams."""
SECTOR_RAD, MOST_POINTS = np.radians(10.0), 20_000
"""About so many points are used, those of every n-th sector."""
BEHIND_M, BEHIND_SHARE = 0.5, 0.05
"""A beam passed a point if it ended this far behind it, and a share of its range: noise and grazing ground."""
CONTRADICTED = 0.05
"""Least share of contradicted points at which the log's own origin is doubted."""
TOLERANCE = 0.0025
"""Heights are alike if their shares differ by less: they tell well what is too low, and badly what is too high."""


def with_origins(clip: Clip) -> Clip:
    """The log with those of its LiDARs that lie on the road moved to where their beams start, if points show it.

    What was found is noted in ``Clip.facts``. Unreadable sweeps change nothing; reading them later says what is wrong.
    """
    found: dict[str, Float64[np.ndarray, " 3"]] = {}
    for name, lidar in clip.rig.lidars.items():
        if lidar.rig_from_lidar[2, 3] >= LOWEST_M or not clip.sweep_count(name):
            continue
        try:
            xyz_m = clip.sweep(name, 0).xyz_m
        except ClipError:
            continue
        roof_m = np.add(clip.rig.body.center_m, [0, 0, clip.rig.body.size_m[2] / 2])
        origin = origin_of(geometry.transform_points(lidar.rig_from_lidar, xyz_m), roof_m)
        if origin is not None:
            found[name] = geometry.transform_points(geometry.inverse(lidar.rig_from_lidar), origin)
    if not found:
        return clip
    moved = remounted(clip, found)
    for name in found:
        height = moved.rig.lidars[name].rig_from_lidar[2, 3]
        moved.facts[f"beams_of_{name}"] = (
            f"start {height:.1f} m over the road, as its points show; the log has them on it"
        )
    return moved


def origin_of(xyz_m: Float64[np.ndarray, "n 3"], roof_m: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 3"] | None:
    """Where the beams of a sweep start, in the rig frame; None if they may as well start at its origin.

    Args:
        xyz_m: returns in the rig frame.
        roof_m: the middle of the car's roof there.
    """
    distance = np.linalg.norm(xyz_m - roof_m, axis=1)
    xyz_m = xyz_m[(distance > NEAR_M) & (distance < FAR_M)]
    sector = np.floor(np.arctan2(xyz_m[:, 1], xyz_m[:, 0]) / SECTOR_RAD)
    xyz_m = xyz_m[sector % (len(xyz_m) // MOST_POINTS + 1) == 0]
    logged = contradicted(xyz_m)
    if not logged > CONTRADICTED:
        return None
    shares = np.array([contradicted(xyz_m - [*roof_m[:2], height]) for height in HEIGHTS_M])
    if shares.min() > logged / 2:
        return None
    alike = HEIGHTS_M[shares < shares.min() + TOLERANCE]
    return np.array([*roof_m[:2], alike[np.abs(alike - roof_m[2]).argmin()]])


def contradicted(xyz_m: Float64[np.ndarray, "n 3"]) -> float:
    """Share of the returns of beams from the origin that another one, of the same direction, passed; NaN for few."""
    from scipy.spatial import cKDTree

    if len(xyz_m) < 3:
        return float("nan")
    distance = np.linalg.norm(xyz_m, axis=1)
    apart, near = cKDTree(xyz_m / distance[:, None]).query(xyz_m / distance[:, None], k=3)
    passed = distance[near] > (distance * (1 + BEHIND_SHARE) + BEHIND_M)[:, None]
    return float((passed & (apart < APART * np.median(apart[:, 1]))).any(axis=1).mean())
