"""Closed-loop speed on the demo log: a policy with a camera, policies without sensors, and the whole demonstration.

    python benchmarks/driving.py [--seconds 10]

CPU seconds are those of this process, which renders, serves, drives and encodes, over all its threads: on a shared
machine they say more than wall time. The scene is reconstructed once and cached.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nurec_sim import runs, sim
from nurec_sim.metrics import read_table
from nurec_sim.serving.client import RemoteSensors
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore
from nurec_sim.types import GaussianScene, Sense

BARS = {
    "camera at 10 Hz, video": "at least 1.5 rollout seconds per CPU second",
    "no sensors, no video": "at least 100 rollout seconds per CPU second",
    "demo, videos": "at most 80 CPU seconds",
}
OUT = Path("build/bench_driving.json")


def main() -> None:
    """Measures, prints a table and writes it as JSON."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seconds", type=float, default=10.0, help="length of a rollout")
    seconds = options.parse_args().seconds
    demo = sim.scenario_file("demo")
    scenario = sim.load_scenario(demo)
    store = SceneStore([demo.parent / str(scenario.clip)], device="cpu")
    scene = store.get(store.ids[0]).scene
    at_10_hz = {"name": "bench", "duration_s": seconds, "replan_s": 0.1}
    at_2_hz = {**at_10_hz, "replan_s": 0.5}
    with SensorServer(store, port=0) as address, RemoteSensors(address, scene.id) as sensors:
        drive(scene, sensors.sense, {**at_10_hz, "duration_s": 1.0}, ["camera_road_follower"], True)  # compiles kernels
        rows = {
            "camera at 10 Hz, video": drive(scene, sensors.sense, at_10_hz, ["camera_road_follower"], True),
            "camera at 10 Hz, no video": drive(scene, sensors.sense, at_10_hz, ["camera_road_follower"], False),
            "no sensors, no video": drive(scene, sensors.sense, at_2_hz, ["log_replay", "constant_velocity"], False),
            "true actors, no video": drive(scene, sensors.sense, at_2_hz, ["route_follower"], False),
            "demo, videos": drive(scene, sensors.sense, scenario.model_dump(), list(scenario.policies), True),
        }
    for name, row in rows.items():
        print(f"{name:28s} {row['rollouts']} rollouts, {row['rollout_s']:5.1f} s: {row['cpu_s']:6.2f} CPU s, "
              f"{row['wall_s']:6.2f} wall s, {row['rollout_s'] / row['cpu_s']:6.2f} rollout s per CPU s"
              f"{'   bar: ' + BARS[name] if name in BARS else ''}")  # fmt: skip
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps(rows, indent=1) + "\n")
    print(f"wrote {OUT}")


def drive(
    scene: GaussianScene, sense: Sense, scenario: dict[str, Any], policies: Sequence[str], video: bool
) -> dict[str, float]:
    """Drives every policy once; the time includes videos, the road grid, metrics and the report.

    Args:
        scene: the scene.
        sense: renders it.
        scenario: keys of a scenario.
        policies: names.
        video: whether the front camera is recorded.
    """
    with tempfile.TemporaryDirectory() as folder:
        loaded = runs.load_policies(policies)
        made = sim.make_scenario(scenario, source="benchmark")
        wall, cpu = time.perf_counter(), time.process_time()
        if video or scenario["name"] == "demo":
            run = runs.execute([scene], made, loaded, lambda _: sense, folder, video=video)
            table = read_table(run / "metrics.parquet").filter(name="eval_relevant")
            driven_us = sum(part["timestamps_us"].max() - part["timestamps_us"].min()
                            for part in table.partition_by("rollout_id"))  # fmt: skip
        else:
            rollouts = [sim.run_rollout(made, policy.host, sense, scene) for policy in loaded]
            driven_us = sum(int(rollout.t_us[-1] - rollout.t_us[0]) for rollout in rollouts)
        row = {"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}
        for policy in loaded:
            policy.host.close()
    return {"rollouts": len(policies), "rollout_s": driven_us / 1e6, **row}


if __name__ == "__main__":
    main()
