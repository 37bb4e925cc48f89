"""Which faults `nurec-sim inspect` finds when it is given logs that were spoilt on purpose.

    python benchmarks/inspect_faults.py CLIP...

Each row of the table is one way to spoil a log, applied to one camera after the other where it is about cameras. The
first row is the log as it is: nothing may be found there.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from nurec_sim import geometry, logs
from nurec_sim.logs.checks.boxes import check_boxes
from nurec_sim.logs.checks.calibration import check_calibration
from nurec_sim.logs.checks.ground import check_ground
from nurec_sim.logs.checks.sampling import sample_sweeps
from nurec_sim.types import Rig, Trajectory

GROUND_M = 0.93


def turn(axis: int, degrees: float) -> np.ndarray:
    """A turn about one axis, 4x4."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix, (a, b) = np.eye(4), ((axis + 1) % 3, (axis + 2) % 3)
    matrix[[a, a, b, b], [a, b, a, b]] = c, -s, s, c
    return matrix


Spoil = Callable[[logs.Clip, np.ndarray], np.ndarray]
CAMERAS: dict[str, Spoil] = {
    "pose inverted": lambda clip, pose: (
        clip.rig_from_log @ geometry.inverse(geometry.inverse(clip.rig_from_log) @ pose)),
    **{f"turned by {angle} about its {'xyz'[axis]}": lambda clip, pose, a=axis, d=angle: pose @ turn(a, d)
       for angle in (90, 180) for axis in range(3)},
    "turned by 90 about the car's z": lambda clip, pose: turn(2, 90) @ pose,
    "axes of the car (x forward, z up)": lambda clip, pose: geometry.pose(
        pose[:3, :3] @ np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), pose[:3, 3]),
    "turned by 3 about its y": lambda clip, pose: pose @ turn(1, 3),
}  # fmt: skip
"""Ways to spoil a camera's pose in the rig."""
BOXES = {"boxes half a height low": -0.5, "boxes half a height high": 0.5}


def with_camera(clip: logs.Clip, name: str, rig_from_camera: np.ndarray) -> logs.Clip:
    """The log with one camera only, which sits elsewhere in its calibration and in the poses of its frames."""
    camera = clip.rig.cameras[name]
    moved = geometry.inverse(camera.rig_from_camera) @ rig_from_camera
    images = [
        dataclasses.replace(row, world_from_camera=row.world_from_camera @ moved) for row in clip.image_records(name)
    ]
    return remade(
        clip,
        rig=Rig({name: dataclasses.replace(camera, rig_from_camera=rig_from_camera)}, clip.rig.lidars, clip.rig.body),
        images={name: images},
    )


def with_ground(clip: logs.Clip, forgotten_m: float) -> logs.Clip:
    """The log as if its rig frame lay above the road."""
    lifted = geometry.pose(np.eye(3), np.array([0.0, 0.0, forgotten_m]))
    down = geometry.inverse(lifted)
    cameras = {
        name: dataclasses.replace(camera, rig_from_camera=down @ camera.rig_from_camera)
        for name, camera in clip.rig.cameras.items()
    }
    lidars = {
        name: dataclasses.replace(lidar, rig_from_lidar=down @ lidar.rig_from_lidar)
        for name, lidar in clip.rig.lidars.items()
    }
    ego = Trajectory(clip.ego.t_us, clip.ego.world_from_body @ lifted)
    return remade(clip, rig=Rig(cameras, lidars, clip.rig.body), ego=ego)


def with_boxes(clip: logs.Clip, heights: float) -> logs.Clip:
    """The log with its boxes raised by a share of their heights."""
    tracks = []
    for track in clip.tracks:
        up = geometry.pose(np.eye(3), np.array([0.0, 0.0, heights * track.size_m[2]]))
        path = Trajectory(track.path.t_us, track.path.world_from_body @ up)
        tracks.append(dataclasses.replace(track, path=path))
    return remade(clip, tracks=tracks)


def remade(clip: logs.Clip, **changes: object) -> logs.Clip:
    """The log with some arguments of its constructor changed."""
    arguments: dict[str, object] = {
        "id": clip.id,
        "rig": clip.rig,
        "ego": clip.ego,
        "tracks": clip.tracks,
        "road_map": clip.road_map,
        "images": {name: clip.image_records(name) for name in clip.rig.cameras},
        "sweeps": {name: clip.sweep_records(name) for name in clip.rig.lidars},
        "source": clip.source,
        "facts": clip.facts,
        "rig_from_log": clip.rig_from_log,
    }
    return logs.Clip(**{**arguments, **changes})  # type: ignore[arg-type]


def rows(clip: logs.Clip) -> list[tuple[str, int, int]]:
    """(how it was spoilt, how often that was found, how often it was tried)."""
    sweeps = sample_sweeps(clip)
    sound = logs.measure_clip(clip)
    found = [("as it is", sum(len(each.faults) for each in sound), len(sound))]
    for text, spoil in CAMERAS.items():
        clips = [
            with_camera(clip, name, spoil(clip, camera.rig_from_camera)) for name, camera in clip.rig.cameras.items()
        ]
        faults = [any(row.faults for row in check_calibration(each, sweeps)) for each in clips]
        found.append((text, sum(faults), len(faults)))
    high = with_ground(clip, GROUND_M)
    ground = check_ground(high, sample_sweeps(high))
    found.append((f"ground off by {GROUND_M} m", sum(bool(row.faults) for row in ground), len(ground)))
    for text, heights in BOXES.items():
        boxes = check_boxes(with_boxes(clip, heights), sweeps)
        found.append((text, sum(bool(row.faults) for row in boxes), len(boxes)))
    return found


def main() -> None:
    """Prints one column per log."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", nargs="+", type=Path)
    columns: dict[str, list[tuple[str, int, int]]] = {}
    for path in parser.parse_args().clips:
        clip = logs.open_clip(path)
        started = time.process_time()
        columns[clip.id] = rows(clip)
        print(f"{clip.id}: {time.process_time() - started:.0f} s of CPU time", flush=True)
    print("| | " + " | ".join(columns) + " |")
    print("|---|" + "---|" * len(columns))
    for number, (text, _, _) in enumerate(next(iter(columns.values()))):
        cells = [f"{each[number][1]} of {each[number][2]}" if each[number][2] else "-" for each in columns.values()]
        print(f"| {text} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
