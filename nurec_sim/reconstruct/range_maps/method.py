"""The method ``lidar``: every window's range map through the network, and what comes out as one scene.

A window is a sweep. Its Gaussians are placed in the world, or in the box of the actor whose returns they are; windows
are merged by ownership (``ownership``); what recorded beams passed through goes. Images are not used, so the method
works on a log with only a LiDAR; colours show the intensity.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float64

from nurec_sim.compute.cores import in_order
from nurec_sim.errors import ReconstructError
from nurec_sim.network.checkpoints.download import find_weights
from nurec_sim.network.checkpoints.state_dicts import load_weights
from nurec_sim.network.lidar.branch import LidarBranch, build_lidar
from nurec_sim.network.lidar.inputs import lidar_inputs
from nurec_sim.network.lidar.profiles import LIDAR_PROFILES
from nurec_sim.network.lidar.range_image import RangeImage
from nurec_sim.reconstruct.free_space import SweepBeams, balls, in_free_space, sweep_beams
from nurec_sim.reconstruct.lift import actors as actor_layer
from nurec_sim.reconstruct.lift.points import Actor, actors_of, returns_in_box
from nurec_sim.reconstruct.lift.settings import PointSettings
from nurec_sim.reconstruct.range_maps.bodies import WindowGaussians, split_bodies, window_gaussians
from nurec_sim.reconstruct.range_maps.ownership import one_per_voxel, owned, voxel_edge_m
from nurec_sim.reconstruct.range_maps.settings import LidarSettings
from nurec_sim.reconstruct.range_maps.windows import SweepWindow, choose_windows, read_window
from nurec_sim.types import Clip, DynamicGaussians, Gaussians, GaussianScene

Progress = Callable[[str, float], None]
SWEEPS_END, OWNED, DECODED = 0.3, 0.4, 0.8
"""Shares of all work."""
RETURN_M = 0.03
"""Standard deviation of a return when it is tested whether beams pass through it."""
SKY_PX, GREY = 8, 0.6


def range_maps_to_scene(clip: Clip, hold_out: set[int], progress: Progress, settings: LidarSettings) -> GaussianScene:
    """Reconstruct a clip from its sweeps with the LiDAR branch.

    Args:
        clip: the driving log.
        hold_out: sweeps that must not be read, by index, of every LiDAR.
        progress: called with the stage's name and the fraction of all work that is done, about.
        settings: how.

    Raises:
        ReconstructError: the clip has no usable sweep.
        WeightsError: no weights, or weights of another network.
    """
    progress("weights", 0.0)
    model, weights = load_branch(settings)
    chosen = choose_windows(clip, hold_out, settings.windows)
    actors = actors_of(clip, PointSettings())
    windows: list[SweepWindow] = []
    beams: list[SweepBeams] = []
    used: list[tuple[str, int]] = []
    for done, (window, fired) in enumerate(in_order(lambda job: _read(clip, *job), chosen)):
        progress("sweeps", SWEEPS_END * done / len(chosen))
        if window is not None:
            windows.append(window)
            used.append(chosen[done])
            beams.append(fired)
    if not windows:
        raise ReconstructError(
            f"clip {clip.id!r}: method 'lidar' needs LiDAR sweeps; have lidars {list(clip.rig.lidars)} "
            f"with no usable returns after holding out sweeps {sorted(hold_out)}"
        )
    progress("ownership", SWEEPS_END)
    floor = LIDAR_PROFILES[settings.profile].scale_floor
    kept = _kept(windows, beams, actors, settings)
    static, moving = [], {actor.index: [] for actor in actors}  # type: ignore[var-annotated]
    inputs = in_order(lambda k: lidar_inputs(windows[k].image, _over(windows[k].image, kept[k])), range(len(windows)))
    for done, given in enumerate(inputs):
        progress(f"window {done + 1} of {len(windows)}", OWNED + (DECODED - OWNED) * done / len(windows))
        with torch.inference_mode():
            found = window_gaussians(windows[done], kept[done], model(given), floor)
        world, parts = split_bodies(found[found.gaussians.opacity >= settings.min_opacity], actors)
        static.append(world)
        for index, part in parts.items():
            moving[index].append(part)
    merged = WindowGaussians.concatenate(static)
    progress("free space", DECODED)
    rest, brief = _carved(merged, beams, settings)
    dynamic = _dynamic(actors, moving, brief, sorted({window.t_us for window in windows}))
    progress("free space", 1.0)
    still = rest.gaussians
    if settings.ray_drop == "log":
        still = dataclasses.replace(still, ray_drop=None)
        dynamic = dataclasses.replace(dynamic, gaussians=dataclasses.replace(dynamic.gaussians, ray_drop=None))
    unknown = sorted({lidar for (lidar, _), window in zip(used, windows, strict=True) if not window.beams_known})
    counts = {"windows": len(windows), "returns": sum(len(each) for each in kept), "decoded": len(merged),
              "static": len(still), "dynamic": len(dynamic)}  # fmt: skip
    provenance = {
        "method": "lidar",
        "settings": _plain(dataclasses.asdict(settings)),
        "weights": weights,
        "cameras": [],
        "held_out_sweeps": sorted(hold_out),
        "windows": [list(each) for each in used],
        "counts": counts,
        "unknown": _unknown(clip, actors, still, unknown),
    }
    return GaussianScene(
        id=clip.id,
        static=still,
        dynamic=dynamic,
        sky=np.full((6, SKY_PX, SKY_PX, 3), GREY, np.float32),
        isp={},
        rig=clip.rig,
        ego=clip.ego,
        tracks=actor_layer.tracks_of(clip, actors),
        road_map=clip.road_map,
        span_us=clip.span_us,
        camera_times_us={camera: clip.camera_times_us(camera) for camera in clip.rig.cameras},
        provenance=provenance,
        ego_images={},
    )


def load_branch(settings: LidarSettings) -> tuple[LidarBranch, dict[str, Any]]:
    """The branch with its weights, and their description for the provenance.

    Raises:
        WeightsError: no weights, or weights of another network.
    """
    model = build_lidar(LIDAR_PROFILES[settings.profile], settings.random_weights or 0)
    if settings.random_weights is not None:
        return model, {"random_seed": settings.random_weights}
    path = find_weights(settings.profile, settings.checkpoint)
    load_weights(model, path, settings.profile)
    return model, {"file": path.name}


def _read(clip: Clip, lidar: str, index: int) -> tuple[SweepWindow | None, SweepBeams]:
    return read_window(clip, lidar, index), sweep_beams(clip, lidar, clip.sweep(lidar, index))


def _over(image: RangeImage, kept: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, "rows columns"]:
    """Kept returns as an image over beams."""
    chosen = image.returned.copy()
    chosen[image.returned] = kept
    return chosen


def _kept(
    windows: Sequence[SweepWindow], beams: Sequence[SweepBeams], actors: Sequence[Actor], settings: LidarSettings
) -> list[Bool[np.ndarray, " n"]]:
    """The returns of each window that are decoded: those that the window owns, one per voxel; all of actors."""
    xyz = [window.xyz_world_m for window in windows]
    of_actors = [_in_boxes(each, window, actors) for each, window in zip(xyz, windows, strict=True)]

    def own(k: int) -> Bool[np.ndarray, " n"]:
        return owned(xyz[k], windows[k].range_m, [*beams[:k], *beams[k + 1 :]], settings.nearer)

    mine = [each & ~boxed for each, boxed in zip(in_order(own, range(len(windows))), of_actors, strict=True)]
    reach = np.concatenate([window.range_m[each] for window, each in zip(windows, mine, strict=True)])
    edge = np.concatenate([voxel_edge_m(window.spacing_m)[each] for window, each in zip(windows, mine, strict=True)])
    place = np.concatenate([each[own] for each, own in zip(xyz, mine, strict=True)])
    # Gaussians without a floor do not fill a voxel each.
    thin = LIDAR_PROFILES[settings.profile].scale_floor
    first = one_per_voxel(place, edge, reach) if thin else np.ones(len(place), bool)
    if first.sum() > settings.max_gaussians:
        nearest = np.flatnonzero(first)[np.argsort(reach[first], kind="stable")[: settings.max_gaussians]]
        first = np.zeros_like(first)
        first[nearest] = True
    ends = np.cumsum([each.sum() for each in mine])
    for each, part in zip(mine, np.split(first, ends[:-1]), strict=True):
        each[each] = part
    return [each | boxed for each, boxed in zip(mine, of_actors, strict=True)]


def _in_boxes(
    xyz_m: Float64[np.ndarray, "n 3"], window: SweepWindow, actors: Sequence[Actor]
) -> Bool[np.ndarray, " n"]:
    """Returns on actors, each at its own time."""
    free = np.ones(len(xyz_m), bool)
    for actor in actors:
        inside, *_ = returns_in_box(actor, xyz_m, xyz_m, window.point_t_us, free, PointSettings().box_margin_m)
        free[inside] = False
    return ~free


def _carved(
    found: WindowGaussians, beams: Sequence[SweepBeams], settings: LidarSettings
) -> tuple[WindowGaussians, WindowGaussians]:
    """What stays, and what was there for a moment: returns that beams of other times passed through."""
    nothing = np.zeros(0, np.int64)
    if not settings.carve:
        return found, found[nothing]
    free = in_free_space(found.gaussians, beams)
    suspects = found[free]
    points = balls(suspects.gaussians.mean_m.astype(np.float64), np.full(len(suspects), RETURN_M, np.float32))
    return found[~free], suspects[in_free_space(points, beams)]


def _dynamic(
    actors: Sequence[Actor], moving: dict[int, list[WindowGaussians]], brief: WindowGaussians,
    times_us: Sequence[int],
) -> DynamicGaussians:  # fmt: skip
    """Rigid parts of actors, and what lives from the window before to the window after its own."""
    parts = []
    for actor in actors:
        if moving[actor.index]:
            joined = WindowGaussians.concatenate(moving[actor.index])
            place, edge = joined.gaussians.mean_m.astype(np.float64), voxel_edge_m(joined.spacing_m)
            parts.append(actor_layer.in_box(actor, joined[one_per_voxel(place, edge, joined.range_m)].gaussians))
    if len(brief) and len(times_us) > 1:
        times = np.array(times_us)
        index = np.searchsorted(times, brief.t_us)
        after = times[np.minimum(index + 1, len(times) - 1)] - brief.t_us
        before = brief.t_us - times[np.maximum(index - 1, 0)]
        after, before = np.where(after > 0, after, before), np.where(before > 0, before, after)
        knots = np.stack([brief.t_us - before, brief.t_us, brief.t_us + after], axis=1)
        where = np.repeat(brief.gaussians.mean_m[:, None], 3, axis=1)
        no_box = None if not parts else np.zeros(len(brief), bool)
        parts.append(DynamicGaussians(brief.gaussians, knots, where, np.full(len(brief), -1, np.int32), no_box))
    return DynamicGaussians.concatenate(parts)


def _unknown(clip: Clip, actors: Sequence[Actor], gaussians: Gaussians, unknown: Sequence[str]) -> list[str]:
    """What the log does not contain, as notes for the provenance."""
    notes = ["no images: colours show the LiDAR intensity, the sky is grey"]
    if clip.road_map is None:
        notes.append("no map: the road is what the network labels as road")
    if not actors:
        notes.append("no boxes: what moves lives for the time between two windows")
    if not np.isfinite(gaussians.intensity).any():
        notes.append("no LiDAR intensity: simulated returns have none")
    notes += [f"beams of LiDAR {lidar!r} are not known: returns without a beam of their own were left out"
              for lidar in unknown]  # fmt: skip
    return notes


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Settings as JSON; of a path only its name, for scenes must not depend on where files lie."""
    return {key: value.name if isinstance(value, Path) else value for key, value in values.items()}
