"""Rules about dynamic objects: where the actors of a picture are."""

from __future__ import annotations

from dataclasses import dataclass

import grpc
import numpy as np

from nurec_sim import geometry
from nurec_sim.serving import wire
from nurec_sim.serving.conformance.kit import check
from nurec_sim.serving.conformance.target import Skipped, Target, difference, expect, place, unit_error
from nurec_sim.types import Matrix4, Track

_BELOW_M = 100.0  # where AlpaSim hides actors
_LOOKS = 24


@dataclass(frozen=True)
class _Sighting:
    """An actor that a picture shows, found by hiding it."""

    track: Track
    request: object
    plain: np.ndarray
    hidden: np.ndarray
    pose: Matrix4


@check("actors-listed", optional=True)
def listed(target: Target) -> str:
    """get_dynamic_objects gives tracks with different ids, sizes above 0 and increasing times."""
    ids = [track.id for track in target.tracks]
    expect(all(ids) and len(set(ids)) == len(ids), f"track ids must be there and differ, got {ids[:20]}")
    for track in target.tracks:
        size, times = track.object_size, [sample.timestamp_us for sample in track.trajectory.poses]
        expect(min(size.size_x, size.size_y, size.size_z) > 0, f"track {track.id!r} has no size")
        expect(times, f"track {track.id!r} has no poses")
        expect(all(a < b for a, b in zip(times, times[1:], strict=False)), f"times of {track.id!r} do not increase")
        worst = unit_error([sample.pose.quat for sample in track.trajectory.poses])
        expect(worst < 1e-4, f"a quaternion of {track.id!r} has a squared norm {worst:.2g} away from 1")
    return f"{len(ids)} tracks"


@check("actors-unknown-id")
def unknown_id(target: Target) -> str:
    """An actor that the scene does not know is ignored; AlpaSim lists some."""
    request = target.request()
    add(request, "no-such-actor", target.path.at(target.middle_us))
    image = target.picture(request)
    expect(int(image.max()) > 10, "the picture is black")
    return f"{difference(image, target.picture(target.request())):.2f} steps from the plain picture"


@check("actors-not-finite")
def not_finite(target: Target) -> str:
    """An actor at a pose that is not finite is refused."""
    request = target.request()
    add(request, "anyone", target.path.at(target.middle_us))
    request.dynamic_objects[0].pose_pair.start_pose.vec.y = float("inf")
    return target.refused("render_rgb", request, grpc.StatusCode.INVALID_ARGUMENT)


@check("actors-underground")
def underground(target: Target) -> str:
    """An actor that is listed 100 m below its pose is not in the picture."""
    sighting = _sight(target)
    gap = difference(sighting.plain, sighting.hidden)
    return f"without {sighting.track.id!r} the picture differs by {gap:.2f} steps"


@check("actors-where-listed")
def where_listed(target: Target) -> str:
    """An actor that is listed where it was recorded appears as recorded, and moves when it is listed elsewhere."""
    sighting = _sight(target)
    there = _with(target, sighting, sighting.pose)
    aside = sighting.pose.copy()
    aside[:3, 3] += sighting.pose[:3, 1] * 2.0
    moved = _with(target, sighting, aside)
    gap, hidden = difference(there, sighting.plain), difference(sighting.hidden, sighting.plain)
    expect(gap < 0.5 * hidden, f"listed where it was, it differs by {gap:.2f} steps; not at all, by {hidden:.2f}")
    expect(difference(moved, sighting.plain) > gap, "two metres aside the picture is the same")
    return f"{gap:.2f} steps where recorded, {difference(moved, sighting.plain):.2f} two metres aside"


@check("actors-unlisted")
def unlisted(target: Target) -> str:
    """The static world stays, whoever is listed; unlisted actors may stay or go, by the server's choice."""
    sighting = _sight(target)
    request = _copy(sighting.request)
    add(request, "no-such-actor", target.path.at(target.middle_us))
    image = target.picture(request)
    stays = difference(image, sighting.plain) < difference(image, sighting.hidden)
    changed = float((np.abs(image.astype(int) - sighting.plain).max(axis=2) > 40).mean())
    expect(changed < 0.6, f"{changed:.0%} of the picture changed when one unknown actor was listed")
    return "unlisted actors stay as recorded" if stays else "unlisted actors are not drawn"


def add(request, track_id: str, world_from_box: Matrix4) -> None:
    """Lists an actor in a request, at rest."""
    place(request.dynamic_objects.add(track_id=track_id).pose_pair, world_from_box)


def _copy(request):
    copy = type(request)()
    copy.CopyFrom(request)
    return copy


def _with(target: Target, sighting: _Sighting, pose: Matrix4) -> np.ndarray:
    request = _copy(sighting.request)
    add(request, sighting.track.id, pose)
    return target.picture(request)


def _sight(target: Target) -> _Sighting:
    """An actor and a picture that shows it; each camera in which its box can be is tried."""
    below = geometry.pose(np.eye(3), np.array([0.0, 0.0, -_BELOW_M]))
    best: _Sighting | None = None
    for track, camera, t_us in _looks(target)[:_LOOKS]:
        request = target.request(camera, t_us)
        plain, pose = target.picture(request), track.path.at(t_us)
        hiding = _copy(request)
        add(hiding, track.id, pose @ below)
        sighting = _Sighting(track, request, plain, target.picture(hiding), pose)
        gap = difference(plain, sighting.hidden)
        if best is None or gap > difference(best.plain, best.hidden):
            best = sighting
        if gap > 1:
            return sighting
    if best is None:
        raise Skipped("no track comes before a camera")
    expect(difference(best.plain, best.hidden) > 0, f"hiding {best.track.id!r}, or any other actor, changes no picture")
    return best


def _looks(target: Target) -> list[tuple[Track, object, int]]:
    """Tracks, cameras and times at which the track is before the camera, the nearest first."""
    found = []
    for message in target.tracks:
        track = wire.read_track(message)
        moves = np.ptp(track.path.position_m, axis=0).max() > 1.0
        first, last = max(track.path.start_us, target.path.start_us), min(track.path.end_us, target.path.end_us)
        for t_us in {first + (last - first) // 4, (first + last) // 2} if first <= last else ():
            for camera in target.cameras:
                seen = geometry.inverse(target.world_from_camera(camera, t_us)) @ track.path.at(t_us)
                x, y, z = seen[:3, 3]
                if 3 < z < 60 and abs(x) < 0.6 * z and abs(y) < 0.5 * z:
                    found.append((not moves, z, track, camera, t_us))
    return [look[2:] for look in sorted(found, key=lambda look: look[:2])]
