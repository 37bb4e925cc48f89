"""What an alignment found as plain JSON, and logs aligned as a scene has them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.logs.beam_errors import BeamErrors
from nurec_sim.logs.clip import Clip as LoadedClip
from nurec_sim.logs.moved import corrected
from nurec_sim.types import Clip, GaussianScene, Matrix4, Trajectory

FACT, CAMERA_FACT = "sweep_alignment", "camera_alignment"
"""Where ``Clip.facts``, and the provenance of scenes, say what was corrected."""


def plain(errors: BeamErrors) -> dict[str, list[float]]:
    """Errors of beams as plain JSON, in degrees, without the ends where none were seen."""
    error = np.degrees(errors.error_rad).round(5)
    seen = np.flatnonzero(error)
    first, last = (seen[0], seen[-1]) if len(seen) else (0, 0)
    part = slice(max(first - 1, 0), last + 2)
    return {
        "elevation_deg": np.degrees(errors.elevation_rad[part]).round(5).tolist(),
        "error_deg": error[part].tolist(),
    }


def errors_from(stored: Mapping[str, Any]) -> BeamErrors:
    """Errors of beams from ``plain``.

    Raises:
        ClipError: what is stored is not that.
    """
    try:
        elevation, error = (np.array(stored[name], np.float64) for name in ("elevation_deg", "error_deg"))
    except (KeyError, TypeError, ValueError):
        raise ClipError("errors of beams are two lists of degrees, elevation_deg and error_deg") from None
    good = elevation.ndim == 1 and elevation.shape == error.shape and len(error) > 0
    if not (good and np.isfinite(elevation).all() and np.isfinite(error).all() and (np.diff(elevation) > 0).all()):
        raise ClipError("errors of beams are two lists of finite degrees of one length, elevation_deg ascending")
    return BeamErrors(np.radians(elevation), np.radians(error))


def with_beams(clip: LoadedClip, mountings: Mapping[str, Matrix4], beams: Mapping[str, BeamErrors]) -> LoadedClip:
    """The log with LiDARs turned to these mountings in the rig, and without these errors of their beams."""
    lidars, sweeps = dict(clip.rig.lidars), {name: clip.sweep_records(name) for name in clip.rig.lidars}
    for name, mounting in mountings.items():
        turn = geometry.inverse(lidars[name].rig_from_lidar) @ mounting
        lidars[name] = dataclasses.replace(lidars[name], rig_from_lidar=mounting)
        sweeps[name] = tuple(
            dataclasses.replace(
                record, world_from_lidar=record.world_from_lidar @ turn, beam_errors=beams.get(name, record.beam_errors)
            )
            for record in sweeps[name]
        )
    return clip.replaced(sweeps=sweeps, rig=dataclasses.replace(clip.rig, lidars=lidars))


def aligned_as(clip: Clip, scene: GaussianScene) -> Clip:
    """The log aligned as it was for a scene that was made from it; as it is if it was not aligned, or is already.

    Raises:
        ClipError: the scene's provenance does not say how.
    """
    if not isinstance(clip, LoadedClip):
        return clip
    return _cameras_as(_sweeps_as(clip, scene), scene)


def _sweeps_as(clip: LoadedClip, scene: GaussianScene) -> LoadedClip:
    found = scene.provenance.get(FACT)
    if found is None or FACT in clip.facts:
        return clip
    beams = found.get("beams") if isinstance(found, Mapping) else None
    if not isinstance(beams, Mapping) or not set(beams) <= set(clip.rig.lidars) & set(scene.rig.lidars):
        raise ClipError(f"scene {scene.id!r} says {FACT} of LiDARs that clip {clip.id!r} does not have")
    inside = (scene.ego.t_us >= clip.ego.start_us) & (scene.ego.t_us <= clip.ego.end_us)
    t_us = scene.ego.t_us[inside]
    moved = clip
    if len(t_us):
        poses = scene.ego.world_from_body[inside] @ geometry.inverse(clip.ego.at(t_us))
        moved = corrected(clip, Trajectory(t_us, poses))
    mountings = {name: scene.rig.lidars[name].rig_from_lidar for name in beams}
    moved = with_beams(moved, mountings, {name: errors_from(each) for name, each in beams.items()})
    moved.facts[FACT] = dict(found)
    return moved


def _cameras_as(clip: LoadedClip, scene: GaussianScene) -> LoadedClip:
    found = scene.provenance.get(CAMERA_FACT)
    if found is None or CAMERA_FACT in clip.facts:
        return clip
    turns = found.get("turn_deg") if isinstance(found, Mapping) else None
    if not isinstance(turns, Mapping) or not set(turns) <= set(clip.rig.cameras) & set(scene.rig.cameras):
        raise ClipError(f"scene {scene.id!r} says {CAMERA_FACT} of cameras that clip {clip.id!r} does not have")
    mountings = {name: scene.rig.cameras[name].rig_from_camera for name in turns}
    return with_mountings(clip, mountings, found)


def with_mountings(clip: LoadedClip, mountings: Mapping[str, Matrix4], fact: Mapping[str, Any]) -> LoadedClip:
    """The log with cameras at these mountings in the rig, and their images moved with them; ``fact`` is noted."""
    cameras, images = dict(clip.rig.cameras), {name: clip.image_records(name) for name in clip.rig.cameras}
    for name, mounting in mountings.items():
        turn = geometry.inverse(cameras[name].rig_from_camera) @ mounting
        cameras[name] = dataclasses.replace(cameras[name], rig_from_camera=mounting)
        images[name] = tuple(
            dataclasses.replace(record, world_from_camera=record.world_from_camera @ turn) for record in images[name]
        )
    moved = clip.replaced(images=images, rig=dataclasses.replace(clip.rig, cameras=cameras))
    moved.facts[CAMERA_FACT] = dict(fact)
    return moved
