"""The tables of a protocol for terminal, Markdown, CSV and report."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from nurec_sim.evaluate.cells import NOT_KNOWN, Table, number, percent
from nurec_sim.evaluate.detection.summary import detection_tables
from nurec_sim.evaluate.scans import scan_tables
from nurec_sim.evaluate.support import support_tables
from nurec_sim.report.cells import count_of

PAPER_HEADING = ("PSNR", "SSIM", "AbsRel", "δ1")
PAPER_COLUMNS = ("psnr_db", "ssim", "abs_rel", "delta1")


def tables(results: Mapping[str, Any]) -> list[Table]:
    """All tables of the results of a run (``run.run_protocol``), the paper's first."""
    protocol, summary = results["protocol"], results["summary"]
    name, methods = protocol["name"], summary["methods"]
    made = []
    if name == "shift":
        made += [
            _curve(methods, "psnr_db", "PSNR (dB)", 2),
            _curve(methods, "abs_rel", "AbsRel", 3),
            *_shown(methods),
            _doubling(methods),
            *support_tables(methods),
        ]
    elif name == "lidar":
        return [*scan_tables(methods), _cost(methods), *_failures(results["windows"])]
    elif name == "detection":
        return [*detection_tables(methods), _cost(methods), *_failures(results["windows"])]
    else:
        made.append(_paper_table(results))
        if name == "storm":
            made += [_static(methods), _times(methods)]
    made += [_metric_depth(methods, ", on the path" if name == "shift" else ""), _cost(methods)]
    if summary["differences"]:
        made.append(_differences(summary["differences"]))
    return made + _failures(results["windows"])


def _failures(windows: Sequence[Mapping[str, Any]]) -> list[Table]:
    failed = [
        (window["id"], method, record["error"])
        for window in windows
        for method, record in window["methods"].items()
        if "error" in record
    ]
    return [Table("failures", "Failures", ("window", "method", "error"), tuple(failed))] if failed else []


def _paper_table(results: Mapping[str, Any]) -> Table:
    protocol, methods = results["protocol"], results["summary"]["methods"]
    storm = protocol["name"] == "storm"
    heading = ["method", *PAPER_HEADING]
    if storm:
        heading += [f"dyn {name}" for name in PAPER_HEADING]
    rows = []
    for name, row in methods.items():
        cells = [name, *_paper_cells(row["full"])]
        rows.append(tuple(cells + _paper_cells(row["dynamic"]) if storm else cells))
    views = max((row["views"] for row in methods.values()), default=0)
    boxes = "with the log's boxes"
    if not protocol["boxes"]:
        boxes = "without boxes, as the paper's network; those that read sweeps find what moves in them"
    windows = count_of(len(results["windows"]), "window")
    note = (
        f"{windows}, {views} views per method. Depth after per-frame least-squares scale, as in the paper; true depth "
        f"up to 80 m; a pixel without depth counts as wrong. Methods ran {boxes}."
    )
    if storm:
        note += " dyn: pixels of vehicles, pedestrians and other movable objects, moving or not."
    title = "Protocol storm (columns of the paper's Table 1)" if storm else "Protocol clip (columns of Table 2)"
    return Table("paper", title, tuple(heading), tuple(rows), note)


def _paper_cells(figures: Mapping[str, float | None]) -> list[str]:
    return [number(figures[column], 2 if column == "psnr_db" else 3) for column in PAPER_COLUMNS]


def _static(methods: Mapping[str, Any]) -> Table:
    rows = tuple((name, *_paper_cells(row["static"])) for name, row in methods.items())
    note = "All pixels except movable objects; depth with the scale of the whole frame."
    return Table("static", "Static region", ("method", *PAPER_HEADING), rows, note)


def _times(methods: Mapping[str, Any]) -> Table:
    rows = []
    for name, row in methods.items():
        cells = [
            number(row[part][c], 2 if c == "psnr_db" else 3) for part in ("between", "beyond") for c in PAPER_COLUMNS
        ]
        rows.append((name, *cells))
    heading = ("method", *PAPER_HEADING, *(f"after {name}" for name in PAPER_HEADING))
    note = "First interpolated between the four input frames, then extrapolated by up to 0.4 s."
    return Table("times", "Interpolation and extrapolation in time", heading, tuple(rows), note)


