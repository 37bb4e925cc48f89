"""Alignment of a log: what its sweeps tell about errors is found, and taken out if it is worth it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from jaxtyping import Int64

from nurec_sim.logs.alignment.cameras import with_aligned_cameras
from nurec_sim.logs.alignment.fit import Errors, errors_of
from nurec_sim.logs.alignment.followed import followed_points
from nurec_sim.logs.alignment.planes import plane_points
from nurec_sim.logs.alignment.stored import FACT, plain, with_beams
from nurec_sim.logs.clip import Clip as LoadedClip
from nurec_sim.logs.moved import corrected
from nurec_sim.types import Clip, Progress

FEWEST_POINTS, FEWEST_FOLLOWED = 2_000, 200
BETTER = 0.9
"""A log is left as it is if sweeps and images then disagree by more than this times what they did: nearly exact."""
WORSE, WORSE_M, WORSE_PX = 1.02, 0.001, 0.05
"""It is also left as it is if one of both disagrees by more than this times what it did, and this much more."""
TIMES_PER_SWEEP = 4
MOST_TIMES = 400
"""At most so many poses are corrected, evenly chosen; those in between follow."""


def with_aligned_sensors(
    clip: Clip,
    hold_out: Collection[int] = (),
    progress: Progress = lambda stage, done: None,
    cameras: Sequence[str] | None = None,
    held_images: Mapping[str, Collection[int]] | None = None,
) -> Clip:
    """The log with its sweeps and poses aligned (``with_aligned_sweeps``), then its cameras (``with_aligned_cameras``).

    Arguments and errors are those of both.
    """
    clip = with_aligned_sweeps(clip, hold_out, progress, cameras, held_images)
    return with_aligned_cameras(clip, hold_out, progress, cameras, held_images)


def with_aligned_sweeps(
    clip: Clip,
    hold_out: Collection[int] = (),
    progress: Progress = lambda stage, done: None,
    cameras: Sequence[str] | None = None,
    held_images: Mapping[str, Collection[int]] | None = None,
) -> Clip:
    """The log with elevations of beams, mountings of LiDARs and poses corrected by what its sweeps and images share.

    Tracks and images move with the poses. A log that is nearly exact, or shows too little, stays as it is, and so
    do one that is aligned already and parts of logs (``logs.selection``). What was done is in ``Clip.facts``, under
    ``sweep_alignment``.

    Args:
        clip: the log.
        hold_out: indices of sweeps that must not be read, of every LiDAR; they move with what is found in the others.
        progress: called with the stage and the fraction done, if there is anything to do.
        cameras: whose images may be read; all if None.
        held_images: indices of images that must not be read, by camera.

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
    followed = followed_points(
        clip, list(clip.rig.cameras if cameras is None else cameras), hold_out, held_images or {}
    )
    errors = errors_of(points, followed, len(names), _times(clip, names[int(np.argmax(read))]), clip.ego)
    return without(clip, errors) if worth_it(errors, len(followed)) else clip


def worth_it(errors: Errors, followed: int) -> bool:
    """Whether sweeps or images agree clearly better without these errors, and neither worse.

    Args:
        errors: what was found.
        followed: number of followed points; few of them do not count.
    """
    sizes = [(*errors.apart_m, WORSE_M)]
    if followed >= FEWEST_FOLLOWED:
        sizes.append((*errors.apart_px, WORSE_PX))
    worse = any(after > WORSE * before + least for before, after, least in sizes)
    return not worse and any(after < BETTER * before for before, after, _ in sizes)


def _times(clip: LoadedClip, lidar: str) -> Int64[np.ndarray, " k"]:
    """Times at which poses are corrected: some in each sweep of a LiDAR, from half a turn before its time on."""
    every = np.unique([record.t_us for record in clip.sweep_records(lidar)])
    part = int(np.median(np.diff(every))) // TIMES_PER_SWEEP if len(every) > 1 else 0
    times = np.unique(every[:, None] + part * np.arange(-(TIMES_PER_SWEEP // 2), TIMES_PER_SWEEP // 2))
    return times[:: len(times) // MOST_TIMES + 1]


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
        "apart_px": list(errors.apart_px),
        "shift_m": float(np.linalg.norm(errors.shift_m, axis=1).max()),
        "tilt_deg": float(np.degrees(np.linalg.norm(errors.tilt_rad, axis=1).max())),
        "beams": {name: plain(each) for name, each in beams.items()},
    }
    return moved
