"""Actors that the sensors hardly saw: bodies of their class where nothing was measured.

A car that another hid in the log, or whose rear alone was seen, has no surface there: once the ego drives elsewhere or
a scenario moves the car, no camera and no LiDAR would see what collisions count. Such actors, labelled or found in
sweeps, get the missing part of a body of the procedural towns (``world.actor_gaussians``), as large as their box, its
paint the median colour of the brighter half of what was seen. Actors that were seen from three sides stay as they are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import cKDTree

from nurec_sim import geometry
from nurec_sim.reconstruct.free_space import SweepBeams, balls, chosen_sweeps, in_free_space, sweep_beams
from nurec_sim.render import make_renderer
from nurec_sim.render.support import Points, Support, recorded_frames
from nurec_sim.scene.edits import baked_in, joined_dynamic
from nurec_sim.scene.transform import transformed
from nurec_sim.types import Clip, DynamicGaussians, Gaussians, GaussianScene, Label, Track
from nurec_sim.world import ACTOR_SIZES_M, LABEL_OF_KIND, actor_gaussians

MOST_STRETCH = 2.5
"""A side of a box by that of the body, or the reverse: others are not of this class, or wrong."""
COARSER = 1.5
"""Distance of their Gaussians by that of actors that a scenario adds: less than half of the number."""
REACH_M = 0.4
"""A body's surface was seen where a Gaussian of the actor is so near."""
DIRECTIONS, LEAST_SEEN, LEAST_OF_EACH = 16, 0.6, 3
"""Actors that were seen in this share of the directions around their middle stay as they are: a car's rear and one of
its sides are half. A direction was seen with so many Gaussians in it."""
NEAR_M = 60.0
"""Only actors that come so near to the recorded path."""
LEAST_COLOURED = 30
"""Gaussians that tell the colour of an actor."""
GREY = (0.45, 0.45, 0.47)
DAYLIGHT, DARKEST = 0.33, 0.3
"""Median luminance of static Gaussians by day, about; by night bodies are as much darker, down to this factor."""
LUMINANCE = (0.2126, 0.7152, 0.0722)
SWEEPS, VIEWS = 16, 16
"""Recorded sweeps, at most, and images, about, that may show that there is no such body."""
CELL_M, BALL_M, MOST_FREE = 0.5, 0.15, 0.5
"""A box is tested with a ball in each such cell. If beams passed through more of them the label is not believed."""
SOLID = 0.3
"""Least opacity of what counts as seen."""


class Bodies(NamedTuple):
    """Missing parts of actors, by the index of their track."""

    gaussians: dict[int, Gaussians]
    """In the frames of their boxes."""
    seen: dict[int, float]
    """Share of the directions around each actor in which the sensors saw it."""


def with_bodies(scene: GaussianScene, bodies: Bodies) -> GaussianScene:
    """The scene with bodies; its provenance names the actors, with the share that was seen (``completed_actors``)."""
    added = bodies.gaussians
    if not added:
        return scene
    told = {scene.tracks[number].id: bodies.seen[number] for number in added}
    of_track = np.repeat(np.array(list(added), np.int32), [len(body) for body in added.values()])
    moving = DynamicGaussians.rigid(Gaussians.concatenate(list(added.values())), of_track, scene.span_us[0])
    dynamic = joined_dynamic(scene.dynamic, moving) if len(scene.dynamic) else moving
    provenance = {**scene.provenance, "completed_actors": told}
    return dataclasses.replace(scene, dynamic=dynamic, provenance=provenance)


def hidden_bodies(scene: GaussianScene, clip: Clip, hold_out: Collection[int] = ()) -> Bodies:
    """Bodies for the actors of a log that the sensors hardly saw, labelled ones and those found in its sweeps.

    What recorded beams passed through is left out, and what recorded images look at: there the scene shows what they
    saw. If beams passed through most of the box, or images look at most of what would be added, the label is wrong or
    the actor elsewhere, and there is no body.

    Args:
        scene: a reconstruction; actors that deform (Gaussians of their own that are not fixed to their box) stay, and
            so do those that only a network has found.
        clip: its log.
        hold_out: sweeps that must not be read, by index, of every LiDAR.
    """
    bodies: dict[int, Gaussians] = {}
    seen: dict[int, float] = {}
    beams: list[SweepBeams] | None = None
    driven, light, found = cKDTree(scene.ego.position_m), _light(scene.static), {track.id for track in clip.tracks}
    for number, track in enumerate(scene.tracks):
        if not (track.actor and (track.labelled or track.id in found) and (kind := _kind(track))):
            continue
        if not np.isfinite(driven.query(track.path.position_m, distance_upper_bound=NEAR_M)[0]).any():
            continue
        own = _own(scene, number)
        if own is None or (share := _seen(own, track.size_m)) >= LEAST_SEEN:
            continue
        if beams is None:
            chosen = chosen_sweeps(clip, hold_out, SWEEPS)
            beams = [sweep_beams(clip, lidar, clip.sweep(lidar, index)) for lidar, index in chosen]
        if _free(_cells(track), track, beams).mean() > MOST_FREE:
            continue
        body = _body(kind, track, own, light)
        bodies[number], seen[number] = body[_missing(body, own) & ~_free(body, track, beams)], share
    return Bodies(_out_of_sight(scene, bodies), seen)


