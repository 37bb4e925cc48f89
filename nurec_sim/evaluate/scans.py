"""Protocol ``lidar``: held-out sweeps on the driven path and beside it; the columns of the paper's Table 3."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from nurec_sim import geometry
from nurec_sim.evaluate.cells import Table, number, percent
from nurec_sim.evaluate.lidar_scores import score_sweeps
from nurec_sim.evaluate.methods import Built
from nurec_sim.files.new_files import new_file
from nurec_sim.runs.top_view import draw_points
from nurec_sim.types import Clip, LidarFrame, Sense, SensorRequest

Cloud = Float64[np.ndarray, "n 3"]
"""Returns in the frame of the rig."""
FIGURES = (
    "cd_l1_sum", "precision_m", "coverage_m", "intensity_mae", "median_abs_range_error_m", "mean_abs_range_error_m",
    "median_perpendicular_m", "within_0.1_m", "return_recall", "count_ratio",
)  # fmt: skip
SHEET_OFFSETS_M = (0.0, 3.0)
BAR_PX = 18


def score_beside(
    built: Built, beside: Mapping[float, Clip], report: Callable[[float], None]
) -> tuple[dict[str, Any], dict[float, Cloud]]:
    """Scores the target sweeps of a window.

    Args:
        built: a method's result; without a scene it has no sweeps.
        beside: logs of the target sweeps by lateral offset in metres.
        report: called with the fraction done.

    Returns:
        What ``lidar_scores.score_sweeps`` gives, by offset, and for pictures the first simulated sweep at each offset.
    """
    figures, clouds = {}, {}
    for done, (left_m, clip) in enumerate(beside.items()):
        report(done / len(beside))
        count = max(len(clip.sweep_times_us(lidar)) for lidar in clip.rig.lidars)
        if built.scene is None or built.sense is None or not count:
            continue
        figures[f"{left_m:g}"] = score_sweeps(
            clip, built.scene.rig.lidars, range(count), built.sense, lambda stage, fraction: None
        )
        clouds[left_m] = _simulated(clip, built.sense)
    return figures, clouds


def _simulated(clip: Clip, sense: Sense) -> Cloud:
    """The first sweep of a log, simulated, in the frame of the rig at its end."""
    lidar = next(iter(clip.rig.lidars.values()))
    start_us, end_us = (int(t) for t in clip.sweep_times_us(lidar.id)[0])
    poses = clip.ego.at(np.array([start_us, end_us])) @ lidar.rig_from_lidar
    (frame,) = sense([SensorRequest(clip.id, lidar, start_us, end_us, poses)])
    assert isinstance(frame, LidarFrame)
    return geometry.transform_points(lidar.rig_from_lidar, frame.xyz_m.astype(np.float64))


def _recorded(clip: Clip) -> Cloud:
    """The first sweep of a log in the frame of the rig at its end."""
    sweep = clip.sweep(next(iter(clip.rig.lidars)), 0)
    return geometry.transform_points(geometry.inverse(clip.ego.at(sweep.end_us)), sweep.xyz_world_m)


def mean_figures(records: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float | None]]:
    """Means over windows by distance from the path, both sides combined, of ``FIGURES`` and of medians by range.

    Args:
        records: of one method on every window (``scoring.score_window``), without failures.
    """
    at: dict[float, list[Mapping[str, Any]]] = {}
    for record in records:
        for left_m, figures in record.get("sweeps", {}).items():
            at.setdefault(abs(float(left_m)), []).append(figures)
    return {f"{left_m:g}": _means(rows) for left_m, rows in sorted(at.items())}


def _means(rows: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    flat = [
        {name: row.get(name) for name in FIGURES}
        | {f"median at {name}": part["median_abs_range_error_m"] for name, part in row["by_range"].items()}
        for row in rows
    ]
    known = {name: [value for row in flat if (value := row[name]) is not None] for name in flat[0]}
    return {name: float(np.mean(values)) if values else None for name, values in known.items()}


def scan_tables(methods: Mapping[str, Any]) -> list[Table]:
    """The columns of the paper's Table 3, and errors along the beams by range and offset."""
    heading = (
        "method",
        "CD (m)",
        "Prec. (m)",
        "Cov. (m)",
        "Int. MAE",
        "returns",
        "CD at 2 m",
        "of CD at 0",
        "time (s)",
    )
    known = dict.fromkeys(column for row in methods.values() for column in row["sweeps"].get("0", ()))
    by_range = [column for column in known if column.startswith("median at ")]
    table, beams = [], []
    for name, row in methods.items():
        on_path, beside = (row["sweeps"].get(left_m, {}) for left_m in ("0", "2"))
        near, far = on_path.get("cd_l1_sum"), beside.get("cd_l1_sum")
        table.append((
            name, *(number(on_path.get(column), 3) for column in FIGURES[:4]), percent(on_path.get("count_ratio")),
            number(far, 3), number(far / near if near and far is not None else None, 2),
            number(row["seconds"]["reconstruct"], 1),
        ))  # fmt: skip
        beams.append((name, *(number(on_path.get(column), 3) for column in (*FIGURES[4:7], *by_range))))
    note = (
        "CD is the sum of Prec. (mean distance from a simulated return to the nearest recorded one) and Cov. (the "
        "reverse). Int. MAE: over beams that return in both. returns: simulated by recorded. Sweeps: held out, without "
        "noise."
    )
    ranges = ("method", "median", "mean", "perpendicular", *(column.replace(" at", "") for column in by_range))
    away = "perpendicular: median distance from the recorded surface along its normal."
    return [
        Table("lidar", "Protocol lidar (columns of the paper's Table 3)", heading, tuple(table), note),
        Table("lidar_beams", "Range errors along recorded beams, on the path (m)", ranges, tuple(beams), away),
    ]


def draw_scans(path: Path, beside: Mapping[float, Clip], shown: Mapping[str, Mapping[float, Cloud]]) -> None:
    """Writes sweeps from above as PNG, on the path and 3 m to its left: recorded, then one column per method."""
    rows = []
    for left_m in (left for left in SHEET_OFFSETS_M if left in beside):
        clip = beside[left_m]
        if not len(clip.sweep_times_us(next(iter(clip.rig.lidars)))):
            continue
        cells = [_cell(_recorded(clip), clip, f"{left_m:g} m left  truth")]
        cells += [_cell(clouds[left_m], clip, name) for name, clouds in shown.items() if left_m in clouds]
        rows.append(np.hstack(cells))
    if not rows:
        return
    width = max(row.shape[1] for row in rows)
    sheet = np.vstack([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=250) for row in rows])
    with new_file(path) as file:
        file.write(cv2.imencode(".png", np.ascontiguousarray(sheet[..., ::-1]))[1].tobytes())


def _cell(cloud: Cloud, clip: Clip, caption: str) -> UInt8[np.ndarray, "h w 3"]:
    picture = draw_points(cloud, clip.rig.body)
    bar = np.full((BAR_PX, picture.shape[1], 3), 250, np.uint8)
    cv2.putText(bar, caption, (3, BAR_PX - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (40, 40, 40), 1, cv2.LINE_AA)
    return np.pad(np.vstack([bar, picture]), ((0, 3), (0, 3), (0, 0)), constant_values=250)
