"""Timing of entries that take turns: frame 0 of each, then frame 1 of each; drift of the machine hits all alike."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nurec_sim.types import SensorFrame, SensorRequest

Render = Callable[[Sequence[SensorRequest]], list[SensorFrame]]


@dataclass
class Entry:
    """One row in the making: what identifies it, how to render a tick, and the times so far.

    ``reports`` gives the renderer's own account of a tick (evaluations, seconds per stage) where it has one; it is
    called apart from the timed frames.
    """

    facts: dict[str, Any]
    ticks: list[list[SensorRequest]]
    render: Render
    reports: Callable[[Sequence[SensorRequest]], list[Any]] | None = None
    first_ms: float | None = None
    wall_ms: list[float] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)
    load: float = 0.0
    figures: dict[str, Any] = field(default_factory=dict)

    def row(self) -> dict[str, Any]:
        """The row of the results file."""
        timed = len(self.wall_ms) > 0
        return {
            **self.facts,
            "frames": len(self.wall_ms),
            "ms_median": float(np.median(self.wall_ms)) if timed else None,
            "ms_p99": float(np.quantile(self.wall_ms, 0.99)) if timed else None,
            "cpu_ms_median": float(np.median(self.cpu_ms)) if timed else None,
            "ms_first": self.first_ms,
            "load_average": self.load,
            **self.figures,
        }


def warm_up(entries: Sequence[Entry], tick: Callable[[Entry], None]) -> None:
    """Render and time the first frame of every entry; ``tick`` is called after every frame."""
    for entry in entries:
        entry.first_ms = _timed(entry.render, entry.ticks[0])[0]
        tick(entry)


def take_turns(entries: Sequence[Entry], tick: Callable[[Entry], None]) -> None:
    """Time the frames of all entries in turns."""
    for number in range(max((len(entry.ticks) for entry in entries), default=0)):
        for entry in entries:
            if number < len(entry.ticks):
                wall, cpu = _timed(entry.render, entry.ticks[number])
                entry.wall_ms.append(wall)
                entry.cpu_ms.append(cpu)
                entry.load = os.getloadavg()[0]
                tick(entry)


def _timed(render: Render, requests: Sequence[SensorRequest]) -> tuple[float, float]:
    """Wall and process CPU time in milliseconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    render(requests)
    return (time.perf_counter() - wall) * 1e3, (time.process_time() - cpu) * 1e3


def account(entry: Entry, ticks: int = 3) -> dict[str, Any]:
    """Means over some ticks of what the renderer counts itself; nothing if it does not count.

    ``evaluations_per_pixel`` are responses of a Gaussian computed for a ray over rays rendered, ``in_view`` the
    Gaussians that reach some ray, ``stages`` the milliseconds per stage as seen by the calling thread.
    """
    if entry.reports is None:
        return {}
    every = max(1, len(entry.ticks) // ticks)
    counted = [entry.reports(asked) for asked in entry.ticks[::every][:ticks]]
    stats = [report for reports in counted for report in reports]
    stages = {
        # Frames of a tick go through the stages together, and each of them tells the time of all.
        name: 1e3 * sum(max(report.seconds.get(name, 0.0) for report in reports) for reports in counted) / len(counted)
        for name in stats[0].seconds
    }
    return {
        "in_view": round(sum(report.visible for report in stats) / len(counted)),
        "pairs": round(sum(report.pairs for report in stats) / len(counted)),
        "evaluations_per_pixel": sum(report.evaluations for report in stats) / len(counted) / entry.facts["pixels"],
        "stages": stages,
    }
