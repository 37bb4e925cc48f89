"""How reconstructions grow with the length of a log: one town driven for 5, 10, 20 and 30 s.

Finished rows are kept in the output, so that an interrupted run continues where it stopped.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from nurec_sim import logs, render, scene
from nurec_sim.cli.console import print_table
from nurec_sim.evaluate.scores.images import psnr, ssim
from nurec_sim.types import SensorRequest

HEADING = ("method", "log s", "CPU s", "peak GB", "static k", "moving k", "USDZ MB", "PSNR dB", "SSIM")
FRAMES = 12
"""Frames per camera that are scored, evenly spread over the log."""


@dataclass(frozen=True)
class Options:
    """Reconstruct one town driven for different lengths and write build/growth/rows.json.

    Args:
        seconds: lengths of the log.
        methods: reconstruction methods.
        seed: of the town.
        folder: for logs, archives and rows; what is there is not made again.
    """

    seconds: tuple[float, ...] = (5, 10, 20, 30)
    methods: tuple[str, ...] = ("lift", "dense")
    seed: int = 7
    folder: Path = Path("build/growth")


def main(options: Options) -> None:
    """Makes the missing rows and prints all."""
    options.folder.mkdir(parents=True, exist_ok=True)
    kept = options.folder / "rows.json"
    rows: dict[str, dict[str, Any]] = json.loads(kept.read_text()) if kept.exists() else {}
    for length in options.seconds:
        clip = options.folder / f"town{length:g}.zip"
        if not clip.exists():
            _command("world", "--seed", str(options.seed), "--seconds", f"{length:g}", "--out", str(clip))
        for method in options.methods:
            name = f"{method} {length:g}"
            if name not in rows:
                rows[name] = {"method": method, "seconds": length} | _row(clip, method)
                kept.write_text(json.dumps(rows, indent=2) + "\n")
    order = sorted(rows.values(), key=lambda row: (row["method"], row["seconds"]))
    print_table("growth with the length of a log", [_cells(row) for row in order], HEADING)


def _row(clip: Path, method: str) -> dict[str, Any]:
    archive = clip.with_name(f"{method}_{clip.stem}.usdz")
    cpu_s, peak_bytes = _command("reconstruct", str(clip), "--method", method, "--overwrite", "--out", str(archive))
    made = scene.read_scene(archive)
    return {
        "cpu_s": cpu_s,
        "peak_bytes": peak_bytes,
        "static": len(made.static),
        "dynamic": len(made.dynamic),
        "archive_bytes": archive.stat().st_size,
    } | _scores(made, logs.open_clip(clip))


def _command(*words: str) -> tuple[float, int]:
    """Runs nurec-sim on one thread; its CPU seconds and peak memory in bytes."""
    process = subprocess.Popen(
        [sys.executable, "-m", "nurec_sim.cli", *words], env=os.environ | {"OMP_NUM_THREADS": "1"}
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"nurec-sim {words[0]} ended with {process.returncode}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _scores(made: scene.GaussianScene, clip: logs.Clip) -> dict[str, float]:
    """Means over recorded frames of all cameras, which the reconstruction has seen, or lie between seen ones."""
    renderer, psnr_db, similarity = render.make_renderer(made, "cpu"), [], []
    for camera in clip.rig.cameras.values():
        times = clip.camera_times_us(camera.id)
        for k in np.linspace(0, len(times) - 1, FRAMES).round().astype(int):
            start_us, end_us = (int(t) for t in times[k])
            poses = clip.world_from_camera(camera.id, k)
            request = SensorRequest(made.id, camera, start_us, max(end_us, start_us + 1), poses)
            drawn, recorded = renderer.render_camera(request, ("rgb",)).rgb, clip.image(camera.id, k)
            psnr_db.append(psnr(drawn, recorded))
            similarity.append(ssim(drawn, recorded))
    return {"psnr_db": float(np.mean(psnr_db)), "ssim": float(np.mean(similarity))}


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    return (
        row["method"],
        f"{row['seconds']:g}",
        f"{row['cpu_s']:.0f}",
        f"{row['peak_bytes'] / 1e9:.1f}",
        f"{row['static'] / 1e3:.0f}",
        f"{row['dynamic'] / 1e3:.0f}",
        f"{row['archive_bytes'] / 1e6:.0f}",
        f"{row['psnr_db']:.2f}",
        f"{row['ssim']:.3f}",
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
