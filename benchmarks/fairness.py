"""A small client beside a greedy one: how long it waits, how long health takes, and what memory the server needs.

``python benchmarks/fairness.py [--rounds 2]`` starts ``nurec-sim serve`` in a process of its own. A small client asks
for a 320x192 image every 100 ms, alone for a while, then while another process floods the server, and so on in turn.
It prints a table and writes ``build/bench_fairness.json``. All processes share the cores, so the flood's own work slows
the small client, too. Linux only: the server's memory is read from /proc.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import grpc
import numpy as np
from bars import verdict
from grpc_health.v1 import health_pb2
from serving import HEALTH, serving, with_unit_quaternions
from soak import drive, drive_scene, sensor_mix

from nurec_sim.scene import write_scene
from nurec_sim.serving import wire
from nurec_sim.serving.wire import ImageFormat, sensorsim
from nurec_sim.types import CameraModel, Shutter

RESULT = Path("build/bench_fairness.json")
SCENE = "soak"
SMALL, EVERY_S = (320, 192), 0.1
HEALTH_EVERY_S = 0.05
ALONE_S, FLOODED_S, SETTLE_S = 3.0, 6.0, 1.5
MOST_RATIO, MOST_MS, MOST_HEALTH_MS, MOST_MB = 3.0, 100.0, 50.0, 6000.0
HUGE = (7680, 4320)


def image(size: tuple[int, int], image_format: ImageFormat = ImageFormat.JPEG):
    """A request for an image of the drive."""
    asked = (r for r in drive(drive_scene(), sensor_mix(*size)) if isinstance(r.sensor, CameraModel))
    request = next(asked)
    request = replace(request, sensor=replace(request.sensor, shutter=Shutter.GLOBAL))
    message = sensorsim.RGBRenderRequest()
    wire.write_camera_request(replace(request, scene_id=SCENE), message, scene_id=SCENE)
    message.image_format, message.image_quality = image_format, 95
    return message


def together(count: int, size: tuple[int, int]):
    """One call for several images."""
    return sensorsim.AggregatedRenderRequest(rgb_requests=[image(size)] * count)


def crowded(count: int):
    """A small image with this many actors that the scene does not know."""
    message = image(SMALL)
    for k in range(count):
        pair = message.dynamic_objects.add(track_id=f"actor-{k}").pose_pair
        for pose in (pair.start_pose, pair.end_pose):
            pose.vec.x, pose.quat.w = float(k), 1.0
    return message


FLOODS: dict[str, tuple[str, Callable, int, str]] = {
    "aggregate-64": ("render_aggregated", lambda: together(64, HUGE), 1, "one call of 64 images of 33 MP; refused"),
    "aggregate-4": ("render_aggregated", lambda: together(4, HUGE), 2, "two calls of 4 images of 33 MP"),
    "calls-200": ("render_rgb", lambda: image((960, 540)), 200, "200 calls in flight, 960x540"),
    "actors-400000": ("render_rgb", lambda: crowded(400_000), 2, "two calls of 400,000 actors; refused"),
    "actors-4096": ("render_rgb", lambda: crowded(4096), 16, "16 calls in flight of 4,096 actors"),
}
"""Procedure, what makes the request, calls in flight, what it is."""


def channel(address: str) -> grpc.Channel:
    """A connection of its own."""
    return grpc.insecure_channel(
        address, [("grpc.max_receive_message_length", 64 << 20), ("grpc.use_local_subchannel_pool", 1)]
    )


def flood(name: str, address: str) -> None:
    """Keeps a number of calls in flight until the input ends; prints their outcomes."""
    procedure, make, in_flight, _ = FLOODS[name]
    data, ended, stop = make().SerializeToString(), Counter[str](), threading.Event()
    with channel(address) as own:
        call = own.unary_unary(f"/{wire.SERVICE}/{procedure}")

        def keep_asking() -> None:
            while not stop.is_set():
                try:
                    call(data, timeout=60)
                    ended["OK"] += 1
                except grpc.RpcError as error:
                    if not stop.is_set():
                        ended[f"{error.code().name}: {error.details()[:140]}"] += 1
                    time.sleep(0.005)

        threads = [threading.Thread(target=keep_asking, daemon=True) for _ in range(in_flight)]
        for thread in threads:
            thread.start()
        print("flooding", flush=True)
        sys.stdin.read()
        stop.set()
    print(json.dumps(ended))


class Watch:
    """The small client and a probe of health, at a steady pace."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._request = image(SMALL).SerializeToString()
        self.reply = b""

    def measure(self, seconds: float) -> tuple[list[float], list[float]]:
        """Milliseconds of the small client's images and of health."""
        health: list[float] = []
        stop = threading.Event()
        probe = threading.Thread(target=self._probe, args=(health, stop))
        probe.start()
        with channel(self._address) as own:
            ask = own.unary_unary(f"/{wire.SERVICE}/render_rgb")
            self._call(ask, self._request)  # connects
            images = self._paced(ask, self._request, EVERY_S, time.monotonic() + seconds, threading.Event())
        stop.set()
        probe.join()
        return images, health

    def _probe(self, health: list[float], stop: threading.Event) -> None:
        with channel(self._address) as own:
            ask, data = own.unary_unary(f"/{HEALTH}"), health_pb2.HealthCheckRequest().SerializeToString()
            self._call(ask, data)
            health += self._paced(ask, data, HEALTH_EVERY_S, float("inf"), stop)

    def _paced(self, ask, data: bytes, every_s: float, until: float, stop: threading.Event) -> list[float]:
        times, due = [], time.monotonic()
        while time.monotonic() < until and not stop.is_set():
            times.append(1e3 * self._call(ask, data))
            due = max(due + every_s, time.monotonic())
            time.sleep(max(due - time.monotonic(), 0.0))
        return times

    def _call(self, ask, data: bytes) -> float:
        begin = time.perf_counter()
        reply = ask(data, timeout=60)
        took = time.perf_counter() - begin
        if data is self._request:
            assert not self.reply or reply == self.reply, "the same request gave another image"
            self.reply = reply
        return took


