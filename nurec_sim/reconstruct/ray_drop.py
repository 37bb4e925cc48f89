"""Ray drop learnt from a log: how probable it is that a beam which hits a Gaussian does not return.

Range maps show which recorded beams did not return. The finished scene is simulated along the beams of some sweeps;
where the simulation returns and the recording does not, the surface swallowed or deflected the beam: black paint,
glass, wet asphalt, surfaces too far away. Votes of beams are summed in voxels, of the world or of an actor's box. Few
votes are filled up from a logistic regression on range, incidence and intensity over all beams of the log. Beams that
never return, whatever is in their way, are the scanner's: the car's own body blocks them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from nurec_sim import geometry
from nurec_sim.compute.cores import in_order, usable_cores
from nurec_sim.logs.fired import as_fired
from nurec_sim.reconstruct.free_space import chosen_sweeps
from nurec_sim.reconstruct.ray_drop_fit import logistic, sigmoid
from nurec_sim.render import make_renderer
from nurec_sim.render.device import Renderer
from nurec_sim.sensors import RangeMap, beam_sectors, blocked_beams, range_map
from nurec_sim.types import (
    LIDAR_SECTORS,
    Clip,
    DynamicGaussians,
    Gaussians,
    GaussianScene,
    LidarFrame,
    LidarModel,
    SensorRequest,
)

MOST_SWEEPS = 8
"""Sweeps from which it is learnt, evenly over the log."""
VOXEL_M = 0.3
PRIOR_VOTES = 2.0
"""Beams that the regression counts for in a voxel."""
BOX_MARGIN_M = 0.3
LEAST_MOVED_M = 5.0
"""Only a car that moves can tell blocked beams from dark surfaces beside it."""
MEETING, BLOCKED = 0.5, 0.1
"""Beams of a row and sector are blocked if the scene returns more than this share of them, and less than this share of
those have returned in the recording."""
FEATURES = ("constant", "log range", "log range squared", "incidence", "log intensity")


@dataclass(frozen=True, eq=False)
class RecordedSweep:
    """A recorded sweep over its beams.

    ``seen_rad`` is the median elevation of each row seen from the sensor's origin; ``world_from_lidar`` are the poses
    at the start and the end of ``span_us``.
    """

    beams: RangeMap
    seen_rad: Float64[np.ndarray, " rows"]
    t_us: int
    span_us: tuple[int, int]
    world_from_lidar: Float64[np.ndarray, "2 4 4"]


@dataclass(frozen=True, eq=False)
class MappedSweep(RecordedSweep):
    """A recorded sweep over its beams, and the same beams simulated in the scene."""

    frame: LidarFrame


@dataclass(frozen=True)
class Votes:
    """Simulated returns of recorded beams: where, in which body (-1 world, else index of the track), and the outcome.

    ``eye_m`` is where the beam was fired, ``dropped`` whether the recorded beam did not return.
    """

    xyz_m: Float64[np.ndarray, "n 3"]
    eye_m: Float64[np.ndarray, "n 3"]
    body: Int64[np.ndarray, " n"]
    intensity: Float64[np.ndarray, " n"]
    dropped: Bool[np.ndarray, " n"]
    key: Int64[np.ndarray, " n"]


def with_ray_drop(
    scene: GaussianScene, clip: Clip, hold_out: Collection[int], progress: Callable[[float], None] = lambda done: None
) -> GaussianScene:
    """The scene with ``ray_drop`` learnt from the log's sweeps; as it was if their beams are not known.

    Args:
        scene: reconstruction of the log, in the log's world.
        clip: the log.
        hold_out: sweeps that must not be read, by index, of every LiDAR.
        progress: called with the fraction done.
    """
    sweeps = chosen_sweeps(clip, hold_out, MOST_SWEEPS)
    if not sweeps:
        return scene
    renderer = make_renderer(scene, "cpu")
    maps: dict[str, list[MappedSweep]] = {lidar: [] for lidar, _ in sweeps}
    mapped = in_order(lambda each: _mapped(clip, *each), sweeps)
    for done, ((lidar, _), recorded) in enumerate(zip(sweeps, mapped, strict=True)):
        progress(done / len(sweeps))
        if recorded is not None:
            maps[lidar].append(_simulated(clip.id, recorded, renderer))
    notes = [f"beams of LiDAR {lidar!r} are not known: no ray drop learnt from it" for lidar in maps if not maps[lidar]]
    provenance = {**scene.provenance, "unknown": [*scene.provenance.get("unknown", []), *notes]}
    models = {lidar: found_scanner(clip.rig.lidars[lidar], each) for lidar, each in maps.items() if each}
    rig = dataclasses.replace(scene.rig, lidars={**scene.rig.lidars, **models})
    scene = dataclasses.replace(scene, rig=rig, provenance=provenance)
    found = [(each, models[lidar]) for lidar, every in maps.items() for each in every]
    parts = list(in_order(lambda each: _votes(scene, *each), found))
    if not parts:
        return scene
    votes = Votes(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(Votes)))
    layers = [(scene.static, np.full(len(scene.static), -1, np.int64))]
    if len(scene.dynamic):
        body = np.where(_rigid(scene.dynamic), scene.dynamic.track, -1).astype(np.int64)
        layers.append((scene.dynamic.gaussians, body))
    keys = [_keys(gaussians.mean_m.astype(np.float64), body) for gaussians, body in layers]
    normals = _voxel_normals(votes, layers, keys)
    features = _features(votes.xyz_m, votes.eye_m, normals, votes.intensity)
    weights = logistic(features, votes.dropped)
    drops = _drop_probabilities(votes, features, weights, layers, keys)
    dynamic = scene.dynamic
    if len(dynamic):
        dynamic = dataclasses.replace(
            dynamic, gaussians=dataclasses.replace(dynamic.gaussians, ray_drop=drops[1].astype(np.float32))
        )
    model = {name: round(float(w), 4) for name, w in zip(FEATURES, weights, strict=True)}
    learnt = {"beams": len(votes.dropped), "dropped": int(votes.dropped.sum()), "logistic": model}
    return dataclasses.replace(
        scene,
        static=dataclasses.replace(scene.static, ray_drop=drops[0].astype(np.float32)),
        dynamic=dynamic,
        provenance={**provenance, "ray_drop": learnt},
    )


def _mapped(clip: Clip, lidar: str, index: int) -> RecordedSweep | None:
    """A recorded sweep over its beams; None if they are not known."""
    sweep = clip.sweep(lidar, index)
    fired, poses = as_fired(clip, lidar, sweep)
    beams = range_map(clip.rig.lidars[lidar], fired)
    if not beams.known:
        return None
    seen = np.full(beams.point.shape[0], np.nan)
    elevation = np.arctan2(fired[:, 2], np.hypot(fired[:, 0], fired[:, 1]))
    for row in range(len(seen)):
        own = beams.point[row][beams.point[row] >= 0]
        seen[row] = np.median(elevation[own]) if len(own) else beams.lidar.elevation_rad[row]
    return RecordedSweep(beams, seen, sweep.t_us, (sweep.start_us, max(sweep.end_us, sweep.start_us + 1)), poses)


def _simulated(scene_id: str, sweep: RecordedSweep, renderer: Renderer) -> MappedSweep:
    """The sweep with what the scene returns along its beams."""
    request = SensorRequest(scene_id, sweep.beams.lidar, *sweep.span_us, sweep.world_from_lidar)
    return MappedSweep(**vars(sweep), frame=renderer.render_lidar(request))


def found_scanner(nominal: LidarModel, sweeps: Sequence[MappedSweep]) -> LidarModel:
    """The scanner as its sweeps show it: elevations seen from its origin, number of columns, and blocked beams.

    Beams are blocked where the scene has surfaces in their way, at different places, and none of them ever returned.
    """
    rows = int(np.median([len(each.seen_rad) for each in sweeps]))
    alike = [each for each in sweeps if len(each.seen_rad) == rows]
    elevation = np.median([each.seen_rad for each in alike], axis=0)
    if not np.all(np.diff(elevation) < 0):
        elevation = np.median([each.beams.lidar.elevation_rad for each in alike], axis=0)
    # Columns and their spacing are those of one sweep: of several, they would not make one turn.
    middle = sorted(alike, key=lambda each: each.beams.point.shape[1])[(len(alike) - 1) // 2]
    turn = middle.beams.lidar.azimuth_rad
    azimuth = np.linspace(turn[0], turn[-1], len(turn))
    beams, expected, back = np.zeros((3, rows * LIDAR_SECTORS))
    for each in alike:
        cell = np.arange(rows)[:, None] * LIDAR_SECTORS + beam_sectors(each.beams.lidar)
        beams += np.bincount(cell.reshape(-1), minlength=len(beams))
        cell = cell.reshape(-1)[each.frame.beam]
        expected += np.bincount(cell, minlength=len(expected))
        back += np.bincount(cell, each.beams.point.reshape(-1)[each.frame.beam] >= 0, len(back))
    places = np.array([each.world_from_lidar[0, :3, 3] for each in alike])
    moved = np.linalg.norm(places - places[0], axis=1).max() > LEAST_MOVED_M
    blocked = (expected > MEETING * beams) & (back < BLOCKED * expected) & moved
    return dataclasses.replace(
        nominal,
        elevation_rad=elevation,
        azimuth_rad=azimuth,
        row_azimuth_offset_rad=np.zeros(rows),
        blocked=np.flatnonzero(blocked),
    )


def _votes(scene: GaussianScene, sweep: MappedSweep, scanner: LidarModel) -> Votes:
    """The beams of a sweep that the scene returns and that are not blocked: whether they returned in the recording."""
    frame, beams = sweep.frame, sweep.beams
    blocked = np.zeros(frame.beam.shape, bool)
    if len(sweep.seen_rad) == len(scanner.elevation_rad):
        blocked = blocked_beams(dataclasses.replace(beams.lidar, blocked=scanner.blocked)).reshape(-1)[frame.beam]
    recorded = beams.range_m.reshape(-1)[frame.beam]
    dropped = np.isnan(recorded)
    told = ~blocked
    xyz = geometry.transform_points(sweep.world_from_lidar[1], frame.xyz_m[told].astype(np.float64))
    eye = np.broadcast_to(sweep.world_from_lidar.mean(axis=0)[:3, 3], xyz.shape)
    return _in_bodies(scene, sweep.t_us, xyz, eye, frame.intensity[told], dropped[told])


def _rigid(dynamic: DynamicGaussians) -> Bool[np.ndarray, " n"]:
    return np.zeros(len(dynamic), bool) if dynamic.in_box is None else dynamic.in_box


def _in_bodies(
    scene: GaussianScene, t_us: int, xyz: np.ndarray, eye: np.ndarray, intensity: np.ndarray, dropped: np.ndarray
) -> Votes:
    """Votes in the frames of the boxes that hold them, else in the world."""
    xyz, eye, body = xyz.copy(), eye.copy(), np.full(len(xyz), -1, np.int64)
    for track in np.unique(scene.dynamic.track[_rigid(scene.dynamic)]):
        path, size = scene.tracks[track].path, scene.tracks[track].size_m
        if not path.covers(t_us):
            continue
        world_from_box, reach = path.at(t_us), max(size) + BOX_MARGIN_M
        # One axis first: it leaves few of all beams for the others.
        near = np.flatnonzero(np.abs(xyz[:, 0] - world_from_box[0, 3]) < reach)
        near = near[(body[near] < 0) & (np.abs(xyz[near] - world_from_box[:3, 3]) < reach).all(axis=1)]
        box_from_world = geometry.inverse(world_from_box)
        inside = near[geometry.points_in_box(geometry.transform_points(box_from_world, xyz[near]), size, BOX_MARGIN_M)]
        xyz[inside] = geometry.transform_points(box_from_world, xyz[inside])
        eye[inside] = geometry.transform_points(box_from_world, eye[inside])
        body[inside] = track
    return Votes(xyz, eye, body, np.asarray(intensity, np.float64), dropped, _keys(xyz, body))


def _keys(xyz: Float64[np.ndarray, "n 3"], body: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """One number per voxel and body: 16 bits per axis, the body above them."""
    cell = np.floor(np.nan_to_num(xyz) / VOXEL_M).astype(np.int64) & 0xFFFF
    return ((body + 1) << 48) | (cell[:, 0] << 32) | (cell[:, 1] << 16) | cell[:, 2]


def _voxel_normals(
    votes: Votes, layers: Sequence[tuple[Gaussians, np.ndarray]], keys: Sequence[np.ndarray]
) -> Float64[np.ndarray, "n 3"]:
    """Normal of a Gaussian in each vote's voxel; zero where there is none."""
    every, normal = np.concatenate(keys), np.concatenate([gaussians.normal for gaussians, _ in layers])
    order = np.argsort(every, kind="stable")
    place = order[np.minimum(np.searchsorted(every[order], votes.key), len(every) - 1)]
    return np.where((every[place] == votes.key)[:, None], normal[place], 0.0).astype(np.float64)


