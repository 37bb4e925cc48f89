"""Does the road of a reconstruction lie where the town's road is? Off-road from its Gaussians against the true map.

Rollouts of a study are judged by the map. Users' logs often have none, and are judged by the Gaussians.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nurec_sim import logs
from nurec_sim.metrics.offroad_agreement import RoadAgreement, road_agreement
from nurec_sim.runs.scene_file import load_scene_record
from nurec_sim.runs.truth import TRUTH
from nurec_sim.study.config import StudyConfig
from nurec_sim.study.tasks import LOG, Task


@dataclass(frozen=True)
class Road:
    """Agreement of one reconstruction with the map over the scenes of a study (``metrics.RoadAgreement``).

    ``agreement`` and ``unknown_frac`` are means over scenes, ``least`` is the agreement in the worst scene,
    ``boundary_bias_m`` the median over scenes, and ``worst_bias_m`` the largest, with its sign. ``without_road`` counts
    scenes in which no Gaussian is road; they are in no other figure.
    """

    scenes: int
    without_road: int
    agreement: float
    least: float
    unknown_frac: float
    boundary_bias_m: float
    worst_bias_m: float


def measure_roads(folder: Path, config: StudyConfig) -> dict[str, Road]:
    """By reconstruction, in the order of the study; without those that have no road in any scene.

    Args:
        folder: of a study whose rollouts are finished.
        config: the study.

    Raises:
        RunError: the record of a scene cannot be read.
        ClipError: a log cannot be read.
    """
    measured: dict[str, list[RoadAgreement | None]] = {}
    for scene in config.scenes:
        task = Task(folder, config, *scene)
        clip = logs.open_clip(task.scene_folder / LOG)
        for world in config.worlds:
            if world == TRUTH:
                continue
            grid = load_scene_record(dataclasses.replace(task, world=world).world_folder).grid
            found = None if grid is None else road_agreement(grid, clip.road_map, clip.ego, clip.rig.body)
            measured.setdefault(world, []).append(found)
    return {world: _over_scenes(found) for world, found in measured.items() if any(found)}


def _over_scenes(found: Sequence[RoadAgreement | None]) -> Road:
    known = [each for each in found if each is not None]
    agreement, unknown, bias = np.array([(e.agreement, e.unknown_frac, e.boundary_bias_m) for e in known]).T
    return Road(
        len(found), len(found) - len(known), float(np.nanmean(agreement)), float(np.nanmin(agreement)),
        float(unknown.mean()), float(np.nanmedian(bias)), float(bias[np.nanargmax(np.abs(bias))]),
    )  # fmt: skip