def peak_mb(pid: int) -> float:
    """Most resident memory of a process since ``forget_peak``."""
    line = next(line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1e3


def forget_peak(pid: int) -> None:
    """Lets the peak count anew."""
    Path(f"/proc/{pid}/clear_refs").write_text("5")


def measure_flood(name: str, address: str, pid: int, rounds: int, scale: float) -> dict:
    """Figures of one flood, alone and flooded in turn."""
    watch, times, ended = Watch(address), {"alone": ([], []), "flooded": ([], [])}, Counter[str]()
    forget_peak(pid)
    for _ in range(rounds):
        for into, new in zip(times["alone"], watch.measure(ALONE_S * scale), strict=True):
            into += new
        command = [sys.executable, __file__, "--flood", name, "--address", address]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
            assert other.stdin and other.stdout and other.stdout.readline() == "flooding\n"
            time.sleep(SETTLE_S * scale)
            for into, new in zip(times["flooded"], watch.measure(FLOODED_S * scale), strict=True):
                into += new
            other.stdin.close()
            ended.update(json.loads(other.stdout.read() or "{}"))
        time.sleep(0.5 * scale)
    row: dict = {"flood": name, "what": FLOODS[name][3], "ended": dict(ended), "load_average": os.getloadavg()[0]}
    for when, (images, health) in times.items():
        row[when] = {"images": len(images), "p50_ms": float(np.median(images))}
        row[when] |= {"p99_ms": float(np.percentile(images, 99)), "max_ms": max(images)}
        row[when] |= {"health_p99_ms": float(np.percentile(health, 99)), "health_max_ms": max(health)}
    row["peak_mb"] = peak_mb(pid)
    return row


def report(rows: list[dict]) -> None:
    """The table, and whether it meets the limits."""
    print(
        f"{'flood':14s} {'alone p50':>9s} {'p99':>7s} {'flooded p50':>11s} {'p99':>7s} {'health p99':>10s} {'peak':>8s}"
    )
    for row in rows:
        alone, flooded = row["alone"], row["flooded"]
        print(
            f"{row['flood']:14s} {alone['p50_ms']:9.1f} {alone['p99_ms']:7.1f} {flooded['p50_ms']:11.1f} "
            f"{flooded['p99_ms']:7.1f} {flooded['health_p99_ms']:10.1f} {row['peak_mb']:8.0f}"
        )
    for row in rows:
        print(f"{row['flood']}: {row['what']}; load {row['load_average']:.1f}")
        for how, count in row["ended"].items():
            print(f"    {count} x {how}")
    for row in rows:
        limit = max(MOST_MS, MOST_RATIO * row["alone"]["p99_ms"])
        print(verdict(f"{row['flood']}: p99 of the small client", row["flooded"]["p99_ms"], limit, "ms"))
        print(verdict(f"{row['flood']}: p99 of health", row["flooded"]["health_p99_ms"], MOST_HEALTH_MS, "ms"))
        print(verdict(f"{row['flood']}: peak memory of the server", row["peak_mb"], MOST_MB, "MB"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=2, help="alone and flooded in turn, so many times for each flood")
    parser.add_argument("--scale", type=float, default=1.0, help="of all durations")
    parser.add_argument("--floods", nargs="+", choices=FLOODS, default=list(FLOODS))
    parser.add_argument("--workers", type=int, help="of the server; its own choice if not given")
    parser.add_argument("--threads", type=int, help="of a renderer; the server's own choice if not given")
    parser.add_argument("--flood", choices=FLOODS, help=argparse.SUPPRESS)
    parser.add_argument("--address", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.flood:
        flood(options.flood, options.address)
        return
    with tempfile.TemporaryDirectory() as folder:
        archive = write_scene(with_unit_quaternions(drive_scene()), Path(folder) / f"{SCENE}.usdz")
        with serving(archive, options) as (address, pid):
            Watch(address).measure(2 * options.scale)  # loads the scene
            rows = [measure_flood(name, address, pid, options.rounds, options.scale) for name in options.floods]
    report(rows)
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps({"cores": len(os.sched_getaffinity(0)), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
