"""Rules for our own reader, and the limitations of a scene that it reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nurec_sim.scene.archive import archive_faults
from nurec_sim.scene.formats import is_foreign, read_scene
from nurec_sim.scene.interop.validate.finding import Report, Rule
from nurec_sim.types import GaussianScene, Label

RULES = {
    "reads": Rule(
        "error",
        "an archive of ours (docs/scene_format.md) or one that it can read (docs/foreign_scenes.md)",
        "the scene cannot be rendered",
    ),
    "unchanged": Rule("warning", "members as they were written", "other programs see something else than we do"),
    "known": Rule("warning", "a file that tells it", "a default stands for it, or it is left out"),
    "gaussians": Rule("warning", "Gaussians", "every image is empty but for the sky"),
    "road": Rule("warning", "Gaussians of class road", "off-road cannot be judged from the scene"),
    "intensity": Rule("warning", "Gaussians with a LiDAR intensity", "LiDAR frames have no intensity"),
    "cameras": Rule("warning", "a camera in the rig", "clients find no camera to render"),
    "drive": Rule("warning", "a path of two poses or more", "there is no drive to replay"),
}


def check(report: Report, path: Path) -> GaussianScene | None:
    """Adds the findings for our reader; returns the scene if it can be read."""
    scene = None
    with report.rule("reads"):
        scene = read_scene(path)
        if not is_foreign(path):
            for fault in archive_faults(path):
                report.add("unchanged", fault.removeprefix(f"{path}: "))
        for text in scene.provenance.get("unknown", ()):
            report.add("known", f"not known: {text}")
        _check_use(report, scene)
    return scene


def _check_use(report: Report, scene: GaussianScene) -> None:
    if not len(scene.static) and not len(scene.dynamic):
        report.add("gaussians", "the scene is empty")
    elif not (scene.static.label == Label.ROAD).any():
        report.add("road", f"none of {len(scene.static):,} static Gaussians is road")
    if scene.rig.lidars and not np.isfinite(scene.static.intensity).any():
        report.add("intensity", f"the rig has {len(scene.rig.lidars)} LiDARs, but no Gaussian knows its intensity")
    if not scene.rig.cameras:
        report.add("cameras", "the rig has no camera")
    if len(scene.ego.t_us) < 2:
        report.add("drive", "the recorded path has one pose")
