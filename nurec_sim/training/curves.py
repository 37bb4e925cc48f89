"""The curves of a training run: ``curves.csv`` plotted as a self-contained HTML page and as a picture."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from nurec_sim.errors import TrainingError
from nurec_sim.files.new_files import write_file
from nurec_sim.report.cells import escape
from nurec_sim.report.figure import base_layout
from nurec_sim.report.template import html_page

FIXED = ("step", "stage", "seconds")
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
"""Colours of the stages, in turn; safe for colour blindness (Okabe and Ito)."""
RATIO = 20.0
"""Positive curves that span more than this factor get a logarithmic scale."""
SMOOTHING = 0.6
"""Decay per neighbour of the weights in the bold, smoothed line; the thin line is the raw data."""
COLUMNS = 4
PANEL_PX = (340, 210)
LEGEND_PX = 26
MORE_STYLE = ".grid{display:grid;grid-template-columns:repeat(auto-fill,minmax(360px,1fr));gap:10px}"
SCRIPT = """
JSON.parse(document.getElementById('figures').textContent).panels.forEach(function (panel) {
  Plotly.newPlot(panel.id, panel.data, panel.layout, {responsive: true, displayModeBar: false});
});
"""
INK, SOFT_INK = (30, 41, 59), (100, 116, 139)
MARGIN = (52, 10, 24, 26)
"""Left, right, top and bottom of a panel's axes, pixels."""


@dataclass(frozen=True, eq=False)
class Curves:
    """Recorded curves of a run, n rows in the order of the steps; NaN for missing values."""

    step: Float64[np.ndarray, " n"]
    stage: tuple[str, ...]
    seconds: Float64[np.ndarray, " n"]
    values: dict[str, Float64[np.ndarray, " n"]]

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of the stages in order of appearance."""
        return tuple(dict.fromkeys(self.stage))

    def of_stage(self, name: str, stage: str) -> tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, " k"]]:
        """Steps and known values of one curve in one stage."""
        values = self.values[name]
        mine = np.array([each == stage for each in self.stage], dtype=bool) & np.isfinite(values)
        return self.step[mine], values[mine]


def read_curves(path: Path) -> Curves:
    """Reads ``curves.csv`` while it is being written or afterwards.

    An incomplete last line is ignored. Where steps repeat, because a run was resumed from a checkpoint, the newest rows
    are kept.

    Raises:
        TrainingError: there is no such file, columns are missing, or a value is not a number.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise TrainingError(f"no curves at {path}: {error.strerror}") from None
    whole = text[: text.rfind("\n") + 1]
    reader = csv.DictReader(io.StringIO(whole))
    if reader.fieldnames is None or not set(FIXED) <= set(reader.fieldnames):
        raise TrainingError(f"{path} must have the columns {', '.join(FIXED)}; it has {reader.fieldnames or 'none'}")
    rows: list[dict[str, Any]] = []
    for number, row in enumerate(reader, 2):
        try:
            read = {
                name: _number(text) for name, text in row.items() if name not in (None, "stage") and text is not None
            }
            if None in row or None in row.values() or not math.isfinite(read["step"]):
                raise ValueError("a row needs a value or nothing for every column")
        except ValueError as error:
            raise TrainingError(f"{path}, line {number}: {error}") from None
        while rows and rows[-1]["step"] >= read["step"]:
            rows.pop()
        rows.append(read | {"stage": row["stage"]})
    named = [name for name in reader.fieldnames if name not in FIXED]
    columns = {name: np.array([row[name] for row in rows], dtype=np.float64) for name in ("step", "seconds", *named)}
    known = {name: columns[name] for name in named if np.isfinite(columns[name]).any()}
    return Curves(columns["step"], tuple(row["stage"] for row in rows), columns["seconds"], known)


def write_curves(folder: Path) -> tuple[Path, Path]:
    """Plots a run folder's ``curves.csv`` as ``curves.html`` and ``curves.png``; returns their paths.

    Raises:
        TrainingError: the curves cannot be read, or are empty.
    """
    curves = read_curves(folder / "curves.csv")
    if not curves.values:
        raise TrainingError(f"{folder / 'curves.csv'} holds no values yet")
    page, picture = folder / "curves.html", folder / "curves.png"
    write_file(page, curves_page(curves, folder.name))
    write_file(picture, cv2.imencode(".png", np.ascontiguousarray(curves_image(curves)[..., ::-1]))[1].tobytes())
    return page, picture


