"""Aggregates the records of single views to the results of a protocol.

Results are means over views, as in the public protocol; differences between methods are paired by window with a 95 %
bootstrap interval over windows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from nurec_sim.evaluate.detection.summary import summarize_detection
from nurec_sim.evaluate.scans import mean_figures
from nurec_sim.evaluate.support import summarize_support

Record = Mapping[str, Any]
FULL = ("psnr_db", "ssim", "abs_rel", "delta1", "abs_rel_metric", "delta1_metric", "depth_scale", "depth_coverage")
MASKED = FULL[:6]
PAIRS = (
    ("dense", "lift"),
    ("dense-lidar", "lift"),
    ("dense", "copy"),
    ("dense-lidar", "copy"),
    ("selective", "dense"),
    ("dense", "dense-concatenated"),
    ("optimized", "lift"),
    ("optimized", "dense"),
)
"""Pairs of methods whose difference is reported."""
RESAMPLES = 2000
CURVE = ("psnr_db", "ssim", "abs_rel", "abs_rel_metric", "depth_coverage")
SHOWN = ("psnr_db", "abs_rel", "share")
"""Columns of the curves of what an input image shows."""


def summarize(windows: Sequence[Record], methods: Iterable[str]) -> dict[str, Any]:
    """Results of every method over all windows, and differences between methods.

    Args:
        windows: records with ``id`` and ``methods``: by name the result of ``score_window``, or ``error``.
        methods: names in the order of the tables.

    Returns:
        ``methods``: by name ``full``, ``dynamic``, ``static``, ``between``, ``beyond`` (means), ``curve`` (means by the
        offset from the path in metres), ``support`` (``support.summarize_support``), ``sweeps``
        (``scans.mean_figures``), ``detection`` (``detection.summary.summarize_detection``), ``abs_rel_doubles_at_m``,
        ``gaussians``, ``seconds``, ``views``, ``dynamic_views``, ``windows`` and ``failed``; ``differences``: a list of
        paired differences.
    """
    names = list(methods)
    figures = {name: _method([window["methods"][name] for window in windows]) for name in names}
    pairs = [pair for pair in PAIRS if pair[0] in names and pair[1] in names]
    return {"methods": figures, "differences": [_difference(windows, *pair) for pair in pairs]}


def _method(records: Sequence[Record]) -> dict[str, Any]:
    good = [record for record in records if "error" not in record]
    rows = [row for record in good for row in record["targets"]]
    on_path = [row for row in rows if row["left_m"] == 0]
    moving = [row["dynamic"] for row in on_path if row["dynamic"] is not None]
    standing = [row["static"] for row in on_path if row["static"] is not None]
    curve = _curve(rows)
    return {
        "full": _means([row["full"] for row in on_path], FULL),
        "dynamic": _means(moving, MASKED),
        "static": _means(standing, MASKED),
        "between": _means([row["full"] for row in on_path if not row["beyond"]], FULL),
        "beyond": _means([row["full"] for row in on_path if row["beyond"]], FULL),
        "curve": curve,
        "support": summarize_support(rows),
        "sweeps": mean_figures(good),
        "detection": summarize_detection(good),
        "abs_rel_doubles_at_m": doubling_offset({float(offset): row["abs_rel"] for offset, row in curve.items()}),
        "gaussians": _mean([record["gaussians"] for record in good]),
        "seconds": {stage: _mean([record["seconds"][stage] for record in good]) for stage in ("reconstruct", "render")},
        "views": len(on_path),
        "dynamic_views": len(moving),
        "windows": len(good),
        "failed": len(records) - len(good),
    }


def _means(rows: Sequence[Mapping[str, float | None]], names: Sequence[str]) -> dict[str, float | None]:
    return {name: _mean([row.get(name) for row in rows]) for name in names}


def _mean(values: Sequence[float | None]) -> float | None:
    """The mean of known values; None without any."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _curve(rows: Sequence[Record]) -> dict[str, dict[str, float | None]]:
    """Means by distance from the path, both sides combined; empty without lateral offsets.

    ``shown_`` before a name: over what an input image shows (``scoring.score_view``).
    """
    offsets = sorted({abs(row["left_m"]) for row in rows})
    if len(offsets) < 2:
        return {}
    curve = {}
    for offset in offsets:
        at = [row for row in rows if abs(row["left_m"]) == offset]
        shown = _means([row.get("shown") or {} for row in at], SHOWN)
        curve[f"{offset:g}"] = {
            **_means([row["full"] for row in at], CURVE),
            **{f"shown_{name}": value for name, value in shown.items()},
            "views": len(at),
        }
    return curve


def doubling_offset(abs_rel: Mapping[float, float | None]) -> float | None:
    """Offset at which a linearly interpolated curve first reaches twice its value at 0.

    None if it does not, or if a value is unknown.
    """
    offsets = sorted(abs_rel)
    values = [abs_rel[offset] for offset in offsets]
    known = [value for value in values if value is not None]
    if not offsets or offsets[0] != 0 or len(known) < len(values):
        return None
    # The first crossing of twice the value on the path, linear between the sampled offsets.
    limit = 2 * known[0]
    for index in range(1, len(known)):
        before, after = known[index - 1], known[index]
        if after >= limit:
            fraction = (limit - before) / (after - before)
            return float(offsets[index - 1] + fraction * (offsets[index] - offsets[index - 1]))
    return None


def _difference(windows: Sequence[Record], one: str, other: str) -> dict[str, Any]:
    """Advantage of ``one``: mean over windows of the difference of their means, with intervals."""
    both = [w for w in windows if all("error" not in w["methods"][name] for name in (one, other))]

    def paired(of: Callable[[Record], Mapping[str, float | None] | None]) -> dict[str, Any]:
        gains = []
        for window in both:
            psnr = []
            for name in (one, other):
                rows = [row for row in window["methods"][name]["targets"] if row["left_m"] == 0]
                psnr.append(_mean([figures["psnr_db"] for row in rows if (figures := of(row)) is not None]))
            if psnr[0] is not None and psnr[1] is not None:
                gains.append(psnr[0] - psnr[1])
        return {
            "psnr_db": _mean(gains), "interval_db": interval(gains), "better_in": sum(gain > 0 for gain in gains),
            "windows": len(gains),
        }  # fmt: skip

    counts = [[w["methods"][name]["gaussians"] for w in both] for name in (one, other)]
    share = None
    if both and None not in counts[0] + counts[1]:
        share = float(np.sum(counts[0]) / max(np.sum(counts[1]), 1))
    full, dynamic = paired(lambda row: row["full"]), paired(lambda row: row["dynamic"])
    return {"method": one, "against": other, "full": full, "dynamic": dynamic, "share_of_gaussians": share}


def interval(values: Sequence[float]) -> list[float] | None:
    """Deterministic 95 % bootstrap interval of the mean; None with fewer than three values."""
    if len(values) < 3:
        return None
    # Seeded by the sample size: the same values always have the same interval. Below three values a percentile
    # bootstrap has almost no distinct resamples.
    chosen = np.random.default_rng([len(values), 0xB007]).integers(0, len(values), (RESAMPLES, len(values)))
    low, high = np.quantile(np.asarray(values)[chosen].mean(axis=1), (0.025, 0.975))
    return [float(low), float(high)]
