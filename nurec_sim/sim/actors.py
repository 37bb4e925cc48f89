"""Actors: replay of recorded tracks with the edits of a scenario (shift, delay, brake, hide)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry
from nurec_sim.errors import ScenarioError
from nurec_sim.sim.scenario import ActorEdit, Brake, Perturbation, Scenario
from nurec_sim.types import ActorState, Matrix4, Track, Trajectory

HIDDEN_BELOW_M = 100.0
"""Hidden actors are placed this far below the ground, as in AlpaSim's clients."""
VELOCITY_WINDOW_US = 100_000
LEAD = "lead"
LEAD_AHEAD_M, LEAD_ASIDE_M, LEAD_TURNED_RAD = 60.0, 1.5, 0.8
"""How far ahead, beside the recorded path and turned away from it the lead actor may be."""
BRAKE_STEP_US = 10_000


def edited_actors(
    scenario: Scenario, scene_id: str, ego: Trajectory, tracks: Sequence[Track], start_us: int, seed: int
) -> Actors:
    """The actors of one rollout: recorded tracks with the scenario's edits and random differences.

    Args:
        scenario: what is driven.
        scene_id: keys the random differences, with the seed.
        ego: the recorded drive, for finding the lead actor.
        tracks: of the scene.
        start_us: start of the rollout.
        seed: of the rollout.

    Raises:
        ScenarioError: an edit names an actor that the scene does not have, there is no lead actor, or the scene was not
            given the actors that the scenario adds.
    """
    missing = sorted(set(scenario.added_actors) - {track.id for track in tracks})
    if missing:
        raise ScenarioError(f"scene {scene_id!r} lacks the added actors {missing}; see runs.with_added_actors")
    edits = dict(scenario.actors)
    if LEAD in edits and not any(track.id == LEAD for track in tracks):
        edit = edits.pop(LEAD)
        at_us = start_us + (round(edit.brake.at_s * 1e6) if edit.brake is not None else 0)
        edits[lead_actor(ego, tracks, at_us)] = edit
    differences = scenario.perturbation
    if differences.actor_delay_s or differences.actor_along_m:
        for track in tracks:
            if track.actor and track.controllable:
                edits[track.id] = _different(edits.get(track.id, ActorEdit()), differences, scene_id, track.id, seed)
    return Actors(tracks, edits, start_us)


def lead_actor(ego: Trajectory, tracks: Sequence[Track], t_us: int) -> str:
    """Id of the nearest controllable actor ahead on the recorded path, at the recorded poses of an instant.

    Raises:
        ScenarioError: there is none.
    """
    path = ego.position_m[:, :2]
    here = ego.at(min(t_us, ego.end_us))
    (own,), _ = geometry.project_to_polyline(here[None, :2, 3], path)
    found = []
    for track in tracks:
        if not (track.actor and track.controllable and track.path.covers(t_us)):
            continue
        pose = track.path.at(t_us)
        (station,), (aside,) = geometry.project_to_polyline(pose[None, :2, 3], path)
        on_path = ego.at(int(np.interp(station, geometry.arc_length(path), ego.t_us)))
        turned = float(geometry.yaw_of(pose)) - float(geometry.yaw_of(on_path))
        along = np.cos(turned) > np.cos(LEAD_TURNED_RAD)
        if 0 < station - own < LEAD_AHEAD_M and abs(aside) < LEAD_ASIDE_M and along:
            found.append((float(station), track.id))
    if not found:
        raise ScenarioError(
            f"there is no lead actor: at {t_us} us nothing drives within {LEAD_AHEAD_M:g} m ahead on the recorded path"
        )
    return min(found)[1]


def _different(edit: ActorEdit, differences: Perturbation, scene_id: str, track_id: str, seed: int) -> ActorEdit:
    """An edit with the random differences of one actor, from scene, actor and seed only."""
    key = int.from_bytes(hashlib.sha256(f"{scene_id}/actors/{track_id}".encode()).digest()[:8], "little")
    delay, along = np.random.Generator(np.random.Philox(key=[key, seed])).standard_normal(2).tolist()
    ahead, left = edit.shift_m
    return edit.model_copy(
        update={
            "delay_s": edit.delay_s + delay * differences.actor_delay_s,
            "shift_m": (ahead + along * differences.actor_along_m, left),
        }
    )


class Actors:
    """Recorded tracks under the edits of a scenario. An actor is present only while its recorded path covers the time.

    Tracks that are not actors (``types.Track.actor``) are skipped: they are rendered only.

    ``start_us`` is the time from which the edits count their seconds.

    Raises:
        ScenarioError: an edit names a track that the scene does not have.
    """

    def __init__(self, tracks: Sequence[Track], edits: Mapping[str, ActorEdit], start_us: int = 0) -> None:
        self.tracks = {track.id: track for track in tracks if track.actor}
        self.edits = dict(edits)
        self.start_us = start_us
        unknown = sorted(set(edits) - set(self.tracks))
        if unknown:
            raise ScenarioError(f"actors {unknown} are not in the scene; have {sorted(self.tracks)}")

    def poses(self, track_id: str, t_us: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 4 4"]:
        """Box poses in the world, NaN while the actor is absent or hidden."""
        track, edit = self.tracks[track_id], self.edits.get(track_id, ActorEdit())
        # A delayed actor also needs its Gaussians, which exist only inside the recorded span of its path.
        asked = self._asked(track, edit, t_us)
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
            asked = self._asked(track, edit, np.array([start_us, end_us]))
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

    def _asked(self, track: Track, edit: ActorEdit, t_us: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
        """The times of the recording whose poses an actor has."""
        asked = t_us - int(round(edit.delay_s * 1e6))
        return asked if edit.brake is None else braked(track.path, edit.brake, asked, self.start_us)

    @staticmethod
    def _moved(track: Track, edit: ActorEdit, t_us: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 4 4"]:
        # Right-multiplied: the shift is along the box's own axes, so it follows the actor through curves.
        shift = geometry.pose(np.eye(3), np.array([*edit.shift_m, 0.0]))
        return track.path.at(t_us) @ shift


def braked(path: Trajectory, brake: Brake, t_us: Int64[np.ndarray, " n"], start_us: int) -> Int64[np.ndarray, " n"]:
    """The times of a recording at which an actor was where it is when it brakes.

    From the speed v at the start of braking it has driven v t - a t^2 / 2 after t, and stands after v / a; it is never
    ahead of its recording, so an actor that brakes harder by itself does so.

    Args:
        path: as recorded.
        brake: when and how hard.
        t_us: times in the rollout.
        start_us: time from which ``brake.at_s`` counts.
    """
    begin_us = start_us + round(brake.at_s * 1e6)
    if begin_us >= path.end_us:
        return t_us
    begin_us = max(begin_us, path.start_us)
    times = np.append(np.arange(begin_us, path.end_us, BRAKE_STEP_US), path.end_us)
    driven_m = geometry.arc_length(path.at(times)[:, :2, 3])
    window = min(VELOCITY_WINDOW_US, path.end_us - begin_us)
    speed = float(np.interp(begin_us + window, times, driven_m)) / (window / 1e6)
    elapsed_s = np.clip((t_us - begin_us) / 1e6, 0.0, speed / brake.decel_mps2)
    wanted_m = speed * elapsed_s - brake.decel_mps2 * elapsed_s**2 / 2
    there_us = np.rint(np.interp(wanted_m, driven_m, times)).astype(np.int64)
    return np.where(t_us <= begin_us, t_us, np.minimum(t_us, there_us))
