"""The report of an evaluation: one HTML file with tables, curves and contact sheets that needs no network."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from nurec_sim.errors import RunError
from nurec_sim.evaluate.cells import Table
from nurec_sim.evaluate.methods import CHOICES
from nurec_sim.report.cells import count_of
from nurec_sim.report.figure import base_layout, line_trace, plain
from nurec_sim.report.template import html_page

JPEG_QUALITY = 88
TITLES = {
    "storm": "2 s windows, four input frames",
    "clip": "Whole clips through the chunked pipeline",
    "shift": "Views at lateral offsets",
    "lidar": "Held-out LiDAR sweeps on the driven path and beside it",
    "detection": "A camera detector on true and on rendered images",
}
CURVES = {
    "psnr_db": "PSNR (dB)",
    "shown_psnr_db": "PSNR (dB) of what inputs show",
    "abs_rel": "AbsRel (aligned)",
    "abs_rel_metric": "AbsRel (metres)",
}
SWEEP_CURVES = {"cd_l1_sum": "Chamfer distance (m)", "median_abs_range_error_m": "median range error (m)"}
COLOURS = ("#1d4ed8", "#b45309", "#15803d", "#7e22ce", "#64748b")
MORE_STYLE = "img { max-width:100%; border-radius:6px; display:block; } .plots { display:grid; gap:16px; }"


def render_page(results: Mapping[str, Any], tables: Sequence[Table], sheets: Sequence[Path]) -> str:
    """The report as HTML; the same results give the same text."""
    protocol = results["protocol"]
    figures = _curves(results["summary"]["methods"])
    calibration = calibration_figure(results["summary"]["methods"])
    if calibration is not None:
        figures["calibration"] = calibration
    body = [
        f"<h1>Evaluation: protocol {escape(protocol['name'])}</h1>",
        f'<p class="soft">{escape(TITLES[protocol["name"]])} · {count_of(len(results["windows"]), "window")} · '
        f"nurec_sim {escape(results['version'])}</p>",
        '<div class="card"><div class="plots">'
        + "".join(f'<div class="plot" id="{n}"></div>' for n in figures)
        + "</div></div>"
        if figures
        else "",
        *(_table(table) for table in tables),
        _methods(results["methods"]),
        "<h2>Contact sheets</h2>",
        *(_sheet(path, results["windows"]) for path in sheets),
    ]
    stored = {"figures": figures, "images": {}} if figures else None
    return html_page(f"{protocol['name']} · nurec_sim", body, MORE_STYLE, stored)


def _table(table: Table) -> str:
    heads = "".join(f'<th class="{"n" if n else ""}">{escape(text)}</th>' for n, text in enumerate(table.heading))
    rows = "".join(
        "<tr>" + "".join(f'<td class="{"n" if n else ""}">{escape(cell)}</td>' for n, cell in enumerate(row)) + "</tr>"
        for row in table.rows
    )
    note = f'<p class="key">{escape(table.note)}</p>' if table.note else ""
    return (
        f'<h2>{escape(table.title)}</h2><div class="card scroll"><table><thead><tr>{heads}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>{note}"
    )


def _methods(methods: Mapping[str, Any]) -> str:
    items = []
    for name, described in methods.items():
        weights = (described.get("settings") or {}).get("checkpoint")
        seed = (described.get("settings") or {}).get("random_weights")
        text = f"{CHOICES.get(name, '')}"
        text += f"; weights {weights[:12]}" if weights else ""
        text += f"; random weights of seed {seed}: its results are meaningless" if seed is not None else ""
        items.append(f"<li><b>{escape(name)}</b>: {escape(text)}</li>")
    return f'<h2>Methods</h2><div class="card"><ul>{"".join(items)}</ul></div>'


def _sheet(path: Path, windows: Sequence[Mapping[str, Any]]) -> str:
    picture = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise RunError(f"{path} is not an image; delete it and its window's record, and run again")
    data = base64.b64encode(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())
    about: Mapping[str, Any] = next((window["about"] for window in windows if window["id"] == path.stem), {})
    facts = " · ".join(f"{key.replace('_', ' ')} {value}" for key, value in about.items())
    return (
        f'<div class="card"><h3>{escape(path.stem)}</h3><p class="key">{escape(facts)}</p>'
        f'<img alt="contact sheet of {escape(path.stem)}" src="data:image/jpeg;base64,{data.decode()}"></div>'
    )


def _curves(methods: Mapping[str, Any]) -> dict[str, Any]:
    """Metrics over the offset from the path, if available."""
    part, columns = ("sweeps", SWEEP_CURVES) if any(row["sweeps"] for row in methods.values()) else ("curve", CURVES)
    if not any(row[part] for row in methods.values()):
        return {}
    figures = {}
    for column, title in columns.items():
        traces = []
        for number, (name, row) in enumerate(methods.items()):
            values = {float(at): figures.get(column) for at, figures in row[part].items()}
            points = [(at, value) for at, value in values.items() if value is not None]
            if points:
                colour = COLOURS[number % len(COLOURS)]
                traces.append({
                    "type": "scatter", "mode": "lines+markers", "name": plain(name), "x": [x for x, _ in points],
                    "y": [round(y, 4) for _, y in points], "line": {"color": colour, "width": 2},
                })  # fmt: skip
        layout = base_layout(300)
        layout["xaxis"]["title"], layout["yaxis"]["title"] = {"text": "lateral offset (m)"}, {"text": title}
        figures[f"curve_{column}"] = {"data": traces, "layout": layout}
    return figures


def calibration_figure(methods: Mapping[str, Any]) -> dict[str, Any] | None:
    """Share of right pixels over support of the methods that have it; None without."""
    known = {name: row["support"]["calibration"] for name, row in methods.items() if row.get("support")}
    if not known:
        return None
    data = [line_trace("calibrated", np.array([[0, 0], [1, 100]]), "#94a3b8", dash="dot")]
    for name, bins in known.items():
        colour = COLOURS[list(methods).index(name) % len(COLOURS)]
        points = np.array([(each["support"], 100 * each["right"]) for each in bins])
        data.append({**line_trace(name, points, colour), "mode": "lines+markers"})
    layout = base_layout(300)
    layout["xaxis"]["title"], layout["yaxis"]["title"] = {"text": "support"}, {"text": "right pixels (%)"}
    return {"data": data, "layout": layout}
