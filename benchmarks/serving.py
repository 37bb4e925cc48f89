"""A sensor server under load: many clients with mixed requests, every answer compared with that for a single client.

``python benchmarks/serving.py [--clients 32] [--seconds 60] [--workers 2 --threads 1]`` starts ``nurec-sim serve`` in a
process of its own, asks every request of a mix once (the answers to compare with), measures one client, then many, and
the latency of health meanwhile. It prints what was reached and writes ``build/bench_serving.json``. The clients run on
the same cores. Linux only: the server's memory is read from /proc.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import grpc
import numpy as np
from bars import verdict
from grpc_health.v1 import health_pb2
from soak import drive, drive_scene, sensor_mix

from nurec_sim.scene import write_scene
from nurec_sim.serving import wire
from nurec_sim.serving.wire import ImageFormat, common, sensorsim
from nurec_sim.types import CameraModel, GaussianScene, SensorRequest

RESULT = Path("build/bench_serving.json")
HEALTH = "grpc.health.v1.Health/Check"
SIZES = ((160, 90), (320, 180), (640, 360))
FORMATS = (ImageFormat.JPEG, ImageFormat.PNG, ImageFormat.RGB_UINT8_PLANAR)
CAMERAS_IN_BATCH = 3
HEALTH_EVERY_S = 0.02
REACHED = {
    "wrong answers": (0, "", True),
    "errors": (0, "", True),
    "health p99": (50.0, "ms", True),
    "memory growth": (2.0, "%", True),
    "throughput of all clients over one": (1.7, "x", False),
}
"""Limit, unit and whether at most that much, by what is measured."""

Ask = tuple[str, bytes]
"""A procedure's path, and a request."""


def mixed_requests(scene_id: str) -> list[Ask]:
    """Images of all sizes and formats, batches, sweeps, discovery and health: a seeded mix."""
    cameras, sweeps = [], []
    for width, height in SIZES:
        source = drive(drive_scene(), sensor_mix(width, height))
        for _ in range(20):
            request = next(source)
            (cameras if isinstance(request.sensor, CameraModel) else sweeps).append(request)
    asks = [("render_rgb", _image(r, FORMATS[k % len(FORMATS)], scene_id)) for k, r in enumerate(cameras)]
    for k in range(0, len(cameras) - CAMERAS_IN_BATCH, 8):
        batch = sensorsim.BatchRGBRenderRequest()
        for number, request in enumerate(cameras[k : k + CAMERAS_IN_BATCH]):
            batch.items.add(camera_name=str(number), request=_image(request, ImageFormat.JPEG, scene_id))
        asks.append(("batch_render_rgb", batch))
    for request in sweeps[:8]:
        sweep = sensorsim.LidarRenderRequest()
        wire.write_lidar_request(request, sweep, scene_id=scene_id)
        asks.append(("render_lidar", sweep))
    discovery = ("get_version", "get_available_scenes", "get_server_config")
    asks += [(name, common.Empty()) for name in discovery]
    asks.append(("get_available_cameras", sensorsim.AvailableCamerasRequest(scene_id=scene_id)))
    asks.append(("get_dynamic_objects", sensorsim.DynamicObjectsRequest(scene_id=scene_id)))
    paths = [(f"{wire.SERVICE}/{name}", message.SerializeToString(deterministic=True)) for name, message in asks]
    return [*paths, (HEALTH, health_pb2.HealthCheckRequest().SerializeToString())]


def _image(request: SensorRequest, image_format: ImageFormat, scene_id: str):
    message = sensorsim.RGBRenderRequest()
    wire.write_camera_request(replace(request, scene_id=scene_id), message, scene_id=scene_id)
    message.image_format, message.image_quality = image_format, 95
    return message


class Client:
    """One client with a connection of its own; counts what it gets."""

    def __init__(self, address: str) -> None:
        own = [("grpc.max_receive_message_length", 64 << 20), ("grpc.use_local_subchannel_pool", 1)]
        self._channel = grpc.insecure_channel(address, own)
        self.answers, self.wrong, self.errors = 0, 0, Counter[str]()

    def ask(self, ask: Ask) -> bytes:
        """The digest of an answer."""
        return hashlib.sha256(self._channel.unary_unary(f"/{ask[0]}")(ask[1], timeout=300)).digest()

    def work(self, asks: Sequence[Ask], expected: Sequence[bytes], until: float, seed: int) -> None:
        """Asks in an order of its own, again and again, until a time of ``time.monotonic``."""
        rng = np.random.default_rng(seed)
        while time.monotonic() < until:
            for k in rng.permutation(len(asks)):
                if time.monotonic() >= until:
                    return
                try:
                    self.wrong += self.ask(asks[k]) != expected[k]
                    self.answers += 1
                except grpc.RpcError as error:
                    self.errors[error.code().name] += 1

    def close(self) -> None:
        """Ends the connection."""
        self._channel.close()


