"""Reconstruction methods: a driving log in, a layered Gaussian world out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from nurec_sim import plugins
from nurec_sim.errors import ReconstructError
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings
from nurec_sim.reconstruct.lift.settings import (
    ColourSettings,
    GroundSettings,
    LiftSettings,
    PointSettings,
    ViewSettings,
)
from nurec_sim.reconstruct.optimize.settings import OptimizeSettings
from nurec_sim.reconstruct.range_maps.settings import LidarSettings

if TYPE_CHECKING:
    from nurec_sim.types import ActorsName, Clip, GaussianScene, Method

START_S, STEP_S = 40.0, 0.3
"""What a reconstruction, and a step of its optimisation, take about; progress is shared out by them."""
MOVERS_SHARE = 0.15
"""Share of the work of a method, about, that it takes to find what moves."""

__all__ = [
    "ColourSettings",
    "FeedForwardSettings",
    "GroundSettings",
    "LidarSettings",
    "LiftSettings",
    "OptimizeSettings",
    "PointSettings",
    "ViewSettings",
    "available_methods",
    "load_method",
    "reconstruct",
]


def available_methods() -> list[str]:
    """Names of the shipped methods and of those that installed packages offer, sorted."""
    return plugins.available(plugins.METHODS)


def load_method(reference: str) -> Method:
    """Make a method from a name, a file (``my_method.py:Class``) or an importable object (``module:Class``).

    Raises:
        ReconstructError: nothing of that name, or what was found is no method; the text says what is available.
    """
    return plugins.load(plugins.METHODS, reference)


def reconstruct(
    clip: Clip,
    method: str | Method = "lift",
    *,
    cameras: Sequence[str] | None = None,
    hold_out_sweeps: Sequence[int] = (),
    progress: Callable[[str, float], None] | None = None,
    settings: Any = None,
    refine: OptimizeSettings | None = None,
    actors: ActorsName = "auto",
    align_actors: bool = True,
    align_sweeps: bool = True,
    complete_actors: bool = True,
) -> GaussianScene:
    """Build a Gaussian scene from a clip, at the precision of archives: reading it from one gives the same values.

    Args:
        clip: the driving log.
        method: a method, or a reference as ``load_method`` takes it.
        cameras: ids of the cameras to use; if None all, or as many as the network's profile takes.
        hold_out_sweeps: indices of sweeps that must not be read, of every LiDAR.
        progress: called with the stage's name and the fraction of all work that is done, about.
        settings: an instance of the method's settings class: ``LiftSettings`` for ``lift``, ``FeedForwardSettings`` for
            ``dense`` and ``selective``, ``LidarSettings`` for ``lidar``, ``OptimizeSettings`` for ``optimized``; the
            defaults if None.
        refine: fit the scene to the images and sweeps afterwards; ``optimized`` is ``lift`` with this step.
        actors: whose objects move: the boxes of the log (``recorded``), what moves in its sweeps (``found``), nobody
            (``none``); ``auto`` takes the boxes, and what moves if there are none.
        align_actors: correct tracks of moving objects so that the returns of all sweeps on an object make one surface.
        align_sweeps: correct elevations of beams, mountings of LiDARs and poses of a log that was opened from disk, so
            that all sweeps see the same planes, and images of these cameras the same points (``logs.alignment``), and
            mountings of these cameras; the scene's path and rig are the corrected ones.
        complete_actors: give actors that the sensors hardly saw a body of their class (``hidden_actors``).

    Raises:
        ReconstructError: no such method, camera, sweep or choice of actors, settings of another method, or the clip
            lacks what the method needs.
        WeightsError: the network's weights are not there or cannot be used.
    """
    made = load_method(method) if isinstance(method, str) else method
    if made.settings is OptimizeSettings and refine is not None:
        if settings is not None:
            raise ReconstructError("the optimisation was given settings twice: as settings and as refine")
        settings, refine = refine, None
    if settings is None:
        settings = made.settings()
    if not isinstance(settings, made.settings):
        wanted, given = made.settings.__name__, type(settings).__name__
        raise ReconstructError(f"method {made.name!r} takes {wanted}, got {given}")
    chosen = list(clip.rig.cameras) if cameras is None else list(cameras)
    unknown = [camera for camera in chosen if camera not in clip.rig.cameras]
    if unknown:
        raise ReconstructError(f"clip {clip.id!r} has no camera {unknown}; have {list(clip.rig.cameras)}")
    most = max((len(clip.sweep_times_us(lidar)) for lidar in clip.rig.lidars), default=0)
    wrong = [index for index in hold_out_sweeps if not 0 <= index < most]
    if wrong:
        raise ReconstructError(f"clip {clip.id!r} has no sweeps {wrong} to hold out; have 0..{most - 1}")

    from nurec_sim.logs.alignment import with_aligned_sensors
    from nurec_sim.reconstruct.movers import with_actors, with_aligned_actors
    from nurec_sim.scene.precision import archived

    held = {int(index) for index in hold_out_sweeps}
    report = progress or (lambda stage, fraction: None)
    share = 1.0 if refine is None else _start_share(refine)
    begun = 0.0
    if align_sweeps:
        clip = with_aligned_sensors(clip, held, report, chosen)

    def search(done: float) -> None:
        nonlocal begun
        begun = MOVERS_SHARE * done
        report("moving objects", share * begun)

    clip, note = with_actors(clip, actors, held, search)
    aligned = 0
    if align_actors:
        clip, aligned = with_aligned_actors(clip, held)

    def step(stage: str, done: float) -> None:
        report(stage, share * (begun + (1 - begun) * done))

    scene = made.reconstruct(clip, settings, cameras=cameras, hold_out_sweeps=held, progress=step)
    scene = _with_provenance(scene, clip, made.name, chosen, note, aligned)
    if refine is not None:
        from nurec_sim.reconstruct.optimize.method import refine as fit_to_log

        used = list(scene.provenance["cameras"])
        scene = fit_to_log(
            scene, clip, used, held, lambda stage, done: report(stage, share + (1 - share) * done), refine
        )
    if not complete_actors:
        return archived(_with_returns(scene, clip, held, report))
    from nurec_sim.reconstruct.hidden_actors import hidden_bodies, with_bodies

    with ThreadPoolExecutor(1) as beside:
        # Neither needs the other, and each has parts on one core.
        bodies = beside.submit(hidden_bodies, scene, clip, held)
        scene = _with_returns(scene, clip, held, report)
        return archived(with_bodies(scene, bodies.result()))


def _with_returns(
    scene: GaussianScene, clip: Clip, held: set[int], report: Callable[[str, float], None]
) -> GaussianScene:
    """The scene with what LiDAR tells of how its beams return, where it gave surfaces their intensity."""
    if not np.isfinite(scene.static.intensity).any():
        return scene
    if scene.static.falloff is None:
        from nurec_sim.reconstruct.incidence import with_incidence

        scene = with_incidence(scene, clip, held)
    if scene.static.ray_drop is None:
        from nurec_sim.reconstruct.ray_drop import with_ray_drop

        scene = with_ray_drop(scene, clip, held, lambda done: report("ray drop", 1.0))
    return scene


def _start_share(refine: OptimizeSettings) -> float:
    """Share of all work, about, that is done before the optimisation starts."""
    budgets = refine.seconds, None if refine.steps is None else STEP_S * refine.steps
    return START_S / (START_S + min(each for each in budgets if each is not None))


def _with_provenance(
    scene: GaussianScene, clip: Clip, method: str, cameras: list[str], note: str | None, aligned: int
) -> GaussianScene:
    """The scene with the entries that every provenance has, where the method left them out, and a note on its actors.

    The note says more than what methods say about logs without boxes, and replaces it.
    """
    from nurec_sim.logs.alignment import CAMERA_FACT, FACT

    known: dict[str, Any] = {"method": method, "cameras": cameras}
    if clip.time_offset_us:
        known["time_offset_us"] = clip.time_offset_us
    if aligned:
        known["aligned_tracks"] = aligned
    facts = getattr(clip, "facts", {})
    known |= {name: facts[name] for name in (FACT, CAMERA_FACT) if name in facts}
    provenance = known | dict(scene.provenance)
    if note is not None:
        others = [text for text in provenance.get("unknown", ()) if not text.startswith("no boxes:")]
        provenance["unknown"] = [note, *others]
    return dataclasses.replace(scene, provenance=provenance) if provenance != scene.provenance else scene
