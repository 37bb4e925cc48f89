"""Seconds from the start of a process to its first frame, with compiled kernels on disk; the process runs this file."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nurec_sim.types import GaussianScene, SensorRequest

BEGAN = time.perf_counter()


def measure(scene: GaussianScene, request: SensorRequest, threads: int, folder: Path) -> dict[str, float]:
    """Write the scene as an archive, then time a new process twice: the first one may have to compile kernels.

    Args:
        scene: the world.
        request: of an ideal pinhole camera, 90 degrees wide.
        threads: of the renderer.
        folder: where the archive is kept.

    Returns:
        ``first_frame_s`` for importing the renderer, packing the scene and drawing; ``first_frame_process_s`` for the
        whole process, with the interpreter's start and the archive read.
    """
    from nurec_sim.scene import write_scene

    archive = folder / "first_frame.usdz"
    folder.mkdir(parents=True, exist_ok=True)
    write_scene(scene, archive, overwrite=True)
    camera = request.sensor
    asked = {"size": [camera.width_px, camera.height_px], "start_us": request.start_us,
             "poses": request.world_from_sensor.tolist(), "threads": threads}  # fmt: skip
    seconds: dict[str, float] = {}
    for _ in range(2):
        began = time.perf_counter()
        command = [sys.executable, __file__, str(archive), json.dumps(asked)]
        printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        seconds = {**json.loads(printed.splitlines()[-1]), "first_frame_process_s": time.perf_counter() - began}
    return seconds


def main(archive: str, asked: str) -> None:
    """Draw one frame and print how long it took, apart from reading the archive."""
    import numpy as np

    from nurec_sim.render import Renderer
    from nurec_sim.types import CameraModel, Pinhole, SensorRequest

    imported = time.perf_counter() - BEGAN
    from nurec_sim.scene import read_scene

    wanted = json.loads(asked)
    width, height = wanted["size"]
    camera = CameraModel("camera", width, height, Pinhole(width / 2, width / 2, width / 2, height / 2), np.eye(4))
    start_us = wanted["start_us"]
    scene = read_scene(archive)
    request = SensorRequest(scene.id, camera, start_us, start_us + 1, np.array(wanted["poses"]))
    began = time.perf_counter()
    Renderer(scene, threads=wanted["threads"]).sense([request])
    print(json.dumps({"first_frame_s": imported + time.perf_counter() - began}))


if __name__ == "__main__":
    main(*sys.argv[1:])
