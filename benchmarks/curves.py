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

HEADING = ("budget s", "seen dB", "SSIM", "unseen dB", "SSIM", "range 10-20 m", "20-40 m", "Gaussians")


@dataclass(frozen=True)
class Options:
    """Optimise a log for growing times and write build/curves/LOG.json.

    Args:
        log: a driving log.
        inputs: cameras to fit.
        targets: cameras to score.
        hold_out_sweeps: every so many sweeps are held out and simulated.
        budgets: seconds of optimisation after `lift`; 0 is `lift` itself.
        folder: for results; what is there is not made again.
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
    rows = []
    for budget in options.budgets:
        scores = options.folder / f"{options.log.name}_{budget:g}.json"
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
    seen, unseen, ranges = scores["image"]["seen"], scores["image"]["unseen"], scores["lidar"]["by_range"]
    return (
        f"{budget:g}",
        f"{seen['psnr_db']:.2f}",
        f"{seen['ssim']:.3f}",
        f"{unseen['psnr_db']:.2f}",
        f"{unseen['ssim']:.3f}",
        *(f"{ranges[f'{part} m']['median_abs_range_error_m']:.3f}" for part in ("10-20", "20-40")),
        f"{scores['counts']['static'] + scores['counts']['dynamic']}",
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