def _features(xyz: np.ndarray, eye: np.ndarray, normal: np.ndarray, intensity: np.ndarray) -> np.ndarray:
    """The regression's inputs, ``FEATURES``; unknown intensity and incidence count as 0.2 and 0.5."""
    ray = xyz - eye
    distance = np.maximum(np.linalg.norm(ray, axis=1), 0.1)
    incidence = np.abs(np.einsum("ni,ni->n", ray, normal)) / distance
    incidence = np.where(np.abs(normal).sum(axis=1) > 0, incidence, 0.5)
    reach = np.log(distance / 20.0)
    shown = np.log(np.clip(np.where(np.isfinite(intensity), intensity, 0.2), 0.005, 1.0) / 0.2)
    return np.column_stack([np.ones(len(xyz)), reach, reach**2, incidence, shown])


def _logit(p: np.ndarray) -> np.ndarray:
    return np.log(p) - np.log1p(-p)


def _shift(p: np.ndarray, dropped: int) -> float:
    """What to subtract from log odds so that as many beams are more probable than a half as were dropped.

    Beams are dropped where the probability exceeds a half, so without it a surface that swallows every third beam would
    return all of them, and sweeps would hold more points than recorded ones.
    """
    if not 0 < dropped < len(p):
        return 0.0
    return float(_logit(np.partition(p, -dropped)[-dropped]))


