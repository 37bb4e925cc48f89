"""How LiDAR intensity falls off with incidence, learnt from a log: the same surface seen from several sweeps.

A wall that a sweep meets at a right angle returns more light than the same wall seen at a slant. Gaussians keep the
intensity of the return they came from; from elsewhere it would be wrong by up to the whole falloff. Here every
Gaussian gets the intensity at normal incidence that explains best what the sweeps measured near it. The falloff
(``Gaussians.falloff``) is one number for the log, the one that explains all of it best; Gaussians that are explained
better without it, such as leaves, whose normals say little, have none.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

import numpy as np
from jaxtyping import Float32, Float64, Int64

from nurec_sim.compute.cores import usable_cores
from nurec_sim.compute.kernels import kernel
from nurec_sim.reconstruct.free_space import chosen_sweeps
from nurec_sim.types import Clip, Gaussians, GaussianScene

MOST_SWEEPS = 8
"""Sweeps from which it is learnt, evenly over the log."""
NEIGHBOURS, REACH_M = 8, 0.3
"""Returns around a Gaussian that are taken to lie on its surface: so many at most, from so far away at most."""
NEAR_M = 0.03
"""Returns weigh by 1 / (NEAR_M^2 + distance^2), so that those of the next material count little."""
FALLOFFS = np.arange(0.0, 1.001, 0.05)
JUDGED, SPREAD = 50_000, 0.1
"""So many Gaussians at most decide on the falloff: those met at angles whose cosines differ by this at least."""
LEAST_GAIN = 0.05
"""Without falloff the errors must be larger by this share; else the scene stays as it is."""


def with_incidence(scene: GaussianScene, clip: Clip, hold_out: Collection[int]) -> GaussianScene:
    """The scene with intensities at normal incidence, and their falloff; as it was where the log shows none.

    Only the static layer changes. The provenance gets ``incidence``: the falloff, and by which share it lowers the mean
    error of what several sweeps measured.

    Args:
        scene: reconstruction of the log, in the log's world.
        clip: the log.
        hold_out: sweeps that must not be read, by index, of every LiDAR.
    """
    xyz, intensity, eye = _returns(clip, hold_out)
    static = scene.static
    told = np.flatnonzero(np.isfinite(static.intensity) & static.normal.any(axis=1))
    if not len(xyz) or not len(told):
        return scene
    from scipy.spatial import cKDTree

    tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)

    def around(chosen: Int64[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Intensities of the returns around Gaussians, their cosines of incidence, and weights."""
        apart, place = tree.query(
            static.mean_m[chosen], k=NEIGHBOURS, distance_upper_bound=REACH_M, workers=usable_cores()
        )
        found, place = np.isfinite(apart), np.minimum(place, len(xyz) - 1)
        weight = np.where(found, 1 / (NEAR_M**2 + np.where(found, apart, 0) ** 2), 0)
        return intensity[place].astype(np.float64), _cosines(static[chosen], eye, place), weight

    falloff, gain = best_falloff(*around(told[:: max(1, len(told) // JUDGED)]))
    if gain < LEAST_GAIN:
        return scene
    measured = around(told)
    straight, error = at_normal(*measured, falloff)
    level, level_error = at_normal(*measured, 0.0)
    known, slanted = measured[2].any(axis=1), error <= level_error
    fitted, lost = static.intensity.copy(), np.zeros(len(static), np.float32)
    fitted[told[known]] = np.clip(np.where(slanted, straight, level), 0, 1)[known]
    lost[told[known & slanted]] = falloff
    learnt = {"falloff": round(falloff, 4), "gain": round(gain, 4)}
    return dataclasses.replace(
        scene,
        static=dataclasses.replace(static, intensity=fitted, falloff=lost),
        provenance={**scene.provenance, "incidence": learnt},
    )


def _returns(clip: Clip, hold_out: Collection[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns of some sweeps in the world, their intensities, and the places they were seen from, [n,3] each."""
    found = []
    for lidar, index in chosen_sweeps(clip, hold_out, MOST_SWEEPS):
        sweep = clip.sweep(lidar, index)
        if sweep.intensity is None:
            continue
        known = np.isfinite(sweep.intensity) & np.isfinite(sweep.xyz_m).all(axis=1)
        xyz = sweep.xyz_world_m[known].astype(np.float32)
        eye = np.broadcast_to(sweep.world_from_lidar[:3, 3].astype(np.float32), xyz.shape)
        found.append((xyz, sweep.intensity[known], eye))
    if not found:
        return np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros((0, 3), np.float32)
    xyz, intensity, eye = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return xyz, intensity, eye


def _cosines(gaussians: Gaussians, eye: Float32[np.ndarray, "m 3"], place: np.ndarray) -> Float64[np.ndarray, "n k"]:
    """Cosine of incidence on each Gaussian from where each of its returns was seen."""
    cosine = np.empty(place.shape)
    _fill_cosines(gaussians.mean_m, gaussians.normal, eye, place, cosine)
    return cosine


@kernel
def _fill_cosines(mean, normal, eye, place, cosine):
    for i in range(len(place)):
        for k in range(place.shape[1]):
            j = place[i, k]
            x, y, z = mean[i, 0] - eye[j, 0], mean[i, 1] - eye[j, 1], mean[i, 2] - eye[j, 2]
            length = max(np.sqrt(x * x + y * y + z * z), np.float32(1e-6))
            across = abs(x * normal[i, 0] + y * normal[i, 1] + z * normal[i, 2])
            cosine[i, k] = min(across / length, np.float32(1))


def at_normal(
    shown: Float64[np.ndarray, "n k"],
    cosine: Float64[np.ndarray, "n k"],
    weight: Float64[np.ndarray, "n k"],
    falloff: float,
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Intensity at normal incidence by least squares, and the weighted mean of the absolute errors that remain.

    Args:
        shown: intensities that each surface returned.
        cosine: of incidence.
        weight: of each return, 0 for none.
        falloff: see ``Gaussians.falloff``.
    """
    kept = 1 - falloff * (1 - cosine)
    straight = (weight * kept * shown).sum(axis=1) / np.maximum((weight * kept * kept).sum(axis=1), 1e-12)
    error = (weight * np.abs(straight[:, None] * kept - shown)).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-12)
    return straight, error


def best_falloff(
    shown: Float64[np.ndarray, "n k"], cosine: Float64[np.ndarray, "n k"], weight: Float64[np.ndarray, "n k"]
) -> tuple[float, float]:
    """The falloff with the smallest mean error, and the share of the error without one that it saves; 0, 0 unknown."""
    seen = weight > 0
    spread = np.where(seen, cosine, -1).max(axis=1) - np.where(seen, cosine, 2).min(axis=1)
    judged = np.flatnonzero(spread > SPREAD)
    if not len(judged):
        return 0.0, 0.0
    errors = [at_normal(shown[judged], cosine[judged], weight[judged], each)[1].mean() for each in FALLOFFS]
    best = int(np.argmin(errors))
    return float(FALLOFFS[best]), float(1 - errors[best] / max(errors[0], 1e-12))
