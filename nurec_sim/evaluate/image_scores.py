"""Scores of rendered against recorded images: whole image, by region, sharpness, and holes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from nurec_sim.evaluate.log_regions import AROUND_PX, RANGES_M, actor_mask, range_name, seen_points
from nurec_sim.evaluate.scores.flip import flip
from nurec_sim.evaluate.scores.images import psnr, ssim
from nurec_sim.evaluate.scores.sharpness import OCTAVES, sharpness
from nurec_sim.files.new_files import write_file
from nurec_sim.logs.held_out import HeldOut
from nurec_sim.types import CameraFrame, Clip, Sense, SensorRequest

HOLE_ALPHA = 0.5
"""A rendered alpha below this at a LiDAR return is a hole."""
BEST_DB = 100.0
"""PSNR of equal images."""

Image = UInt8[np.ndarray, "h w 3"]
Probe = Callable[[SensorRequest], CameraFrame]


@dataclass
class FrameScore:
    """One image.

    ``regions`` maps names to a sum of squared errors and the number of its values, ``holes`` maps range bins to LiDAR
    points in a hole and all points.
    """

    camera: str
    index: int
    seen: bool
    psnr_db: float
    ssim: float
    flip: float = float("nan")
    sharpness: dict[str, float] = field(default_factory=dict)
    regions: dict[str, tuple[float, int]] = field(default_factory=dict)
    holes: dict[str, tuple[int, int]] = field(default_factory=dict)


def score_images(
    clip: Clip,
    inputs: Sequence[str],
    targets: Sequence[str],
    held: HeldOut,
    sense: Sense,
    probe: Probe,
    images_dir: Path | None,
    report: Callable[[str, float], None],
) -> dict[str, object]:
    """Scores of all recorded images of the target cameras.

    Args:
        clip: the log.
        inputs: input cameras of the reconstruction.
        targets: cameras to compare with.
        held: what was held out.
        sense: renders the scene.
        probe: renders one request with alpha.
        images_dir: folder for recorded (top) and rendered (bottom) images, PNG.
        report: called with a stage and the share of it done.
    """
    frames: list[FrameScore] = []
    floors: dict[str, list[FrameScore]] = {}
    for done, camera in enumerate(targets):
        floors[camera] = []
        count = len(clip.camera_times_us(camera))
        for index in range(count):
            report(f"images of {camera}", (done + index / count) / len(targets))
            request, recorded = image_request(clip, camera, index), clip.image(camera, index)
            (frame,) = sense([request])
            assert isinstance(frame, CameraFrame)
            seen = camera in inputs and index not in held.images.get(camera, frozenset())
            score = _score(camera, index, seen, frame.rgb, recorded)
            score.flip, score.sharpness = flip(frame.rgb, recorded), sharpness(frame.rgb, recorded)
            _add_regions(score, clip, request, frame.rgb, recorded, probe)
            frames.append(score)
            # The floor that any reconstruction should beat.
            copied = _nearest_input(clip, camera, index, inputs, held)
            if copied is not None:
                floors[camera].append(_score(camera, index, seen, copied, recorded))
            if images_dir is not None:
                _write_pair(images_dir / f"{camera}_{index:04d}.png", recorded, frame.rgb)
        report(f"images of {camera}", (done + 1) / len(targets))
    cameras = {}
    for camera in targets:
        own = [frame for frame in frames if frame.camera == camera]
        cameras[camera] = {**_means(own, "flip"), "input": camera in inputs, "floor": _means(floors[camera])}
    groups = {"seen": [f for f in frames if f.seen], "unseen": [f for f in frames if not f.seen]}
    return {
        "psnr_db": _mean(frame.psnr_db for frame in frames),
        "ssim": _mean(frame.ssim for frame in frames),
        **{name: summarized(group) for name, group in groups.items() if group},
        "cameras": cameras,
    }


def image_request(clip: Clip, camera: str, index: int) -> SensorRequest:
    """The request that repeats a recorded image."""
    start, end = (int(t) for t in clip.camera_times_us(camera)[index])
    poses = clip.world_from_camera(camera, index)
    return SensorRequest(clip.id, clip.rig.cameras[camera], start, max(end, start + 1), poses, show_ego=True)


def summarized(frames: Sequence[FrameScore]) -> dict[str, object]:
    """Means over frames, of all and of each camera; regions and holes pooled over pixels and points."""
    regions = {
        name: _psnr_of(sum(f.regions[name][0] for f in frames if name in f.regions),
                       sum(f.regions[name][1] for f in frames if name in f.regions))
        for name in dict.fromkeys(name for f in frames for name in f.regions)
    }  # fmt: skip
    holes = {}
    for name in dict.fromkeys(name for f in frames for name in f.holes):
        missing, points = (sum(f.holes[name][k] for f in frames if name in f.holes) for k in (0, 1))
        holes[name] = missing / points if points else None
    return {
        "frames": len(frames),
        "psnr_db": _mean(frame.psnr_db for frame in frames),
        "ssim": _mean(frame.ssim for frame in frames),
        "flip": _mean(frame.flip for frame in frames),
        "sharpness": {name: _mean(frame.sharpness[name] for frame in frames) for name in OCTAVES},
        "region_psnr_db": regions,
        "camera_psnr_db": {
            camera: _mean(frame.psnr_db for frame in frames if frame.camera == camera)
            for camera in dict.fromkeys(frame.camera for frame in frames)
        },
        "holes": holes,
        "worst": [
            f"{f.camera}_{f.index:04d}" for f in sorted(frames, key=lambda f: (f.psnr_db, f.camera, f.index))[:3]
        ],
    }


def _score(camera: str, index: int, seen: bool, image: Image, recorded: Image) -> FrameScore:
    return FrameScore(camera, index, seen, min(psnr(image, recorded), BEST_DB), ssim(image, recorded))


def _add_regions(
    score: FrameScore, clip: Clip, request: SensorRequest, image: Image, recorded: Image, probe: Probe
) -> None:
    error = ((image.astype(np.float64) - recorded) ** 2).sum(axis=2)
    actors = actor_mask(clip, request)
    masks = {"actors": actors, "background": ~actors}
    points = seen_points(clip, request)
    if len(points.pixel):
        alpha = probe(request).alpha
        assert alpha is not None
        through = alpha[points.pixel[:, 1], points.pixel[:, 0]] < HOLE_ALPHA
        for k in range(len(RANGES_M) - 1):
            chosen = points.bin == k
            masks[range_name(k)] = _around(points.pixel[chosen], actors.shape)
            score.holes[range_name(k)] = (int(through[chosen].sum()), int(chosen.sum()))
    for name, mask in masks.items():
        if mask.any():
            score.regions[name] = (float(error[mask].sum()), 3 * int(mask.sum()))


def _around(pixel: np.ndarray, shape: tuple[int, ...]) -> Bool[np.ndarray, "h w"]:
    mask = np.zeros(shape, np.uint8)
    mask[pixel[:, 1], pixel[:, 0]] = 1
    return cv2.dilate(mask, np.ones((2 * AROUND_PX + 1, 2 * AROUND_PX + 1), np.uint8)).astype(bool)


def _means(frames: Sequence[FrameScore], *more: str) -> dict[str, object]:
    lists = {name: [getattr(frame, name) for frame in frames] for name in ("psnr_db", "ssim", *more)}
    return {**{name: _mean(values) for name, values in lists.items()}, "per_frame": lists}


def _mean(values: Iterable[float]) -> float | None:
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else None


def _psnr_of(squared: float, values: int) -> float | None:
    if not values:
        return None
    return min(float(10 * np.log10(255.0**2 * values / squared)), BEST_DB) if squared > 0 else BEST_DB


def _nearest_input(clip: Clip, camera: str, index: int, inputs: Sequence[str], held: HeldOut) -> Image | None:
    """Copy baseline: the input image nearest in time, of the camera with the most similar direction; never itself."""
    model, t_us = clip.rig.cameras[camera], int(clip.camera_times_us(camera)[index].sum()) // 2
    best: tuple[float, float, str, int] | None = None
    for other in inputs:
        gap = np.abs(clip.camera_times_us(other).sum(axis=1) // 2 - t_us).astype(np.float64)
        gap[sorted(held.images.get(other, frozenset()))] = np.inf
        if other == camera:
            gap[index] = np.inf
        nearest = int(np.argmin(gap)) if len(gap) else 0
        if not len(gap) or not np.isfinite(gap[nearest]):
            continue
        facing = float(clip.rig.cameras[other].rig_from_camera[:3, 2] @ model.rig_from_camera[:3, 2])
        # Ordered by direction (cosine, rounded so that a stereo pair ties), then by time.
        candidate = (round(-facing, 2), float(gap[nearest]), other, nearest)
        best = candidate if best is None or candidate < best else best
    if best is None or best[0] > 0:
        return None
    image = clip.image(best[2], best[3])
    size = (model.width_px, model.height_px)
    return image if image.shape[1::-1] == size else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _write_pair(path: Path, recorded: Image, rendered: Image) -> None:
    pair = np.ascontiguousarray(np.vstack([recorded, rendered])[..., ::-1])
    write_file(path, cv2.imencode(path.suffix, pair)[1].tobytes())
