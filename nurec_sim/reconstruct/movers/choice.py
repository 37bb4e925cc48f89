"""Which objects of a log count as its actors: those with recorded boxes, those found by their motion, or none."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import get_args

from nurec_sim.errors import ReconstructError
from nurec_sim.logs.selection import with_tracks
from nurec_sim.reconstruct.movers.contradicted import main_lidar
from nurec_sim.reconstruct.movers.find import find_actors
from nurec_sim.types import ActorsName, Clip


def with_actors(
    clip: Clip,
    actors: ActorsName,
    hold_out: Collection[int] = (),
    progress: Callable[[float], None] = lambda done: None,
) -> tuple[Clip, str | None]:
    """A log with the actors that are asked for.

    Args:
        clip: the driving log.
        actors: ``recorded``: the boxes of the log. ``found``: what moves in its sweeps (``find_actors``). ``none``: no
            actors. ``auto``: recorded; found if the log has no boxes at all.
        hold_out: sweeps that must not be read, by index, of every LiDAR.
        progress: called with the fraction done.

    Returns:
        The log, and a note on what its actors are if they are not the recorded ones.

    Raises:
        ReconstructError: no such choice, or no sweeps in which to find actors that were asked for.
    """
    if actors not in get_args(ActorsName):
        raise ReconstructError(f"actors must be one of {list(get_args(ActorsName))}, got {actors!r}")
    if actors == "none" and clip.tracks:
        return with_tracks(clip, ()), f"no boxes: the {len(clip.tracks)} recorded tracks were left out as asked"
    if actors in ("recorded", "none") or (actors == "auto" and clip.tracks):
        return clip, None
    if actors == "found" and main_lidar(clip, hold_out) is None:
        raise ReconstructError(f"clip {clip.id!r}: actors are found in two LiDAR sweeps or more, and it has fewer")
    found = find_actors(clip, hold_out, progress)
    if not found:
        return (with_tracks(clip, ()) if clip.tracks else clip), None
    return with_tracks(clip, found), (
        f"no boxes: {len(found)} actors were found by their motion in the sweeps; what stands throughout, such as "
        "parked cars, is part of the static world"
    )
