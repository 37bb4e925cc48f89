"""Recorded logs for evaluation: held-out frames and sweeps are the ground truth.

Depth comes from the held-out sweep nearest in time, the dynamic region from the log's boxes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from jaxtyping import Float32, Float64, Int64

from nurec_sim import geometry, sensors
from nurec_sim.errors import ReconstructError
from nurec_sim.evaluate.log_regions import actor_mask
from nurec_sim.evaluate.views import ScoredView, reduced, scored_size
from nurec_sim.evaluate.windows import EvaluationView, Window
from nurec_sim.logs.selection import ContextClip, Revolution, Shot
from nurec_sim.reconstruct.feedforward.inputs.frames import choose_cameras
from nurec_sim.types import CameraModel, Clip, Rig, SensorRequest

STEP_TOLERANCE = 0.25
"""Tolerance of the frame interval."""
NEAREST_SWEEP_US = 60_000
"""Maximum time between a frame and the sweep for its depth."""


def front_cameras(clip: Clip, most: int) -> tuple[str, ...]:
    """Up to ``most`` cameras of a log, the front one first."""
    from nurec_sim.network import PROFILES

    return choose_cameras(clip, PROFILES["tiny"])[:most]


def storm_windows(
    clip: Clip, frames: int, context: Sequence[int], step_us: int, boxes: bool
) -> dict[str, Callable[[], Window]]:
    """Consecutive windows of front camera frames, by name, as functions that read them.

    Args:
        clip: the log.
        frames: length of a window in frames.
        context: indices of the input frames within a window; the others are targets.
        step_us: expected frame interval, microseconds, within ``STEP_TOLERANCE``.
        boxes: whether the methods get the log's boxes.

    Raises:
        ReconstructError: too few frames, or not about ``step_us`` apart.
    """
    (camera,) = front_cameras(clip, 1)
    times = clip.camera_times_us(camera).sum(axis=1) // 2
    rate = np.median(np.diff(times)) if len(times) > 1 else 0
    if len(times) < frames or abs(rate - step_us) > STEP_TOLERANCE * step_us:
        apart = f" {rate / 1e6:.3g} s apart" if len(times) > 1 else ""
        raise ReconstructError(
            f"clip {clip.id!r}: protocol 'storm' needs {frames} frames {step_us / 1e6:g} s apart, "
            f"camera {camera!r} has {len(times)}{apart}"
        )
    seen = set(context)
    return {
        f"{clip.id}-{first:04d}": partial(
            recorded_window, clip, f"{clip.id}-{first:04d}", (camera,), [first + k for k in context],
            [first + k for k in range(frames) if k not in seen], boxes,
        )
        for first in range(0, len(times) - frames + 1, frames)
    }  # fmt: skip


def clip_window(clip: Clip, cameras: int, every: int, boxes: bool) -> dict[str, Callable[[], Window]]:
    """The whole log as one window, frames ``every - 1``, ``2 every - 1``, ... held out; as a function that reads it.

    Args:
        clip: the log.
        cameras: maximum number of cameras.
        every: every such frame is held out.
        boxes: whether the methods get the log's boxes.

    Raises:
        ReconstructError: the log has no frame to hold out.
    """
    names = front_cameras(clip, cameras)
    count = min(len(clip.camera_times_us(camera)) for camera in names)
    asked = list(range(every - 1, count, every))
    if not asked:
        raise ReconstructError(f"clip {clip.id!r} has {count} frames: none to hold out when every {every}th is")
    seen = sorted(set(range(count)) - set(asked))
    return {clip.id: partial(recorded_window, clip, clip.id, names, seen, asked, boxes)}


def recorded_window(
    clip: Clip,
    id: str,
    cameras: Sequence[str],
    seen: Sequence[int],
    asked: Sequence[int],
    boxes: bool,
    asked_of: Sequence[str] | None = None,
) -> Window:
    """A window of a recorded log.

    Sweeps nearest in time to target views are held out, unless the views themselves are inputs.

    Args:
        clip: the log.
        id: name of the window.
        cameras: input cameras.
        seen: indices of the input frames of each of these cameras.
        asked: indices of the target frames.
        boxes: whether the methods get the log's boxes.
        asked_of: target cameras; default: the input cameras.
    """
    shown_by = list(cameras if asked_of is None else asked_of)
    frames = sorted({*seen, *asked})
    views = [(camera, index) for index in asked for camera in shown_by]
    given = {(camera, index) for camera in cameras for index in seen}
    exposures = np.concatenate([clip.camera_times_us(camera)[frames] for camera in {*cameras, *shown_by}])
    span_us = (int(exposures.min()), int(exposures.max()) + 1)
    nearest = {view: _nearest_sweep(clip, clip.camera_times_us(view[0])[view[1]]) for view in views}
    # A sweep that is the depth truth of a held-out view must not be an input, otherwise methods could copy it.
    held = {sweep for view, sweep in nearest.items() if view not in given}
    shots = {camera: tuple(_shot(clip, camera, index) for index in seen) for camera in cameras}
    turns = {
        lidar: tuple(
            Revolution(int(start), int(end), partial(clip.sweep, lidar, index))
            for index, (start, end) in enumerate(clip.sweep_times_us(lidar))
            if (lidar, index) not in held
            and span_us[0] - NEAREST_SWEEP_US <= (start + end) // 2 < span_us[1] + NEAREST_SWEEP_US
        )
        for lidar in clip.rig.lidars
    }
    names = [name for name in clip.rig.cameras if name in {*cameras, *shown_by}]
    rig = Rig({name: clip.rig.cameras[name] for name in names}, clip.rig.lidars, clip.rig.body)
    context = ContextClip(
        id, rig, clip.ego, _wider(turns, span_us), shots, turns, tuple(clip.tracks) if boxes else (),
        ego_mask=clip.ego_mask,
    )  # fmt: skip
    targets = tuple(_target(clip, *view, nearest[view], beyond=view[1] > max(seen)) for view in views)
    ends = clip.ego.at(np.array(span_us))[:, :3, 3]
    about: dict[str, str | int | float] = {
        "log": clip.id,
        "first_frame": frames[0],
        "driven_m": round(float(np.linalg.norm(ends[1] - ends[0])), 2),
    }
    return Window(id, context, targets, about)


def _wider(turns: Mapping[str, Sequence[Revolution]], span_us: tuple[int, int]) -> tuple[int, int]:
    """The span of the window and of its sweeps."""
    times = [t for records in turns.values() for turn in records for t in (turn.start_us, turn.end_us + 1)]
    return min([span_us[0], *times]), max([span_us[1], *times])


def _shot(clip: Clip, camera: str, index: int) -> Shot:
    start, end = (int(t) for t in clip.camera_times_us(camera)[index])
    return Shot(start, end, clip.world_from_camera(camera, index), lambda: clip.image(camera, index))


def _nearest_sweep(clip: Clip, exposure_us: Int64[np.ndarray, " 2"]) -> tuple[str, int] | None:
    """The LiDAR and the index of the sweep nearest to the middle of an exposure, None if none is near enough."""
    best: tuple[int, str, int] | None = None
    for lidar in clip.rig.lidars:
        gaps = np.abs(clip.sweep_times_us(lidar).sum(axis=1) // 2 - int(exposure_us.sum()) // 2)
        if len(gaps) and gaps.min() <= NEAREST_SWEEP_US:
            entry = (int(gaps.min()), lidar, int(gaps.argmin()))
            best = entry if best is None else min(best, entry)
    return None if best is None else best[1:]


def _target(clip: Clip, camera_id: str, index: int, sweep: tuple[str, int] | None, beyond: bool) -> EvaluationView:
    camera, exposure = clip.rig.cameras[camera_id], clip.camera_times_us(camera_id)[index]
    start, end = int(exposure[0]), max(int(exposure[1]), int(exposure[0]) + 1)
    request = SensorRequest("", camera, start, end, clip.world_from_camera(camera_id, index))
    true = reduced(clip.image(camera_id, index), None)
    depth_m = np.zeros(true.rgb.shape[:2], np.float32)
    if sweep is not None:
        depth_m = projected_depth(request, camera, clip.sweep(*sweep).xyz_world_m)
    movable = actor_mask(clip, request, scored_size(camera.width_px, camera.height_px)) if clip.tracks else None
    name = f"{camera_id}-{index:04d}"
    return EvaluationView(name, request, ScoredView(true.rgb, depth_m), movable, beyond=beyond)


def projected_depth(
    request: SensorRequest, camera: CameraModel, xyz_world_m: Float64[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "h w"]:
    """Z-depth at the scored size: of the nearest point in each pixel, 0 without a point."""
    width, height = scored_size(camera.width_px, camera.height_px)
    uv, valid, fraction = sensors.project_rolling(camera, request.world_from_sensor, xyz_world_m)
    valid &= sensors.in_image(camera, uv)
    uv, xyz, fraction = uv[valid], xyz_world_m[valid], fraction[valid]
    poses = geometry.inverse(geometry.interpolate_pose_pair(request.world_from_sensor, fraction))
    # Only the third row is needed: z in the camera at the instant at which its pixel was exposed.
    z = np.einsum("ni,ni->n", poses[:, 2, :3], xyz) + poses[:, 2, 3]
    column = (uv[:, 0] * width / camera.width_px).astype(int).clip(0, width - 1)
    row = (uv[:, 1] * height / camera.height_px).astype(int).clip(0, height - 1)
    depth_m = np.full((height, width), np.inf, np.float32)
    np.minimum.at(depth_m, (row, column), z.astype(np.float32))
    return np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, np.float32(0))
