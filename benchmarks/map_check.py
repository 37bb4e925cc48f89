"""AlpaSim's off-road rule on ``map.xodr`` against the drivable polygon: the demo log and procedural towns.

    python benchmarks/map_check.py [--carla PYTHON] [--placements 900]

Exit status 1 if a map agrees on less than 98 % of the placements, or alarms on a recorded pose.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from nurec_sim.logs import open_clip
from nurec_sim.scene.interop.validate.alpasim_map import AlpasimMap
from nurec_sim.scene.interop.validate.map_agreement import LEAST_SHARE, PLACEMENTS, agreement
from nurec_sim.scene.opendrive.road_area import drivable_area
from nurec_sim.scene.opendrive.writer import opendrive_map
from nurec_sim.types import Box, RoadMap, Trajectory
from nurec_sim.world import TownNetwork, street_rig, town_plan

TOWNS = ((1, "train", "x_junction"), (5, "test", "roundabout"), (4, "train", "s_curve"), (9, "test", "double_junction"),
         (7, "train", "narrowing"), (8, "train", "slip_road"))  # fmt: skip
CARLA = """import sys, carla
for path in sys.argv[1:]:
    waypoints = carla.Map(path, open(path).read()).generate_waypoints(2.0)
    print(len({point.road_id for point in waypoints}), len(waypoints))
"""


def cases() -> Iterator[tuple[str, RoadMap, Trajectory, Box]]:
    """Name, map, recorded path and body of the car."""
    clip = open_clip(Path(__file__).parent.parent / "scenarios" / "demo_clip.zip")
    assert clip.road_map is not None
    yield "demo", clip.road_map, clip.ego, clip.rig.body
    for seed, split, template in TOWNS:
        plan = town_plan(seed, split, template)
        yield f"{template} {split} {seed}", TownNetwork(plan).road_map(), plan.ego_trajectory(), street_rig().body


def main() -> int:
    """Prints a table; returns the exit status."""
    flags = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    flags.add_argument("--placements", type=int, default=PLACEMENTS)
    flags.add_argument("--carla", help="a Python interpreter with the carla package")
    given = flags.parse_args()
    good = True
    print(
        "| map | climb m | agreement | judged | false alarms | misses | alarms on the path | kB "
        "| CARLA: roads, waypoints |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for name, road_map, ego, body in cases():
        data = opendrive_map(name, road_map, ego)
        assert data is not None
        roads = AlpasimMap(ElementTree.fromstring(data))
        area, box = drivable_area(road_map), (np.array(body.center_m), np.array(body.size_m))
        found = agreement(roads, area, ego.world_from_body, *box, given.placements)
        good &= found.share >= LEAST_SHARE and found.alarms_on_path == found.poses_off_lanes == 0
        climb_m = np.ptp(np.concatenate(road_map.lanes)[:, 2])
        parsed = "-" if given.carla is None else carla_reads(given.carla, data)
        print(f"| {name} | {climb_m:.1f} | {found.share:.1%} | {found.judged} | {found.false_alarms} | {found.misses} "
              f"| {found.alarms_on_path} | {len(data) / 1000:.0f} | {parsed} |")  # fmt: skip
    return 0 if good else 1


def carla_reads(python: str, data: bytes) -> str:
    """How many driving roads and waypoints (every 2 m) CARLA finds."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.xodr"
        path.write_bytes(data)
        done = subprocess.run([python, "-c", CARLA, str(path)], capture_output=True, text=True)
    return ", ".join(done.stdout.split()) if done.returncode == 0 else "refused"


if __name__ == "__main__":
    sys.exit(main())
