"""The actors that a scenario adds to a log, put into its reconstructions and into the town that it was recorded in.

One set of tracks serves all worlds of a log, so policies that see nothing rendered drive the same in all of them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from nurec_sim.errors import RequestError, ScenarioError
from nurec_sim.runs.sources import Offer
from nurec_sim.scene import edits, read_scene
from nurec_sim.serving.store import SceneStore
from nurec_sim.sim import Scenario
from nurec_sim.sim.added_actors import Body, GroundHeight, added_tracks
from nurec_sim.sim.scenario import AddedActor
from nurec_sim.types import GaussianScene, Label, Track
from nurec_sim.world import ACTOR_SIZES_M, LABEL_OF_KIND, Actor, TownPlan, actor_gaussians

ARCHIVE = ".usdz"
CAR_RGB, SHIRT_RGB = (0.62, 0.07, 0.07), (0.85, 0.55, 0.10)
NEAR_M, STEP_M, LEAST = 0.8, 0.5, 5
"""The road below a point: the median of at least 5 road-class Gaussians so near, and so near in height."""
SMOOTHED = 21
"""Poses of a path over which the difference to the recorded drive's ground is averaged: one second."""


@dataclass(frozen=True)
class AddedActors:
    """The added actors of one log: their tracks, what they look like, and which actors of a town they are."""

    tracks: tuple[Track, ...] = ()
    assets: Mapping[str, edits.Asset] = dataclasses.field(default_factory=dict)
    kinds: Mapping[str, tuple[str, tuple[float, float, float]]] = dataclasses.field(default_factory=dict)
    """Kind and colour by id; none for Gaussians from an archive."""

    def in_facts(self, scene: GaussianScene) -> GaussianScene:
        """The scene with the tracks, but without anything to render."""
        return dataclasses.replace(scene, tracks=(*scene.tracks, *self.tracks))

    def in_scene(self, scene: GaussianScene) -> GaussianScene:
        """The scene with the actors as rigid parts of its dynamic layer."""
        for track in self.tracks:
            scene = edits.with_track(scene, track, self.assets[track.id])
        return scene

    def in_town(self, plan: TownPlan) -> TownPlan:
        """The town with the same actors.

        Raises:
            ScenarioError: one is from an archive, which a town cannot show.
        """
        found = []
        for track in self.tracks:
            if track.id not in self.kinds:
                raise ScenarioError(f"added actor '{track.id}' has the Gaussians of an archive; the true world needs "
                                    f"one of {sorted(ACTOR_SIZES_M)}")  # fmt: skip
            kind, colour = self.kinds[track.id]
            place, poses = track.path.position_m, track.path.world_from_body
            above = place[:, 2] - plan.terrain.height_m(place[:, :2])
            yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
            rows = np.column_stack([place[:, :2], above, yaw]).tolist()
            path = tuple((int(t), *row) for t, row in zip(track.path.t_us, rows, strict=True))
            found.append(Actor(track.id, kind, track.size_m, colour, True, path))
        return dataclasses.replace(plan, actors=(*plan.actors, *found))


def added_actors(scenario: Scenario, scene: GaussianScene, folder: Path | str = ".") -> AddedActors:
    """The actors that a scenario adds to a log.

    Args:
        scenario: what is driven.
        scene: any reconstruction of the log, or its facts; heights follow its road-class Gaussians, where it has them.
        folder: that paths of archives are relative to: the scenario file's.

    Raises:
        ScenarioError: an asset is unknown, or a path is impossible, see ``sim.added_actors.added_tracks``.
        ArchiveError: an archive cannot be read.
    """
    if not scenario.added_actors:
        return AddedActors()
    assets, kinds = {}, {}
    for name, actor in scenario.added_actors.items():
        if ARCHIVE in actor.asset:
            assets[name] = _from_archive(name, actor, Path(folder))
            continue
        if actor.asset not in ACTOR_SIZES_M:
            raise ScenarioError(f"added actor '{name}': no asset '{actor.asset}'; have {sorted(ACTOR_SIZES_M)}, or "
                                f"give an archive ({ARCHIVE})")  # fmt: skip
        label = LABEL_OF_KIND.get(actor.asset, "automobile")
        size_m = actor.size_m or ACTOR_SIZES_M[actor.asset]
        colour = actor.colour or (SHIRT_RGB if label in ("person", "rider") else CAR_RGB)
        assets[name] = edits.Asset(actor_gaussians(actor.asset, size_m, colour), size_m, label)
        kinds[name] = actor.asset, colour
    bodies = {name: Body(asset.label, asset.size_m) for name, asset in assets.items()}
    return AddedActors(added_tracks(scenario, scene, bodies, _road_height(scene)), assets, kinds)