def _drop_probabilities(
    votes: Votes,
    features: np.ndarray,
    weights: np.ndarray,
    layers: Sequence[tuple[Gaussians, np.ndarray]],
    keys: Sequence[np.ndarray],
) -> list[np.ndarray]:
    """Probability per Gaussian of each layer: votes of its voxel and the regression's, as ``PRIOR_VOTES`` beams."""
    voxel, where = np.unique(votes.key, return_inverse=True)
    count = np.bincount(where)
    dropped = np.bincount(where, votes.dropped)
    expected = np.bincount(where, sigmoid(features @ weights)) / count
    share = (dropped + PRIOR_VOTES * expected) / (count + PRIOR_VOTES)
    shift = _shift(share[where], int(votes.dropped.sum()))
    share = sigmoid(_logit(share) - shift)
    eyes = np.round(votes.eye_m[votes.body < 0], 3)
    # Votes of one sweep follow each other: sorting all of them would take long.
    eyes = np.unique(eyes[np.append(np.ones(min(len(eyes), 1), bool), (eyes[1:] != eyes[:-1]).any(axis=1))], axis=0)
    out = []
    for (gaussians, body), key in zip(layers, keys, strict=True):
        place = np.minimum(np.searchsorted(voxel, key), len(voxel) - 1)
        drop = np.where(voxel[place] == key, share[place], np.nan)
        missing = np.flatnonzero(np.isnan(drop))
        drop[missing] = 0.0
        if len(eyes) and (missing := missing[body[missing] < 0]).size:
            from scipy.spatial import cKDTree

            xyz = gaussians.mean_m[missing].astype(np.float64)
            eye = eyes[cKDTree(eyes).query(xyz, workers=usable_cores())[1]]
            inputs = _features(xyz, eye, gaussians.normal[missing], gaussians.intensity[missing])
            drop[missing] = sigmoid(inputs @ weights - shift)
        out.append(drop)
    return out
