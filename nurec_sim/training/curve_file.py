"""The file of a run's curves: rows of means, appended while it trains."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from nurec_sim.files.new_files import write_file, writing


class Curve:
    """Rows of means since the previous row; rows after the step at which a run resumes are dropped."""

    def __init__(self, path: Path, step: int, columns: Sequence[str]) -> None:
        self.path, self.columns, self.stage = path, columns, ""
        self.sums: dict[str, tuple[float, int]] = {}
        kept = []
        if path.is_file():
            with path.open(newline="") as file:
                kept = [row for row in csv.DictReader(file) if row["step"].isdigit() and int(row["step"]) <= step]
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, columns)
        writer.writeheader()
        writer.writerows({name: row.get(name, "") for name in columns} for row in kept)
        write_file(path, text.getvalue())

    def add(self, stage: str, values: Mapping[str, float]) -> None:
        """Figures of one step."""
        self.stage = stage
        for name, value in values.items():
            total, count = self.sums.get(name, (0.0, 0))
            self.sums[name] = (total + value, count + 1)

    def write(self, step: int, seconds: float) -> None:
        """A row: means of the figures since the last one."""
        means = {name: f"{total / count:.6g}" for name, (total, count) in self.sums.items()}
        with writing(self.path), self.path.open("a", newline="") as file:
            csv.DictWriter(file, self.columns).writerow(
                {"step": step, "stage": self.stage, "seconds": f"{seconds:.1f}"} | means
            )
        self.sums = {}
