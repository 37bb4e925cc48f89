"""Alignment of a log: what its sweeps tell about errors is found, and taken out if it is worth it."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from nurec_sim.logs.alignment.fit import Errors, errors_of
from nurec_sim.logs.alignment.planes import plane_points
from nurec_sim.logs.alignment.stored import FACT, plain, with_beams
from nurec_sim.logs.clip import Clip as LoadedClip
from nurec_sim.logs.moved import corrected
from nurec_sim.types import Clip, Progress

FEWEST_POINTS = 2_000
BETTER = 0.9
"""A log is left as it is if its sweeps then disagree by more than this times what they did: it is nearly exact."""
MOST_TIMES = 600
"""At most so many poses are corrected, evenly chosen; those in between follow."""


def with_aligned_sweeps(
    clip: Clip, hold_out: Collection[int] = (), progress: Progress = lambda stage, done: None
) -> Clip:
    """The log with elevations of beams, mountings of LiDARs and poses corrected by planes that its sweeps share.

    Tracks and images move with the poses. A log that is nearly exact, or shows too few planes, stays as it is, and so
    do one that is aligned already and parts of logs (``logs.selection``). What was done is in ``Clip.facts``, under
    ``sweep_alignment``.

    Args:
        clip: the log.
        hold_out: indices of sweeps that must not be read, of every LiDAR; they move with what is found in the others.
        progress: called with the stage and the fraction done, if there is anything to do.

    Raises:
        ClipError: a sweep cannot be read.
    """
    if not isinstance(clip, LoadedClip):
        return clip
    names = list(clip.rig.lidars)
    read = [sum(index not in hold_out for index in range(clip.sweep_count(name))) for name in names]
    if FACT in clip.facts or max(read, default=0) < 2:
        return clip
    progress("aligning sweeps", 0.0)
    points = plane_points(clip, hold_out)
    if len(points) < FEWEST_POINTS:
        return clip
    most = names[int(np.argmax(read))]
    t_us = np.unique([record.t_us for i, record in enumerate(clip.sweep_records(most)) if i not in hold_out])
    errors = errors_of(points, len(names), t_us[:: len(t_us) // MOST_TIMES + 1], clip.ego)
    before, after = errors.apart_m
    return without(clip, errors) if after < BETTER * before else clip


def without(clip: LoadedClip, errors: Errors) -> LoadedClip:
    """The log without these errors."""
    moved = corrected(clip, errors.correction(clip.ego))
    names = list(clip.rig.lidars)
    beams = dict(zip(names, errors.beams, strict=True))
    mountings = {
        name: lidar.rig_from_lidar @ errors.mounting(k) for k, (name, lidar) in enumerate(clip.rig.lidars.items())
    }
    moved = with_beams(moved, mountings, beams)
    moved.facts[FACT] = {
        "apart_m": list(errors.apart_m),
        "shift_m": float(np.linalg.norm(errors.shift_m, axis=1).max()),
        "tilt_deg": float(np.degrees(np.linalg.norm(errors.tilt_rad, axis=1).max())),
        "beams": {name: plain(each) for name, each in beams.items()},
    }
    return moved