def with_added_actors(scene: GaussianScene, scenario: Scenario, folder: Path | str = ".") -> GaussianScene:
    """A scene with the actors that a scenario adds, to render and to drive in; raises as ``added_actors`` does."""
    return added_actors(scenario, scene, folder).in_scene(scene)


def add_to_served(
    store: SceneStore, loaded: Sequence[tuple[Offer, GaussianScene]], scenario: Scenario, folder: Path
) -> tuple[list[tuple[Offer, GaussianScene]], dict[str, AddedActors]]:
    """Scenes and what a server shows of them, with a scenario's added actors; the same in all of one log.

    Args:
        store: of the server.
        loaded: results of ``sources.load_all``.
        scenario: what is driven.
        folder: see ``added_actors``.

    Returns:
        ``loaded`` with the actors, and the actors by scene id.
    """
    by_id: dict[str, AddedActors] = {}
    if not scenario.added_actors:
        return list(loaded), by_id
    result = []
    for offer, scene in loaded:
        if scene.id not in by_id:
            by_id[scene.id] = added_actors(scenario, scene, folder)
        with store.lease(offer.served_as) as served:
            store.replace(offer.served_as, by_id[scene.id].in_scene(served.scene))
        result.append((offer, by_id[scene.id].in_scene(scene)))
    return result, by_id


def _from_archive(name: str, actor: AddedActor, folder: Path) -> edits.Asset:
    """The Gaussians of a track of an archive; the name of the track may be left out if only one has any."""
    file, _, wanted = actor.asset.partition("#")
    scene = read_scene(folder / file)
    numbers = sorted({int(number) for number in scene.dynamic.track if number >= 0})
    if not wanted and len(numbers) != 1:
        ids = [scene.tracks[number].id for number in numbers]
        raise ScenarioError(f"added actor '{name}': '{file}' has {len(ids)} tracks with Gaussians; give one as "
                            f"'{file}#track', of {ids[:20]}")  # fmt: skip
    try:
        asset = edits.asset_of(scene, wanted or scene.tracks[numbers[0]].id)
    except RequestError as error:
        raise ScenarioError(f"added actor '{name}': {error}") from None
    return asset if actor.size_m is None else edits.resized(asset, actor.size_m)


def _road_height(scene: GaussianScene) -> GroundHeight | None:
    """Heights of the road-class Gaussians, smoothed along a path; None for a scene that has none."""
    road = scene.static.mean_m[(scene.static.label == Label.ROAD) & (scene.static.opacity > 0.3)].astype(np.float64)
    if not len(road):
        return None
    tree = cKDTree(road[:, :2])

    def ground(xy: Float64[np.ndarray, "n 2"], height_m: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        off = np.full(len(xy), np.nan)
        for index, near in enumerate(tree.query_ball_point(xy, NEAR_M)):
            above = road[near, 2] - height_m[index]
            above = above[np.abs(above) < STEP_M]
            if len(above) >= LEAST:
                off[index] = np.median(above)
        known = np.flatnonzero(np.isfinite(off))
        if not len(known):
            return height_m
        off = np.interp(np.arange(len(off)), known, off[known])
        padded = np.pad(off, SMOOTHED // 2, mode="edge")
        return height_m + np.convolve(padded, np.full(SMOOTHED, 1 / SMOOTHED), mode="valid")

    return ground
