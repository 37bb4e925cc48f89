"""Times the CUDA back end on the scenes of ``render.py``, with its distance from the reference beside each time.

Every frame has another pose of the path. ``ms`` is what the GPU's own clock says between the first and the last
kernel of a batch, the host's part included where the GPU waits for it; ``sense_ms`` is the wall time of
``GpuRenderer.sense``, which also copies the frames to the host.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cases
import numpy as np
import parity
import torch
import tyro
from cases import SENSORS, SensorCase, camera, lidar
from render import write
from scenes import SCENES, BenchScene

from nurec_sim.errors import GpuError
from nurec_sim.reconstruct import OptimizeSettings
from nurec_sim.reconstruct.optimize.method import Optimization
from nurec_sim.reconstruct.optimize.views import Returns, TrainingView
from nurec_sim.render.cpu.backward.gradients import GaussianTensors
from nurec_sim.render.gpu.frame import GpuFrames
from nurec_sim.render.gpu.gradients import DifferentiableRenderer
from nurec_sim.render.gpu.launcher import CudaLauncher, Launcher
from nurec_sim.render.gpu.renderer import GpuRenderer

EIGHT = SensorCase(
    (*(camera(1920, 1080, yaw_deg=360 / 7 * k, id=f"camera-{k}") for k in range(7)), lidar("PANDAR128")),
    "seven cameras and a LiDAR in one launch",
)
CASES = {
    **{name: SENSORS[name] for name in ("pinhole-960", "pinhole-1920", "ftheta-1920", "rolling-ftheta-1920")},
    "lidar-128": SENSORS["lidar-128"],
    "tick-8": EIGHT,
}
TRAINED = ("pinhole-960", "lidar-128")
OPTIMIZED = "pinhole-960"
DETAILED = ("pinhole-1920", "lidar-128", "tick-8")
SceneName = Literal[tuple(SCENES)]  # type: ignore[valid-type]
SensorName = Literal[tuple(CASES)]  # type: ignore[valid-type]
Timed = Callable[[Callable[[], Any]], tuple[Any, float]]


@dataclass(frozen=True)
class Options:
    """Time the CUDA back end, compare it with the float64 reference and write build/bench_gpu.json.

    Args:
        scenes: scenes to render.
        sensors: sensors to render.
        detail_px: level of detail of further rows, for the sensors of DETAILED; 0 leaves them out.
        frames: frames per row, each from another pose of the path.
        parity_rays: pixels or beams per row that the reference renders; 0 leaves it out.
        device: a CUDA device.
        output: the results, as JSON.
    """

    scenes: tuple[SceneName, ...] = ("driving", "2m", "6m")
    sensors: tuple[SensorName, ...] = tuple(CASES)
    detail_px: float = 0.15
    frames: int = 200
    parity_rays: int = 400
    device: str = "cuda"
    output: Path = Path("build/bench_gpu.json")


def main() -> int:
    """Run the benchmark; 1 where there is no GPU."""
    options = tyro.cli(Options)
    try:
        launcher = CudaLauncher(options.device)
    except GpuError as error:
        print(error, file=sys.stderr)
        return 1
    rows: list[dict[str, Any]] = []
    print(f"{'scene sensor':32s} {'ms':>8s} {'p99':>8s} {'sense':>8s} {'forward':>8s} {'dB':>6s}  {gpu_state()}")
    for name in options.scenes:
        for row in scene_rows(name, SCENES[name](), launcher, timed_on_gpu, options):
            rows.append({**row, "gpu": torch.cuda.get_device_name(launcher.device), "gpu_state": gpu_state()})
            write(rows, options.output)
            print(line_of(rows[-1]), flush=True)
    return 0


def scene_rows(
    name: str, bench: BenchScene, launcher: Launcher, timed: Timed, options: Options
) -> Iterator[dict[str, Any]]:
    """A row per sensor, and ones for the gradients of some and for steps of the optimisation."""
    full, path = GpuRenderer(bench.scene, launcher), next(iter(bench.paths))
    rows = [(full, sensor, "") for sensor in options.sensors]
    detailed = [sensor for sensor in options.sensors if sensor in DETAILED and options.detail_px]
    if detailed:
        coarse = GpuRenderer(bench.scene, launcher, detail_px=options.detail_px)
        rows += [(coarse, sensor, " lod") for sensor in detailed]
    for renderer, sensor, kind in rows:
        ticks = cases.tick_requests(bench, CASES[sensor], path, options.frames)
        for tick in ticks[:10]:
            renderer.sense(tick)
        ms = [timed(lambda tick=tick, renderer=renderer: renderer.render(tick))[1] for tick in ticks]
        wall = []
        for tick in ticks[: max(1, options.frames // 4)]:
            began = time.perf_counter()
            frames = renderer.sense(tick)
            wall.append((time.perf_counter() - began) * 1e3)
        against = parity.against_spec(bench.scene, tick, frames, options.parity_rays) if options.parity_rays else {}
        yield {**facts(name, sensor + kind, path, bench, ms), "sense_ms_median": float(np.median(wall)), **against}
        if sensor in TRAINED and not kind:
            yield backward_row(name, sensor, path, bench, launcher, timed, options)
        if sensor == OPTIMIZED and not kind:
            yield step_row(name, sensor, path, bench, renderer, launcher, options)


def backward_row(
    name: str, sensor: str, path: str, bench: BenchScene, launcher: Launcher, timed: Timed, options: Options
) -> dict[str, Any]:
    """Forward and backward of one sensor, by all that a Gaussian has; weights on every value of every output."""
    tensors = GaussianTensors.of(bench.scene.static)
    leaves = {key: value.to(launcher.device).requires_grad_() for key, value in vars(tensors).items()
              if value is not None and key != "sh_rest"}  # fmt: skip
    renderer = DifferentiableRenderer(CASES[sensor].sensors, launcher)
    forward, backward = [], []
    for (asked,) in cases.tick_requests(bench, CASES[sensor], path, max(2, options.frames // 4)):
        poses = [torch.from_numpy(np.asarray(asked.world_from_sensor, np.float64))]
        (seen,), render_ms = timed(lambda poses=poses: renderer.render(GaussianTensors(**leaves), poses))
        loss = sum((value * torch.rand_like(value)).sum() for value in vars(seen).values())
        forward.append(render_ms)
        backward.append(timed(loss.backward)[1])
        for leaf in leaves.values():
            leaf.grad = None
    row = facts(name, f"{sensor} backward", path, bench, backward[1:])
    return {**row, "forward_ms_median": float(np.median(forward[1:]))}


def step_row(
    name: str, sensor: str, path: str, bench: BenchScene, renderer: GpuRenderer, launcher: Launcher, options: Options
) -> dict[str, Any]:
    """Wall time of steps of the per-scene optimisation, whose images are a little darker than the scene shows them."""
    views = []
    for (asked,) in cases.tick_requests(bench, CASES[sensor], path, max(2, options.frames // 4)):
        (frame,) = renderer.sense([asked])
        poses = np.broadcast_to(np.asarray(asked.world_from_sensor, np.float64), (2, 4, 4))
        nothing = Returns(np.zeros((0, 2)), np.zeros(0))
        views.append(TrainingView(asked.sensor, len(views), asked.start_us, poses, frame.rgb // 8 * 7, nothing))
    settings = OptimizeSettings(seconds=None, steps=len(views), check_every=0)
    run = Optimization(bench.scene, views, settings, frames=GpuFrames(launcher))
    ms = []
    for number in range(len(views)):
        began = time.perf_counter()
        run.step(number, 1.0)
        ms.append((time.perf_counter() - began) * 1e3)
    return facts(name, f"{sensor} step", path, bench, ms[1:])


def timed_on_gpu(work: Callable[[], Any]) -> tuple[Any, float]:
    """The result and the milliseconds between two events around the work."""
    began, ended = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    torch.cuda.synchronize()
    began.record()
    result = work()
    ended.record()
    ended.synchronize()
    return result, began.elapsed_time(ended)


def facts(name: str, sensor: str, path: str, bench: BenchScene, ms: list[float]) -> dict[str, Any]:
    """What identifies a row, and its times."""
    width, height = CASES[sensor.split()[0]].size
    return {
        "name": f"{name} {sensor} {path}",
        "width": width,
        "height": height,
        "sensors": len(CASES[sensor.split()[0]].sensors),
        "gaussians": len(bench.scene.static) + len(bench.scene.dynamic),
        "backend": "cuda",
        "frames": len(ms),
        "ms_median": float(np.median(ms)),
        "ms_p99": float(np.quantile(ms, 0.99)),
    }


def line_of(row: dict[str, Any]) -> str:
    """A row of the table."""

    def number(key: str, width: int) -> str:
        return f"{row[key]:{width}.2f}" if row.get(key) is not None else " " * width

    return (
        f"{row['name']:32s} {number('ms_median', 8)} {number('ms_p99', 8)} {number('sense_ms_median', 8)} "
        f"{number('forward_ms_median', 8)} {number('psnr_vs_spec_db', 6)}  {row['gpu_state']}"
    )


def gpu_state() -> str:
    """Name, driver, power state, clock and power draw, as the driver reports them now."""
    if shutil.which("nvidia-smi") is None:
        return "power state unknown: no nvidia-smi"
    fields = "name,driver_version,pstate,clocks.sm,power.draw,power.limit"
    command = ["nvidia-smi", f"--query-gpu={fields}", "--format=csv,noheader"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip().replace("\n", "; ")


if __name__ == "__main__":
    sys.exit(main())