def _kind(track: Track) -> str | None:
    """The kind of the actor's class that has to be stretched least to fill its box; None if there is none like it."""
    kinds = [kind for kind in ACTOR_SIZES_M if LABEL_OF_KIND.get(kind, "automobile") == track.label]
    size_m = np.maximum(track.size_m, 1e-3)
    stretch = [np.exp(np.abs(np.log(size_m / ACTOR_SIZES_M[kind])).max()) for kind in kinds]
    return kinds[int(np.argmin(stretch))] if kinds and min(stretch) <= MOST_STRETCH else None


def _own(scene: GaussianScene, number: int) -> Gaussians | None:
    """The Gaussians of an actor in the frame of its box; None if some are not fixed to it.

    Methods may have left an actor that stands in the static layer, as movable Gaussians.
    """
    dynamic, track = scene.dynamic, scene.tracks[number]
    mine = (dynamic.track == number) & (dynamic.gaussians.label != Label.ROAD)  # without its shadow
    if mine.any():
        fixed = dynamic.in_box is not None and dynamic.in_box[mine].all()
        return dynamic.gaussians[mine] if fixed else None
    standing = scene.static[baked_in(scene, track)]
    return transformed(standing, geometry.inverse(track.path.world_from_body[0])) if len(standing) else standing


def _seen(own: Gaussians, size_m: tuple[float, float, float]) -> float:
    """Share of the directions around the middle of a box, in units of its sides, in which Gaussians lie."""
    x, y = (own.mean_m[own.opacity > SOLID, :2] / np.array(size_m[:2])).T
    direction = np.floor((np.arctan2(y, x) / (2 * np.pi) + 0.5) * DIRECTIONS).astype(np.int64) % DIRECTIONS
    return float((np.bincount(direction, minlength=DIRECTIONS) >= LEAST_OF_EACH).mean())


def _light(static: Gaussians) -> float:
    """How bright bodies are that were made for the light of a day, 0..1."""
    solid = static.opacity > SOLID
    if not solid.any():
        return 1.0
    return float(np.clip(np.median(static.rgb[solid] @ np.array(LUMINANCE)) / DAYLIGHT, DARKEST, 1.0))


def _body(kind: str, track: Track, own: Gaussians, light: float) -> Gaussians:
    """A body as large as the actor's box, without a shadow: that of the log lies on the ground already."""
    solid = own.opacity > SOLID
    colour = GREY
    if solid.sum() >= LEAST_COLOURED:
        seen = own.rgb[solid]
        # Windows, tyres and what lies in their shade are the darker half of most cars; the paint is in the other.
        bright = np.argsort(seen @ np.array(LUMINANCE), kind="stable")[len(seen) // 2 :]
        colour = tuple(np.clip(np.median(seen[bright], axis=0) / light, 0, 1).tolist())
    body = actor_gaussians(kind, track.size_m, colour, COARSER)
    return dataclasses.replace(body, rgb=(light * body.rgb).astype(np.float32))[body.label == Label.MOVABLE]


def _missing(body: Gaussians, own: Gaussians) -> Bool[np.ndarray, " n"]:
    """Which Gaussians of a body lie where nothing of the actor was seen."""
    solid = own.mean_m[own.opacity > SOLID]
    if not len(solid):
        return np.ones(len(body), bool)
    return cKDTree(solid).query(body.mean_m, distance_upper_bound=REACH_M)[0] > REACH_M


def _cells(track: Track) -> Gaussians:
    """Balls that fill an actor's box."""
    sides = [(np.arange(n) + 0.5) / n * size - size / 2
             for size in track.size_m if (n := max(1, round(size / CELL_M)))]  # fmt: skip
    xyz = np.stack([part.ravel() for part in np.meshgrid(*sides, indexing="ij")], axis=1)
    return balls(xyz, np.full(len(xyz), BALL_M))


def _free(gaussians: Gaussians, track: Track, beams: list[SweepBeams]) -> Bool[np.ndarray, " n"]:
    """Which Gaussians in the frame of an actor's box recorded beams passed through, while it is known where it was."""
    path = track.path

    def place(t_us: int) -> Float64[np.ndarray, "4 4"] | None:
        return path.at(t_us) if path.start_us <= t_us <= path.end_us else None

    return in_free_space(gaussians, beams, place)


def _out_of_sight(scene: GaussianScene, bodies: dict[int, Gaussians]) -> dict[int, Gaussians]:
    """The parts of bodies, by track, that no recorded image sees or looks through; none of bodies that most do."""
    if not recorded_frames(scene) or not any(map(len, bodies.values())):
        return {number: body for number, body in bodies.items() if len(body)}
    poses = {number: scene.tracks[number].path.world_from_body[0] for number in bodies}
    place = np.concatenate(
        [geometry.transform_points(poses[number], body.mean_m.astype(np.float64)) for number, body in bodies.items()]
    )
    eye = scene.ego.position_m[0]
    distance = np.linalg.norm(place - eye, axis=1)
    counts = [len(body) for body in bodies.values()]
    points = Points(eye, (place - eye) / distance[:, None], distance, np.repeat(list(bodies), counts), poses)
    # Few views look where they are, and only these are shown.
    evidence = Support(make_renderer(scene, "cpu"), most=VIEWS, ahead=False).evidence(points)
    hidden = np.split((evidence.seen == 0) & (evidence.through == 0), np.cumsum(counts)[:-1])
    return {number: body[unseen] for (number, body), unseen in zip(bodies.items(), hidden, strict=True)
            if len(body) and unseen.mean() > 1 - MOST_FREE}  # fmt: skip
