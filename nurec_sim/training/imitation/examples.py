"""Batches for imitation: what the policy's network sees of the generated drives, with noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from nurec_sim.errors import TrainingError
from nurec_sim.training.imitation.config import ImitationConfig
from nurec_sim.training.imitation.drives import AFTER_S, PATH_M, Drives
from nurec_sim.types import CameraFrame, Needs

BRAKING, BRAKING_SHARE = 0.6, 0.3
"""An expert who will be slower than this part of its speed brakes; this share of a batch is of that kind."""
ROUTE_DROPPED = 0.1
"""Probability that the network is told nothing of the route but straight on."""


class Learner(Protocol):
    """What a policy offers to be trained: its inputs and the meaning of its outputs, so that driving cannot differ."""

    needs: Needs
    path_m: np.ndarray
    after_s: np.ndarray

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the weights."""
        ...

    def view(self, frame: CameraFrame, camera: str, turn_rad: float = 0.0) -> UInt8[np.ndarray, "h w 3"]:
        """What the network sees of an image, with the rig turned to the left."""
        ...

    def numbers(self, speed_mps: float, route_m: np.ndarray, route_speed_mps: np.ndarray) -> np.ndarray:
        """The network's other inputs."""
        ...

    def targets(self, path_m: np.ndarray, speeds_mps: np.ndarray) -> np.ndarray:
        """Outputs that mean a path and speeds."""
        ...


@dataclass(frozen=True, eq=False)
class Batch:
    """Inputs and answers.

    Attributes:
        images: as the network sees them.
        numbers: its other inputs.
        targets: outputs that mean the expert's path and speeds.
    """

    images: UInt8[np.ndarray, "b cameras h w 3"]
    numbers: Float32[np.ndarray, "b n"]
    targets: Float32[np.ndarray, "b m"]


class Examples:
    """All examples of some towns as one policy sees them.

    Args:
        towns: the generated drives.
        learner: the policy.
        progress: called with the share of images that are prepared.

    Raises:
        TrainingError: the policy wants points of the path or times that the drives do not have.
    """

    def __init__(self, towns: Sequence[Drives], learner: Learner, progress: Callable[[float], None]) -> None:
        if not (np.array_equal(learner.path_m, PATH_M) and np.array_equal(learner.after_s, AFTER_S)):
            raise TrainingError(f"drives have answers at {PATH_M} m and after {AFTER_S} s, the policy wants "
                                f"{learner.path_m} and {learner.after_s}")  # fmt: skip
        self.learner, cameras = learner, learner.needs.cameras
        images = []
        for k, town in enumerate(towns):
            progress(k / len(towns))
            for place, turns in enumerate(town.turn_rad):
                frames = {camera: town.frame(place, camera) for camera in cameras}
                images += [[learner.view(frames[c], c, float(turn)) for c in cameras] for turn in turns]
        self.images = np.array(images, np.uint8)
        self.speed, self.route, self.route_speed, self.path, self.later = (
            np.concatenate([getattr(town, name).reshape(-1, *getattr(town, name).shape[2:]) for town in towns])
            for name in ("speed_mps", "route_m", "route_speed_mps", "path_m", "later_mps")
        )
        self.brakes = np.flatnonzero((self.speed > 2) & (self.later.min(axis=1) < BRAKING * self.speed))

    def training(self, config: ImitationConfig, step: int) -> Batch:
        """The batch of a step; it depends on seed, step and examples only."""
        rng = np.random.default_rng([config.seed, step, 0x1417])
        chosen = rng.integers(len(self.images), size=config.batch)
        if len(self.brakes):
            share = rng.random(config.batch) < BRAKING_SHARE
            chosen = np.where(share, self.brakes[rng.integers(len(self.brakes), size=config.batch)], chosen)
        images = np.stack([varied(self.images[i], rng) for i in chosen])
        beside = rng.normal(0, 1, (config.batch, 2)) * config.route_noise_m
        dropped = rng.random(config.batch) < ROUTE_DROPPED
        numbers = [self._numbers(i, beside[k], bool(dropped[k])) for k, i in enumerate(chosen)]
        return Batch(images, np.array(numbers, np.float32), self._targets(chosen))

    def measuring(self, count: int) -> Batch:
        """Evenly spread examples without noise."""
        chosen = np.unique(np.linspace(0, len(self.images) - 1, count).astype(np.int64))
        numbers = np.array([self._numbers(i, np.zeros(2), False) for i in chosen], np.float32)
        return Batch(self.images[chosen], numbers, self._targets(chosen))

    def _numbers(self, index: int, beside_m: np.ndarray, dropped: bool) -> np.ndarray:
        known = np.isfinite(self.route_speed[index])
        route = self.route[index][known].astype(np.float64)
        # An offset near the car, and another one far ahead.
        route[:, 1] += beside_m[0] + (beside_m[1] - beside_m[0]) * np.clip(route[:, 0] / 50.0, 0, 1)
        return self.learner.numbers(float(self.speed[index]), route[:0] if dropped else route,
                                    self.route_speed[index][known])  # fmt: skip

    def _targets(self, chosen: Int64[np.ndarray, " b"]) -> Float32[np.ndarray, "b m"]:
        return self.learner.targets(self.path[chosen], self.later[chosen]).astype(np.float32)


def varied(images: UInt8[np.ndarray, "cameras h w 3"], rng: np.random.Generator) -> UInt8[np.ndarray, "cameras h w 3"]:
    """Images of another camera in another light: exposure, tint, contrast, gamma, blur and noise."""
    level = np.arange(256, dtype=np.float64) / 255
    tint = np.exp(rng.normal(0, 0.25)) * np.exp(rng.normal(0, 0.05, 3))
    gamma, contrast = np.exp(rng.normal(0, 0.15)), np.exp(rng.normal(0, 0.15))
    curves = np.clip(0.5 + contrast * (tint * level[:, None] ** gamma - 0.5), 0, 1).astype(np.float32) * 255
    noisy = np.stack([curves[:, channel][images[..., channel]] for channel in range(3)], axis=-1)
    if rng.random() < 0.3:
        noisy[:, :, 1:] = (noisy[:, :, 1:] + noisy[:, :, :-1]) / 2
        noisy[:, 1:] = (noisy[:, 1:] + noisy[:, :-1]) / 2
    # Brightness noise, the same in all three channels: a third of the random numbers.
    noisy += np.float32(rng.uniform(0, 6)) * rng.standard_normal((*images.shape[:3], 1), np.float32)
    return np.where(images.any(axis=-1, keepdims=True), np.clip(noisy, 0, 255), 0).astype(np.uint8)
