"""What support (``render.support``) says about rollouts: doubtful verdicts, and from which distance on they are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from nurec_sim.report.cells import escape
from nurec_sim.report.data import ReportRollout
from nurec_sim.report.events import first_event_us
from nurec_sim.report.reasons import beside_path_m

LOW = 0.6
"""Verdicts after an image with less support are marked. Of pixels with less about half or fewer are right
(docs/trust.md); that verdicts after such images are wrong more often has not been shown."""
LIMITS_M = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0)
LEAST_IMAGES = 3
"""So few images at a distance say nothing about it."""


def support_curve(entry: ReportRollout) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Times (microseconds) and support of the images that a policy got while it drove; empty where not known."""
    series = entry.series.get("support")
    if series is None:
        return np.zeros(0), np.zeros(0)
    valid = np.asarray(series.valid, bool)
    return series.t_us[valid].astype(np.float64), series.values[valid]


def verdict_support(entry: ReportRollout) -> float | None:
    """Least support of the images up to the first event, or in the whole rollout without one; None if not known."""
    times, values = support_curve(entry)
    event_us = first_event_us(entry)
    if event_us is not None:
        values = values[times <= event_us]
    return float(values.min()) if len(values) else None


def low_support(entry: ReportRollout) -> str:
    """A few words if the verdict rests on images with little support, else empty."""
    least = verdict_support(entry)
    return "" if least is None or least >= LOW else f"low support: {100 * least:.0f} %"


def support_by_distance(rollouts: Sequence[ReportRollout], worlds: Sequence[str]) -> str:
    """Support by distance from the recorded path, and from where on verdicts rest on invention; empty if not known.

    Args:
        rollouts: all rollouts.
        worlds: order of the reconstructions.
    """
    rows, said = [], []
    for world in worlds:
        found = np.concatenate([np.zeros((0, 2)), *(_pairs(e) for e in rollouts if e.rollout.reconstruction == world)])
        if not len(found):
            continue
        place = np.searchsorted(LIMITS_M, found[:, 0], side="right") - 1
        means = [
            float(found[place == k, 1].mean()) if (place == k).sum() >= LEAST_IMAGES else None
            for k in range(len(LIMITS_M))
        ]
        cells = "".join(_cell(mean) for mean in means)
        rows.append(f'<tr><td><b>{escape(world)}</b></td><td class="n">{len(found)}</td>{cells}</tr>')
        low = [limit for limit, mean in zip(LIMITS_M, means, strict=True) if mean is not None and mean < LOW]
        said.append(
            f"In {escape(world)} what policies saw rests on invention from <b>{low[0]:g} m</b> beside the recorded "
            f"path on: less than {100 * LOW:.0f} % of those images is supported. Look at the video before you believe "
            "a verdict there."
            if low
            else f"In {escape(world)} images kept {100 * LOW:.0f} % support as far as policies drove "
            f"({found[:, 0].max():.1f} m beside the recorded path)."
        )
    if not rows:
        return '<p class="none">Support is not known: no policy with a camera, or the scene has no times of frames.</p>'
    ends = [f"{a:g} to {b:g} m" for a, b in zip(LIMITS_M, LIMITS_M[1:], strict=False)] + [f"beyond {LIMITS_M[-1]:g} m"]
    heads = "".join(f'<th class="n">{end}</th>' for end in ends)
    return (
        f"<h3>Support of the images that policies got</h3><p>{' '.join(said)}</p>"
        f'<table><thead><tr><th>Reconstruction</th><th class="n">instants</th>{heads}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table>"
        '<p class="key">Mean share of the pixels that rests on recorded views, by distance of the car from the '
        "recorded path. Rollouts whose verdict follows an image below the mark are tagged <i>low support</i>.</p>"
    )


def _pairs(entry: ReportRollout) -> Float64[np.ndarray, "n 2"]:
    """Distance from the recorded path (m), and support, of the images that a policy got."""
    times, values = support_curve(entry)
    beside = [abs(beside_path_m(entry.rollout, int(t))) for t in times]
    return np.column_stack([np.array(beside, np.float64), values]).reshape(-1, 2)


def _cell(mean: float | None) -> str:
    if mean is None:
        return '<td class="n"><span class="none">none</span></td>'
    return f'<td class="n{" bad" if mean < LOW else ""}">{100 * mean:.0f} %</td>'
