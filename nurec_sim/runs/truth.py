"""Driving in the original world: the same scene, but rendered by the town in which its log was recorded.

It is the reference for rollouts in reconstructions of that log.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from nurec_sim.errors import ClipError, RunError
from nurec_sim.runs.added_actors import AddedActors
from nurec_sim.types import GaussianScene, Sense
from nurec_sim.world import TownPlan, TrueWorld

TRUTH = "truth"
"""Name of the original world among the reconstructions of a run."""
SAME_PLACE_M = 0.01


@contextmanager
def true_world(
    plan_file: str | Path, scene: GaussianScene, backend: str | None = None, added: AddedActors | None = None
) -> Iterator[tuple[GaussianScene, Sense]]:
    """The town of a plan as a scene.

    Args:
        plan_file: ``plan.json`` of a ground truth folder (docs/world.md).
        scene: any reconstruction of that town's log; metrics use its sensors, tracks, map and road, so that only the
            rendering differs.
        backend: see ``world.TrueWorld``.
        added: actors of the scenario, which the scene has.

    Yields:
        The scene with reconstruction name ``truth``, and the town's ``sense``.

    Raises:
        RunError: the file cannot be read or is not a plan, or the scene is not from that town's log.
    """
    try:
        plan = TownPlan.from_json(Path(plan_file).read_text(encoding="utf-8"))
    except ClipError as error:
        raise RunError(f"{plan_file}: {error}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"{plan_file}: the town plan cannot be read: {error}") from None
    if added is not None:
        plan = added.in_town(plan)
    _check_same_town(plan, scene)
    with TrueWorld(plan, backend) as world:
        provenance = {**scene.provenance, "method": TRUTH}
        yield dataclasses.replace(scene, provenance=provenance), world.sense


def _check_same_town(plan: TownPlan, scene: GaussianScene) -> None:
    unknown = sorted({track.id for track in scene.tracks if track.actor} - {actor.id for actor in plan.actors})
    if unknown:
        raise RunError(f"scene {scene.id!r} is not from this town: the plan has no actor {unknown[0]!r}")
    driven = plan.ego_trajectory()
    times = scene.ego.t_us
    if not (driven.covers(int(times[0])) and driven.covers(int(times[-1]))):
        raise RunError(f"scene {scene.id!r} is not from this town: it lasts from {times[0]} to {times[-1]} us, "
                       f"the plan from {driven.start_us} to {driven.end_us} us")  # fmt: skip
    off = float(np.linalg.norm(driven.at(times)[:, :3, 3] - scene.ego.position_m, axis=1).max())
    if off > SAME_PLACE_M:
        raise RunError(f"scene {scene.id!r} is not from this town: its ego is up to {off:.2f} m beside the plan's")
