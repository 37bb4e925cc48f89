"""Which rows each scene gets: its sensors, paths and back ends, as entries to be timed in turns."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cases
import peers
from cases import SENSORS
from scenes import PATHS, ROOT, SCENES, BenchScene
from timing import Entry, Render

from nurec_sim.render import CpuRenderer
from nurec_sim.types import CameraModel, GaussianScene, SensorFrame, SensorRequest

BUILD = ROOT / "build"
FIRST_FRAME_ROW = "driving pinhole-960 drive"
HEADLINES = ("pinhole-640", "pinhole-960", "pinhole-1920", "rolling-960", "ftheta-1920", "lidar-128")
OTHER_SCENES = ("pinhole-960", "rolling-960", "ftheta-1920", "lidar-128")
LARGE_SCENES = ("pinhole-960", "pinhole-1920", "lidar-128")
SCANNERS = ("lidar-64-sparse", "lidar-48-sparse", "lidar-64", "lidar-128")
SCENE_SENSORS: dict[str, tuple[str, ...]] = {"driving": tuple(SENSORS), "2m": LARGE_SCENES, "6m": LARGE_SCENES,
                                             "lifted": SCANNERS}  # fmt: skip
FEWER_FRAMES = {"2m": 0.5, "6m": 0.25, "lifted": 0.5}
ALL_PATHS_SENSOR = "pinhole-960"
"""The sensor that is driven along every path of a scene; all others along the first one."""
DETAIL_SENSORS = ("pinhole-960", "pinhole-1920")
DETAIL_SCENES = ("driving", "real", "2m", "6m")
LESSER_KERNELS = ("avx2", "plain")
LESSER_SENSORS = ("pinhole-640", "pinhole-960", "lidar-128")
PEER_SENSOR = "pinhole-640"
PEER_FRAMES = 2


SceneName = Literal[tuple(SCENES)]  # type: ignore[valid-type]
SensorName = Literal[tuple(SENSORS)]  # type: ignore[valid-type]
PathName = Literal[PATHS]  # type: ignore[valid-type]


@dataclass(frozen=True)
class Options:
    """Time the renderer, compare it with the float64 reference, print a table and write build/bench.json.

    A row is a sensor on a path through a scene: median and 99th percentile of the wall time, CPU time of all threads,
    the first frame (kernels loaded, tables made), evaluations per pixel, milliseconds per stage, and the PSNR of a
    sample of its pixels against render/spec.py, over the whole scene at the full resolution. LiDAR rows give range
    errors. Ctrl-C keeps the rows that have been measured. docs/benchmarks.md explains every column.

    Examples: "python benchmarks/render.py --quick" takes a minute; "python benchmarks/render.py --scenes driving 2m
    --sensors pinhole-960 lidar-128 --repeats 100" measures four rows closely.

    Args:
        scenes: scenes to render.
        sensors: sensors to render; each scene's own choice if not given.
        paths: paths to drive; if not given, all of a scene for pinhole-960 and the first one for other sensors.
        quick: one scene, the sensors of the headline numbers, one path, few frames, no extras.
        repeats: frames per row; scenes of millions of Gaussians take fewer.
        threads: render threads; all that the process may use if not given.
        gaussians: make the seeded scenes of this many Gaussians instead of their own number.
        parity_rays: pixels or beams per row that the reference renders; 0 leaves it out.
        detail_px: of the rows with level of detail; 0 leaves them out.
        extras: with the driving scene also run the plain torch renderer, gsplat where it runs, gradients, the first
            frame of a new process, and our kernels for lesser machines.
        output: the results, as JSON.
    """

    scenes: tuple[SceneName, ...] = tuple(SCENES)
    sensors: tuple[SensorName, ...] = ()
    paths: tuple[PathName, ...] = ()
    quick: bool = False
    repeats: int = 30
    threads: int | None = None
    gaussians: int | None = None
    parity_rays: int = 600
    detail_px: float = 0.15
    extras: bool = True
    output: Path = BUILD / "bench.json"

    @property
    def thread_count(self) -> int:
        """Threads of every renderer."""
        return self.threads or len(os.sched_getaffinity(0))


def quick(options: Options) -> Options:
    """The options of ``--quick``."""
    return dataclasses.replace(
        options,
        scenes=("driving",),
        sensors=options.sensors or HEADLINES,
        paths=("drive",),
        repeats=min(options.repeats, 8),
        extras=False,
    )


def build(name: str, options: Options, progress: Callable[[str, float], None]) -> BenchScene:
    """A scene by name; seeded scenes with another number of Gaussians if requested."""
    if name in ("real", "lifted"):
        return SCENES[name](progress)
    return SCENES[name]() if options.gaussians is None else SCENES[name](options.gaussians)


def count(scene: GaussianScene) -> int:
    """Gaussians of both layers."""
    return len(scene.static) + len(scene.dynamic)


def entries(name: str, built: BenchScene, renderer: CpuRenderer, options: Options) -> tuple[list[Entry], list[str]]:
    """All entries to time on a scene, and remarks on those that cannot be timed."""
    chosen = options.sensors or SCENE_SENSORS.get(name, OTHER_SCENES)
    frames = max(2, round(options.repeats * FEWER_FRAMES.get(name, 1.0)))
    paths = [path for path in built.paths if path in options.paths] or list(built.paths)
    first = paths[0]
    result: list[Entry] = []

    def add(
        sensor: str, path: str, backend: str, render: Render, measured: CpuRenderer | None = None, **more: Any
    ) -> None:
        case, outputs = SENSORS[sensor], SENSORS[sensor].outputs
        ticks = cases.tick_requests(built, case, path, more.pop("frames", frames))
        width, height = case.size
        facts = {
            "name": row_name(name, sensor, path, backend), "width": width, "height": height,
            "gaussians": count(built.scene), "threads": options.thread_count, "scene": name, "sensor": sensor,
            "path": path, "backend": backend, "pixels": sum(w * h for w, h in map(cases.sensor_size, case.sensors)),
            **more,
        }  # fmt: skip
        result.append(Entry(facts, ticks, render, None if measured is None else own_account(measured, outputs)))

    for sensor in chosen:
        if len(SENSORS[sensor].sensors) > 1:
            add(sensor, first, "ours", renderer.sense, renderer)
            add(sensor, first, "ours one by one", one_by_one(renderer))
            continue
        for path in paths if sensor == ALL_PATHS_SENSOR or options.paths else (first,):
            add(sensor, path, "ours", each(renderer, SENSORS[sensor].outputs), renderer)
    detailed = [sensor for sensor in chosen if sensor in DETAIL_SENSORS]
    if detailed and options.detail_px > 0 and name in DETAIL_SCENES:
        coarse = CpuRenderer(built.scene, threads=options.thread_count, detail_px=options.detail_px)
        for sensor in detailed:
            full = row_name(name, sensor, first, "ours")
            add(sensor, first, "ours lod", each(coarse, SENSORS[sensor].outputs), coarse, full=full)
    notes = []
    if options.extras and name == "driving" and PEER_SENSOR in chosen:
        torch = peers.rendering(peers.torch_frame, built.scene, threads=options.thread_count)
        add(PEER_SENSOR, first, "torch", torch, frames=PEER_FRAMES)
        reason = peers.why_gsplat_cannot_run(built.scene, result[-1].ticks[0][0])
        if reason is None:
            add(PEER_SENSOR, first, "gsplat", peers.rendering(peers.gsplat_frame, built.scene), frames=PEER_FRAMES)
        else:
            notes.append(f"gsplat does not run here: {reason}")
        notes += [f"{peer} is not run: {text}" for peer, text in peers.NOT_RUN.items()]
    return result, notes


def row_name(scene: str, sensor: str, path: str, backend: str) -> str:
    """The name of a row, unique in the results."""
    return f"{scene} {sensor} {path}" + ("" if backend == "ours" else f" {backend.removeprefix('ours ')}")


def each(renderer: CpuRenderer, outputs: tuple[str, ...]) -> Render:
    """Renders requests one after the other, cameras with the given outputs."""

    def render(requests: Sequence[SensorRequest]) -> list[SensorFrame]:
        return [
            renderer.render_camera(asked, outputs)
            if isinstance(asked.sensor, CameraModel)
            else renderer.render_lidar(asked)
            for asked in requests
        ]

    return render


def own_account(renderer: CpuRenderer, outputs: tuple[str, ...]) -> Callable[[Sequence[SensorRequest]], list[Any]]:
    """What the renderer itself counts of a tick."""
    return lambda requests: renderer.measure(requests, outputs)[1]


def one_by_one(renderer: CpuRenderer) -> Render:
    """Renders requests as ``sense`` calls of one request."""
    return lambda requests: [frame for asked in requests for frame in renderer.sense([asked])]
