"""Runs a protocol window by window; finished windows are kept on disk and interrupted runs resumed.

::

    evaluations/latest -> 2026-01-31_18-00-00/
      settings.json  results.json  tables.md  <table>.csv  report.html
      windows/<window>.json  sheets/<window>.png
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import nurec_sim
from nurec_sim.errors import ReconstructError, RunError
from nurec_sim.evaluate.detection.sheet import draw_detections
from nurec_sim.evaluate.methods import Contender, describe
from nurec_sim.evaluate.page import render_page
from nurec_sim.evaluate.protocols import Protocol
from nurec_sim.evaluate.scans import draw_scans
from nurec_sim.evaluate.scoring import Scored, score_window
from nurec_sim.evaluate.sheet import draw_sheet
from nurec_sim.evaluate.summary import summarize
from nurec_sim.evaluate.tables import tables
from nurec_sim.evaluate.windows import Window
from nurec_sim.files.new_files import write_file

Progress = Callable[[str, float], None]
SETTINGS, RESULTS, TABLES, REPORT = "settings.json", "results.json", "tables.md", "report.html"
DRAWING_SHARE = 0.3
"""Fractions of a window's time, for the progress bar."""


def run_protocol(
    protocol: Protocol,
    methods: Sequence[Contender],
    folder: Path | None = None,
    progress: Progress | None = None,
    device: str = "auto",
) -> dict[str, Any]:
    """Compares methods on a protocol.

    Args:
        protocol: the windows.
        methods: the methods; see ``contenders``.
        folder: run folder for windows, tables, sheets and report, also for resuming; None writes nothing.
        progress: called with stage and fraction done.
        device: that renders; see ``render.choose_device``.

    Returns:
        ``protocol``, ``methods`` (all settings), ``windows`` (per-view metrics) and ``summary``
        (``summary.summarize``), plain JSON.

    Raises:
        RunError: the folder holds a run with other settings, or a file in it is damaged.
        WeightsError: a network's weights are not there or cannot be used.
    """
    settings = settings_of(protocol, methods)
    if folder is not None:
        _open_folder(folder, settings)
    records = []
    for index, name in enumerate(protocol.ids):
        record = None if folder is None else _finished(folder, name, methods)
        if record is None:
            record = _window(protocol, index, methods, folder, progress or (lambda stage, fraction: None), device)
        records.append(record)
    results = settings | {"windows": records, "summary": summarize(records, [method.name for method in methods])}
    if folder is not None:
        _write_results(folder, results)
    return results


def settings_of(protocol: Protocol, methods: Sequence[Contender]) -> dict[str, Any]:
    """All settings that affect the results, as round-tripped JSON."""
    described = {
        "version": nurec_sim.__version__,
        "protocol": dataclasses.asdict(protocol),
        "methods": {method.name: describe(method) for method in methods},
        "ids": list(protocol.ids),
    }
    return json.loads(json.dumps(described, default=str))


def _window(
    protocol: Protocol, index: int, methods: Sequence[Contender], folder: Path | None, progress: Progress, device: str
) -> dict[str, Any]:
    name, count = protocol.ids[index], len(protocol.ids)

    def tell(stage: str, fraction: float) -> None:
        progress(f"{name} ({index + 1} of {count}): {stage}", (index + min(fraction, 1.0)) / count)

    with protocol.window(index, lambda stage, fraction: tell(stage, DRAWING_SHARE * fraction)) as window:
        scored: dict[str, Scored | str] = {}
        share = (1 - DRAWING_SHARE) / len(methods)
        for number, method in enumerate(methods):
            first = DRAWING_SHARE + share * number
            scored[method.name] = _scored(method, window, _part(tell, first, share), device)
        record = {
            "id": window.id,
            "about": dict(window.about),
            "methods": {n: {"error": s} if isinstance(s, str) else s.record for n, s in scored.items()},
        }
        if folder is not None:
            shown = {n: s for n, s in scored.items() if isinstance(s, Scored)}
            sheet = folder / "sheets" / f"{name}.png"
            if window.beside:
                draw_scans(sheet, window.beside, {method: scored.sweeps for method, scored in shown.items()})
            elif any(target.sight is not None for target in window.targets):
                draw_detections(sheet, window, {method: scored.detections for method, scored in shown.items()})
            else:
                draw_sheet(sheet, window, shown)
            write_file(folder / "windows" / f"{name}.json", _json(record))
    return record


def _part(progress: Progress, first: float, share: float) -> Progress:
    """Maps the progress of a part to the whole."""
    return lambda stage, fraction: progress(stage, first + share * fraction)


def _scored(method: Contender, window: Window, progress: Progress, device: str) -> Scored | str:
    """A method's scores, or the error text if it failed on this window."""
    try:
        return score_window(method, window, progress, device)
    except ReconstructError as error:
        return str(error)


def _open_folder(folder: Path, settings: dict[str, Any]) -> None:
    """Creates a folder for these settings, or checks an existing one.

    Raises:
        RunError: it has a run with other settings.
    """
    for part in ("windows", "sheets"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    path = folder / SETTINGS
    if not path.exists():
        write_file(path, _json(settings))
        return
    found = _read(path)
    if found != settings:
        where, was, now = next(_differences(found, settings))
        raise RunError(
            f"{folder} has a run with other settings: {where} was {was}, now {now}; "
            "use the old settings, or start a new run without --resume"
        )


def _differences(was: Any, now: Any, where: str = "") -> Any:
    """Differences of two JSON values: (path, old, new)."""
    if isinstance(was, dict) and isinstance(now, dict):
        for key in sorted({*was, *now}):
            yield from _differences(was.get(key), now.get(key), f"{where}.{key}" if where else key)
    elif was != now:
        yield where or "everything", json.dumps(was), json.dumps(now)


def _finished(folder: Path, name: str, methods: Sequence[Contender]) -> dict[str, Any] | None:
    """The record of a finished window."""
    path = folder / "windows" / f"{name}.json"
    if not path.exists():
        return None
    record = _read(path)
    if not isinstance(record, dict) or set(record.get("methods", ())) != {method.name for method in methods}:
        raise RunError(f"{path} does not have the results of these methods; delete it and run again")
    return record


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RunError(f"cannot read {path}: {error}; delete it and run again") from None


def _write_results(folder: Path, results: dict[str, Any]) -> None:
    made = tables(results)
    write_file(folder / TABLES, "\n".join(table.markdown() for table in made))
    for table in made:
        write_file(folder / f"{table.name}.csv", table.csv())
    write_file(folder / RESULTS, _json(results))
    write_file(folder / REPORT, render_page(results, made, sorted((folder / "sheets").glob("*.png"))))


def _json(values: Any) -> str:
    return json.dumps(values, indent=1, sort_keys=False, allow_nan=False) + "\n"
