"""Contact sheets: ground truth beside every method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from nurec_sim.evaluate.scoring import Scored
from nurec_sim.evaluate.views import ScoredView
from nurec_sim.evaluate.windows import EvaluationView, Window
from nurec_sim.files.new_files import new_file

Picture = UInt8[np.ndarray, "h w 3"]
NEAR_M, FAR_M = 2.0, 80.0
"""Range of the logarithmic depth colour scale."""
BAR_PX, GAP_PX = 18, 3
PAPER, INK, UNKNOWN = (250, 250, 250), (40, 40, 40), (225, 225, 225)


def draw_sheet(path: Path, window: Window, shown: Mapping[str, Scored]) -> None:
    """Writes a sheet as PNG: a row per target, then the depth of the first; one column per method."""
    columns = ["truth", *shown]
    rows = []
    chosen = chosen_targets(window.targets)
    for target in chosen:
        cells = [lettered(_rgb(target.true), f"{target.name}  truth")]
        for name, scored in shown.items():
            full = _figures(scored, target)["full"]
            cells.append(lettered(_rgb(scored.views[target.name]), f"{name}  {full['psnr_db']:.1f} dB"))
        rows.append(side_by_side(cells))
    target = chosen[0]
    cells = [lettered(_depth(target.true), f"{target.name}  depth, {NEAR_M:g} to {FAR_M:g} m")]
    for name in columns[1:]:
        error = _figures(shown[name], target)["full"]["abs_rel"]
        caption = f"{name}  depth unknown" if error is None else f"{name}  AbsRel {error:.3f}"
        cells.append(lettered(_depth(shown[name].views[target.name]), caption))
    rows.append(side_by_side(cells))
    sheet = stacked(rows)
    with new_file(path) as file:
        file.write(cv2.imencode(".png", np.ascontiguousarray(sheet[..., ::-1]))[1].tobytes())


def chosen_targets(targets: Sequence[EvaluationView]) -> list[EvaluationView]:
    """The targets on a sheet.

    With lateral offsets: on the path, left, right and far off. Otherwise the middle interpolated view of each camera,
    and the last extrapolated one.
    """
    if beside := [target for target in targets if target.left_m]:
        at = sorted(beside, key=lambda target: (target.left_m, target.name))
        wanted = [
            next(t for t in targets if t.left_m == 0),
            *(min(at, key=lambda t: abs(t.left_m - m)) for m in (1, -2)),
        ]
        return list(dict.fromkeys([*wanted, max(at, key=lambda target: abs(target.left_m))]))
    picked = []
    for camera in dict.fromkeys(target.request.sensor.id for target in targets):
        seen = [t for t in targets if t.request.sensor.id == camera and not t.beyond]
        picked += seen[len(seen) // 2 : len(seen) // 2 + 1]
    after = [target for target in targets if target.beyond and target.request.sensor.id == targets[0].request.sensor.id]
    return picked + after[-1:]


def _figures(scored: Scored, target: EvaluationView) -> dict[str, Any]:
    return next(row for row in scored.record["targets"] if row["name"] == target.name)


def _rgb(view: ScoredView) -> Picture:
    return np.rint(view.rgb * 255).astype(np.uint8)


def _depth(view: ScoredView) -> Picture:
    """Depth as colours, near is bright; grey if unknown."""
    if view.depth_m is None:
        return np.full(view.rgb.shape, UNKNOWN, np.uint8)
    colours = cv2.applyColorMap(_shade(view.depth_m), cv2.COLORMAP_TURBO)[..., ::-1].copy()
    colours[view.depth_m <= 0] = UNKNOWN
    return colours


def _shade(depth_m: Float32[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    share = np.log(np.clip(depth_m, NEAR_M, FAR_M) / NEAR_M) / np.log(FAR_M / NEAR_M)
    return np.rint(255 * (1 - share)).astype(np.uint8)


def lettered(picture: Picture, caption: str) -> Picture:
    """A picture under its caption."""
    bar = np.full((BAR_PX, picture.shape[1], 3), PAPER, np.uint8)
    cv2.putText(bar, caption, (3, BAR_PX - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.4, INK, 1, cv2.LINE_AA)
    return np.vstack([bar, picture])


def side_by_side(cells: Sequence[Picture]) -> Picture:
    """Pictures of one height in a row."""
    gap = np.full((cells[0].shape[0], GAP_PX, 3), PAPER, np.uint8)
    return np.hstack([part for cell in cells for part in (cell, gap)][:-1])


def stacked(rows: Sequence[Picture]) -> Picture:
    """Stacks rows of any width, padded on the right."""
    width = max(row.shape[1] for row in rows)
    return np.vstack(
        [np.pad(row, ((0, GAP_PX), (0, width - row.shape[1]), (0, 0)), constant_values=250) for row in rows]
    )
