"""Mountings of cameras turned and shifted so that cameras agree where their fields of view overlap."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.logs.alignment.shared import SharedFeatures, rotation, shared_features
from nurec_sim.logs.alignment.stored import CAMERA_FACT, with_mountings
from nurec_sim.logs.clip import Clip as LoadedClip
from nurec_sim.types import Clip, Progress

EXPECTED_RAD = np.radians(0.3)
"""Standard deviation of how far mountings are turned from the calibration."""
EXPECTED_M = 0.05
"""The same of how far they are shifted: what is near is then off by more pixels than what is far."""
MEAN_RAD, MEAN_M = np.radians(0.05), 0.01
"""Both of the mean of all cameras: overlaps hardly tell whether all look up, but then they are off the LiDAR."""
PIXEL, DEPTH_SHARE = 2.0, 0.1
"""Standard deviations of where a feature is found, and of its depth: between rows of beams, and of another time."""
ALIKE = 20
"""Features of one pair of images count for so many at most: they err alike, by poses and depths."""
FEWEST = 30
BETTER = 0.8
"""Mountings stay as they are if cameras then disagree by more than this times what they did."""
ROUNDS = 10


def with_aligned_cameras(
    clip: Clip,
    hold_out: Collection[int] = (),
    progress: Progress = lambda stage, done: None,
    cameras: Sequence[str] | None = None,
    held_images: Mapping[str, Collection[int]] | None = None,
) -> Clip:
    """The log with mountings of cameras moved so that they show the same where their fields of view overlap.

    Images move with them. What was done is in ``Clip.facts``, under ``camera_alignment``. Arguments and errors are
    those of ``with_aligned_sweeps``; a log with one camera, or whose cameras agree or share too little, stays as it is.
    """
    if not isinstance(clip, LoadedClip) or CAMERA_FACT in clip.facts:
        return clip
    names = [name for name in (clip.rig.cameras if cameras is None else cameras) if clip.frame_count(name)]
    if len(names) < 2:
        return clip
    progress("aligning cameras", 0.0)
    features = shared_features(clip, names, hold_out, held_images or {})
    if len(features) < FEWEST:
        return clip
    moves = moves_of(features, len(names))
    before, after = disagreement_px(features), disagreement_px(features, moves)
    if after > BETTER * before:
        return clip
    fact = {
        "apart_px": [before, after],
        "turn_deg": {name: np.degrees(move[:3]).round(5).tolist() for name, move in zip(names, moves, strict=True)},
        "shift_m": {name: move[3:].round(5).tolist() for name, move in zip(names, moves, strict=True)},
    }
    mountings = {
        name: clip.rig.cameras[name].rig_from_camera @ geometry.pose(rotation(move[:3]), move[3:])
        for name, move in zip(names, moves, strict=True)
    }
    return with_mountings(clip, mountings, fact)


def moves_of(features: SharedFeatures, count: int) -> Float64[np.ndarray, "count 6"]:
    """Turns (radian) and shifts (metres) of cameras, each about and along its own axes.

    By robust least squares with a prior of none.
    """
    moves = np.zeros((count, 6))
    sizes = np.bincount(features.group)[features.group]
    share = np.minimum(ALIKE / sizes, 1.0)
    # Along the line on which a wrong depth moves a feature it tells less.
    along = DEPTH_SHARE * features.by_depth
    noise = PIXEL**2 * np.eye(2) + along[:, :, None] * along[:, None]
    whiten = np.linalg.cholesky(np.linalg.inv(noise)).transpose(0, 2, 1)
    n = len(features)
    rows = np.zeros((n, 2, count, 6))
    for k in range(2):
        rows[np.arange(n), :, features.cameras[:, k]] += features.by_mounting[:, :, k]
    rows = whiten @ rows.reshape(n, 2, -1)
    off = (whiten @ features.off_px[:, :, None])[..., 0]
    own, mean = (np.diag(np.repeat(each, 3) ** -2.0) for each in ((EXPECTED_RAD, EXPECTED_M), (MEAN_RAD, MEAN_M)))
    prior = np.kron(np.eye(count), own) + np.kron(np.ones((count, count)), mean) / count**2
    for _ in range(ROUNDS):
        left = off - rows @ moves.reshape(-1)
        # Cauchy weights: features that are not the same, or not on the surface that the LiDAR saw.
        weight = share / (1 + (left**2).sum(axis=1))
        weighted = rows * weight[:, None, None]
        normal = np.einsum("nki,nkj->ij", weighted, rows) + prior
        moves = np.linalg.solve(normal, np.einsum("nki,nk->i", weighted, off)).reshape(count, 6)
    return moves


def disagreement_px(features: SharedFeatures, moves: Float64[np.ndarray, "count 6"] | None = None) -> float:
    """Median distance of features from where they are expected, pixels, with cameras moved."""
    left = features.off_px
    if moves is not None:
        left = left - np.einsum("nkci,nci->nk", features.by_mounting, moves[features.cameras])
    return float(np.median(np.linalg.norm(left, axis=1)))