def _metric_depth(methods: Mapping[str, Any], where: str) -> Table:
    rows = tuple(
        (
            name,
            *(number(row["full"][column], 3) for column in ("abs_rel_metric", "delta1_metric")),
            *(number(row["dynamic"][column], 3) for column in ("abs_rel_metric", "delta1_metric")),
            number(row["full"]["depth_scale"], 3),
            percent(row["full"]["depth_coverage"]),
        )
        for name, row in methods.items()
    )
    heading = ("method", "AbsRel", "δ1", "dyn AbsRel", "dyn δ1", "scale", "covered")
    note = "scale: least-squares factor of the depth, 1 if metric."
    return Table("metric_depth", f"Metric depth, not aligned{where}", heading, rows, note)


def _cost(methods: Mapping[str, Any]) -> Table:
    rows = []
    for name, row in methods.items():
        count, seconds = row["gaussians"], row["seconds"]
        render_ms = None if seconds["render"] is None else 1000 * seconds["render"]
        cells = (
            number(None if count is None else count / 1000, 0),
            number(seconds["reconstruct"], 2),
            number(render_ms, 1),
        )
        rows.append((name, *cells, str(row["windows"]), str(row["failed"])))
    heading = ("method", "Gaussians (thousand)", "reconstruct (s)", "render (ms per view)", "windows", "failed")
    return Table("cost", "Cost", heading, tuple(rows), "Means over windows, on this machine.")


def _curve(methods: Mapping[str, Any], column: str, title: str, digits: int) -> Table:
    offsets = sorted({offset for row in methods.values() for offset in row["curve"]}, key=float)
    rows = tuple(
        (name, *(number(row["curve"].get(offset, {}).get(column), digits) for offset in offsets))
        for name, row in methods.items()
    )
    views = max(methods.values(), key=lambda row: len(row["curve"]))["curve"]
    counts = ", ".join(f"{offset} m: {views[offset]['views']}" for offset in offsets if offset in views)
    note = f"Views left and right of the path combined ({counts}); those inside objects are skipped."
    return Table(f"shift_{column}", f"{title} by lateral offset", ("method", *(f"{o} m" for o in offsets)), rows, note)


def _shown(methods: Mapping[str, Any]) -> list[Table]:
    """Curves of what an input image shows; none where that is not known."""
    curves = [row["curve"] for row in methods.values()]
    shares = {offset: figures.get("shown_share") for curve in curves for offset, figures in curve.items()}
    if not any(shares.values()):
        return []
    text = ", ".join(f"{offset} m: {100 * share:.0f} %" for offset, share in shares.items() if share is not None)
    note = f"Pixels that show what an input image shows, too, by true depth ({text} of all)."
    made = [
        _curve(methods, "shown_psnr_db", "PSNR (dB) of what an input image shows", 2),
        _curve(methods, "shown_abs_rel", "AbsRel of what an input image shows", 3),
    ]
    return [dataclasses.replace(table, note=note) for table in made]


def _doubling(methods: Mapping[str, Any]) -> Table:
    rows = []
    for name, row in methods.items():
        known = [figures["abs_rel"] for figures in row["curve"].values()]
        reached, farthest = row["abs_rel_doubles_at_m"], max(map(float, row["curve"]), default=0.0)
        text = f"{reached:.2f} m" if reached is not None else f"not reached up to {farthest:g} m"
        psnr_db = [row["curve"].get(offset, {}).get("psnr_db") for offset in ("0", "2")]
        lost = None if None in psnr_db else psnr_db[0] - psnr_db[1]
        rows.append((name, text if known and None not in known else "depth unknown", number(lost, 2)))
    heading = ("method", "AbsRel doubles at", "PSNR loss at 2 m (dB)")
    return Table("shift_doubling", "Degradation with lateral offset", heading, tuple(rows))


def _differences(differences: Sequence[Mapping[str, Any]]) -> Table:
    rows = []
    for pair in differences:
        cells = [f"{pair['method']} - {pair['against']}"]
        for part in ("full", "dynamic"):
            found = pair[part]
            cells += [number(found["psnr_db"], 2, sign=True), _interval(found["interval_db"])]
            cells.append(f"{found['better_in']} of {found['windows']}")
        rows.append((*cells, percent(pair["share_of_gaussians"])))
    heading = ("PSNR, paired by window", "dB", "95 %", "better in", "dyn dB", "dyn 95 %", "dyn better in", "Gaussians")
    note = "Intervals by a bootstrap over windows. Gaussians: of the first method, relative to the second."
    return Table("differences", "Differences between methods", heading, tuple(rows), note)


def _interval(ends: Sequence[float] | None) -> str:
    return NOT_KNOWN if ends is None else f"{ends[0]:+.2f} to {ends[1]:+.2f}"
