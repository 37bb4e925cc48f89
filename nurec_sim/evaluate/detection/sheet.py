"""Contact sheets of protocol ``detection``: boxes of detections on true and on rendered images."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from nurec_sim import sensors
from nurec_sim.evaluate.detection.sights import seen_from_above
from nurec_sim.evaluate.sheet import chosen_targets, lettered, side_by_side, stacked
from nurec_sim.evaluate.windows import Window
from nurec_sim.files.new_files import new_file
from nurec_sim.metrics.detection import match
from nurec_sim.network.detector.codec import Detections
from nurec_sim.network.detector.objects import Labelled, Objects, outlines
from nurec_sim.types import CameraModel

Picture = UInt8[np.ndarray, "h w 3"]
RIGHT, WRONG, IGNORED, MISSED = (40, 220, 60), (255, 60, 50), (150, 150, 150), (255, 200, 40)
NEAR_M = 60.0


def draw_detections(path: Path, window: Window, shown: Mapping[str, Mapping[str, tuple[Picture, Detections]]]) -> None:
    """Writes a sheet as PNG: a row per chosen target, the true image and then one column per method.

    Args:
        path: the file.
        window: its targets have sights.
        shown: image and detections, by method and target.
    """
    rows = []
    for target in chosen_targets(window.targets):
        sight = target.sight
        if sight is None:
            continue
        cells = [lettered(drawn(sight.rgb, sight.camera, sight.objects, sight.found), f"{target.name}  truth")]
        for name, pictures in shown.items():
            rgb, found = pictures[target.name]
            cells.append(lettered(drawn(rgb, sight.camera, sight.objects, found), name))
        rows.append(side_by_side(cells))
    if rows:
        with new_file(path) as file:
            file.write(cv2.imencode(".png", np.ascontiguousarray(stacked(rows)[..., ::-1]))[1].tobytes())


def drawn(rgb: Picture, camera: CameraModel, objects: Labelled, found: Detections) -> Picture:
    """An image with the boxes of detections.

    Right ones are green, wrong ones red, those at objects that do not count grey. Yellow dots are visible objects
    within 60 m that were missed.
    """
    picture = np.ascontiguousarray(rgb).copy()
    owner, taken = match(seen_from_above(found), seen_from_above(objects), objects.visible)
    for edges, one in zip(outlines(camera, found), owner, strict=True):
        colour = IGNORED if one == -2 else WRONG if one == -1 else RIGHT
        if edges is not None:
            cv2.polylines(picture, _lines(edges), False, colour, 1)
    near = np.linalg.norm(objects.ground_m, axis=1) < NEAR_M
    for place in _pixels(camera, objects)[objects.visible & ~taken & near]:
        cv2.circle(picture, (int(place[0]), int(place[1])), 4, MISSED, -1, cv2.LINE_AA)
    return picture


def _lines(corners: Float64[np.ndarray, "8 2"]) -> list[np.ndarray]:
    """The twelve edges of a box."""
    ends = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]
    return [np.rint(corners[list(pair)]).astype(np.int32) for pair in ends]


def _pixels(camera: CameraModel, objects: Objects) -> Float64[np.ndarray, "n 2"]:
    return sensors.project(camera, objects.centre_m)[0] if len(objects) else np.zeros((0, 2))
