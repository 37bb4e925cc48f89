"""Scores of one method on one window: images and depth, full image, dynamic and static region."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from nurec_sim.evaluate.methods import Built, Contender, build
from nurec_sim.evaluate.scans import score_beside
from nurec_sim.evaluate.scores.depth import depth_score, least_squares_scale
from nurec_sim.evaluate.scores.images import masked_psnr, masked_ssim, psnr, ssim
from nurec_sim.evaluate.support import support_record
from nurec_sim.evaluate.views import ScoredView, reduced
from nurec_sim.evaluate.windows import EvaluationView, Window
from nurec_sim.network.detector.codec import Detections
from nurec_sim.render.support import Support

HIGHEST_PSNR_DB = 100.0
"""PSNR of identical images."""

Figures = dict[str, float | None]


@dataclass(frozen=True, eq=False)
class Scored:
    """Results of a method on a window.

    Attributes:
        record: plain JSON.
        views: by target name.
        sweeps: one by lateral offset.
        detections: images at their full size with detections, by target name.
    """

    record: dict[str, Any]
    views: dict[str, ScoredView]
    sweeps: dict[float, Float64[np.ndarray, "n 3"]] = field(default_factory=dict)
    detections: dict[str, tuple[UInt8[np.ndarray, "h w 3"], Detections]] = field(default_factory=dict)


def score_window(
    contender: Contender, window: Window, progress: Callable[[str, float], None] | None = None, device: str = "auto"
) -> Scored:
    """Runs a method on a window and scores its target views.

    Args:
        contender: the method.
        window: inputs and ground truth.
        progress: called with the stage and the fraction done.
        device: rendering device; see ``render.choose_device``.

    Returns:
        The record: ``gaussians``, ``seconds`` (``reconstruct``; ``render`` per view), ``unknown``, and per target
        ``name``, ``left_m``, ``beyond``, ``full``, ``dynamic`` and ``static`` (see ``score_view``), and in windows with
        targets beside the path ``support`` (``support.support_record``), or where a detector is asked ``detection``
        (``detection.sights.Sight.record``). Windows with target sweeps also have
        ``sweeps`` (see ``scans.score_beside``).

    Raises:
        ReconstructError, WeightsError: see ``methods.build``.
    """
    report = progress or (lambda stage, fraction: None)
    report(f"{contender.name} reconstructs", 0.0)
    built: Built = build(contender, window, device)
    support = _support(built, window)
    rows, views, detections, rendering = [], {}, {}, 0.0
    for index, target in enumerate(window.targets):
        report(f"{contender.name} shows", 0.3 + 0.7 * index / len(window.targets))
        started = time.perf_counter()
        frame = built.show(target.request)
        rendering += time.perf_counter() - started
        views[target.name] = view = reduced(frame.rgb, frame.depth_m)
        row = {"name": target.name, "left_m": target.left_m, "beyond": target.beyond, **score_view(view, target)}
        if support is not None:
            row["support"] = support_record(support.map(target.request, view.rgb.shape[1]), view, target.true)
        if target.sight is not None:
            found = target.sight.detector(frame.rgb, target.sight.camera)
            row["detection"], detections[target.name] = target.sight.record(found), (frame.rgb, found)
        rows.append(row)
    seconds = {"reconstruct": round(built.seconds, 3), "render": round(rendering / max(len(rows), 1), 4)}
    unknown = [] if built.scene is None else list(built.scene.provenance.get("unknown", ()))
    record = {"gaussians": built.gaussians, "seconds": seconds, "unknown": unknown, "targets": rows}
    if not window.beside:
        return Scored(record, views, detections=detections)
    record["sweeps"], sweeps = score_beside(
        built, window.beside, lambda fraction: report(f"{contender.name} scans", 0.3 + 0.7 * fraction)
    )
    return Scored(record, views, sweeps)


def _support(built: Built, window: Window) -> Support | None:
    """The support of a method's views, where some are beside the path and no detector is asked."""
    if built.renderer is None or not any(target.left_m and target.sight is None for target in window.targets):
        return None
    return Support(built.renderer)


def score_view(view: ScoredView, target: EvaluationView) -> dict[str, Figures | None]:
    """Scores of one view: ``full``; with a known dynamic region also ``dynamic`` and ``static``, and ``shown``.

    ``static`` is the complement of ``dynamic``, ``shown`` what an input image shows, with its ``share`` of all pixels,
    where that is known; each is None if empty. Each has ``psnr_db``, ``ssim``, and with known depth ``abs_rel`` and
    ``delta1`` after the frame's least-squares scale over all pixels, ``abs_rel_metric`` and ``delta1_metric`` as
    predicted; ``full`` also ``depth_scale`` and ``depth_coverage``. Values that cannot be computed are None.
    """
    true, mask = target.true, target.movable
    full: Figures = {"psnr_db": _capped(psnr(view.rgb, true.rgb)), "ssim": ssim(view.rgb, true.rgb)}
    # One scale per frame, from all its pixels: a scale per region would hide errors between the regions.
    scale = 1.0
    if view.depth_m is not None and true.depth_m is not None:
        scale = least_squares_scale(view.depth_m, true.depth_m)
        whole = depth_score(view.depth_m, true.depth_m)
        full |= {"depth_scale": scale, "depth_coverage": _known(whole.coverage)}
    full |= _depth_figures(view, true, scale, None)
    parts = {"dynamic": mask, "static": None if mask is None else ~mask}
    figures = {"full": full} | {name: _figures_inside(view, true, scale, part) for name, part in parts.items()}
    if target.shown is not None:
        shown = _figures_inside(view, true, scale, target.shown)
        figures["shown"] = None if shown is None else {**shown, "share": float(target.shown.mean())}
    return figures


def _figures_inside(
    view: ScoredView, true: ScoredView, scale: float, mask: Bool[np.ndarray, "h w"] | None
) -> Figures | None:
    if mask is None or not mask.any():
        return None
    return {
        "psnr_db": _capped(masked_psnr(view.rgb, true.rgb, mask)),
        "ssim": _known(masked_ssim(view.rgb, true.rgb, mask)),
        **_depth_figures(view, true, scale, mask),
    }


def _depth_figures(view: ScoredView, true: ScoredView, scale: float, mask: Bool[np.ndarray, "h w"] | None) -> Figures:
    figures: Figures = dict.fromkeys(("abs_rel", "delta1", "abs_rel_metric", "delta1_metric"))
    if view.depth_m is not None and true.depth_m is not None:
        for factor, suffix in ((scale, ""), (1.0, "_metric")):
            score = depth_score(view.depth_m * factor, true.depth_m, mask)
            figures |= {f"abs_rel{suffix}": _known(score.abs_rel), f"delta1{suffix}": _known(score.delta1)}
    return figures


def _capped(psnr_db: float) -> float:
    return min(psnr_db, HIGHEST_PSNR_DB)


def _known(value: float) -> float | None:
    """None for NaN, which JSON lacks."""
    return float(value) if np.isfinite(value) else None
