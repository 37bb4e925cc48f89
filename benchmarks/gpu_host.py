"""Host time of the CUDA back end per batch, measured without a GPU: a stub takes the kernels' place.

The stub converts every argument of a launch as ``CudaLauncher`` does, counts, and runs nothing, so what is left is the
work of the CPU: checks, poses of sensors and actors, tables, allocations. A GPU adds about 5 us per launch to it.
"""

from __future__ import annotations

import dataclasses
import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from cases import camera, lidar

from nurec_sim import geometry
from nurec_sim.render.gpu.launcher import as_scalar
from nurec_sim.render.gpu.renderer import GpuRenderer
from nurec_sim.types import DynamicGaussians, Gaussians, GaussianScene, SensorRequest, Shutter, Track, Trajectory

START_US, END_US = 1_000_000, 21_000_000
POSES = 200
"""Recorded poses of each track."""


@dataclass(frozen=True)
class Options:
    """Measure the host time of a batch and write build/bench_gpu_host.json.

    Args:
        sensors: sensors of a batch; the last is a LiDAR.
        actors: tracks of the scene, each posed anew in every request.
        batches: batches to time, each at another instant.
        output: the results, as JSON.
    """

    sensors: int = 8
    actors: int = 50
    batches: int = 200
    output: Path = Path("build/bench_gpu_host.json")


class StubLauncher:
    """A ``Launcher`` that runs nothing; counts ``launches`` and ``synchronisations``."""

    device = torch.device("cpu")

    def __init__(self) -> None:
        self.launches = self.synchronisations = 0

    def launch(self, kernel, grid, *arguments) -> None:
        """Converts the arguments."""
        if min(grid) == 0:
            return
        self.launches += 1
        for argument in arguments:
            as_scalar(argument, self.device)

    def upload(self, data: np.ndarray) -> torch.Tensor:
        """As on a GPU, without a copy."""
        return torch.from_numpy(data)

    def sort(self, keys: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Memory for a result."""
        self.launches += 1
        return torch.empty_like(keys), torch.empty(len(keys), dtype=torch.int64)

    def running_sum(self, counts: torch.Tensor) -> torch.Tensor:
        """Memory for a result."""
        self.launches += 1
        return torch.empty(len(counts), dtype=torch.int64)

    def read(self, tensor: torch.Tensor) -> np.ndarray:
        """Zeros: nothing was seen."""
        self.synchronisations += 1
        return np.zeros(tuple(tensor.shape), tensor.numpy().dtype)


def main() -> None:
    """Run the benchmark."""
    options = tyro.cli(Options)
    rows = [measured(options.sensors, actors, options.batches) for actors in (0, options.actors)]
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(rows, indent=1) + "\n")
    for row in rows:
        print("  ".join(f"{name} {value}" for name, value in row.items()))


def measured(sensor_count: int, actor_count: int, batches: int) -> dict[str, float]:
    """Milliseconds of CPU per batch, and what it launched."""
    launcher = StubLauncher()
    scene = moving_scene(actor_count)
    renderer = GpuRenderer(scene, launcher)
    cameras = [camera(64, 48, yaw_deg=51 * k, id=f"camera-{k}", shutter=Shutter.TOP_TO_BOTTOM)
               for k in range(sensor_count - 1)]  # fmt: skip
    ticks = [tick(scene, (*cameras, lidar("VLP-16", 90)), t_us)
             for t_us in np.linspace(START_US, END_US - 200_000, batches + 10).astype(int).tolist()]  # fmt: skip
    for requests in ticks[:10]:
        renderer.render(requests)
    launcher.launches = launcher.synchronisations = 0
    spent = []
    for requests in ticks[10:]:
        began = time.process_time()
        renderer.render(requests)
        spent.append((time.process_time() - began) * 1e3)
    return {
        "sensors": sensor_count,
        "actors": actor_count,
        "host_ms_median": round(float(np.median(spent)), 3),
        "host_ms_p10": round(float(np.quantile(spent, 0.1)), 3),
        "launches": launcher.launches / batches,
        "synchronisations": launcher.synchronisations / batches,
    }


def moving_scene(actors: int) -> GaussianScene:
    """A few Gaussians, and tracks with curved paths that own some; half of them in their boxes."""
    rng = np.random.default_rng(7)
    t_us = np.linspace(START_US, END_US, POSES).astype(np.int64)
    s = (t_us - START_US) / 1e6
    tracks = [
        Track(f"actor-{k}", "automobile", (4.5, 1.9, 1.6),
              Trajectory(t_us, np.stack([geometry.pose_from_xyyaw(5 * x, 3 * k + np.sin(x), 0.1 * x + k) for x in s])))
        for k in range(actors)
    ]  # fmt: skip
    owner = np.repeat(np.arange(actors), 16)
    knots = np.array([START_US, (START_US + END_US) // 2, END_US])
    mean = rng.uniform(-2, 2, (len(owner), 3)).astype(np.float32)
    dynamic = DynamicGaussians(
        gaussians_at(mean), np.tile(knots, (len(owner), 1)), np.repeat(mean[:, None], 3, axis=1), owner.astype(np.int32)
    )
    if actors:
        dynamic = dataclasses.replace(dynamic, in_box=owner % 2 == 0)
    return GaussianScene(
        id="host",
        static=gaussians_at(rng.uniform(-20, 20, (2000, 3)).astype(np.float32)),
        dynamic=dynamic,
        sky=np.zeros((6, 4, 4, 3), np.float32),
        isp={},
        rig=None,
        ego=None,
        tracks=tracks,
        road_map=None,
        span_us=(START_US, END_US),
        camera_times_us={},
        provenance={},
    )


def gaussians_at(mean: np.ndarray) -> Gaussians:
    """Grey balls."""
    count = len(mean)
    values = Gaussians.empty()
    return dataclasses.replace(
        values, mean_m=mean, quat_wxyz=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        scale_m=np.full((count, 3), 0.1, np.float32), opacity=np.full(count, 0.9, np.float32),
        rgb=np.full((count, 3), 0.5, np.float32), normal=np.zeros((count, 3), np.float32),
        label=np.zeros(count, np.uint8), intensity=np.full(count, 0.5, np.float32),
    )  # fmt: skip


def tick(scene: GaussianScene, sensors, t_us: int) -> list[SensorRequest]:
    """A request per sensor, with a moving car and every actor posed anew, each over its own exposure."""
    requests = []
    for k, sensor in enumerate(sensors):
        start, end = t_us + 500 * k, t_us + 500 * k + 30_000
        mount = getattr(sensor, "rig_from_camera", None)
        mount = sensor.rig_from_lidar if mount is None else mount
        ego = np.stack([geometry.pose_from_xyyaw(x, 0.1 * x, 0.02 * x) @ mount for x in (start / 1e6, end / 1e6)])
        shift = geometry.pose_from_xyyaw(0.5, 0.2, 0.1)
        actors = {track.id: track.path.at(np.array([start, end])) @ shift for track in scene.tracks}
        requests.append(SensorRequest(scene.id, sensor, start, end, ego, actors))
    return requests


if __name__ == "__main__":
    main()
