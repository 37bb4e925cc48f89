"""How much of what a policy's cameras showed rests on recorded views (``render.support``): ``support.json``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from nurec_sim.errors import ArchiveError, RunError
from nurec_sim.files.new_files import write_file
from nurec_sim.render.support import Support
from nurec_sim.scene import codec
from nurec_sim.sim import Scenario
from nurec_sim.sim.actors import edited_actors
from nurec_sim.sim.policy_sensors import SensorSuite
from nurec_sim.sim.rollout import timeline
from nurec_sim.types import GaussianScene, Needs, Rollout, SensorRequest

DIGITS = 4


def seen_support(
    rollout: Rollout, scene: GaussianScene, scenario: Scenario, needs: Needs, support: Support
) -> dict[int, float]:
    """Mean support of the images that a policy got, by the time of its plans in microseconds.

    Args:
        rollout: the rollout.
        scene: what was driven in.
        scenario: its sensors and edited actors.
        needs: of the policy; without cameras there is nothing to say.
        support: of the scene.
    """
    cameras = [SensorSuite(needs, scenario.sensors, scene).cameras[name] for name in needs.cameras]
    start_us = timeline(scenario, scene).start_us
    actors = edited_actors(scenario, scene.id, scene.ego, scene.tracks, start_us, rollout.seed).overrides
    found = {}
    poses = dict(zip(rollout.t_us.tolist(), rollout.world_from_rig, strict=True))
    for t_us, _ in rollout.plans if cameras else ():
        # Exposures end at planning time (``sim.policy_sensors``), and plans are made at states.
        maps = []
        for camera in cameras:
            pose = poses[t_us] @ camera.rig_from_camera
            request = SensorRequest(scene.id, camera, t_us, t_us + 1, np.stack([pose, pose]), actors(t_us, t_us))
            maps.append(support.map(request).reshape(-1))
        found[t_us] = round(float(np.concatenate(maps).mean(dtype=np.float64)), DIGITS)
    return found


def save_support(found: dict[int, float], path: Path) -> None:
    """Writes the result of ``seen_support``."""
    write_file(path, json.dumps({"t_us": list(found), "support": list(found.values())}) + "\n")


def load_support(path: Path) -> dict[int, float]:
    """Reads a file of ``save_support``; empty if there is none, as in older run folders.

    Raises:
        RunError: it is damaged.
    """
    if not path.exists():
        return {}
    try:
        facts = codec.load(path.read_bytes(), str(path))
        times, values = (
            codec.sequence(codec.integer)(facts["t_us"]),
            codec.numbers(len(facts["t_us"]))(facts["support"]),
        )
    except (OSError, TypeError, KeyError, ValueError, ArchiveError) as error:
        raise RunError(f"{path} is not a readable record of support: {type(error).__name__}: {error}") from error
    if not all(0 <= value <= 1 for value in values) or any(b <= a for a, b in zip(times, times[1:], strict=False)):
        raise RunError(f"{path}: support must lie in 0..1, at rising times")
    return dict(zip(times, values, strict=True))
