"""Several reconstructions of one log, given the same facts: drive, rig, actors and map."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from nurec_sim.errors import RunError
from nurec_sim.types import GaussianScene

SAME_PATH_M = 0.01


def with_common_truth(scenes: Sequence[GaussianScene]) -> list[GaussianScene]:
    """Reconstructions that differ in nothing but what is rendered and in their road-class Gaussians.

    Rig, recorded drive, exposures and map are those of the first scene that has them, the time span is what all cover,
    and the actors are those that the log labelled: what a reconstruction detected by itself is rendered, but is no
    actor. So a policy that sees no rendered sensor drives the same in all of them, bit for bit.

    Args:
        scenes: reconstructions of one log; a single one is returned unchanged.

    Raises:
        RunError: they are not of the same log.
    """
    first = scenes[0]
    if len(scenes) == 1:
        return list(scenes)
    for other in scenes[1:]:
        _check_same_log(first, other)
    span_us = max(scene.span_us[0] for scene in scenes), min(scene.span_us[1] for scene in scenes)
    road_map = next((scene.road_map for scene in scenes if scene.road_map is not None), None)
    actors = tuple(track for track in first.tracks if track.actor and track.labelled)
    return [
        dataclasses.replace(
            scene, id=first.id, rig=first.rig, ego=first.ego, span_us=span_us, road_map=road_map,
            camera_times_us=first.camera_times_us,
            tracks=actors + tuple(dataclasses.replace(t, actor=False) for t in scene.tracks if not t.labelled),
        )
        for scene in scenes
    ]  # fmt: skip


def _check_same_log(first: GaussianScene, other: GaussianScene) -> None:
    def refuse(why: str) -> None:
        raise RunError(f"two scenes named {first.id!r} are not of the same log: {why}")

    labelled = [{track.id for track in scene.tracks if track.actor and track.labelled} for scene in (first, other)]
    if labelled[0] != labelled[1]:
        refuse(f"only one of them has the actors {sorted(labelled[0] ^ labelled[1])[:5]}")
    missing = {*first.rig.cameras, *first.rig.lidars} ^ {*other.rig.cameras, *other.rig.lidars}
    if missing:
        refuse(f"only one of them has the sensors {sorted(missing)}")
    start, end = max(first.span_us[0], other.span_us[0]), min(first.span_us[1], other.span_us[1])
    if start >= end:
        refuse(f"their times {first.span_us} and {other.span_us} us do not overlap")
    times = np.linspace(start, end - 1, 50).astype(np.int64)
    apart = np.linalg.norm((first.ego.at(times) - other.ego.at(times))[:, :3, 3], axis=1).max()
    if apart > SAME_PATH_M:
        refuse(f"their recorded drives are up to {apart:.2f} m apart")
