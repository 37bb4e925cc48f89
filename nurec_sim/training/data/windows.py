"""Sampling of training samples from clips: cameras, context frames, target frames, and augmentation."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from nurec_sim.network.profiles import PROFILES, Profile
from nurec_sim.network.stereo.plane_sweep import plane_sweep
from nurec_sim.reconstruct.feedforward.inputs.frames import ChunkWindow
from nurec_sim.reconstruct.feedforward.inputs.window import chunk_inputs
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings
from nurec_sim.training.data.augment import AugmentSettings, augmented
from nurec_sim.training.data.clips import TrueClip
from nurec_sim.training.data.reframe import Cut, ReframedClip
from nurec_sim.training.data.sample import TrainingSample
from nurec_sim.training.data.truth import target_view, true_maps


@dataclass(frozen=True)
class WindowSettings:
    """How samples are taken from clips.

    Attributes:
        profile: network profile and image size (``tiny`` keeps the aspect ratio of the cameras at about
            ``width_px * height_px`` pixels).
        cameras: sampling weight of each number of cameras; numbers that a rig does not have are skipped.
        frames: sampling weight of each number of context frames per camera.
        usual_share: probability of a context frame interval of ``usual_spacing_s``.
        usual_spacing_s: as in the protocol ``storm``, with four frames in two seconds.
        spacing_s: range of the interval otherwise.
        most_images: maximum number of images over all cameras; limits the frames per camera.
        targets: number of held-out frames to render.
        zoom: maximum magnification by random crops; 1 keeps images whole.
        mirror: probability of mirroring left and right.
        augment: photometric augmentation; None for clean colours.
    """

    profile: Profile = PROFILES["tiny"]
    cameras: Mapping[int, float] = field(default_factory=lambda: {1: 0.5, 3: 0.4, 5: 0.1})
    frames: Mapping[int, float] = field(default_factory=lambda: {2: 0.1, 3: 0.1, 4: 0.6, 5: 0.1, 6: 0.05, 8: 0.05})
    usual_share: float = 0.6
    usual_spacing_s: float = 0.5
    spacing_s: tuple[float, float] = (0.1, 0.6)
    most_images: int = 12
    targets: int = 4
    zoom: float = 1.4
    mirror: float = 0.5
    augment: AugmentSettings | None = AugmentSettings()

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            ValueError: no way to choose cameras or frames, or a number out of range.
        """
        for name, weights in (("cameras", self.cameras), ("frames", self.frames)):
            if not weights or min(weights) < 1 or min(weights.values()) < 0 or sum(weights.values()) <= 0:
                raise ValueError(f"{name} must give a positive weight to numbers of at least 1, got {dict(weights)}")
        if not 0 < self.spacing_s[0] <= self.spacing_s[1] or self.usual_spacing_s <= 0:
            raise ValueError(f"spacing_s must be positive and rise, got {self.spacing_s}, {self.usual_spacing_s}")
        if self.zoom < 1 or self.targets < 0 or self.most_images < max(1, *self.cameras):
            raise ValueError("zoom must be at least 1, targets 0, and most_images the number of cameras, got "
                             f"{self.zoom}, {self.targets}, {self.most_images}")  # fmt: skip


