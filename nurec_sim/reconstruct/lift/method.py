"""The `lift` method: coloured LiDAR and lifted pixels as Gaussians, without a network or an optimisation.

Sweeps give the geometry: they are gathered in the world (or in the box frame of their actor), thinned, and get normals.
Images give the detail: each frame gets a dense depth, measured where surfels lie in it and matched against its
neighbours elsewhere, and its pixels are lifted. Every surface is owned by the view that saw it from nearest; surfels
remain where no view saw them. Directions that nothing covers are sky. In the end colours are solved for: those with
which all Gaussians together reproduce the images best.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Bool

from nurec_sim.compute.cores import in_order
from nurec_sim.errors import ReconstructError
from nurec_sim.geometry import arc_length
from nurec_sim.reconstruct.ego_vehicle import find_ego_images
from nurec_sim.reconstruct.lift import actors as actor_layer
from nurec_sim.reconstruct.lift import colour, people, points
from nurec_sim.reconstruct.lift.bake import Baked, body_gaussians, body_pixels, camera_isp
from nurec_sim.reconstruct.lift.bodies import surfels_of
from nurec_sim.reconstruct.lift.colour_solve import solve_colours
from nurec_sim.reconstruct.lift.pictures import DepthPicture, depth_pictures
from nurec_sim.reconstruct.lift.points import Actor
from nurec_sim.reconstruct.lift.settings import LiftSettings
from nurec_sim.reconstruct.lift.sky_cubemap import make_sky
from nurec_sim.reconstruct.lift.thin_parts import with_thin_parts
from nurec_sim.reconstruct.lift.views import (
    LEAST_SKY_WEIGHT,
    WorkingView,
    border_weight,
    key_frames,
    key_pixels,
    read_views,
)
from nurec_sim.reconstruct.unseen_colours import colours_by_likeness
from nurec_sim.types import Clip, DynamicGaussians, Gaussians, GaussianScene

Progress = Callable[[str, float], None]
NARROWER = (1.0, 0.8, 0.64, 0.5)
"""Widths of working views that are tried, as shares of the largest, until ``pixels_per_gaussian`` is met."""
SHOWN_PX = 0.1
"""Images show a surfel if its shares of all their pixels add up to more than this."""


def lift(
    clip: Clip, cameras: Sequence[str], hold_out: set[int], progress: Progress, settings: LiftSettings
) -> GaussianScene:
    """Reconstruct a clip from its sweeps and the frames of the given cameras.

    Args:
        clip: the driving log.
        cameras: ids of the cameras whose frames are used; may be empty.
        hold_out: sweeps that must not be read, by index, of every LiDAR.
        progress: called with the stage's name and the fraction of all work done, about.
        settings: all settings of the method.

    Raises:
        ReconstructError: the clip has no LiDAR sweep to build from.
    """
    given, settings = settings, _settings_for(clip, cameras, settings)
    stages = _Stages(progress)
    stages.start("sweeps")
    frames = key_frames(clip, cameras, settings.views)
    actors = people.in_windows(points.actors_of(clip, settings.points), clip, frames, hold_out)
    gathered = points.gather(clip, actors, hold_out, settings.points, stages.fraction)
    if gathered.point_count == 0:
        raise ReconstructError(
            f"clip {clip.id!r}: method 'lift' needs LiDAR sweeps; have lidars {list(clip.rig.lidars)} "
            f"with no usable points after holding out sweeps {sorted(hold_out)}; method 'dense' needs images only, and "
            "--refine SECONDS optimises its scene"
        )
    stages.start("ground and surfaces")
    with ThreadPoolExecutor(1) as beside:
        # Images do not depend on surfaces, whose first steps use one core.
        seen = beside.submit(_images, clip, cameras, hold_out, settings)
        bodies, ground = surfels_of(clip, actors, gathered, settings)
        stages.start("images")
        ego_images, views = seen.result()
    stages.start("depth")
    pictures = depth_pictures(views, bodies, list(clip.rig.lidars.values()), settings, stages.fraction)
    views = [view for view in views if view.key]
    pictures = with_thin_parts(views, bodies, pictures, settings.views.agreement)
    stages.start("colours")
    isp, unaligned_cameras = camera_isp(views, pictures, bodies, cameras)
    # Responses first: colours of different cameras are mixed from here on.
    canonical = [colour.to_canonical(view.rgb, isp[view.camera_id]).astype(np.uint8) for view in views]
    stages.start("lifting")
    static, moving, lifted = Baked(Gaussians.empty(), 0, np.zeros(0, bool)), [], 0
    beams = gathered.beams if settings.points.carve else []
    pixels = body_pixels(bodies, views, pictures, canonical, settings)

    def made(number: int) -> Baked:
        body = bodies[number]
        shown = [k for k, view in enumerate(views) if body.present(view.t_us)]
        lifted = dataclasses.replace(pixels[number], view=np.searchsorted(shown, pixels[number].view).astype(np.int32))
        mine, depths, colours = [views[k] for k in shown], [pictures[k] for k in shown], [canonical[k] for k in shown]
        # The world takes as long as all actors, which are made beside it: its progress is that of all.
        report = stages.fraction if body.actor is None else lambda fraction: None
        baked = body_gaussians(body, lifted, ground, mine, depths, colours, settings, beams, report)
        return baked._replace(gaussians=_coloured(baked.gaussians, baked.shown))

    with ThreadPoolExecutor(1) as beside:
        weights = [_sky_weight(picture, view, settings) for picture, view in zip(pictures, views, strict=True)]
        far = beside.submit(make_sky, views, canonical, weights, settings.sky_px)
        for number, baked in enumerate(in_order(made, range(len(bodies)), len(bodies))):
            lifted += baked.lifted
            if (actor := bodies[number].actor) is None:
                static = baked
            elif len(baked.gaussians):
                place = actor_layer.in_box if actor.window_us is None else people.moving
                moving.append(place(actor, baked.gaussians))
        sky = far.result()
    dynamic = DynamicGaussians.concatenate(moving)
    counts = {
        "sweeps": gathered.sweep_count,
        "points": gathered.point_count,
        "views": len(views),
        "lifted": lifted,
        "static": len(static.gaussians),
        "dynamic": len(dynamic),
    }
    provenance = {
        "method": "lift",
        "settings": dataclasses.asdict(given),
        "cameras": list(cameras),
        "held_out_sweeps": sorted(hold_out),
        "counts": counts,
        "unknown": _unknown(clip, cameras, actors, gathered, unaligned_cameras),
    }
    scene = GaussianScene(
        id=clip.id,
        static=static.gaussians,
        dynamic=dynamic,
        sky=sky,
        isp=isp,
        rig=clip.rig,
        ego=clip.ego,
        tracks=actor_layer.tracks_of(clip, actors),
        road_map=clip.road_map,
        span_us=clip.span_us,
        camera_times_us={camera: clip.camera_times_us(camera) for camera in clip.rig.cameras},
        provenance=provenance,
        ego_images=ego_images,
    )
    stages.start("solving colours")
    scene, taken_px = solve_colours(scene, clip, cameras, settings, stages.fraction)
    shown = static.shown
    if taken_px is not None:
        # An image that should show a surfel, by its depth, may show it through a gap only, and in the colour of what is
        # around that. Pixels that are white in image and scene count nothing in the solve.
        white = scene.static.rgb.min(axis=1) > colour.SATURATED
        shown = (np.arange(len(shown)) < static.lifted) | (taken_px > SHOWN_PX) | (static.shown & white)
    stages.stop()
    return dataclasses.replace(scene, static=_coloured(scene.static, shown))


def _settings_for(clip: Clip, cameras: Sequence[str], given: LiftSettings) -> LiftSettings:
    """The settings for a log, with views that are as wide as its budget of Gaussians is worth."""
    path_m, span_us = float(arc_length(clip.ego.world_from_body[:, :3, 3])[-1]), clip.span_us[1] - clip.span_us[0]
    images = [(model.width_px, model.height_px, len(clip.camera_times_us(camera)))
              for camera, model in clip.rig.cameras.items() if camera in cameras]  # fmt: skip
    settings = given.for_log(path_m, span_us / 1e6, images)
    for share in NARROWER:
        views = dataclasses.replace(settings.views, width_px=max(1, round(share * settings.views.width_px)))
        if key_pixels(clip, cameras, views) <= views.pixels_per_gaussian * views.budget:
            break
    return dataclasses.replace(settings, views=views)


def _images(
    clip: Clip, cameras: Sequence[str], hold_out: set[int], settings: LiftSettings
) -> tuple[dict[str, np.ndarray], list[WorkingView]]:
    """What cameras see of the ego vehicle (``find_ego_images``), and the working views without it."""
    ego_images = find_ego_images(clip, cameras, hold_out=hold_out)
    return ego_images, read_views(clip, cameras, ego_images, settings.views)


def _coloured(gaussians: Gaussians, shown: Bool[np.ndarray, " n"]) -> Gaussians:
    """Gaussians of which those that no image shows take colours of what is like them."""
    return dataclasses.replace(gaussians, rgb=colours_by_likeness(gaussians, shown))


def _sky_weight(picture: DepthPicture, view: WorkingView, settings: LiftSettings) -> np.ndarray:
    """Weight of each pixel in the sky: 1 if it is far and looks like sky, little if it is merely far."""
    far = (picture.inverse_depth < 1 / settings.views.max_depth_m) & view.tile.valid
    border = border_weight(view.tile.height, view.tile.width, LEAST_SKY_WEIGHT)
    return np.where(far, np.where(picture.sky, 1.0, 0.02), 0.0) * border


_ENDS = {
    "sweeps": 0.1,
    "ground and surfaces": 0.23,
    "images": 0.24,
    "depth": 0.5,
    "colours": 0.51,
    "lifting": 0.78,
    "solving colours": 1.0,
}
"""The part of all work that is done at the end of each stage, about (on the demonstration's log)."""


class _Stages:
    """Reports the running stage. Timing is up to the caller: a scene must not depend on the clock."""

    def __init__(self, progress: Progress) -> None:
        self.progress, self.stage, self.begun = progress, "", 0.0

    def start(self, stage: str) -> None:
        self.stop()
        self.stage = stage
        self.fraction(0.0)

    def fraction(self, fraction: float) -> None:
        self.progress(self.stage, self.begun + fraction * (_ENDS[self.stage] - self.begun))

    def stop(self) -> None:
        if self.stage:
            self.fraction(1.0)
            self.begun = _ENDS[self.stage]


def _unknown(
    clip: Clip,
    cameras: Sequence[str],
    actors: Sequence[Actor],
    gathered: points.Gathered,
    unaligned_cameras: Sequence[str],
) -> list[str]:
    """What the log does not contain, as notes for the provenance."""
    notes = []
    if clip.road_map is None:
        notes.append("no map: the road is grown from the driven path up to height steps")
    if not actors:
        notes.append("no boxes: moving objects are baked into the static layer where they were not carved away")
    if not gathered.intensity_known:
        notes.append("no LiDAR intensity: simulated returns have none")
    if not cameras:
        notes.append("no cameras: colours are grey")
    if len(cameras) > 1 and unaligned_cameras:
        notes.append(
            f"no shared points: colours of {', '.join(unaligned_cameras)} are not aligned with the other cameras"
        )
    if gathered.sweep_count == 1:
        notes.append("one sweep only: surfaces behind what it saw are missing")
    return notes
