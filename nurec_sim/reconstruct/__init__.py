"""Reconstruction methods: a driving log in, a layered Gaussian world out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from nurec_sim.errors import ReconstructError
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings
from nurec_sim.reconstruct.lift.settings import GroundSettings, LiftSettings, PointSettings, ViewSettings
from nurec_sim.reconstruct.optimize.settings import OptimizeSettings

if TYPE_CHECKING:
    from nurec_sim.types import Clip, GaussianScene

METHODS = ("lift", "dense", "selective", "optimized")
START_SHARE = 0.15
"""Of the work of a reconstruction that is fitted to its log, about, is what it starts from."""

__all__ = [
    "METHODS",
    "FeedForwardSettings",
    "GroundSettings",
    "LiftSettings",
    "OptimizeSettings",
    "PointSettings",
    "ViewSettings",
    "reconstruct",
]


def reconstruct(
    clip: Clip,
    method: str = "lift",
    *,
    cameras: Sequence[str] | None = None,
    hold_out_sweeps: Sequence[int] = (),
    progress: Callable[[str, float], None] | None = None,
    settings: LiftSettings | FeedForwardSettings | OptimizeSettings | None = None,
    refine: OptimizeSettings | None = None,
) -> GaussianScene:
    """Build a Gaussian scene from a clip.

    Args:
        clip: the driving log.
        method: one of ``METHODS``.
        cameras: ids of the cameras to use; if None all, or as many as the network's profile takes.
        hold_out_sweeps: indices of sweeps that must not be read, of every LiDAR.
        progress: called with the stage's name and the fraction of all work that is done, about.
        settings: ``LiftSettings`` for ``lift``, ``OptimizeSettings`` for ``optimized``, ``FeedForwardSettings`` for the
            others; the defaults if None.
        refine: fit the scene to the images and sweeps afterwards; ``optimized`` is ``lift`` with this step.

    Raises:
        ReconstructError: no such method, camera or sweep, settings of another method, or the clip lacks what the
            method needs.
        WeightsError: the network's weights are not there or cannot be used.
    """
    if method not in METHODS:
        raise ReconstructError(f"no reconstruction method {method!r}; have {list(METHODS)}")
    chosen = list(clip.rig.cameras) if cameras is None else list(cameras)
    unknown = [camera for camera in chosen if camera not in clip.rig.cameras]
    if unknown:
        raise ReconstructError(f"clip {clip.id!r} has no camera {unknown}; have {list(clip.rig.cameras)}")
    most = max((len(clip.sweep_times_us(lidar)) for lidar in clip.rig.lidars), default=0)
    wrong = [index for index in hold_out_sweeps if not 0 <= index < most]
    if wrong:
        raise ReconstructError(f"clip {clip.id!r} has no sweeps {wrong} to hold out; have 0..{most - 1}")

    held = {int(index) for index in hold_out_sweeps}
    report = progress or (lambda stage, fraction: None)
    if refine is not None or method == "optimized":
        if isinstance(settings, OptimizeSettings) and refine is not None:
            raise ReconstructError("the optimisation was given settings twice: as settings and as refine")
        start = "lift" if method == "optimized" else method
        plain = None if isinstance(settings, OptimizeSettings) else settings
        fit = settings if isinstance(settings, OptimizeSettings) else refine or OptimizeSettings()
        scene = reconstruct(
            clip, start, cameras=cameras, hold_out_sweeps=hold_out_sweeps, settings=plain,
            progress=lambda stage, share: report(stage, START_SHARE * share),
        )  # fmt: skip
        from nurec_sim.reconstruct.optimize.method import refine as fit_to_log

        return fit_to_log(scene, clip, list(scene.provenance["cameras"]), held,
                          lambda stage, share: report(stage, START_SHARE + (1 - START_SHARE) * share), fit)  # fmt: skip
    wanted = LiftSettings if method == "lift" else FeedForwardSettings
    if settings is None:
        settings = wanted()
    if isinstance(settings, LiftSettings) and method == "lift":
        from nurec_sim.reconstruct.lift.method import lift

        return _timed(clip, lift(clip, chosen, held, report, settings))
    if isinstance(settings, FeedForwardSettings) and method != "lift":
        from nurec_sim.reconstruct.feedforward.method import feedforward

        return _timed(clip, feedforward(clip, method, cameras, held, report, settings))
    raise ReconstructError(f"method {method!r} takes {wanted.__name__}, got {type(settings).__name__}")


def _timed(clip: Clip, scene: GaussianScene) -> GaussianScene:
    """The scene; where its times are not those of the log, the provenance says so."""
    if clip.time_offset_us == 0:
        return scene
    return dataclasses.replace(scene, provenance={**scene.provenance, "time_offset_us": clip.time_offset_us})