def sample_window(rng: np.random.Generator, clip: TrueClip, settings: WindowSettings) -> TrainingSample:
    """One sample of a clip; the same generator state gives the same sample.

    Context frames are evenly spaced. Targets are other frames of the same cameras, from the first context frame until
    one interval after the last (then ``time`` exceeds 1); if there are none, context frames are targets.
    """
    names = _cameras(rng, clip, settings.cameras)
    taken = len(clip.camera_times_us(names[0]))
    count, step = _rhythm(rng, clip, names, settings)
    first = int(rng.integers(taken - (count - 1) * step))
    context = tuple(range(first, first + count * step, step))
    reframed, how = _reframed(rng, clip, names, settings)
    shown = np.concatenate([reframed.camera_times_us(name)[list(context)] for name in names])
    window = ChunkWindow(0, (int(shown[:, 0].min()), int(shown[:, 1].max())), dict.fromkeys(names, context))
    chunk = chunk_inputs(reframed, settings.profile, window, FeedForwardSettings(), {})
    sample = TrainingSample(
        id=f"{clip.id}/{len(names)}x{count}@{first}+{step}{how}",
        inputs=chunk.tensors,
        truth=true_maps(reframed, settings.profile, chunk),
        targets=tuple(
            target_view(reframed, settings.profile, window, chunk, name, frame)
            for name, frame in _targets(rng, names, context, step, taken, settings.targets)
        ),
    )
    if settings.augment is not None:
        sample = augmented(rng, sample, settings.augment)
    if not settings.profile.encoder.car_view:
        return sample
    # Plane sweeping is done here, in a worker process, so that it does not delay the training step.
    return dataclasses.replace(sample, inputs=dataclasses.replace(sample.inputs, matches=plane_sweep(sample.inputs)))


def _cameras(rng: np.random.Generator, clip: TrueClip, weights: Mapping[int, float]) -> tuple[str, ...]:
    """The first cameras of the rig, which lists them in the network's order: front, sides, rear sides."""
    names = tuple(clip.rig.cameras)
    possible = {number: weight for number, weight in weights.items() if number <= len(names)} or {1: 1.0}
    return names[: _drawn(rng, possible)]


def _rhythm(
    rng: np.random.Generator, clip: TrueClip, names: tuple[str, ...], settings: WindowSettings
) -> tuple[int, int]:
    """Number of context frames, and their interval in frames of the clip."""
    times = clip.camera_times_us(names[0])[:, 0]
    count = max(1, min(_drawn(rng, settings.frames), settings.most_images // len(names), len(times)))
    usual = rng.random() < settings.usual_share
    spacing_s = settings.usual_spacing_s if usual else rng.uniform(*settings.spacing_s)
    period_s = float(np.median(np.diff(times))) / 1e6 if len(times) > 1 else 1.0
    longest = (len(times) - 1) // max(count - 1, 1)
    return count, int(np.clip(round(spacing_s / period_s), 1, max(longest, 1)))


def _targets(
    rng: np.random.Generator, names: tuple[str, ...], context: tuple[int, ...], step: int, taken: int, count: int
) -> list[tuple[str, int]]:
    span = range(context[0], min(context[-1] + step, taken))
    held_out = [(name, frame) for name in names for frame in span if frame not in context]
    candidates = held_out or [(name, frame) for name in names for frame in context]
    chosen = rng.choice(len(candidates), min(count, len(candidates)), replace=False)
    return [candidates[k] for k in chosen]


def _reframed(
    rng: np.random.Generator, clip: TrueClip, names: tuple[str, ...], settings: WindowSettings
) -> tuple[TrueClip, str]:
    """The cropped and mirrored clip, and a suffix for the sample's name."""
    # Log-uniform: magnifications by equal factors are equally likely.
    zoom = float(np.exp(rng.uniform(0, np.log(settings.zoom))))
    cuts = {}
    for name in names:
        camera = clip.rig.cameras[name]
        width, height = round(camera.width_px / zoom), round(camera.height_px / zoom)
        x, y = (int(rng.integers(spare + 1)) for spare in (camera.width_px - width, camera.height_px - height))
        cuts[name] = Cut(x, y, width, height)
    glass = any(clip.rig.cameras[name].windshield is not None for name in names)
    mirrored = bool(rng.random() < settings.mirror) and not glass
    return ReframedClip(clip, cuts, mirrored), f"x{zoom:.2f}{'m' if mirrored else ''}"


def _drawn(rng: np.random.Generator, weights: Mapping[int, float]) -> int:
    values = np.array(list(weights.values()), np.float64)
    return int(rng.choice(list(weights), p=values / values.sum()))
