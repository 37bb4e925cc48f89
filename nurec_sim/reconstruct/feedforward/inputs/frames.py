"""Choice of the cameras of a clip, of its chunks, and of the frames in each chunk.

A reference time takes the frame of each camera whose exposure ends nearest to it. Everything is int64 microseconds.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64

from nurec_sim import sensors
from nurec_sim.errors import ReconstructError
from nurec_sim.network.profiles import Profile
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings
from nurec_sim.types import CameraModel, Clip

USUAL_FIELD_DEG = 120.0
"""Field of view of the cameras that the released weights were trained with."""
FIELD_WEIGHT = 0.1
"""Degrees off the wanted direction that one degree off the usual field counts for."""
PAIR_AZIMUTHS_DEG = (60.0, 130.0)
"""Where the front and the rear side cameras of a surround rig look, left positive."""
AHEAD_DEG, BEHIND_DEG = 20.0, 165.0
"""Range of the yaw of a side camera, to either side."""
PAIR_ASYMMETRY_DEG = 45.0

SLOWEST_STEP_US = 500_000
"""2 Hz, the slowest sampling of the paper (section 3.1)."""
FASTEST_STEP_US = 250_000
"""4 Hz, its fastest."""
RELEASE_STEP_US = 750_000
RELEASE_MARGIN_US = 100_000
STAGGER_US = 200_000
"""Maximum time between the only frames of cameras that count as recording at the same time."""


@dataclass(frozen=True)
class ChunkWindow:
    """What one chunk sees: frame indices of every camera (in the network's order, all equally many).

    ``span_us`` goes from the first start to the last end of their exposures.
    """

    index: int
    span_us: tuple[int, int]
    frames: Mapping[str, tuple[int, ...]]


def choose_cameras(clip: Clip, profile: Profile, cameras: Sequence[str] | None = None) -> tuple[str, ...]:
    """Cameras in the network's order: front, left, right, rear left, rear right.

    Args:
        clip: the driving log.
        profile: determines how many cameras there may be.
        cameras: ids in the order wanted; None picks as many as the profile allows, by where they look and how wide,
            never by their names. Cameras that look the same way (a stereo pair, a tele beside a wide one) count as one.

    Raises:
        ReconstructError: an id that is unknown, given twice or has no frames; a number that the profile does not allow.
    """
    allowed = sorted(profile.cameras)
    if cameras is not None:
        chosen = tuple(cameras)
        unknown = [camera for camera in chosen if camera not in clip.rig.cameras]
        if unknown:
            raise ReconstructError(f"clip {clip.id!r} has no camera {unknown}; have {list(clip.rig.cameras)}")
        if len(set(chosen)) < len(chosen):
            raise ReconstructError(f"every camera may be named once, got {list(chosen)}")
        silent = [camera for camera in chosen if len(clip.camera_times_us(camera)) == 0]
        if silent:
            raise ReconstructError(f"clip {clip.id!r}: cameras {silent} have no frames")
        if len(chosen) not in allowed:
            raise ReconstructError(
                f"profile {profile.name!r} takes {_any_of(allowed)} cameras, got {len(chosen)}: {list(chosen)}"
            )
        return chosen
    ordered = _by_geometry([model for name, model in clip.rig.cameras.items() if len(clip.camera_times_us(name))])
    fitting = [count for count in allowed if count <= len(ordered)]
    if not fitting:
        raise ReconstructError(
            f"profile {profile.name!r} takes {_any_of(allowed)} cameras, but clip {clip.id!r} has "
            f"{len(ordered)} that look in different directions; cameras of the rig: {list(clip.rig.cameras)}"
        )
    return tuple(camera.id for camera in ordered[: fitting[-1]])


def _any_of(counts: Sequence[int]) -> str:
    return " or ".join(map(str, counts))


def _by_geometry(cameras: Sequence[CameraModel]) -> list[CameraModel]:
    """The front camera, then up to two pairs of side cameras."""
    if not cameras:
        return []
    forward = {camera.id: np.asarray(camera.rig_from_camera)[:3, 2] for camera in cameras}
    off_ahead = {name: np.degrees(np.arccos(np.clip(axis[0], -1, 1))) for name, axis in forward.items()}
    azimuth = {name: np.degrees(np.arctan2(axis[1], axis[0])) for name, axis in forward.items()}
    width = {camera.id: FIELD_WEIGHT * abs(_field_deg(camera) - USUAL_FIELD_DEG) for camera in cameras}
    # Whole degrees, so that among cameras alike (stereo) the log's order decides and not the noise of calibration.
    front = min(cameras, key=lambda camera: round(off_ahead[camera.id] + width[camera.id]))
    pairs: list[tuple[CameraModel, CameraModel]] = []
    for wanted in PAIR_AZIMUTHS_DEG:
        new = [camera for camera in cameras if _looks_elsewhere(azimuth, camera, [front, *itertools.chain(*pairs)])]
        left = [camera for camera in new if AHEAD_DEG < azimuth[camera.id] < BEHIND_DEG]
        right = [camera for camera in new if AHEAD_DEG < -azimuth[camera.id] < BEHIND_DEG]
        costs: list[tuple[int, tuple[CameraModel, CameraModel]]] = []
        for one, other in itertools.product(left, right):
            a, b = azimuth[one.id], -azimuth[other.id]
            if abs(a - b) <= PAIR_ASYMMETRY_DEG:
                # Pairs should be where surround rigs have them, symmetric, and with the field of view of the training
                # data.
                cost = abs((a + b) / 2 - wanted) + abs(a - b) + width[one.id] + width[other.id]
                costs.append((round(cost), (one, other)))
        if not costs:
            break
        pairs.append(min(costs, key=lambda entry: entry[0])[1])
    pairs.sort(key=lambda pair: azimuth[pair[0].id] - azimuth[pair[1].id])
    return [front, *itertools.chain(*pairs)]


def _looks_elsewhere(azimuth_deg: Mapping[str, float], camera: CameraModel, others: Sequence[CameraModel]) -> bool:
    """Whether a camera shows something that none of the others does."""
    turns = [abs((azimuth_deg[camera.id] - azimuth_deg[other.id] + 180) % 360 - 180) for other in others]
    return min(turns) > AHEAD_DEG


def _field_deg(camera: CameraModel) -> float:
    """Horizontal field of view along the middle row, as far as the lens sees."""
    u = np.linspace(0, camera.width_px, 65)
    rays, valid = sensors.unproject(camera, np.stack([u, np.full_like(u, camera.height_px / 2)], axis=1))
    angle = np.degrees(np.arctan2(rays[valid, 0], rays[valid, 2]))
    return float(np.ptp(angle)) if len(angle) else 0.0


def chunk_windows(
    clip: Clip, cameras: Sequence[str], profile: Profile, settings: FeedForwardSettings
) -> list[ChunkWindow]:
    """Cut a clip into chunks and choose their frames.

    ``overlapping`` (paper section 3.4): reference times from the first to the last frame that all cameras have, evenly
    at 2 to 4 Hz; a chunk holds as many as the profile takes and repeats the share ``settings.overlap`` of the previous
    one. A single camera may contribute more frames (``profile.frames_alone``), denser in time over the same span.

    ``non-overlapping`` (the release): equal chunks of at most 750 ms per frame, sampled without a half step, over the
    interval that lies within 0.1 s of every camera's frames. No frame occurs twice in a chunk: where a log has fewer
    frames than requested, the chunk has fewer, always equally many per camera.

    Args:
        clip: the driving log.
        cameras: ids in the network's order (``choose_cameras``).
        profile: bounds the number of frames per camera.
        settings: ``chunking``, ``overlap``, ``frames`` and ``max_chunks`` are used.

    Raises:
        ReconstructError: cameras that do not record at the same time, more than ``settings.max_chunks`` chunks, or a
            number of frames that the profile does not take.
    """
    fewest, usual = profile.frames
    release = settings.chunking == "non-overlapping"
    most = usual if release or len(cameras) > 1 else profile.frames_alone or usual
    count = most if settings.frames is None else settings.frames
    if not fewest <= count <= most:
        raise ReconstructError(f"profile {profile.name!r} takes {fewest} to {most} frames per camera, got {count}")
    exposures = {camera: np.asarray(clip.camera_times_us(camera), np.int64) for camera in cameras}
    start, end = _usable_interval(clip, exposures, RELEASE_MARGIN_US if release else 0)
    chunks, references = (
        _separate_times(end - start, count) if release else _shared_times(end - start, count, settings.overlap, usual)
    )
    if chunks > settings.max_chunks:
        raise ReconstructError(
            f"clip {clip.id!r}: {(end - start) / 1e6:.1f} s at {count} frames per camera and chunk are {chunks} "
            f"chunks, but max_chunks is {settings.max_chunks}; allow more, or cut the log"
        )
    windows: list[ChunkWindow] = []
    for times in references:
        frames = _nearest_frames(exposures, start + times)
        # A log slower than the sampling can give a chunk that only repeats the one before.
        if windows and all(set(row) <= set(windows[-1].frames[camera]) for camera, row in frames.items()):
            continue
        shown = np.concatenate([exposures[camera][list(row)] for camera, row in frames.items()])
        windows.append(ChunkWindow(len(windows), (int(shown[:, 0].min()), int(shown[:, 1].max())), frames))
    return windows


def _usable_interval(
    clip: Clip, exposures: Mapping[str, Int64[np.ndarray, "frames 2"]], margin_us: int
) -> tuple[int, int]:
    """From when to when the rig has poses and every camera frames, give or take ``margin_us``; start <= end."""
    start = max(clip.ego.start_us, *(int(times[0, 1]) - margin_us for times in exposures.values()))
    end = min(clip.ego.end_us, *(int(times[-1, 1]) + margin_us for times in exposures.values()))
    if start - end > STAGGER_US:
        ends = {camera: (int(times[0, 1]), int(times[-1, 1])) for camera, times in exposures.items()}
        raise ReconstructError(
            f"clip {clip.id!r}: the cameras and the rig have no time in common: poses from {clip.ego.start_us} to "
            f"{clip.ego.end_us} us, first and last frames {ends}"
        )
    if start > end:
        start = end = (start + end) // 2
    return start, end


def _separate_times(span: int, count: int) -> tuple[int, list[Int64[np.ndarray, " n"]]]:
    """Number of chunks, and the release's times of each from the start of the interval."""
    # ceil(span / (frames * 750 ms)) in integers; reference times at start + k * span / (frames * chunks), no half step.
    chunks = max(1, -(-span // (count * RELEASE_STEP_US)))
    times = np.arange(count * chunks, dtype=np.int64) * span // (count * chunks)
    return chunks, np.split(times, chunks)


def _shared_times(span: int, count: int, overlap: float, usual: int) -> tuple[int, list[Int64[np.ndarray, " n"]]]:
    """Number of chunks, and the overlapping chunks' times from the start of the interval; the last is ``span``.

    Chunks of more times than ``usual`` have them the more often.
    """
    slowest, fastest = (step * usual // max(count, usual) for step in (SLOWEST_STEP_US, FASTEST_STEP_US))
    advance = max(1, count - round(count * overlap))
    # A chunk covers (count - 1) steps, each further one adds ``advance`` steps: as few chunks as 2 Hz allows.
    beyond = span - (count - 1) * slowest
    if beyond > 0:
        chunks = 1 - (-beyond // (advance * slowest))
        total = count + (chunks - 1) * advance
    else:
        chunks = 1
        total = count = min(count, max(span // fastest + 1, 2 if span else 1))
    times = np.arange(total, dtype=np.int64) * span // max(total - 1, 1)
    return chunks, [times[first : first + count] for first in range(0, chunks * advance, advance)]


def _nearest_frames(
    exposures: Mapping[str, Int64[np.ndarray, "frames 2"]], times: Int64[np.ndarray, " n"]
) -> dict[str, tuple[int, ...]]:
    """Frames nearest to the reference times, without those times that would repeat a frame of any camera."""
    nearest = np.stack([np.abs(e[:, 1] - times[:, None]).argmin(axis=1) for e in exposures.values()], axis=1)
    kept = [nearest[0]]
    for frames in nearest[1:]:
        # Camera by camera as many frames: a time is dropped for all of them as soon as one camera would repeat.
        if (frames > kept[-1]).all():
            kept.append(frames)
    return {camera: tuple(int(row[k]) for row in kept) for k, camera in enumerate(exposures)}
