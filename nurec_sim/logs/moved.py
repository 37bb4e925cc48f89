"""Logs whose poses, times or sensor mountings are changed: corrected poses, later times, remounted LiDARs."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TypeVar

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry
from nurec_sim.logs.clip import Clip, ImageRecord
from nurec_sim.logs.sweeps import SweepRecord
from nurec_sim.types import Trajectory

R = TypeVar("R", ImageRecord, SweepRecord)
_TIMES = ("start_us", "t_us", "end_us")


def corrected(clip: Clip, correction: Trajectory) -> Clip:
    """The same log with all poses moved by a correction that varies over time.

    Args:
        clip: the log.
        correction: ``refined_from_recorded`` in the world at some times; interpolated in between.
    """

    def moved(path: Trajectory) -> Trajectory:
        return Trajectory(path.t_us, _corrected(correction, path.t_us, path.world_from_body))

    def image(record: ImageRecord) -> ImageRecord:
        times = np.array([record.start_us, record.end_us])
        return dataclasses.replace(record, world_from_camera=_corrected(correction, times, record.world_from_camera))

    def sweep(record: SweepRecord) -> SweepRecord:
        pose = _corrected(correction, np.array([record.t_us]), record.world_from_lidar[None])[0]
        return dataclasses.replace(record, world_from_lidar=pose)

    return clip.replaced(
        # Poses of the ego where the correction changes too: in between, both are interpolated.
        ego=moved(_resampled(clip.ego, correction.t_us)),
        images={name: [image(record) for record in clip.image_records(name)] for name in clip.rig.cameras},
        sweeps={name: [sweep(record) for record in clip.sweep_records(name)] for name in clip.rig.lidars},
        tracks=[dataclasses.replace(track, path=moved(track.path)) for track in clip.tracks],
    )


def later(clip: Clip, offset_us: int) -> Clip:
    """The same log with ``offset_us`` added to all times."""

    def moved(path: Trajectory) -> Trajectory:
        return Trajectory(path.t_us + offset_us, path.world_from_body)

    def put_off(record: R) -> R:
        changed = {name: getattr(record, name) + offset_us for name in _TIMES if hasattr(record, name)}
        return dataclasses.replace(record, **changed)

    return clip.replaced(
        ego=moved(clip.ego),
        images={name: [put_off(record) for record in clip.image_records(name)] for name in clip.rig.cameras},
        sweeps={name: [put_off(record) for record in clip.sweep_records(name)] for name in clip.rig.lidars},
        tracks=[dataclasses.replace(track, path=moved(track.path)) for track in clip.tracks],
        time_offset_us=clip.time_offset_us + offset_us,
    )


def remounted(clip: Clip, origins_m: Mapping[str, Float64[np.ndarray, " 3"]]) -> Clip:
    """The same log with LiDARs moved to where their beams start, given in their present frames."""
    lidars = dict(clip.rig.lidars)
    sweeps = {name: clip.sweep_records(name) for name in lidars}
    for name, origin in origins_m.items():
        pose = lidars[name].rig_from_lidar @ geometry.pose(np.eye(3), origin)
        lidars[name] = dataclasses.replace(lidars[name], rig_from_lidar=pose)
        sweeps[name] = tuple(record.from_origin(origin) for record in sweeps[name])
    return clip.replaced(sweeps=sweeps, rig=dataclasses.replace(clip.rig, lidars=lidars))


def _resampled(path: Trajectory, t_us: Int64[np.ndarray, " n"]) -> Trajectory:
    """A trajectory with poses at further times within its span."""
    times = np.union1d(path.t_us, t_us[(t_us > path.start_us) & (t_us < path.end_us)])
    return Trajectory(times, path.at(times))


def _corrected(
    correction: Trajectory, t_us: Int64[np.ndarray, " n"], poses: Float64[np.ndarray, "n 4 4"]
) -> Float64[np.ndarray, "n 4 4"]:
    """Poses moved by the correction at their times.

    The correction turns about the origin of the world, which may be far away. Poses moved by the corrections before and
    after are interpolated instead, in which rotation and translation do not mix.
    """
    low = np.clip(np.searchsorted(correction.t_us, t_us, side="right") - 1, 0, max(len(correction.t_us) - 2, 0))
    ends = np.stack([low, np.minimum(low + 1, len(correction.t_us) - 1)], axis=1)
    span = np.maximum(np.diff(correction.t_us[ends], axis=1)[:, 0], 1)
    share = np.clip((t_us - correction.t_us[low]) / span, 0.0, 1.0)
    pairs = correction.world_from_body[ends] @ poses[:, None]
    return geometry.interpolate_pose_pairs(pairs, share)