def load(
    address: str, pid: int, clients: int, seconds: float, asks: Sequence[Ask], expected: Sequence[bytes]
) -> dict[str, float | dict]:
    """Throughput of a number of clients over some seconds, and the latency of health calls under this load."""
    crowd, waits = [Client(address) for _ in range(clients)], list[float]()
    begin, used_s, own_s = time.monotonic(), cpu_s(pid), time.process_time()
    until = begin + seconds

    def look() -> None:
        probe = Client(address)
        while time.monotonic() < until:
            start = time.perf_counter()
            probe.ask(asks[-1])
            waits.append(1e3 * (time.perf_counter() - start))
            time.sleep(HEALTH_EVERY_S)
        probe.close()

    threads = [threading.Thread(target=c.work, args=(asks, expected, until, k)) for k, c in enumerate(crowd)]
    threads.append(threading.Thread(target=look))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    took, answers = time.monotonic() - begin, sum(c.answers for c in crowd)
    for client in crowd:
        client.close()
    return {
        "clients": clients,
        "seconds": took,
        "answers": answers,
        "answers_per_s": answers / took,
        "server_cpu_ms_per_answer": 1e3 * (cpu_s(pid) - used_s) / answers,
        "clients_cpu_ms_per_answer": 1e3 * (time.process_time() - own_s) / answers,
        "wrong": sum(c.wrong for c in crowd),
        "errors": dict(sum((c.errors for c in crowd), Counter())),
        "health_p50_ms": float(np.percentile(waits, 50)),
        "health_p99_ms": float(np.percentile(waits, 99)),
        "health_max_ms": max(waits),
    }


@contextlib.contextmanager
def serving(archive: Path, options: argparse.Namespace) -> Iterator[tuple[str, int]]:
    """``nurec-sim serve`` in a process of its own: its address and process id."""
    words = [sys.executable, "-m", "nurec_sim.cli", "serve", str(archive), "--port", "0"]
    for name in ("workers", "threads"):
        if getattr(options, name) is not None:
            words += [f"--{name}", str(getattr(options, name))]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield process.stdout.readline().removeprefix("Serving on ").strip(), process.pid
        finally:
            process.terminate()


def cpu_s(pid: int) -> float:
    """Processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def resident_mb(pid: int) -> float:
    """Resident memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def with_unit_quaternions(scene: GaussianScene) -> GaussianScene:
    """The scene as archives want it."""
    static, moving = scene.static, scene.dynamic.gaussians
    static = replace(static, quat_wxyz=static.quat_wxyz / np.linalg.norm(static.quat_wxyz, axis=1, keepdims=True))
    moving = replace(moving, quat_wxyz=moving.quat_wxyz / np.linalg.norm(moving.quat_wxyz, axis=1, keepdims=True))
    return replace(scene, static=static, dynamic=replace(scene.dynamic, gaussians=moving))


def measure(options: argparse.Namespace) -> dict:
    """All figures of a run."""
    with tempfile.TemporaryDirectory() as folder:
        archive = write_scene(with_unit_quaternions(drive_scene()), Path(folder) / "soak.usdz")
        with serving(archive, options) as (address, pid):
            asks, first = mixed_requests("soak"), Client(address)
            expected = [first.ask(ask) for ask in asks]
            first.close()
            load(address, pid, options.clients, options.seconds / 6, asks, expected)  # buffers reach their size
            one = load(address, pid, 1, options.seconds / 3, asks, expected)
            start_mb = resident_mb(pid)
            many = load(address, pid, options.clients, options.seconds, asks, expected)
            end_mb = resident_mb(pid)
    return {
        "requests_in_mix": len(asks),
        "distinct_answers": len(set(expected)),
        "workers": options.workers,
        "threads": options.threads,
        "cores": len(os.sched_getaffinity(0)),
        "load_average": os.getloadavg()[0],
        "one": one,
        "many": many,
        "memory_mb": [start_mb, end_mb],
        "reached": {
            "wrong answers": one["wrong"] + many["wrong"],
            "errors": sum(one["errors"].values()) + sum(many["errors"].values()),
            "health p99": many["health_p99_ms"],
            "memory growth": 100 * (end_mb / start_mb - 1),
            "throughput of all clients over one": many["answers_per_s"] / one["answers_per_s"],
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clients", type=int, default=32)
    parser.add_argument("--seconds", type=float, default=60.0, help="of many clients; one gets a third of it")
    parser.add_argument(
        "--workers", type=int, help="frames rendered at the same time; the server's choice if not given"
    )
    parser.add_argument("--threads", type=int, help="of a renderer; the server's choice if not given")
    options = parser.parse_args()
    figures = measure(options)
    for name in ("one", "many"):
        row = figures[name]
        health = ", ".join(f"{q} {row[f'health_{q}_ms']:.1f} ms" for q in ("p50", "p99", "max"))
        cpu = ", ".join(f"{who} {row[f'{who}_cpu_ms_per_answer']:.1f} ms" for who in ("server", "clients"))
        print(f"{row['clients']:3d} clients {row['answers_per_s']:7.1f} answers/s, errors {row['errors'] or 'none'}")
        print(f"    health {health}; processor time for an answer: {cpu}")
    print(f"memory {figures['memory_mb'][0]:.0f} -> {figures['memory_mb'][1]:.0f} MB")
    print(
        f"load of the machine {figures['load_average']:.1f} on {figures['cores']} cores, the clients' own share in it"
    )
    for what, (limit, unit, at_most) in REACHED.items():
        print(verdict(what, figures["reached"][what], limit, unit, at_most))
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
