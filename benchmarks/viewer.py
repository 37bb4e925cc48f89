"""Pictures per second of the viewer while its camera moves, without a browser: rendering, drawing over, JPEG.

python benchmarks/viewer.py [SCENE.usdz] [--seconds 6]; without a scene, the demo log is reconstructed with lift.

The canvas is 640x360. The camera circles above the drive, or time plays in the first camera of the car. `scale` is the
side of the coarse pictures against the canvas, `CPU` the processor time of a picture with all threads, `full CPU` that
of one at the canvas' full size, all with JPEG.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import time

import numpy as np
from viser._image_encoding import cv2_imencode_with_fallback

from nurec_sim import geometry, sim
from nurec_sim.view import Painter, Session, View, open_sources
from nurec_sim.view.camera import start_pose
from nurec_sim.view.drawing import DrawingThread
from nurec_sim.view.viewer import MOVING_QUALITY

SIZE_PX = (640, 360)
CAMERA_HZ = 60


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?")
    parser.add_argument("--seconds", type=float, default=6.0)
    given = parser.parse_args()
    path = sim.scenario_file("demo")
    source = given.scene or path.parent / str(sim.load_scenario(path).clip)
    with contextlib.ExitStack() as stack:
        painter = Painter(open_sources([source], device="cpu", stack=stack))
        camera = next(iter(painter.opened.worlds[0].rig.cameras))
        print(f"{'moving':<22}{'pictures/s':>12}{'scale':>8}{'CPU ms':>8}{'full CPU ms':>13}")
        for name, values, playing in (
            ("free camera", {}, False),
            ("free, boxes, labels", {"boxes": True, "names": True}, False),
            ("free, wipe", {"other": 0}, False),
            ("playing, " + camera, {"camera": camera}, True),
        ):
            print(f"{name:<22}" + _measure(painter, values, playing, given.seconds))


def _measure(painter: Painter, values: dict, playing: bool, seconds: float) -> str:
    eye, _ = start_pose()
    first = painter.stage.opened.worlds[0].times_us[0] + 1_000_000
    session = Session(View(first, SIZE_PX, browser_from_eye=eye, fov_rad=math.radians(75), **values))
    pictures: list[tuple[int, bool]] = []

    def show(picture: np.ndarray, full: bool) -> None:
        cv2_imencode_with_fallback("jpeg", picture, MOVING_QUALITY, "rgb")
        pictures.append((picture.shape[1], full))

    full = []
    for _ in range(6):  # the first compiles or warms caches
        started = time.process_time()
        show(painter.paint(session.view), True)
        full.append(time.process_time() - started)
    thread = DrawingThread(session, painter, show, lambda text: print(text) if text else None)
    session.playing = playing
    session.change(moving=True)
    thread.start()
    time.sleep(1.5)  # the size of coarse pictures settles
    pictures.clear()
    start, cpu = time.perf_counter(), time.process_time()
    while (elapsed := time.perf_counter() - start) < seconds:
        turned = geometry.pose_from_xyyaw(0, 0, 0.3 * math.sin(elapsed)) @ eye
        t_us = first + round(1e6 * (elapsed % 5)) if playing else first
        session.change(moving=True, browser_from_eye=turned, t_us=t_us)
        time.sleep(1 / CAMERA_HZ)
    count, cpu = len(pictures), time.process_time() - cpu
    session.playing = False
    thread.stop()
    scale = np.mean([width for width, _ in pictures]) / SIZE_PX[0]
    return f"{count / seconds:>12.1f}{scale:>8.2f}{1e3 * cpu / max(count, 1):>8.0f}{1e3 * np.median(full[1:]):>13.0f}"


if __name__ == "__main__":
    main()
