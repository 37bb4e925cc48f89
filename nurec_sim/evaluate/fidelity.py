"""A short measure of how true a reconstruction is, for the report of a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from nurec_sim.evaluate.image_scores import BEST_DB, image_request
from nurec_sim.evaluate.lidar_scores import score_sweeps
from nurec_sim.evaluate.log import score_road
from nurec_sim.evaluate.scores.images import psnr, ssim
from nurec_sim.logs import hold_out
from nurec_sim.logs.alignment import aligned_as
from nurec_sim.types import CameraFrame, Clip, GaussianScene, Sense

IMAGES, SWEEPS = 8, 4
"""Images per camera and sweeps that are compared, evenly spaced."""


def measure_fidelity(
    clip: Clip, scene: GaussianScene, sense: Sense, hold_out_every: int, progress: Callable[[str, float], None]
) -> dict[str, Any]:
    """Compares what a scene renders with what its log recorded; ``evaluate.score_scene`` measures more.

    Args:
        clip: the log.
        scene: its reconstruction.
        sense: renders it.
        hold_out_every: every N-th image, and the sweeps taken with it, were kept out of the reconstruction; 0 for none:
            then images and sweeps that it was made from are compared.
        progress: called with a stage and the fraction done.

    Returns:
        JSON-ready figures: ``held_out``, ``images``, ``psnr_db``, ``ssim``, ``sweeps``, ``range_error_m`` (median),
        ``return_recall``; ``road`` as in ``metrics.road_agreement``, None without a map.
    """
    clip = aligned_as(clip, scene)
    cameras = [camera for camera in scene.provenance.get("cameras", scene.rig.cameras) if camera in clip.rig.cameras]
    held = hold_out(clip, cameras, images_every=hold_out_every)
    jobs = [
        (camera, index)
        for camera in cameras
        for index in _spread(
            sorted(held.images[camera]) if hold_out_every else range(len(clip.camera_times_us(camera))), IMAGES
        )
    ]
    scores = []
    for done, (camera, index) in enumerate(jobs):
        progress("comparing images with the log", 0.7 * done / len(jobs))
        (frame,) = sense([image_request(clip, camera, index)])
        assert isinstance(frame, CameraFrame)
        recorded = clip.image(camera, index)
        scores.append((min(psnr(frame.rgb, recorded), BEST_DB), ssim(frame.rgb, recorded)))
    most = max((len(clip.sweep_times_us(lidar)) for lidar in clip.rig.lidars), default=0)
    sweeps = _spread(sorted(held.sweeps) if hold_out_every else range(most), SWEEPS)
    lidar: dict[str, object] = {}
    if sweeps:
        lidar = score_sweeps(
            clip, scene.rig.lidars, sweeps, sense, lambda stage, share: progress(stage, 0.7 + 0.3 * share)
        )
    means = np.mean(scores, axis=0).tolist() if scores else [None, None]
    return {
        "held_out": bool(hold_out_every), "images": len(scores), "psnr_db": means[0], "ssim": means[1],
        "sweeps": len(sweeps), "range_error_m": lidar.get("median_abs_range_error_m"),
        "return_recall": lidar.get("return_recall"), "road": score_road(scene),
    }  # fmt: skip


def _spread(indices: range | list[int], most: int) -> list[int]:
    """At most so many of the indices, evenly spaced."""
    places = np.unique(np.linspace(0, len(indices) - 1, min(most, len(indices))).round().astype(int))
    return [int(indices[place]) for place in places]
