"""Compares the network with `lift` on real logs: views that were not seen, and whether the archive is complete.

The logs are not part of this repository (docs/evaluation.md). The network runs as it is, and with its depth fitted to
the LiDAR that it was given; `lift` always has the LiDAR.
"""

from __future__ import annotations

import dataclasses
import json
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from nurec_sim import logs, scene
from nurec_sim.cli.console import err, out, print_table
from nurec_sim.errors import NurecSimError
from nurec_sim.evaluate.cells import number
from nurec_sim.evaluate.methods import Contender, build
from nurec_sim.evaluate.recorded import front_cameras, recorded_window
from nurec_sim.evaluate.scores.images import psnr
from nurec_sim.evaluate.scoring import score_view
from nurec_sim.evaluate.views import reduced
from nurec_sim.evaluate.windows import Window
from nurec_sim.reconstruct import FeedForwardSettings, LiftSettings
from nurec_sim.scene.interop.validate import validate_archive

HEADING = (
    "method",
    "PSNR full size",
    "PSNR",
    "SSIM",
    "AbsRel",
    "δ1",
    "in metres",
    "thousand",
    "s",
    "USDZ",
)
SIDE_VIEW_EVERY = 5


@dataclass(frozen=True)
class Options:
    """Compare the network with lift on real logs and write build/real_logs.json.

    Args:
        folder: where the logs are: kitti_raw_0009, ddad_6cam, ddad_3cam_static, nuscenes_6cam_1frame.
        checkpoint: weights of the network's profile; those that come with the package if not given.
        profile: which network.
        random_weights: seed of random weights instead, to try the script.
        names: only these logs.
        output: the rows, as JSON.
    """

    folder: tyro.conf.Positional[Path]
    checkpoint: Path | None = None
    profile: str = "tiny"
    random_weights: int | None = None
    names: tuple[str, ...] = ("kitti_raw_0009", "ddad_6cam", "ddad_3cam_static", "nuscenes_6cam_1frame")
    output: Path = Path("build/real_logs.json")


def window_of(path: Path) -> tuple[str, Window]:
    """The chosen part of a log, in words and as a window."""
    log = logs.open_clip(path)
    names = list(log.rig.cameras)
    count = min(len(log.camera_times_us(name)) for name in names)
    if "cam_right" in names:
        asked = range(0, count, SIDE_VIEW_EVERY)
        window = recorded_window(log, log.id, ("cam_left",), range(count), asked, False, ("cam_right",))
        return "cam_right from cam_left", window
    cameras = front_cameras(log, 5)
    if count < 2:
        return "seen frames", recorded_window(log, log.id, cameras, (0,), (0,), False)
    held = count // 2
    seen = [index for index in range(count) if index != held]
    return f"held-out frame {held} of {count}", recorded_window(log, log.id, cameras, seen, (held,), False)


def row(path: Path, shown: str, window: Window, method: Contender) -> dict[str, Any]:
    """Figures of one method on one log."""
    log = logs.open_clip(path)
    built = build(method, window)
    figures: dict[str, list[float]] = {}
    for target in window.targets:
        frame = built.show(target.request)
        index = int(target.name.rsplit("-", 1)[1])
        scores: Mapping[str, float | None] = score_view(reduced(frame.rgb, frame.depth_m), target)["full"] or {}
        whole = {"psnr_whole_db": psnr(frame.rgb, log.image(target.request.sensor.id, index))}
        for name, value in {**scores, **whole}.items():
            if value is not None:
                figures.setdefault(name, []).append(value)
    return {
        "log": log.id, "shown": shown, "method": method.name, "views": len(window.targets),
        **{name: float(np.mean(values)) for name, values in figures.items()},
        "gaussians": built.gaussians, "seconds": built.seconds, "archive": archive_faults(built.scene),
    }  # fmt: skip


def archive_faults(made: Any) -> str:
    """What is wrong with the scene's archive, in one word or more; "complete" if nothing is."""
    if made is None:
        return ""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.usdz"
        scene.write_scene(made, path)
        errors = [finding for finding in validate_archive(path) if finding.severity == "error"]
    return f"{len(errors)} errors: {errors[0]}" if errors else "complete"


def cells(values: Mapping[str, Any]) -> tuple[str, ...]:
    """A row of the printed table."""
    digits = {"psnr_whole_db": 2, "psnr_db": 2, "ssim": 3, "abs_rel": 3, "delta1": 3, "abs_rel_metric": 3}
    thousand = None if values["gaussians"] is None else values["gaussians"] / 1000
    return (
        values["method"], *(number(values.get(n), d) for n, d in digits.items()),
        number(thousand, 0), number(values["seconds"], 1), values["archive"],
    )  # fmt: skip


def main() -> None:
    """Run the benchmark."""
    options = tyro.cli(Options)
    plain = FeedForwardSettings(
        profile=options.profile, checkpoint=options.checkpoint, random_weights=options.random_weights
    )
    methods = [
        Contender("lift", "lift", LiftSettings()),
        Contender(options.profile, "dense", plain),
        Contender(f"{options.profile} + scale", "dense", dataclasses.replace(plain, lidar_depth="scale")),
        Contender(f"{options.profile} + affine", "dense", dataclasses.replace(plain, lidar_depth="affine")),
        Contender(f"{options.profile} + local", "dense", dataclasses.replace(plain, lidar_depth="local")),
    ]
    rows = []
    for name in options.names:
        path, started = options.folder / name, time.monotonic()
        try:
            shown, window = window_of(path)
            for method in methods:
                rows.append(row(path, shown, window, method))
        except NurecSimError as error:
            err.print(f"{name}: {error}", style="red", markup=False)
        out.print(f"{name}: {time.monotonic() - started:.0f} s", markup=False)
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps(rows, indent=1) + "\n")
    for name, shown in dict.fromkeys((values["log"], values["shown"]) for values in rows):
        print_table(f"{name}: {shown}", [cells(values) for values in rows if values["log"] == name], HEADING)


if __name__ == "__main__":
    main()
