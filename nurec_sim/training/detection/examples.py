"""Batches for the detector: crops of generated images in another light, mirrored or not, with their maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from nurec_sim.network.detector.codec import encode, ray_tangents
from nurec_sim.network.detector.objects import FOCAL_PX, Labelled
from nurec_sim.training.detection.config import DetectorConfig
from nurec_sim.training.detection.images import SIZE_PX, TownImages
from nurec_sim.training.imitation.examples import varied
from nurec_sim.types import Pinhole

CROP_PX = 320, 192
SOFT, SOFTEST = 0.3, 2.2
"""Share of images that lose detail, as renderings do, and by how much their size shrinks at most on the way."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Inputs and answers of the network (``codec``)."""

    images: UInt8[np.ndarray, "b 3 h w"]
    tangents: Float32[np.ndarray, "b 2 h w"]
    heat: Float32[np.ndarray, "b kinds h w"]
    weight: Float32[np.ndarray, "b kinds h w"]
    numbers: Float32[np.ndarray, "b numbers h w"]
    known: Bool[np.ndarray, "b h w"]


class Examples:
    """All images of some towns."""

    def __init__(self, towns: Sequence[TownImages]) -> None:
        self.images = np.concatenate([town.images for town in towns])
        self.objects = [town.of_image(k) for town in towns for k in range(len(town.images))]

    def training(self, config: DetectorConfig, step: int) -> Batch:
        """The batch of a step; it depends on seed, step and images only."""
        rng = np.random.default_rng([config.seed, step, 0xDE7])
        chosen = rng.integers(len(self.images), size=config.batch)
        return _together([self._sample(int(index), rng) for index in chosen])

    def _sample(self, index: int, rng: np.random.Generator) -> tuple[np.ndarray, Pinhole, Labelled]:
        image, objects = self.images[index], self.objects[index]
        left, top = (int(rng.integers(whole - part + 1)) for whole, part in zip(SIZE_PX, CROP_PX, strict=True))
        image = image[top : top + CROP_PX[1], left : left + CROP_PX[0]]
        lens = Pinhole(FOCAL_PX, FOCAL_PX, SIZE_PX[0] / 2 - left, SIZE_PX[1] / 2 - top)
        if rng.random() < 0.5:
            image, lens, objects = mirrored(image, lens, objects)
        image = varied(image[None], rng)[0]
        return (_softened(image, rng) if rng.random() < SOFT else image), lens, objects


def mirrored(
    image: UInt8[np.ndarray, "h w 3"], lens: Pinhole, objects: Labelled
) -> tuple[UInt8[np.ndarray, "h w 3"], Pinhole, Labelled]:
    """A view with left and right exchanged."""
    centre, heading = objects.centre_m * np.array([-1.0, 1.0, 1.0]), -objects.heading_rad
    other = Pinhole(lens.fx_px, lens.fy_px, image.shape[1] - lens.cx_px, lens.cy_px)
    return image[:, ::-1], other, replace(objects, centre_m=centre, heading_rad=heading)


def _softened(image: UInt8[np.ndarray, "h w 3"], rng: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    factor, (width, height) = rng.uniform(1.2, SOFTEST), CROP_PX
    small = cv2.resize(image, (round(width / factor), round(height / factor)), interpolation=cv2.INTER_AREA)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)


def _together(samples: Sequence[tuple[np.ndarray, Pinhole, Labelled]]) -> Batch:
    maps = [encode(objects, lens, *CROP_PX) for _, lens, objects in samples]
    return Batch(
        np.ascontiguousarray(np.stack([image for image, _, _ in samples]).transpose(0, 3, 1, 2)),
        np.stack([ray_tangents(lens, *CROP_PX) for _, lens, _ in samples]),
        *(np.stack([getattr(each, name) for each in maps]) for name in ("heat", "weight", "numbers", "known")),
    )
