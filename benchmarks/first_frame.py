"""Seconds from the start of a process, or of a server, to its first frame, with compiled kernels on disk.

The process that is timed runs this file.
"""

from __future__ import annotations

import json
import os
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
        ``first_frame_s`` for importing the renderer, packing the scene and rendering; ``first_frame_process_s`` for the
        whole process, with the interpreter's start and the archive read; and those of ``measure_served``.
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
    return seconds | measure_served(archive, request, threads)


def measure_served(archive: Path, request: SensorRequest, threads: int) -> dict[str, float]:
    """Time ``nurec-sim serve`` from the start of its process to a client's first frame.

    Args:
        archive: the scene to serve.
        request: of a camera.
        threads: of the renderer.

    Returns:
        ``served_listening_s`` until the server takes calls; ``served_first_frame_s`` until ``render_rgb`` has answered;
        ``served_cpu_s``, the processor time that the server had taken by then, which other programs do not change;
        ``served_next_frame_s`` for the same frame again.
    """
    from nurec_sim.serving.client import RemoteSensors

    began = time.perf_counter()
    command = [sys.executable, "-m", "nurec_sim.cli", "serve", str(archive), "--port", "0", "--threads", str(threads)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            address = server.stdout.readline().removeprefix("Serving on ").strip()
            listening = time.perf_counter() - began
            with RemoteSensors(address, archive.stem) as remote:
                remote.sense([request])
                first, cpu = time.perf_counter() - began, _cpu_seconds(server.pid)
                remote.sense([request])
                again = time.perf_counter() - began - first
        finally:
            server.terminate()
    return {"served_listening_s": listening, "served_first_frame_s": first, "served_cpu_s": cpu,
            "served_next_frame_s": again}  # fmt: skip


def _cpu_seconds(process_id: int) -> float:
    """Processor time of a process and its threads; NaN where the system does not tell."""
    try:
        fields = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return float("nan")
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main(archive: str, asked: str) -> None:
    """Render one frame and print how long it took, apart from reading the archive."""
    import numpy as np

    from nurec_sim.render import CpuRenderer
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
    CpuRenderer(scene, threads=wanted["threads"]).sense([request])
    print(json.dumps({"first_frame_s": imported + time.perf_counter() - began}))


if __name__ == "__main__":
    main(*sys.argv[1:])
