"""Protocol ``detection``: sums of counts to precision, recall and consistency, and their tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nurec_sim.evaluate.cells import Table, number, percent
from nurec_sim.metrics.detection import RANGES_M, added, share
from nurec_sim.network.detector.objects import KINDS

Record = Mapping[str, Any]
NAMES = tuple(f"{low:g}-{high:g} m" for low, high in RANGES_M)
RESAMPLES = 2000


def detection_figures(records: Sequence[Record]) -> dict[str, dict[str, float | int | None]]:
    """Figures of many images, by ``kind range``.

    Args:
        records: of ``sights.Sight.record``.

    Returns:
        ``precision``, ``recall``, ``true_precision``, ``true_recall`` of rendered and of true images, the differences
        ``delta_precision`` and ``delta_recall``, ``kept`` and ``backed``, None where there is nothing to divide by;
        ``there``, the objects, ``found`` and ``true_found``, the detections.
    """
    parts = {part: added([record[part] for record in records]) for part in ("rendered", "true", "kept", "backed")}
    figures: dict[str, dict[str, float | int | None]] = {}
    for name, rendered in parts["rendered"].items():
        true, kept, backed = parts["true"][name], parts["kept"][name], parts["backed"][name]
        row: dict[str, float | int | None] = {
            "precision": share(rendered["right"], rendered["found"]),
            "recall": share(rendered["seen"], rendered["there"]),
            "true_precision": share(true["right"], true["found"]),
            "true_recall": share(true["seen"], true["there"]),
            "kept": share(kept["again"], kept["found"]),
            "backed": share(backed["again"], backed["found"]),
        }
        for figure in ("precision", "recall"):
            one, other = row[figure], row[f"true_{figure}"]
            row[f"delta_{figure}"] = None if one is None or other is None else one - other
        figures[name] = row | {"there": rendered["there"], "found": rendered["found"], "true_found": true["found"]}
    return figures


def summarize_detection(windows: Sequence[Record]) -> dict[str, Any]:
    """A method's figures by distance from the path, both sides combined.

    Args:
        windows: records of ``scoring.score_window`` of one method, without failures.

    Returns:
        By offset in metres ``psnr_db``, ``views``, ``figures`` (``detection_figures``), and ``interval``: of the
        differences of precision and recall of vehicles in the first range, 95 % by a bootstrap over windows. Empty
        without detections.
    """
    rows = [[row for row in window["targets"] if "detection" in row] for window in windows]
    result: dict[str, Any] = {}
    for offset in sorted({abs(row["left_m"]) for window in rows for row in window}):
        at = [[row for row in window if abs(row["left_m"]) == offset] for window in rows]
        views = [row for window in at for row in window]
        result[f"{offset:g}"] = {
            "psnr_db": float(np.mean([row["full"]["psnr_db"] for row in views])),
            "views": len(views),
            "figures": detection_figures([row["detection"] for row in views]),
            "interval": _interval([[row["detection"] for row in window] for window in at if window]),
        }
    return result


def _interval(windows: Sequence[Sequence[Record]]) -> dict[str, list[float] | None]:
    """95 % of the two differences when windows are drawn with replacement; None of less than three windows."""
    ends: dict[str, list[float] | None] = {"delta_precision": None, "delta_recall": None}
    if len(windows) < 3:
        return ends
    name = f"{KINDS[0]} {NAMES[0]}"
    sums = [{part: added([record[part] for record in window])[name] for part in ("rendered", "true")}
            for window in windows]  # fmt: skip
    rng = np.random.default_rng(0)
    drawn = rng.integers(len(sums), size=(RESAMPLES, len(sums)))
    for figure, over, under in (("delta_precision", "right", "found"), ("delta_recall", "seen", "there")):
        both = []
        for part in ("rendered", "true"):
            upper, lower = (
                np.array([each[part][key] for each in sums], np.float64)[drawn].sum(1) for key in (over, under)
            )
            both.append(np.divide(upper, lower, out=np.full(len(upper), np.nan), where=lower > 0))
        difference = both[0] - both[1]
        if np.isfinite(difference).all():
            ends[figure] = [float(end) for end in np.percentile(difference, [2.5, 97.5])]
    return ends


def detection_tables(methods: Mapping[str, Any]) -> list[Table]:
    """Vehicles and people in each range, by method and offset; then intervals."""
    known = {name: row for name, row in methods.items() if row["detection"]}
    if not known:
        return []
    tables = [_of_part(known, kind, name) for kind in KINDS for name in NAMES]
    rows = [
        (name, f"{offset} m", *(_ends(at["interval"][figure]) for figure in ("delta_precision", "delta_recall")))
        for name, row in known.items()
        for offset, at in row["detection"].items()
    ]
    heading = ("method", "offset", "95 % of ΔP", "95 % of ΔR")
    title = f"Differences to true images, {KINDS[0]}, {NAMES[0]}"
    note = "By a bootstrap over windows; of at least three."
    return [*tables, Table("detection_intervals", title, heading, tuple(rows), note)]


def _of_part(methods: Mapping[str, Any], kind: str, name: str) -> Table:
    """One kind in one range: true images at every offset, then the methods."""
    key, first = f"{kind} {name}", next(iter(methods.values()))["detection"]
    rows = []
    for offset, at in first.items():
        row = at["figures"][key]
        shares = percent(row["true_precision"]), "-", percent(row["true_recall"]), *["-"] * 4
        rows.append(("true images", f"{offset} m", "-", *shares))
    for method, summary in methods.items():
        for offset, at in summary["detection"].items():
            row = at["figures"][key]
            shares = (percent(row["precision"]), _points(row["delta_precision"]), percent(row["recall"]),
                      _points(row["delta_recall"]), percent(row["kept"]), percent(row["backed"]))  # fmt: skip
            seconds = number(summary["seconds"]["reconstruct"], 1)
            rows.append((method, f"{offset} m", number(at["psnr_db"], 2), *shares, seconds))
    counts = ", ".join(f"{at['figures'][key]['there']} in {at['views']} views at {o} m" for o, at in first.items())
    note = f"Visible objects: {counts}."
    if (kind, name) == (KINDS[0], NAMES[0]):
        note = (
            "P, R: precision and recall; a detection is right within 2 m of a visible object, seen from above. ΔP, ΔR: "
            "against true images from the same poses, percentage points. kept: detections on true images that are on "
            f"rendered ones too; backed: the reverse. {note}"
        )
    heading = ("method", "offset", "PSNR", "P", "ΔP", "R", "ΔR", "kept", "backed", "time (s)")
    title = f"Protocol detection: {kind}, {name} (as the paper's comparison on internal data)"
    return Table(f"detection_{key.removesuffix(' m').replace(' ', '_')}", title, heading, tuple(rows), note)


def _points(value: float | None) -> str:
    return number(None if value is None else 100 * value, 1, sign=True)


def _ends(ends: Sequence[float] | None) -> str:
    return "-" if ends is None else f"{100 * ends[0]:+.1f} to {100 * ends[1]:+.1f}"
