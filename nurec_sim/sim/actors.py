"""Actors: replay of recorded tracks with the edits of a scenario (shift, delay, hide)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry
from nurec_sim.errors import ScenarioError
from nurec_sim.sim.scenario import ActorEdit
from nurec_sim.types import ActorState, Matrix4, Track

HIDDEN_BELOW_M = 100.0
"""Hidden actors are placed this far below the ground, as in AlpaSim's clients."""
VELOCITY_WINDOW_US = 100_000


class Actors:
    """Recorded tracks under the edits of a scenario. An actor is present only while its recorded path covers the time.

    Tracks that are not actors (``types.Track.actor``) are skipped: they are rendered only.

    Raises:
        ScenarioError: an edit names a track that the scene does not have.
    """

    def __init__(self, tracks: Sequence[Track], edits: Mapping[str, ActorEdit]) -> None:
        self.tracks = {track.id: track for track in tracks if track.actor}
        self.edits = dict(edits)
        unknown = sorted(set(edits) - set(self.tracks))
        if unknown:
            raise ScenarioError(f"actors {unknown} are not in the scene; have {sorted(self.tracks)}")

    def poses(self, track_id: str, t_us: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 4 4"]:
        """Box poses in the world, NaN while the actor is absent or hidden."""
        track, edit = self.tracks[track_id], self.edits.get(track_id, ActorEdit())
        # A delayed actor also needs its Gaussians, which exist only inside the recorded span of its path.
        asked = t_us - int(round(edit.delay_s * 1e6))
        first, last = track.path.start_us, track.path.end_us
        present = (t_us >= first) & (t_us <= last) & (asked >= first) & (asked <= last) & (not edit.hide)
        result = np.full((len(t_us), 4, 4), np.nan)
        result[present] = self._moved(track, edit, asked[present])
        return result

    def overrides(self, start_us: int, end_us: int) -> dict[str, Float64[np.ndarray, "2 4 4"]]:
        """Actor poses for a sensor request: only edited actors; the others move as recorded."""
        result = {}
        for track_id, edit in self.edits.items():
            track = self.tracks[track_id]
            if not track.path.covers(end_us):
                continue
            asked = np.array([start_us, end_us]) - int(round(edit.delay_s * 1e6))
            pair = self._moved(track, edit, asked)
            # A request can only override poses, not remove an actor: it is placed out of sight instead.
            if edit.hide or not track.path.covers(int(asked[1])):
                pair[:, 2, 3] -= HIDDEN_BELOW_M
            result[track_id] = pair
        return result

    def seen_from(self, t_us: int, world_from_rig: Matrix4) -> tuple[ActorState, ...]:
        """Current ground-truth actors in the rig frame; velocities are over ground, in rig axes."""
        rig_from_world = geometry.inverse(world_from_rig)
        result = []
        for track_id, track in self.tracks.items():
            # Central differences over 0.2 s, one-sided where the actor has just appeared or is about to vanish.
            times = np.array([t_us - VELOCITY_WINDOW_US, t_us, t_us + VELOCITY_WINDOW_US])
            before, now, after = self.poses(track_id, times)
            if np.isnan(now[0, 0]):
                continue
            first, first_us = (now, times[1]) if np.isnan(before[0, 0]) else (before, times[0])
            last, last_us = (now, times[1]) if np.isnan(after[0, 0]) else (after, times[2])
            elapsed_s = max(last_us - first_us, 1) / 1e6
            velocity = rig_from_world[:3, :3] @ (last[:3, 3] - first[:3, 3]) / elapsed_s
            result.append(ActorState(track_id, track.label, track.size_m, rig_from_world @ now, velocity[:2]))
        return tuple(result)

    @staticmethod
    def _moved(track: Track, edit: ActorEdit, t_us: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 4 4"]:
        # Right-multiplied: the shift is along the box's own axes, so it follows the actor through curves.
        shift = geometry.pose(np.eye(3), np.array([*edit.shift_m, 0.0]))
        return track.path.at(t_us) @ shift
