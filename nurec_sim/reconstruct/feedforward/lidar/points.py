"""LiDAR points visible in context images: where in the image, and at what depth."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64

from nurec_sim import geometry, sensors
from nurec_sim.errors import ReconstructError
from nurec_sim.reconstruct.feedforward.chunks import ChunkInputs, ContextImage
from nurec_sim.types import Clip, Track

MAX_TIME_US = 150_000
"""Sweeps farther in time from an image than this are not compared with it."""
SWEEPS_PER_IMAGE = 2
"""Nearest sweeps of every LiDAR that are compared with an image."""
STANDING_TIME_US, STANDING_SWEEPS = 1_000_000, 8
"""The same for static surfaces: they stay in place, so more sweeps measure them."""
MIN_RANGE_M = 1.0
BODY_MARGIN_M = 0.3
CONE_MARGIN_RAD = 0.1
BOX_MARGIN_M = 0.1
HIDDEN_RATIO = 1.1
"""A point is occluded if one nearer by this factor lies beside or above it in the image."""

Values = Float64[np.ndarray, " n"]
Points = tuple[Float64[np.ndarray, "n 3"], Int64[np.ndarray, " n"]]
Seen = tuple[Float64[np.ndarray, "n 2"], Values]
"""Pixels (u, v) of points, and their depth along the optical axis in metres."""


def visible_points(
    clip: Clip,
    chunk: ChunkInputs,
    hold_out_sweeps: set[int],
    most_us: int = MAX_TIME_US,
    most_sweeps: int = SWEEPS_PER_IMAGE,
) -> list[Seen]:
    """What every image of a chunk sees of the sweeps around its time.

    Args:
        clip: the log.
        chunk: the images.
        hold_out_sweeps: sweeps that must not be read, by index, of every LiDAR.
        most_us: from the middle of a sweep to that of an image.
        most_sweeps: of every LiDAR for each image, the nearest in time.

    Raises:
        ReconstructError: the log has no sweeps, or all of them are held out.
    """
    times = {
        lidar: [(int(start + end) // 2, i) for i, (start, end) in enumerate(clip.sweep_times_us(lidar))]
        for lidar in clip.rig.lidars
    }
    kept = {lidar: [item for item in sweeps if item[1] not in hold_out_sweeps] for lidar, sweeps in times.items()}
    if not any(kept.values()):
        count = sum(map(len, times.values()))
        raise ReconstructError(
            f"fitting depth to LiDAR needs sweeps: clip {clip.id!r} has {count}, of which all are held out"
            if count
            else f"fitting depth to LiDAR needs sweeps, and clip {clip.id!r} has none; use lidar_depth='off'"
        )
    # In the order of time, images that share a sweep come one after the other.
    read = functools.lru_cache(maxsize=4 * most_sweeps)(functools.partial(_sweep_points, clip))
    seen: list[Seen] = [(np.zeros((0, 2)), np.zeros(0))] * len(chunk.images)
    for index in sorted(range(len(chunk.images)), key=lambda i: chunk.images[i].centre_t_us):
        image = chunk.images[index]
        near = _nearest(kept, image.centre_t_us, most_us, most_sweeps)
        seen[index] = _visible(image, _points_of(clip.tracks, near, read, image.centre_t_us))
    return seen


def _sweep_points(clip: Clip, lidar: str, index: int) -> Points:
    """Points of a sweep in the world, without the recording car, and when each was measured."""
    sweep = clip.sweep(lidar, index)
    near = np.linalg.norm(sweep.xyz_m, axis=1) < MIN_RANGE_M
    xyz = sweep.xyz_world_m
    body = clip.rig.body
    in_rig = geometry.transform_points(geometry.inverse(clip.ego.at(sweep.t_us)), xyz)
    on_body = geometry.points_in_box(in_rig - body.center_m, body.size_m, BODY_MARGIN_M)
    keep = np.isfinite(xyz).all(axis=1) & ~near & ~on_body
    return xyz[keep], sweep.point_t_us[keep]


def _nearest(
    kept: dict[str, list[tuple[int, int]]], t_us: int, most_us: int, most_sweeps: int
) -> list[tuple[str, int]]:
    """LiDAR and index of the sweeps nearest in time; ``kept`` has their middle and index."""
    found = []
    for lidar, sweeps in kept.items():
        near = sorted((abs(middle - t_us), i) for middle, i in sweeps if abs(middle - t_us) <= most_us)
        found += [(lidar, index) for _, index in near[:most_sweeps]]
    return found


def _points_of(
    tracks: Sequence[Track], sweeps: Sequence[tuple[str, int]], read: Callable[[str, int], Points], t_us: int
) -> Float64[np.ndarray, "n 3"]:
    """Points of some sweeps, where they were in the world at ``t_us``."""
    parts = [_carried(tracks, *read(lidar, index), t_us) for lidar, index in sweeps]
    return np.concatenate([np.zeros((0, 3)), *parts])


def _carried(
    tracks: Sequence[Track], xyz: Float64[np.ndarray, "n 3"], point_t_us: Int64[np.ndarray, " n"], t_us: int
) -> Float64[np.ndarray, "n 3"]:
    """Points in labelled boxes move along to ``t_us``; those of boxes that are not known then are left out."""
    xyz, keep, free = xyz.copy(), np.ones(len(xyz), bool), np.ones(len(xyz), bool)
    for track in tracks:
        path, reach = track.path, np.linalg.norm(track.size_m) / 2 + BOX_MARGIN_M
        low, high = path.position_m.min(axis=0) - reach, path.position_m.max(axis=0) + reach
        known = (point_t_us >= path.start_us) & (point_t_us <= path.end_us)
        near = np.flatnonzero(free & known & np.all((xyz > low) & (xyz < high), axis=1))
        box_from_world = geometry.inverse(path.at(point_t_us[near]))
        in_box = np.einsum("nij,nj->ni", box_from_world[:, :3, :3], xyz[near]) + box_from_world[:, :3, 3]
        inside = geometry.points_in_box(in_box, track.size_m, BOX_MARGIN_M)
        xyz[near[inside]] = geometry.transform_points(path.at(t_us), in_box[inside])
        keep[near[inside]] = path.covers(t_us)
        free[near[inside]] = False
    return xyz[keep]


def _visible(image: ContextImage, xyz: Float64[np.ndarray, "n 3"]) -> Seen:
    """Pixels and z-depths of the world points that an image sees: inside it, and not behind other points."""
    camera = image.camera
    xyz = xyz[_ahead(image, xyz)]
    uv, valid, fraction = sensors.project_rolling(camera, image.world_from_camera, xyz)
    seen = np.flatnonzero(valid & sensors.in_image(camera, uv))
    uv, poses = uv[seen], geometry.interpolate_pose_pair(image.world_from_camera, fraction[seen])
    depth = np.einsum("nj,nj->n", poses[:, :3, 2], xyz[seen] - poses[:, :3, 3])
    uv, depth = uv[depth > MIN_RANGE_M / 2], depth[depth > MIN_RANGE_M / 2]
    column, row = np.floor(uv).astype(np.int64).T
    nearest = np.full((camera.height_px, camera.width_px), np.inf)
    np.minimum.at(nearest, (row, column), depth)
    # Sweeps are sparse and what hides a point may lie some pixels away. Below a point of the road is always nearer
    # road, which hides nothing; so only what lies beside and above counts: upright things.
    reach = max(1, round(camera.width_px / 100))
    nearest = cv2.erode(
        nearest, np.ones((reach + 1, 2 * reach + 1), np.uint8), anchor=(reach, reach), borderValue=np.inf
    )
    free = depth <= HIDDEN_RATIO * nearest[row, column]
    return uv[free], depth[free]


def _ahead(image: ContextImage, xyz: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Points within the cone around all rays of an image: most points of a sweep need no exact projection."""
    rays, valid = sensors.pixel_rays(image.camera)
    widest = np.arccos(np.clip(rays[..., 2][valid].min(initial=1.0), -1.0, 1.0)) + CONE_MARGIN_RAD
    origin, axis = image.world_from_camera[0, :3, 3], image.world_from_camera[0, :3, 2]
    offset = xyz - origin
    along = np.einsum("nj,j->n", offset, axis)
    return along >= np.cos(min(widest, np.pi)) * np.sqrt(np.einsum("nj,nj->n", offset, offset))
