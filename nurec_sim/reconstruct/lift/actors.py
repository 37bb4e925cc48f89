"""Actors as moving Gaussians: adaptive time windows with three knots each, overlapping so that no hole opens."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry
from nurec_sim.reconstruct.lift.points import Actor
from nurec_sim.reconstruct.lift.settings import LiftSettings
from nurec_sim.types import Clip, DynamicGaussians, Gaussians, Track, Trajectory

OVERLAP = 1.2
"""Knots lie this much farther from the middle than the core that a window is for: exp(-(1/1.2)**10) = 0.85 there."""
SAMPLE_US = 20_000


@dataclass(frozen=True)
class Window:
    """Three knot times, the box positions there, and the box pose at the middle one."""

    t_us: Int64[np.ndarray, " 3"]
    position_m: Float64[np.ndarray, "3 3"]
    world_from_box: Float64[np.ndarray, "4 4"]


def tracks_of(clip: Clip, actors: Sequence[Actor]) -> tuple[Track, ...]:
    """The clip's tracks as the scene shows them: one that stands does so at one place, over the whole clip.

    Logs label objects only while a sensor sees them; a parked car that the ego has passed is still there to be hit.
    """
    tracks = list(clip.tracks)
    for actor in actors:
        if actor.standing:
            pose = actor.path.world_from_body[0]
            path = Trajectory(np.array(clip.span_us), np.stack([pose, pose]))
            tracks[actor.index] = dataclasses.replace(actor.track, path=path)
    return tuple(tracks)


def windows_of(actor: Actor, span_us: tuple[int, int], settings: LiftSettings) -> list[Window]:
    """Windows that cover an actor's labelled life, or the whole span if it stands.

    Each is as long as the path stays within ``window_position_m`` of straight lines between its knots and within
    ``window_rotation_deg`` of its middle. The outer knots are moved outwards along those lines, so that the actor is
    where its path says at the borders between windows.
    """
    path = actor.path
    if actor.standing or len(path.t_us) == 1:
        start, end = span_us if actor.standing else (path.start_us - 50_000, path.end_us + 50_000)
        half = int((end - start) / 2 * OVERLAP) + 1
        middle = (start + end) // 2
        times = np.array([middle - half, middle, middle + half])
        return [Window(times, np.repeat(path.position_m[:1], 3, axis=0), path.world_from_body[0])]
    windows, start = [], path.start_us
    while start < path.end_us:
        end = _longest(path, start, settings)
        windows.append(_window(path, start, end))
        start = end
    return windows


def _longest(path: Trajectory, start: int, settings: LiftSettings) -> int:
    """The farthest end for which one window is good enough; at least one sample on."""
    low, high = 1, max(1, int(np.ceil((path.end_us - start) / SAMPLE_US)))
    while low < high:
        middle = (low + high + 1) // 2
        if _good(path, start, min(start + middle * SAMPLE_US, path.end_us), settings):
            low = middle
        else:
            high = middle - 1
    return min(start + low * SAMPLE_US, path.end_us)


def _good(path: Trajectory, start: int, end: int, settings: LiftSettings) -> bool:
    times = np.unique(np.concatenate([np.arange(start, end, SAMPLE_US), [start, (start + end) // 2, end]]))
    poses = path.at(times)
    knots = np.array([start, (start + end) // 2, end])
    straight = np.column_stack([np.interp(times, knots, path.at(knots)[:, k, 3]) for k in range(3)])
    middle = path.at(int(knots[1]))[:3, :3]
    turn = np.einsum("ij,nij->n", middle, poses[:, :3, :3])
    angle = np.degrees(np.arccos(np.clip((turn - 1) / 2, -1, 1)))
    return bool(
        np.linalg.norm(straight - poses[:, :3, 3], axis=1).max() <= settings.window_position_m
        and angle.max() <= settings.window_rotation_deg
    )


def _window(path: Trajectory, start: int, end: int) -> Window:
    middle = (start + end) // 2
    half = max(int((end - start) / 2 * OVERLAP), 1)
    first, centre, last = (path.at(t)[:3, 3] for t in (start, middle, end))
    before = centre + (first - centre) * (half / max(middle - start, 1))
    after = centre + (last - centre) * (half / max(end - middle, 1))
    times = np.array([middle - half, middle, middle + half])
    return Window(times, np.stack([before, centre, after]), path.at(middle))


def emit(actor: Actor, gaussians_box: Gaussians, windows: list[Window]) -> DynamicGaussians:
    """Gaussians of the box frame placed in the world, once per window."""
    n = len(gaussians_box)
    parts, times, knots = [], [], []
    for window in windows:
        rotation = window.world_from_box[:3, :3]
        offset = gaussians_box.mean_m.astype(np.float64) @ rotation.T
        quat = geometry.quat_multiply(geometry.quat_from_matrix(rotation)[None], gaussians_box.quat_wxyz)
        positions = offset[:, None] + window.position_m[None]
        parts.append(
            Gaussians(
                positions[:, 1].astype(np.float32),
                geometry.quat_normalize(quat).astype(np.float32) if n else gaussians_box.quat_wxyz,
                gaussians_box.scale_m,
                gaussians_box.opacity,
                gaussians_box.rgb,
                (gaussians_box.normal.astype(np.float64) @ rotation.T).astype(np.float32),
                gaussians_box.label,
                gaussians_box.intensity,
            )
        )
        times.append(np.broadcast_to(window.t_us, (n, 3)))
        knots.append(positions.astype(np.float32))
    total = n * len(windows)
    return DynamicGaussians(
        Gaussians.concatenate(parts),
        np.concatenate(times).astype(np.int64),
        np.concatenate(knots),
        np.full(total, actor.index, np.int32),
    )
