"""People, who change their shape as they walk or ride: each one is built anew several times a second.

What a rigid body gathers over its life would be a person with a blur of legs. So the life of a person that moves is cut
into windows of one or two images; each is a body of its own, made from the sweeps and images of its time. Where no
image shows the person, the window lasts until one does, and where no sweep may be read, until the next one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Int64

from nurec_sim import geometry, sensors
from nurec_sim.reconstruct.lift.points import Actor
from nurec_sim.scene.transform import transformed
from nurec_sim.types import Clip, DynamicGaussians, Gaussians, Trajectory

LABELS = ("person", "animal", "rider")
SHORTEST_US = 200_000
"""Windows are no shorter, but the last one; a walking person takes half a second for a step."""
OFF_M, OFF_RAD = 0.1, np.radians(20.0)
"""Gaussians move straight from knot to knot and do not turn. Where the track differs from that by more, those of a long
window are repeated for shorter times."""
BEYOND, BEYOND_US = 0.1, 100_000
"""Knots lie beyond the ends of a window by this share of its half, but no farther than this: where one window ends and
the next begins, neither has faded by more than a third: exp(-(1 / 1.1)**10) = 0.68."""


def in_windows(
    actors: Sequence[Actor], clip: Clip, frames: Sequence[tuple[str, int]], hold_out: Collection[int] = ()
) -> list[Actor]:
    """The actors, with each person that moves replaced by one actor for each of its windows.

    Args:
        actors: of the clip.
        clip: the driving log.
        frames: (camera, frame) of the images whose pixels are lifted.
        hold_out: sweeps that must not be read, by index, of every LiDAR.
    """
    result: list[Actor] = []
    swept_us = _swept_us(clip, hold_out)
    for actor in actors:
        stands = len(actor.path.t_us) == 1
        if stands or actor.track.label not in LABELS:
            result.append(actor)
            continue
        ends = _ends_us(actor.path, _seen_us(actor, clip, frames), swept_us)
        result += [dataclasses.replace(actor, window_us=pair) for pair in zip(ends[:-1], ends[1:], strict=True)]
    return result


def _seen_us(actor: Actor, clip: Clip, frames: Sequence[tuple[str, int]]) -> Int64[np.ndarray, " n"]:
    """Times of the images in which the middle of the actor lies, ascending."""
    seen = []
    for camera, index in frames:
        t_us = int(clip.camera_times_us(camera)[index].sum()) // 2
        if not actor.path.covers(t_us):
            continue
        camera_from_world = geometry.inverse(clip.world_from_camera(camera, index)[0])
        middle = geometry.transform_points(camera_from_world, actor.path.at(t_us)[None, :3, 3])
        uv, valid = sensors.project(clip.rig.cameras[camera], middle)
        if valid[0] and sensors.in_image(clip.rig.cameras[camera], uv)[0]:
            seen.append(t_us)
    return np.unique(np.array(seen, np.int64))


def _swept_us(clip: Clip, hold_out: Collection[int]) -> Int64[np.ndarray, " n"]:
    """Middles of the sweeps of all LiDARs that may be read."""
    middle = [clip.sweep_times_us(lidar).sum(axis=1) // 2 for lidar in clip.rig.lidars]
    kept = [each[~np.isin(np.arange(len(each)), sorted(hold_out))] for each in middle]
    return np.concatenate([np.zeros(0, np.int64), *kept])


def _ends_us(path: Trajectory, seen_us: Int64[np.ndarray, " n"], swept_us: Int64[np.ndarray, " m"]) -> list[int]:
    """Where windows end: half-way between images, ``SHORTEST_US`` apart at least, and half of it before the last label.

    The last window ends after the last label. Each holds the middle of a sweep, the last one within ``SHORTEST_US``
    after it: without returns there is no body.
    """

    def swept(first_us: int, last_us: int) -> bool:
        return bool(((swept_us >= first_us) & (swept_us < last_us)).any())

    ends = [path.start_us]
    for end in ((seen_us[1:] + seen_us[:-1]) // 2).tolist():
        long = end - ends[-1] >= SHORTEST_US and path.end_us - end >= SHORTEST_US // 2
        if long and swept(ends[-1], end) and swept(end, path.end_us + SHORTEST_US):
            ends.append(end)
    return [*ends, path.end_us + 1]


def moving(actor: Actor, gaussians_box: Gaussians) -> DynamicGaussians:
    """The Gaussians of a window, in the frame of the box, as they move along the track during that time."""
    assert actor.window_us is not None
    parts = [_straight(actor, gaussians_box, *part) for part in _straight_parts(actor.path, *actor.window_us)]
    return DynamicGaussians.concatenate(parts)


def _straight_parts(path: Trajectory, first_us: int, last_us: int) -> list[tuple[int, int]]:
    """The time in parts during which the path is straight, by halving."""
    knot_us = np.array([first_us, (first_us + last_us) // 2, last_us])
    times = path.t_us[(path.t_us > first_us) & (path.t_us < last_us)]
    knots, poses = path.at(knot_us), path.at(times)
    straight = np.column_stack([np.interp(times, knot_us, column) for column in knots[:, :3, 3].T])
    off_m = np.linalg.norm(poses[:, :3, 3] - straight, axis=1).max(initial=0.0)
    yaw = geometry.yaw_of(np.concatenate([poses, knots])) - geometry.yaw_of(knots[1])
    if off_m <= OFF_M and np.abs(geometry.wrap_angle(yaw)).max() <= OFF_RAD or last_us - first_us < 2 * SHORTEST_US:
        return [(first_us, last_us)]
    middle_us = int(knot_us[1])
    return [*_straight_parts(path, first_us, middle_us), *_straight_parts(path, middle_us, last_us)]


def _straight(actor: Actor, gaussians_box: Gaussians, first_us: int, last_us: int) -> DynamicGaussians:
    middle_us, half_us = (first_us + last_us) // 2, (last_us - first_us) // 2
    half_us += min(int(BEYOND * half_us), BEYOND_US)
    knot_us = middle_us + half_us * np.array([-1, 0, 1], np.int64)
    path = actor.path
    poses = path.at(np.clip(knot_us, path.start_us, path.end_us))
    xyz = gaussians_box.mean_m.astype(np.float64)
    knot_m = np.stack([geometry.transform_points(pose, xyz) for pose in poses], axis=1).astype(np.float32)
    return DynamicGaussians(
        transformed(gaussians_box, poses[1]),
        np.tile(knot_us, (len(xyz), 1)),
        knot_m,
        np.full(len(xyz), actor.index, np.int32),
        np.zeros(len(xyz), bool),
    )
