"""Edited copies of a scene: actors removed, inserted or replaced.

Scenes are never modified in place. An asset is the appearance of an actor in its box frame (origin at the centre, x
forward, y left, z up).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from nurec_sim import geometry
from nurec_sim.errors import RequestError, TooLargeError
from nurec_sim.scene.transform import joined, transformed
from nurec_sim.types import DynamicGaussians, Gaussians, GaussianScene, Label, Track, Trajectory

MAX_DYNAMIC = 20_000_000
"""Maximum number of Gaussians in the dynamic layer of an edited scene."""

MAX_BEYOND_US = 86_400_000_000
"""Maximum time that an actor may exist before and after the scene."""
MIN_SIZE_M = 0.01

Size = tuple[float, float, float]

MAX_PLACE_M = 1e6
"""Maximum distance of an actor from the world origin."""

_STANDS_M = 0.5
_FAINT = 1 / 255
_LOOKS = 64  # maximum number of sampled instants


@dataclass(frozen=True)
class Asset:
    """The appearance of an actor: Gaussians in its box frame, the box size in metres, and its semantic class."""

    gaussians: Gaussians
    size_m: Size
    label: str


def asset_of(scene: GaussianScene, track_id: str) -> Asset:
    """The appearance of a track: its rigid parts, and its other Gaussians at an instant when most are visible.

    A static track without its own Gaussians gets the movable ones of the static layer in its box.

    Raises:
        RequestError: unknown track, or it has no Gaussians.
    """
    number = _number_of(scene, track_id)
    track, dynamic = scene.tracks[number], scene.dynamic
    own, boxed = dynamic.track == number, _boxed(dynamic)
    parts = [dynamic.gaussians[own & boxed]]
    if (own & ~boxed).any():
        world, pose = _snapshot(_rows(dynamic, own & ~boxed), track)
        parts.append(transformed(world, geometry.inverse(pose)))
    if not own.any():
        pose = track.path.world_from_body[0]
        parts = [transformed(scene.static[baked_in(scene, track)], geometry.inverse(pose))]
    look = Gaussians.concatenate(parts)
    if not len(look):
        raise RequestError(f"track {track_id!r} of scene {scene.id!r} has no Gaussians of its own; {have(scene)}")
    return Asset(look, track.size_m, track.label)


def resized(asset: Asset, size_m: Size) -> Asset:
    """The asset scaled along its box axes to another size."""
    factor = np.array(size_m) / np.maximum(asset.size_m, MIN_SIZE_M)
    return Asset(transformed(asset.gaussians, np.diag([*factor, 1.0])), size_m, asset.label)


def with_track(scene: GaussianScene, track: Track, asset: Asset) -> GaussianScene:
    """A copy of the scene with an additional track with the appearance of ``asset``, scaled to the track's size.

    A path with a single pose is static for the duration of the scene.

    Raises:
        RequestError: the id exists, or the path does not overlap the scene in time.
        TooLargeError: the scene would have more than ``MAX_DYNAMIC`` moving Gaussians.
    """
    if any(other.id == track.id for other in scene.tracks):
        raise RequestError(f"scene {scene.id!r} has a track {track.id!r} already; replace it, or take another id")
    if len(track.path.t_us) == 1:
        track = dataclasses.replace(track, path=_standing(track.path, scene))
    return _grown(scene, track, asset)


def replaced_track(scene: GaussianScene, track_id: str, asset: Asset, size_m: Size | None = None) -> GaussianScene:
    """A copy of the scene in which a track has the appearance of ``asset``, with the same path and id.

    The box keeps its ground contact: its centre moves vertically by half of the height difference.

    Args:
        scene: the scene, which is not modified.
        track_id: id of the track to replace.
        asset: the new appearance, which also gives the track's label.
        size_m: new length, width and height of the box; None takes the asset's own.

    Raises:
        RequestError: unknown track.
        TooLargeError: see ``with_track``.
    """
    track = scene.tracks[_number_of(scene, track_id)]
    size_m = size_m or asset.size_m
    rise = geometry.pose(np.eye(3), np.array([0.0, 0.0, (size_m[2] - track.size_m[2]) / 2]))
    path = Trajectory(track.path.t_us, track.path.world_from_body @ rise)
    if not (scene.dynamic.track == _number_of(scene, track_id)).any() and _stands(track):
        path = _standing(path, scene)  # static Gaussians exist throughout the scene
    place_in = [other.id for other in scene.tracks].index(track_id)
    bare = without_track(scene, track_id)
    grown = _grown(bare, dataclasses.replace(track, label=asset.label, size_m=size_m, path=path), asset)
    return _moved_track(grown, len(grown.tracks) - 1, place_in)


def without_track(scene: GaussianScene, track_id: str) -> GaussianScene:
    """A copy of the scene without a track and its Gaussians.

    Raises:
        RequestError: unknown track.
    """
    number = _number_of(scene, track_id)
    own = scene.dynamic.track == number
    static = scene.static if own.any() else scene.static[~baked_in(scene, scene.tracks[number])]
    kept = _rows(scene.dynamic, ~own)
    # Indices of later tracks move down by one.
    dynamic = dataclasses.replace(kept, track=(kept.track - (kept.track > number)).astype(np.int32))
    tracks = [track for track in scene.tracks if track.id != track_id]
    return dataclasses.replace(scene, static=static, dynamic=dynamic, tracks=tuple(tracks))


def have(scene: GaussianScene) -> str:
    """The tracks of a scene, for error texts."""
    ids = [track.id for track in scene.tracks]
    return f"have {ids[:20]}" + (f" and {len(ids) - 20} more" if len(ids) > 20 else "")


def _number_of(scene: GaussianScene, track_id: str) -> int:
    for number, track in enumerate(scene.tracks):
        if track.id == track_id:
            return number
    raise RequestError(f"scene {scene.id!r} has no track {track_id!r}; {have(scene)}")


def _snapshot(mine: DynamicGaussians, track: Track) -> tuple[Gaussians, np.ndarray]:
    """A track's Gaussians in the world at one instant, with their fade, and its pose.

    Uses the upper quartile by total opacity of all middle knot times: at the maximum two time windows may overlap and
    duplicate everything.
    """
    times = np.unique(mine.knot_t_us[:, 1])
    times = times[np.linspace(0, len(times) - 1, min(len(times), _LOOKS)).astype(int)]
    looks = []
    for t_us in times.tolist():
        rows, _, fade = mine.at(t_us)
        looks.append((float((mine.gaussians.opacity[rows] * fade).sum()), t_us))
    t_us = sorted(looks)[int(0.75 * (len(looks) - 1))][1]
    rows, mean_m, fade = mine.at(t_us)
    opacity = (mine.gaussians.opacity[rows] * fade).astype(np.float32)
    seen = dataclasses.replace(mine.gaussians[rows], mean_m=mean_m.astype(np.float32), opacity=opacity)
    return seen[opacity >= _FAINT], track.path.at(t_us)


def _stands(track: Track) -> bool:
    return bool(np.ptp(track.path.position_m, axis=0).max() <= _STANDS_M)


def _standing(path: Trajectory, scene: GaussianScene) -> Trajectory:
    """The first pose of a path, held for the duration of the scene."""
    return Trajectory(np.array(scene.span_us), np.repeat(path.world_from_body[:1], 2, axis=0))


def baked_in(scene: GaussianScene, track: Track) -> Bool[np.ndarray, " n"]:
    """Mask of static Gaussians that belong to a static track: the movable ones in its box, enlarged by 10 %."""
    inside = np.zeros(len(scene.static), bool)
    if _stands(track):
        movable = np.flatnonzero(scene.static.label == Label.MOVABLE)
        box_from_world = geometry.inverse(track.path.world_from_body[0])
        local = geometry.transform_points(box_from_world, scene.static.mean_m[movable])
        inside[movable] = (np.abs(local) <= 0.55 * np.array(track.size_m)).all(axis=1)
    return inside


def _grown(scene: GaussianScene, track: Track, asset: Asset) -> GaussianScene:
    """The scene with a track appended."""
    path, (first, last) = track.path, scene.span_us
    if path.end_us < first or path.start_us > last:
        raise RequestError(
            f"track {track.id!r} lives during [{path.start_us}, {path.end_us}] us, scene {scene.id!r} covers "
            f"[{first}, {last}]"
        )
    if path.start_us < first - MAX_BEYOND_US or path.end_us > last + MAX_BEYOND_US:
        raise RequestError(
            f"track {track.id!r} lives during [{path.start_us}, {path.end_us}] us; that may be at most a day before "
            f"and after scene {scene.id!r}, which covers [{first}, {last}]"
        )
    if np.abs(path.position_m).max() > MAX_PLACE_M:
        raise RequestError(f"track {track.id!r} leaves the {MAX_PLACE_M:g} m around the world's origin")
    look = asset.gaussians if asset.size_m == track.size_m else resized(asset, track.size_m).gaussians
    total = len(scene.dynamic) + len(look)
    if total > MAX_DYNAMIC:
        raise TooLargeError(
            f"an edited scene may have {MAX_DYNAMIC:,} moving Gaussians; with track {track.id!r} it has {total:,}"
        )
    added = DynamicGaussians.rigid(look, np.full(len(look), len(scene.tracks), np.int32), first)
    dynamic = joined_dynamic(scene.dynamic, added) if len(scene.dynamic) else added
    return dataclasses.replace(scene, dynamic=dynamic, tracks=(*scene.tracks, track))


def _moved_track(scene: GaussianScene, at: int, to: int) -> GaussianScene:
    """The same scene with a track moved to another index."""
    tracks = list(scene.tracks)
    tracks.insert(to, tracks.pop(at))
    old = scene.dynamic.track
    # Tracks between the two places move up by one.
    number = np.where(old == at, to, np.where((old >= to) & (old < at), old + 1, old)).astype(np.int32)
    return dataclasses.replace(scene, dynamic=dataclasses.replace(scene.dynamic, track=number), tracks=tuple(tracks))


def _boxed(dynamic: DynamicGaussians) -> Bool[np.ndarray, " n"]:
    return np.zeros(len(dynamic), bool) if dynamic.in_box is None else dynamic.in_box


def _rows(dynamic: DynamicGaussians, keep: Bool[np.ndarray, " n"]) -> DynamicGaussians:
    return DynamicGaussians(
        dynamic.gaussians[keep],
        dynamic.knot_t_us[keep],
        dynamic.knot_m[keep],
        dynamic.track[keep],
        None if dynamic.in_box is None else dynamic.in_box[keep],
    )


def joined_dynamic(one: DynamicGaussians, other: DynamicGaussians) -> DynamicGaussians:
    """Concatenation, with harmonics padded to the higher degree."""
    count = len(one)
    gaussians = joined([one.gaussians, other.gaussians])
    parts = [
        dataclasses.replace(one, gaussians=gaussians[:count]),
        dataclasses.replace(other, gaussians=gaussians[count:]),
    ]
    return DynamicGaussians.concatenate(parts)
