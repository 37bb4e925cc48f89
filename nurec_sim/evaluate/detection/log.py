"""The detector on the images of a recorded log and on a scene's renderings of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from nurec_sim import geometry
from nurec_sim.evaluate.detection.sheet import drawn
from nurec_sim.evaluate.detection.sights import Detect, Sight, detect
from nurec_sim.evaluate.detection.summary import detection_figures
from nurec_sim.evaluate.image_scores import image_request
from nurec_sim.files.new_files import new_file
from nurec_sim.logs.held_out import HeldOut
from nurec_sim.network.detector.objects import KIND_OF_LABEL, labelled_objects
from nurec_sim.types import CameraFrame, CameraModel, Clip, Sense

FRONT_DEG = 35.0
"""Cameras whose axis is within this angle of the car's are asked: the detector learnt with cameras that look ahead."""
CAVEAT = "The detector learnt in generated towns and never saw a real image: compare the two rows, not their level."


def score_log_detections(
    clip: Clip,
    targets: Sequence[str],
    held: HeldOut,
    sense: Sense,
    images_dir: Path | None = None,
    report: Callable[[float], None] | None = None,
    detector: Detect = detect,
) -> dict[str, Any]:
    """Precision, recall and consistency on a log, whose boxes are the truth.

    Args:
        clip: the log.
        targets: cameras that are scored; those that look ahead take part.
        held: what was held out; these images are scored, or all if there are none.
        sense: renders the scene.
        images_dir: folder for images with boxes, recorded on top, rendered below; None writes none.
        report: called with the share done.
        detector: the shipped one by default.

    Returns:
        ``images``, ``caveat``, and ``figures`` (``summary.detection_figures``, ``true_`` for recorded images). If
        there is nothing to compare with only ``not_known``, the reason.
    """
    cameras = [name for name in targets if _ahead(clip.rig.cameras[name])]
    if not any(track.label in KIND_OF_LABEL for track in clip.tracks) or not cameras:
        why = "no target camera looks ahead" if not cameras else "the log has no boxes of vehicles or people"
        return {"not_known": why}
    views = [
        (name, index)
        for name in cameras
        for index in sorted(held.images.get(name, ())) or range(len(clip.camera_times_us(name)))
    ]
    records = []
    for done, (name, index) in enumerate(views):
        if report is not None:
            report(done / len(views))
        request, camera = image_request(clip, name, index), clip.rig.cameras[name]
        middle_us = (request.start_us + request.end_us) // 2
        (pose,) = geometry.interpolate_pose_pair(request.world_from_sensor, np.array([0.5]))
        sight = Sight(clip.image(name, index), camera, labelled_objects(clip.tracks, middle_us, camera, pose), detector)
        (frame,) = sense([request])
        assert isinstance(frame, CameraFrame)
        found = detector(frame.rgb, camera)
        records.append(sight.record(found))
        if images_dir is not None:
            pair = [
                drawn(rgb, camera, sight.objects, each) for rgb, each in ((sight.rgb, sight.found), (frame.rgb, found))
            ]
            with new_file(images_dir / f"{name}_{index:04d}_detections.png") as file:
                file.write(cv2.imencode(".png", np.ascontiguousarray(np.vstack(pair)[..., ::-1]))[1].tobytes())
    return {"images": len(views), "caveat": CAVEAT, "figures": detection_figures(records)}


def _ahead(camera: CameraModel) -> bool:
    return bool(camera.rig_from_camera[0, 2] >= np.cos(np.deg2rad(FRONT_DEG)))
