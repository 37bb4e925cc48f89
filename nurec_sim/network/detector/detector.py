"""Finds vehicles and people in camera images."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, UInt8

from nurec_sim.errors import WeightsError
from nurec_sim.network.checkpoints.state_dicts import load_weights, read_metadata
from nurec_sim.network.detector.codec import Detections, decode, look
from nurec_sim.network.detector.model import DetectorNetwork
from nurec_sim.network.detector.objects import KINDS
from nurec_sim.types import CameraModel

SHIPPED = Path(__file__).parents[1] / "weights" / "detector.safetensors"
SCORES = "scores"
"""Key of the thresholds in the facts of a weights file."""


class Detector:
    """A trained detector; the same image always gives the same detections on one machine.

    Args:
        weights: the file; the shipped one if None.

    Raises:
        WeightsError: it is not there, damaged, of another network, or without thresholds.
    """

    def __init__(self, weights: Path | None = None) -> None:
        path = SHIPPED if weights is None else Path(weights)
        self.network = DetectorNetwork()
        load_weights(self.network, path, "detector")
        self.network.eval()
        try:
            self.scores: Float64[np.ndarray, " kinds"] = np.array(json.loads(read_metadata(path)[SCORES]), np.float64)
        except (KeyError, ValueError):
            raise WeightsError(f"{path} has no thresholds of the scores") from None
        if self.scores.shape != (len(KINDS),):
            raise WeightsError(f"{path} has {self.scores.size} thresholds of scores instead of {len(KINDS)}")

    def detect(self, rgb: UInt8[np.ndarray, "h w 3"], camera: CameraModel) -> Detections:
        """Objects in an image, in the frame of its camera, whose scores reach the threshold.

        Args:
            rgb: the image.
            camera: any lens; the image is resized, and freed of distortion, to what the network was trained for.
        """
        return detections(self.network, rgb, camera).above(self.scores)


def detections(network: DetectorNetwork, rgb: UInt8[np.ndarray, "h w 3"], camera: CameraModel) -> Detections:
    """Detections of all scores."""
    seen = look(rgb, camera)
    with torch.no_grad():
        images = torch.from_numpy(seen.rgb.transpose(2, 0, 1).copy())[None]
        heat, numbers = network(images, torch.from_numpy(seen.coordinates)[None])
    return decode(heat[0].sigmoid().numpy(), numbers[0].numpy(), seen.lens)


@lru_cache(maxsize=1)
def shipped_detector() -> Detector:
    """The detector of this package."""
    return Detector()
