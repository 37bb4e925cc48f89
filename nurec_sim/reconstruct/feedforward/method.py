"""The methods ``dense`` and ``selective``: a clip through the network, chunk by chunk (docs/network.md)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nurec_sim import network
from nurec_sim.errors import ReconstructError
from nurec_sim.network.checkpoints.download import find_weights
from nurec_sim.network.checkpoints.state_dicts import load_weights
from nurec_sim.network.model import InstantNuRec, Precision
from nurec_sim.network.sky.background import is_static
from nurec_sim.reconstruct.ego_vehicle import find_ego_images
from nurec_sim.reconstruct.feedforward.chunks import ChunkLayers
from nurec_sim.reconstruct.feedforward.inputs.frames import ChunkWindow, choose_cameras, chunk_windows
from nurec_sim.reconstruct.feedforward.inputs.window import chunk_inputs
from nurec_sim.reconstruct.feedforward.layers import chunk_layers
from nurec_sim.reconstruct.feedforward.lidar.depth import DepthFit, fit_depth
from nurec_sim.reconstruct.feedforward.merging.consensus import find_consensus
from nurec_sim.reconstruct.feedforward.merging.merge import merge_chunks
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings
from nurec_sim.reconstruct.feedforward.tracks.clusters import group_into_tracks
from nurec_sim.reconstruct.feedforward.tracks.labelled import scene_actors
from nurec_sim.reconstruct.feedforward.tracks.rigid import rigid_once
from nurec_sim.reconstruct.feedforward.tracks.standing import standing_pixels
from nurec_sim.reconstruct.lift.actors import tracks_of
from nurec_sim.reconstruct.measured_ground import NOTE, with_measured_ground
from nurec_sim.types import Clip, DynamicGaussians, GaussianScene, Track

Progress = Callable[[str, float], None]
CHUNKS_SHARE = 0.9
"""Of all work; merging and tracks take the rest."""


def feedforward(
    clip: Clip,
    method: str,
    cameras: Sequence[str] | None,
    hold_out: set[int],
    progress: Progress,
    settings: FeedForwardSettings,
) -> GaussianScene:
    """Reconstruct a clip with the network.

    Args:
        clip: the driving log.
        method: ``dense`` or ``selective``, which the profile must be.
        cameras: ids of the cameras to use; None picks as many as the profile takes.
        hold_out: sweeps that must not be read.
        progress: called with the stage's name and the fraction of all work that is done, about.
        settings: how; its ``profile`` may be None for the method's small one.

    Raises:
        ReconstructError: a profile that does not exist or fit the method, cameras or frames that it does not take, a
            log that lacks what the settings ask for, or a device that is not there.
        WeightsError: no weights, or weights of another network.
    """
    settings = dataclasses.replace(settings, profile=profile_name(method, settings.profile))
    device = chosen_device(settings.device)
    profile = network.PROFILES[settings.profile or ""]
    chosen = choose_cameras(clip, profile, cameras)
    windows = chunk_windows(clip, chosen, profile, settings)
    by_lidar = _road_by_lidar(clip, settings, hold_out)
    progress("weights", 0.0)
    model, weights = _model(settings, device)
    ego_images = find_ego_images(clip, chosen, hold_out=hold_out)
    layers, fits = [], []
    for window in windows:
        chunk_progress = _within(progress, window.index, len(windows))
        chunk, chunk_fit = _chunk(clip, model, window, ego_images, hold_out, settings, chunk_progress)
        layers.append(chunk)
        fits.append(chunk_fit)
    merged = merge_chunks(layers, settings, lambda stage, fraction: progress(stage, CHUNKS_SHARE + 0.07 * fraction))
    progress("tracks", CHUNKS_SHARE + 0.07)
    dynamic = merged.dynamic
    if settings.merge == "ownership":
        chunk_of = np.repeat(np.arange(len(layers)), [len(each.dynamic) for each in layers])
        dynamic = rigid_once(dynamic, chunk_of, scene_actors(clip), clip.span_us)
    tracks, dynamic = _tracks(clip, dynamic)
    progress("road", CHUNKS_SHARE + 0.08)
    provenance = {
        "method": method,
        "settings": _plain(dataclasses.asdict(settings)),
        "weights": weights,
        "cameras": list(chosen),
        "held_out_sweeps": sorted(hold_out),
        "chunks": [{"span_us": list(w.span_us), "frames": {c: list(f) for c, f in w.frames.items()}} for w in windows],
        "road_labels": "lidar" if by_lidar else "network",
        "lidar_depth": [fit.report() for fit in fits if fit is not None],
        "counts": dict(merged.counts)
        | {"dynamic_merged": len(merged.dynamic), "dynamic": len(dynamic)}
        | {"tracks_found": len(tracks) - len(clip.tracks)},
        "unknown": _unknown(clip, settings, len(tracks) - len(clip.tracks), by_lidar),
    }
    scene = GaussianScene(
        id=clip.id,
        static=merged.static,
        dynamic=dynamic,
        sky=merged.sky,
        isp=merged.isp,
        rig=clip.rig,
        ego=clip.ego,
        tracks=tracks,
        road_map=clip.road_map,
        span_us=clip.span_us,
        camera_times_us={camera: clip.camera_times_us(camera) for camera in clip.rig.cameras},
        provenance=provenance,
        ego_images=ego_images,
    )
    if by_lidar:
        scene = with_measured_ground(scene, clip, hold_out)
    scene.provenance["counts"]["ground_added"] = len(scene.static) - len(merged.static)
    progress("road", 1.0)
    return scene


def _road_by_lidar(clip: Clip, settings: FeedForwardSettings, hold_out: set[int]) -> bool:
    """Whether sweeps tell the road.

    Raises:
        ReconstructError: they should, and there are none.
    """
    sweeps = any(index not in hold_out for name in clip.rig.lidars for index in range(len(clip.sweep_times_us(name))))
    if settings.road_labels == "lidar" and not sweeps:
        raise ReconstructError(
            f"road_labels='lidar' needs sweeps that are not held out, and clip {clip.id!r} has none; use 'network'"
        )
    return sweeps and settings.road_labels != "network"


def profile_name(method: str, profile: str | None) -> str:
    """The profile to use for a method.

    Raises:
        ReconstructError: there is no such profile, or it is of the other method.
    """
    fitting = [name for name, each in network.PROFILES.items() if each.decoder == method]
    if profile is None:
        return next(name for name in fitting if name.startswith("tiny"))
    if profile not in network.PROFILES:
        raise ReconstructError(f"no network profile {profile!r}; have {list(network.PROFILES)}")
    if profile not in fitting:
        raise ReconstructError(f"profile {profile!r} is not {method}; profiles of method {method!r}: {fitting}")
    return profile


def chosen_device(name: str) -> torch.device:
    """The device of that name; ``auto`` is a GPU if there is one.

    Raises:
        ReconstructError: it is not there.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise ReconstructError(f"cannot run the network on device {name!r} ({reason}); try cpu") from None
    return device