def smoothed(values: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Two-sided exponential moving average, normalised at both ends."""
    forth, back = _fading_sums(values), _fading_sums(values[::-1])[::-1]
    count = _fading_sums(np.ones(len(values)))
    return (forth + back - values) / (count + count[::-1] - 1)


def _fading_sums(values: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    sums, total = np.empty(len(values)), 0.0
    for index, value in enumerate(values):
        sums[index] = total = SMOOTHING * total + value
    return sums


def curves_page(curves: Curves, title: str) -> str:
    """One self-contained HTML text; the same curves give the same text."""
    panels = [{"id": name, **_figure(curves, name)} for name in curves.values]
    plots = "".join(
        f'<div class="card"><b>{escape(name)}</b><div id="{escape(name)}"></div></div>' for name in curves.values
    )
    stages = ", ".join(f'<b style="color:{colour}">{escape(stage)}</b>' for stage, colour in _coloured(curves))
    hours = curves.seconds[-1] / 3600
    last = ", ".join(f"{escape(name)} {_shown(values)}" for name, values in curves.values.items())
    body = [
        f'<h1>Training curves</h1><p class="soft">{escape(title)} · {int(curves.step[-1]):,} steps · '
        f"{hours:.2f} h · stages {stages}</p><div class='grid'>{plots}</div>",
        f'<p class="key">Thin: measured. Bold: smoothed. Newest: {last}.</p>',
    ]
    return html_page(f"{title} · nurec_sim", body, MORE_STYLE, stored={"panels": panels}, script=SCRIPT)


def curves_image(curves: Curves) -> UInt8[np.ndarray, "h w 3"]:
    """One panel per curve, stages in their colours."""
    names = list(curves.values)
    columns = min(COLUMNS, len(names))
    rows = -(-len(names) // columns)
    width, place, lines = columns * PANEL_PX[0], MARGIN[0], 1
    legend = []
    for stage, colour in _coloured(curves):
        wide = 30 + 10 * len(stage)
        if place + wide > width and place > MARGIN[0]:
            place, lines = MARGIN[0], lines + 1
        legend.append((stage, place, lines * LEGEND_PX - 5, colour))
        place += wide
    above = lines * LEGEND_PX
    sheet = np.full((above + rows * PANEL_PX[1], width, 3), 255, np.uint8)
    for stage, left, baseline, colour in legend:
        _write(sheet, stage, left, baseline, 0.5, _rgb(colour))
    for index, name in enumerate(names):
        top, left = above + (index // columns) * PANEL_PX[1], (index % columns) * PANEL_PX[0]
        _draw_panel(sheet[top : top + PANEL_PX[1], left : left + PANEL_PX[0]], curves, name)
    return sheet


def _figure(curves: Curves, name: str) -> dict[str, Any]:
    layout = base_layout(230) | {"showlegend": False}
    layout["xaxis"] |= {"range": [float(curves.step[0]), float(curves.step[-1])]}
    if _logarithmic(curves.values[name]):
        layout["yaxis"] |= {"type": "log"}
    data = []
    for stage, colour in _coloured(curves):
        step, values = curves.of_stage(name, stage)
        for line, opacity, width in ((values, 0.35, 1), (smoothed(values), 1.0, 2)):
            data.append(
                {"type": "scatter", "mode": "lines", "name": escape(stage), "x": step.tolist(), "opacity": opacity,
                 "y": [float(f"{value:.5g}") for value in line], "line": {"color": colour, "width": width}}
            )  # fmt: skip
    return {"data": data, "layout": layout}


def _draw_panel(panel: UInt8[np.ndarray, "h w 3"], curves: Curves, name: str) -> None:
    left, right, top, bottom = MARGIN
    height, width = panel.shape[0] - top - bottom, panel.shape[1] - left - right
    log = _logarithmic(curves.values[name])
    scale = np.log10 if log else np.asarray
    known = scale(curves.values[name][np.isfinite(curves.values[name])])
    low, high = float(known.min()), float(known.max())
    pad = 0.05 * (high - low) or 0.5 * abs(high) or 1.0
    low, high = low - pad, high + pad
    first, last = curves.step[0], max(curves.step[-1], curves.step[0] + 1)

    for share in (0.0, 0.5, 1.0):
        y = top + round((1 - share) * height)
        cv2.line(panel, (left, y), (left + width, y), (226, 232, 240), 1)
        level = low + share * (high - low)
        _write(panel, f"{10**level if log else level:.3g}", 4, y + 4)
    _write(panel, name, left, top - 8, 0.46, INK)
    newest = _shown(curves.values[name])
    _write(panel, newest, left + width - 8 * len(newest), top - 8, 0.4, INK)
    _write(panel, f"{int(first)}", left, panel.shape[0] - 8)
    _write(panel, f"step {int(last)}", left + width - 75, panel.shape[0] - 8)
    for stage, colour in _coloured(curves):
        step, values = curves.of_stage(name, stage)
        rgb = np.array(_rgb(colour))
        for line, ink, thick in ((values, 255 - 0.35 * (255 - rgb), 1), (smoothed(values), rgb, 2)):
            x = left + (step - first) / (last - first) * width
            y = top + (high - scale(line)) / (high - low) * height
            points = np.rint(np.stack([x, y], axis=1)).astype(np.int32)
            cv2.polylines(panel, [points], False, [float(c) for c in ink], thick, cv2.LINE_AA)


def _write(
    image: UInt8[np.ndarray, "h w 3"], text: str, x: int, y: int, size: float = 0.38, ink: tuple[int, ...] = SOFT_INK
) -> None:
    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, ink, 1, cv2.LINE_AA)


def _rgb(colour: str) -> tuple[int, ...]:
    return tuple(int(colour[k : k + 2], 16) for k in (1, 3, 5))


def _coloured(curves: Curves) -> list[tuple[str, str]]:
    return [(stage, COLOURS[index % len(COLOURS)]) for index, stage in enumerate(curves.stages)]


def _logarithmic(values: Float64[np.ndarray, " n"]) -> bool:
    known = values[np.isfinite(values)]
    return bool(known.min() > 0 and known.max() > RATIO * known.min())


def _shown(values: Float64[np.ndarray, " n"]) -> str:
    """The newest known value."""
    return f"{values[np.isfinite(values)][-1]:.4g}"


def _number(text: str) -> float:
    """A number, NaN for an empty cell; infinities count as unknown."""
    if not text.strip():
        return math.nan
    value = float(text)
    return value if math.isfinite(value) else math.nan
