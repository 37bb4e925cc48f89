"""Support (``render.support``) against the real error, where the true image at every pose is known.

A pixel is right if its colour is within ``RIGHT_COLOUR`` of the true one in every channel and its inverse depth within
a tenth of the true one (0 for the sky). Support is calibrated if it is the share of pixels that are right, and it
predicts errors if views rank by it as they do by the share of their wrong pixels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from nurec_sim.evaluate.cells import Table, number, percent
from nurec_sim.evaluate.views import ScoredView
from nurec_sim.metrics.agreement import spearman

RIGHT_COLOUR = 0.1
"""Of the range of a channel."""
RIGHT_DEPTH, RIGHT_PER_M = 0.1, 1e-3
BINS = 10
ERRORS = ("wrong", "psnr_db", "abs_rel_metric")
"""Real errors of a view that predicted ones are ranked against; of PSNR the negative."""


def right_pixels(view: ScoredView, true: ScoredView) -> Bool[np.ndarray, "h w"]:
    """Which pixels of a view with depth are right."""
    assert view.depth_m is not None and true.depth_m is not None
    shown, real = (np.where(d > 0, 1 / np.maximum(d, 1e-6), 0) for d in (view.depth_m, true.depth_m))
    near = np.abs(shown - real) <= RIGHT_DEPTH * real + RIGHT_PER_M
    return near & (np.abs(view.rgb - true.rgb) <= RIGHT_COLOUR).all(axis=-1)


def support_record(support: Float32[np.ndarray, "h w"], view: ScoredView, true: ScoredView) -> dict[str, Any]:
    """What is kept of a view: ``mean`` support, share of ``wrong`` pixels, and by bin of support ``pixels``, ``right``.

    ``sums`` are those of support by bin.
    """
    right = right_pixels(view, true)
    bins = np.minimum((support * BINS).astype(int), BINS - 1).reshape(-1)
    weights = {"pixels": None, "right": right.reshape(-1), "sums": support.reshape(-1).astype(np.float64)}
    counted = {name: np.bincount(bins, each, minlength=BINS).round(4).tolist() for name, each in weights.items()}
    return {"mean": float(support.mean(dtype=np.float64)), "wrong": float(1 - right.mean()), **counted}


def summarize_support(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Calibration, curve over the offset and rank correlations; empty without support.

    Args:
        rows: targets of a method in all windows (``scoring.score_window``).

    Returns:
        ``calibration``: by bin mean ``support``, share of ``right`` pixels and of all ``pixels``; ``curve``: by offset
        from the path predicted and real share of ``wrong`` pixels; ``rank``: Spearman's correlation over views of the
        predicted error with each of ``ERRORS``; ``views``.
    """
    known = [row for row in rows if row.get("support")]
    if not known:
        return {}
    pixels, right, sums = (
        np.sum([row["support"][name] for row in known], axis=0) for name in ("pixels", "right", "sums")
    )
    filled = np.flatnonzero(pixels)
    calibration = [
        {"support": float(sums[k] / pixels[k]), "right": float(right[k] / pixels[k]),
         "pixels": float(pixels[k] / pixels.sum())}
        for k in filled
    ]  # fmt: skip
    curve = {}
    for offset in sorted({abs(row["left_m"]) for row in known}):
        at = [row["support"] for row in known if abs(row["left_m"]) == offset]
        curve[f"{offset:g}"] = {
            "predicted": float(np.mean([1 - each["mean"] for each in at])),
            "real": float(np.mean([each["wrong"] for each in at])),
        }
    return {"calibration": calibration, "curve": curve, "rank": _ranks(known), "views": len(known)}


def _ranks(rows: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    predicted = np.array([1 - row["support"]["mean"] for row in rows])
    real = {
        "wrong": [row["support"]["wrong"] for row in rows],
        "psnr_db": [-row["full"]["psnr_db"] for row in rows],
        "abs_rel_metric": [row["full"].get("abs_rel_metric") for row in rows],
    }
    found: dict[str, float | None] = {}
    for name in ERRORS:
        pairs = np.array([pair for pair in zip(predicted, real[name], strict=True) if pair[1] is not None], np.float64)
        value = spearman(*pairs.T) if len(pairs) > 2 else np.nan
        found[name] = float(value) if np.isfinite(value) else None
    return found


def support_tables(methods: Mapping[str, Any]) -> list[Table]:
    """Tables of ``summarize_support`` of all methods that have it."""
    known = {name: row["support"] for name, row in methods.items() if row.get("support")}
    if not known:
        return []
    offsets = sorted({offset for row in known.values() for offset in row["curve"]}, key=float)
    rows = []
    for name, row in known.items():
        for which in ("predicted", "real"):
            cells = [percent(row["curve"].get(offset, {}).get(which)) for offset in offsets]
            rows.append((name, which, *cells))
    curve = Table(
        "support_curve", "Wrong pixels by lateral offset: predicted by support, and real",
        ("method", "share", *(f"{offset} m" for offset in offsets)), tuple(rows),
        f"Predicted: 1 - support. Real: colour off by more than {RIGHT_COLOUR:g}, or depth by more than 10 %.",
    )  # fmt: skip
    ranks = tuple(
        (name, *(number(row["rank"][error], 2) for error in ERRORS), str(row["views"])) for name, row in known.items()
    )
    rank = Table(
        "support_rank", "Rank correlation over views of predicted and real error",
        ("method", "wrong pixels", "-PSNR", "AbsRel (metres)", "views"), ranks, "Spearman's.",
    )  # fmt: skip
    bins = [f"{k / BINS:.1f}-{(k + 1) / BINS:.1f}" for k in range(BINS)]
    shares = []
    for name, row in known.items():
        by_bin = {min(int(each["support"] * BINS), BINS - 1): each["right"] for each in row["calibration"]}
        shares.append((name, *(percent(by_bin.get(k)) for k in range(BINS))))
    calibration = Table(
        "support_calibration", "Right pixels by support", ("method", *bins), tuple(shares),
        "Calibrated: the share lies in the range of its column.",
    )  # fmt: skip
    return [curve, rank, calibration]