def _model(settings: FeedForwardSettings, device: torch.device) -> tuple[InstantNuRec, dict[str, Any]]:
    """The network with its weights, and their description for the provenance."""
    name = settings.profile or ""
    precision: Precision = settings.precision if settings.precision != "auto" else "float32"
    if settings.precision == "auto" and device.type == "cuda":
        # The precisions that the release runs these decoders in.
        precision = "float16" if network.PROFILES[name].decoder == "dense" else "bfloat16"
    model = network.build(name, seed=settings.random_weights, precision=precision)
    facts: dict[str, Any] = {"precision": precision, "device": device.type}
    if settings.random_weights is not None:
        facts["random_seed"] = settings.random_weights
    else:
        path = find_weights(name, settings.checkpoint)
        load_weights(model, path, name)
        facts["file"] = path.name
    return model.to(device), facts


def _chunk(
    clip: Clip,
    model: InstantNuRec,
    window: ChunkWindow,
    ego_images: Mapping[str, np.ndarray],
    hold_out: set[int],
    settings: FeedForwardSettings,
    progress: Progress,
) -> tuple[ChunkLayers, DepthFit | None]:
    """Layers of one chunk: images in, one forward pass, Gaussians out."""
    device = next(model.parameters()).device
    progress("images", 0.0)
    chunk = chunk_inputs(clip, model.profile, window, settings, ego_images)
    progress("network", 0.2)
    with torch.inference_mode():
        outputs = model(chunk.tensors.to(device))
    fit, gaussians, depth_m = None, outputs.gaussians, outputs.context.depth_m[0].cpu().numpy()
    if settings.lidar_depth != "off":
        progress("LiDAR depth", 0.7)
        static = is_static(outputs.context.logits[0]).cpu().numpy()
        fit = fit_depth(clip, chunk, depth_m, hold_out, settings.lidar_depth, static)
        gaussians, depth_m = fit.apply(gaussians, chunk), fit.factor * depth_m
    outputs = dataclasses.replace(outputs, gaussians=gaussians)
    # After the LiDAR fit: images agree more often once their depths have the right scale.
    if settings.consensus:
        progress("consensus", 0.8)
        semantic, rgb = outputs.context.logits[0].argmax(-1).cpu().numpy(), outputs.context.rgb[0].float().cpu().numpy()
        standing = standing_pixels(clip, chunk, depth_m, semantic, outputs.context.motion_m)
        consensus = find_consensus(chunk.tensors, depth_m, semantic, rgb, chunk.ego, standing)
        outputs = consensus.coloured(
            dataclasses.replace(outputs, gaussians=consensus.apply(gaussians, chunk.tensors)), chunk.tensors
        )
    progress("layers", 0.9)
    return chunk_layers(clip, chunk, outputs, settings), fit


def _within(progress: Progress, index: int, count: int) -> Progress:
    """Progress of one chunk as part of all of them."""
    return lambda stage, fraction: progress(
        f"chunk {index + 1} of {count}: {stage}", CHUNKS_SHARE * (index + fraction) / count
    )


def _tracks(clip: Clip, dynamic: DynamicGaussians) -> tuple[tuple[Track, ...], DynamicGaussians]:
    """Tracks of the clip and those found in the motion of the Gaussians, which get them as their own.

    The latter are actors only where the log has no boxes.
    """
    known = tracks_of(clip, scene_actors(clip))
    found, track = group_into_tracks(dynamic, clip.ego, len(known), [each.id for each in known])
    alone = not known
    found = tuple(dataclasses.replace(each, labelled=False, actor=alone, controllable=alone) for each in found)
    return (*known, *found), dataclasses.replace(dynamic, track=track)


def _unknown(clip: Clip, settings: FeedForwardSettings, found: int, by_lidar: bool) -> list[str]:
    """What the log does not contain, as notes for the provenance."""
    notes = []
    if settings.random_weights is not None:
        notes.append("random weights: nothing in this scene means anything")
    if clip.road_map is None:
        notes.append(NOTE if by_lidar else "no map: the road is what the network labels as road")
    if not clip.tracks:
        notes.append(f"no boxes: moving objects are what the network says, {found} of them followed over time")
    notes.append("no LiDAR intensity: the network knows colours only")
    return notes


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as JSON; of a path only its name, for scenes must not depend on where files lie."""
    return {key: value.name if isinstance(value, Path) else value for key, value in values.items()}
