"""Quality of per-scene optimisation over its time: `nurec-sim evaluate` with growing budgets, one table.

Every row is the command that a user types, from the log on, so learning rates decay within each budget. Finished rows
are kept, so that an interrupted run continues where it stopped.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from nurec_sim.cli.console import print_table

HEADING = ("budget s", "seen dB, SSIM", "unseen dB, SSIM", "median range error at 10-20, 20-40 m", "Gaussians")


@dataclass(frozen=True)
class Options:
    """Optimise a log for growing times; the scores of each budget go to a file of their own in build/curves.

    Args:
        log: a driving log.
        inputs: cameras to fit.
        targets: cameras to score.
        hold_out_sweeps: every so many sweeps are held out and simulated.
        budgets: seconds of optimisation after `lift`; 0 is `lift` itself.
        folder: for results; what is there of the same log, cameras and sweeps is not made again.
    """

    log: tyro.conf.Positional[Path]
    inputs: tuple[str, ...] = ("cam_left",)
    targets: tuple[str, ...] = ("cam_left", "cam_right")
    hold_out_sweeps: int = 10
    budgets: tuple[float, ...] = (0, 10, 30, 60, 120, 300)
    folder: Path = Path("build/curves")


def main(options: Options) -> None:
    """Makes the missing rows and prints all."""
    options.folder.mkdir(parents=True, exist_ok=True)
    rows, cameras = [], f"{'-'.join(options.inputs)}_{'-'.join(options.targets)}"
    for budget in options.budgets:
        scores = options.folder / f"{options.log.name}_{cameras}_{options.hold_out_sweeps}_{budget:g}.json"
        if not scores.exists():
            _evaluate(options, budget, scores)
        rows.append(_cells(budget, json.loads(scores.read_text())))
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    print_table(f"quality over seconds of optimisation, {options.log.name}", rows, HEADING)


def _evaluate(options: Options, budget: float, scores: Path) -> None:
    refine = () if budget == 0 else ("--refine", f"{budget:g}")
    words = (
        *("evaluate", str(options.log), "--method", "lift", *refine, "--local", "--json", str(scores)),
        *("--input-cameras", *options.inputs, "--target-cameras", *options.targets),
        *("--hold-out-sweeps", str(options.hold_out_sweeps)),
    )
    if subprocess.run([sys.executable, "-m", "nurec_sim.cli", *words], check=False).returncode:
        raise SystemExit(f"nurec-sim {' '.join(words)} failed")


def _cells(budget: float, scores: dict[str, Any]) -> tuple[str, ...]:
    seen, unseen = (scores["image"][kind] for kind in ("seen", "unseen"))
    ranges = [scores["lidar"]["by_range"][part]["median_abs_range_error_m"] for part in ("10-20 m", "20-40 m")]
    images = [f"{each['psnr_db']:.2f}, {each['ssim']:.3f}" for each in (seen, unseen)]
    count = scores["counts"]["static"] + scores["counts"]["dynamic"]
    return f"{budget:g}", *images, ", ".join(f"{each:.3f}" for each in ranges), str(count)


if __name__ == "__main__":
    main(tyro.cli(Options))
