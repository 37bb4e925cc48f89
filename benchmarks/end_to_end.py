"""Drives policies through held-out towns in the true world: who collides, who leaves the road, who stays behind."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass

import numpy as np
import tyro

from nurec_sim.metrics.aggregate import rollout_values
from nurec_sim.metrics.score import score_rollout
from nurec_sim.metrics.table import metric_table
from nurec_sim.plugins import load_policy
from nurec_sim.runs.added_actors import added_actors
from nurec_sim.sim import load_scenario, run_rollout, scenario_file
from nurec_sim.types import DynamicGaussians, Gaussians, GaussianScene, Rollout
from nurec_sim.world import TownNetwork, TownPlan, TrueWorld, street_rig, town_plan

FAMILIES = (("curve", "study_drive"), ("s_curve", "start_offset"), ("narrowing", "study_drive"),
            ("x_junction", "study_drive"), ("roundabout", "study_drive"), ("straight", "hard_brake"))  # fmt: skip
NAMES = {"collision_any": "collided", "collision_at_fault": "at fault", "offroad": "off the road"}


@dataclass(frozen=True)
class Options:
    """Drive policies through towns of the split test, among their traffic, and print one table.

    Args:
        policies: names or files.
        seeds: of the towns; every one is made with each of six road templates.
        seconds: simulated.
    """

    policies: tuple[str, ...] = (
        "constant_velocity", "blind_route", "camera_road_follower", "e2e_1cam", "e2e_2cam", "e2e_4cam",
        "route_follower",
    )  # fmt: skip
    seeds: tuple[int, ...] = (31,)
    seconds: float = 12.0


def main() -> int:
    """Prints the table; 1 if a rollout failed."""
    options = tyro.cli(Options, description=Options.__doc__)
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in options.policies}
    failed = 0
    for template, scenario_name in FAMILIES:
        for seed in options.seeds:
            plan = town_plan(seed, "test", template, options.seconds)
            base, scene = load_scenario(scenario_name), facts(plan)
            added = added_actors(base, scene, scenario_file(scenario_name).parent)
            scene = added.in_facts(scene)
            with TrueWorld(added.in_town(plan)) as world:
                for name in options.policies:
                    since = time.perf_counter()
                    rollout = run_rollout(base, load_policy(name), world.sense, scene, seed=seed)
                    took = time.perf_counter() - since
                    failed += rollout.status != "ok"
                    values = scored(rollout, scene)
                    rows[name].append(values)
                    shown = ", ".join(f"{key} {value:.2f}" for key, value in values.items())
                    print(f"{template}-{seed} {name}: {rollout.error or shown}, {took:.0f} s", flush=True)
    count = len(FAMILIES) * len(options.seeds)
    print(f"\n| policy | {' | '.join(f'{text}, of {count}' for text in NAMES.values())} "
          "| progress | distance to the recorded drive, m |\n|---|---|---|---|---|---|")  # fmt: skip
    for name, found in rows.items():
        flags = " | ".join(f"{np.nansum([values[key] for values in found]):.0f}" for key in NAMES)
        progress, apart = (np.nanmean([values[key] for values in found]) for key in ("progress", "apart"))
        print(f"| `{name}` | {flags} | {progress:.2f} | {apart:.2f} |")
    return int(failed > 0)


def facts(plan: TownPlan) -> GaussianScene:
    """What the loop and the metrics know of a town, with the cameras of the demo and nothing to render."""
    return GaussianScene(
        id=f"town-{plan.seed}", static=Gaussians.empty(), dynamic=DynamicGaussians.empty(),
        sky=np.zeros((6, 1, 1, 3), np.float32), isp={}, rig=street_rig(224, 128), ego=plan.ego_trajectory(),
        tracks=tuple(plan.tracks()), road_map=TownNetwork(plan).road_map(), span_us=plan.span_us,
        camera_times_us={}, provenance={"method": "truth", "unknown": []},
    )  # fmt: skip


def scored(rollout: Rollout, scene: GaussianScene) -> dict[str, float]:
    """The metrics of the table."""
    series = score_rollout(rollout, None, scene.road_map, actors_known=True)
    table = rollout_values(metric_table([(rollout, series)], "benchmark"), offroad="offroad_true")
    by_name = dict(zip(table["name"], table["value"], strict=True))
    wanted = {**{name: name for name in NAMES}, "progress": "progress", "apart": "dist_to_gt_trajectory"}
    return {key: float("nan") if by_name[name] is None else float(by_name[name]) for key, name in wanted.items()}


if __name__ == "__main__":
    sys.exit(main())
