"""How reconstructions grow with the length of a log: the first 5, 10, 20 and 30 s of one recorded drive.

Frames are scored over the whole log, and over the shortest one, which all have in common. Finished rows are kept in the
output, so that an interrupted run continues where it stopped.
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

HEADING = (
    *("method", "log s", "CPU s", "peak GB", "static k", "moving k", "USDZ MB"),
    *("PSNR dB", "SSIM", "PSNR dB, shared part", "SSIM, shared part"),
)
FRAMES = 12
"""Frames per camera that are scored, evenly spread."""


@dataclass(frozen=True)
class Options:
    """Reconstruct the first parts of one drive through a town and write rows.json, in a folder for each drive.

    Args:
        seconds: lengths of the log; the longest is recorded, the others are its first parts.
        methods: reconstruction methods.
        seed: of the town.
        hz: frame sets per second.
        folder: for the folders of drives: logs, archives and rows. What is there is not made again.
    """

    seconds: tuple[float, ...] = (5, 10, 20, 30)
    methods: tuple[str, ...] = ("lift", "dense")
    seed: int = 7
    hz: float = 10.0
    folder: Path = Path("build/growth")


def main(options: Options) -> None:
    """Makes the missing rows and prints all."""
    longest, shortest = max(options.seconds), min(options.seconds)
    # A longer drive need not begin as a shorter one, and the shared part is that of the shortest.
    folder = options.folder / f"seed{options.seed}_{options.hz:g}hz_{shortest:g}to{longest:g}s"
    folder.mkdir(parents=True, exist_ok=True)
    kept = folder / "rows.json"
    rows: dict[str, dict[str, Any]] = json.loads(kept.read_text()) if kept.exists() else {}
    drive = folder / f"town{longest:g}.zip"
    if not drive.exists():
        drawn = ("--seed", str(options.seed), "--seconds", f"{longest:g}", "--hz", f"{options.hz:g}")
        _command("world", *drawn, "--out", str(drive))
    for length in options.seconds:
        clip = folder / f"town{length:g}.zip"
        if not clip.exists():
            _command("trim", str(drive), "--seconds", f"{length:g}", "--out", str(clip))
        for method in options.methods:
            name = f"{method} {length:g}"
            if name not in rows:
                rows[name] = {"method": method, "seconds": length} | _row(clip, method, shortest)
                kept.write_text(json.dumps(rows, indent=2) + "\n")
    order = sorted(rows.values(), key=lambda row: (row["method"], row["seconds"]))
    print_table("growth with the length of a log", [_cells(row) for row in order], HEADING)


def _row(clip: Path, method: str, shared_s: float) -> dict[str, Any]:
    archive = clip.with_name(f"{method}_{clip.stem}.usdz")
    cpu_s, peak_bytes = _command("reconstruct", str(clip), "--method", method, "--overwrite", "--out", str(archive))
    made = scene.read_scene(archive)
    return {
        "cpu_s": cpu_s,
        "peak_bytes": peak_bytes,
        "static": len(made.static),
        "dynamic": len(made.dynamic),
        "archive_bytes": archive.stat().st_size,
    } | _scores(made, logs.open_clip(clip), shared_s)


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


def _scores(made: scene.GaussianScene, clip: logs.Clip, shared_s: float) -> dict[str, float]:
    """Means over recorded frames of all cameras, of the whole log and of its first ``shared_s`` seconds."""
    renderer = render.make_renderer(made, "cpu")
    shared_end_us = clip.span_us[0] + round(shared_s * 1e6)

    def means(end_us: int) -> tuple[float, float]:
        scores = []
        for camera in clip.rig.cameras.values():
            times = np.asarray(clip.camera_times_us(camera.id))
            last = np.searchsorted(times[:, 1], end_us, side="right") - 1
            for k in np.unique(np.linspace(0, last, FRAMES).round().astype(int)):
                start_us, end = (int(t) for t in times[k])
                poses = clip.world_from_camera(camera.id, k)
                request = SensorRequest(made.id, camera, start_us, max(end, start_us + 1), poses)
                drawn, recorded = renderer.render_camera(request, ("rgb",)).rgb, clip.image(camera.id, k)
                scores.append((psnr(drawn, recorded), ssim(drawn, recorded)))
        psnr_db, similarity = np.mean(scores, axis=0)
        return float(psnr_db), float(similarity)

    whole, shared = means(clip.span_us[1]), means(shared_end_us)
    return dict(zip(("psnr_db", "ssim", "shared_psnr_db", "shared_ssim"), (*whole, *shared), strict=True))


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
        f"{row['shared_psnr_db']:.2f}",
        f"{row['shared_ssim']:.3f}",
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
