"""An image with labelled objects, what the detector finds in it, and in a rendered one from the same pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import UInt8

from nurec_sim.metrics.detection import Places, agreement, count
from nurec_sim.network.detector.codec import Detections
from nurec_sim.network.detector.objects import KINDS, Labelled, Objects
from nurec_sim.types import CameraModel

Image = UInt8[np.ndarray, "h w 3"]
Detect = Callable[[Image, CameraModel], Detections]


def detect(rgb: Image, camera: CameraModel) -> Detections:
    """What the shipped detector finds."""
    from nurec_sim.network.detector.detector import shipped_detector

    return shipped_detector().detect(rgb, camera)


@dataclass(frozen=True, eq=False)
class Sight:
    """A true image at its full size, its camera and the objects before it."""

    rgb: Image
    camera: CameraModel
    objects: Labelled
    detector: Detect = field(default=detect)

    @cached_property
    def found(self) -> Detections:
        """Detections on the true image."""
        return self.detector(self.rgb, self.camera)

    def record(self, found: Detections) -> dict[str, Any]:
        """Counts of an image from the same pose, plain JSON.

        Args:
            found: detections on that image.

        Returns:
            ``rendered`` and ``true``: detections on either image against the objects (``metrics.detection.count``);
            ``kept``: detections on the true image, and how many of them are in the other; ``backed``: the reverse.
        """
        there, visible = seen_from_above(self.objects), self.objects.visible
        rendered, true = seen_from_above(found), seen_from_above(self.found)
        return {
            "rendered": count(rendered, there, visible, KINDS),
            "true": count(true, there, visible, KINDS),
            "kept": agreement(true, rendered, KINDS),
            "backed": agreement(rendered, true, KINDS),
        }


def seen_from_above(objects: Objects) -> Places:
    """Places relative to the camera, in the plane of its right and its optical axis."""
    return Places(objects.kind, objects.ground_m)
