"""Points of sweeps that are followed from an image to later ones: where each was expected, and where it was found.

A return is where the LiDAR saw it, so an image that shows it elsewhere was taken from another pose than recorded. An
image tells the turn of the car to hundredths of a degree, which walls and ground at its sides do not.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from scipy.spatial import cKDTree

from nurec_sim import geometry, sensors
from nurec_sim.compute.cores import in_order
from nurec_sim.errors import ClipError
from nurec_sim.logs.clip import Clip
from nurec_sim.logs.odometry.static_points import moving_tracks, standing
from nurec_sim.types import CameraModel

LATER = (1, 2)
"""Points of an image are followed to the next one, and to the one after it."""
APART_US = 60_000
"""An image's points are those of a sweep that is at most so far away in time."""
FARTHEST_S = 1.0
"""Images farther apart than this do not show the same."""
MOST_IMAGES = 300
"""Of all cameras."""
WIDEST_PX = 1300
"""Wider images are reduced by a whole number to about this: tenths of a pixel suffice."""
MOST_POINTS, CANDIDATES = 400, 3
"""Per image; those of most texture, out of so many times as many."""
SPACING_PX = 8
SURFACE_PX, SURFACE_SHARE = 6.0, 0.03
"""A point is followed if the three nearest ones are within so many pixels, at depths that differ by this share at most:
others may be at the edge of a surface, or hidden from the camera."""
WINDOW_PX, LEVELS = 15, 1
THERE_AND_BACK_PX = 0.3
"""Followed back from where it was found, a point must come as near as this to where it was."""
FARTHEST_PX = 8.0
"""A point is looked for within this distance of where it is expected."""
BORDER_PX = 8
Grays = Mapping[int, UInt8[np.ndarray, "h w"]]
NEAREST_M = 2.0


@dataclass(frozen=True, eq=False)
class FollowedPoints:
    """Points of one image found in another.

    Attributes:
        first_us: middle of the exposure of the image that they were taken from.
        second_us: of the image that they were found in.
        xyz_m: in the world.
        by_xyz: pixels in the second image per metre of each point, along the axes of the world.
        off_px: where it was found minus where it was expected.
    """

    first_us: Int64[np.ndarray, " n"]
    second_us: Int64[np.ndarray, " n"]
    xyz_m: Float64[np.ndarray, "n 3"]
    by_xyz: Float64[np.ndarray, "n 2 3"]
    off_px: Float64[np.ndarray, "n 2"]

    def __len__(self) -> int:
        return len(self.off_px)

    @classmethod
    def concatenate(cls, parts: Sequence[FollowedPoints]) -> FollowedPoints:
        """All of them."""
        empty = cls(*(np.zeros((0, *shape), kind) for shape, kind in
                      (((), np.int64), ((), np.int64), ((3,), float), ((2, 3), float), ((2,), float))))  # fmt: skip
        return cls(*(np.concatenate([getattr(each, name) for each in (empty, *parts)]) for name in vars(empty)))


def followed_points(
    clip: Clip, cameras: Sequence[str], hold_out: Collection[int], held_images: Mapping[str, Collection[int]]
) -> FollowedPoints:
    """Points of the sweeps of a log followed through the images of some cameras; of many images through every n-th.

    Images that cannot be read are left out: it is for who needs them to say so.

    Args:
        clip: the log.
        cameras: whose images may be read.
        hold_out: indices of sweeps that must not be read, of every LiDAR.
        held_images: indices of images that must not be read, by camera.

    Raises:
        ClipError: a sweep cannot be read.
    """
    moving = moving_tracks(clip)

    @cache
    def still(lidar: str, index: int) -> np.ndarray:
        """Of which points of a sweep: images of all cameras share it."""
        return standing(clip, clip.sweep(lidar, index), moving)[0]

    parts: list[FollowedPoints] = []
    every = sum(clip.frame_count(camera) for camera in cameras) // MOST_IMAGES + 1
    for camera in cameras:
        chosen = [k for k in range(clip.frame_count(camera)) if k not in held_images.get(camera, ())][::every]
        # Each image is decoded once: it is the second of one pair and the first of another.
        read = zip(chosen, in_order(partial(_gray, clip, camera), chosen), strict=True)
        grays = {k: gray for k, gray in read if gray is not None}
        frames = list(grays)

        def follow(
            place: int, camera: str = camera, frames: list[int] = frames, grays: Grays = grays
        ) -> FollowedPoints:
            later = [frames[place + step] for step in LATER if place + step < len(frames)]
            return _followed(clip, camera, frames[place], later, grays, still, hold_out)

        parts += in_order(follow, range(len(frames)))
    return FollowedPoints.concatenate(parts)


def _model(clip: Clip, camera: str) -> CameraModel:
    """A camera with as many pixels as are looked at."""
    model = clip.rig.cameras[camera]
    by = max(1, round(model.width_px / WIDEST_PX))
    return model if by == 1 else sensors.scaled_camera(model, model.width_px // by, model.height_px // by)


def _gray(clip: Clip, camera: str, frame: int) -> UInt8[np.ndarray, "h w"] | None:
    """An image with its contrast evened out locally, so that shadows have corners too and exposures do not matter.

    None if it cannot be read.
    """
    try:
        rgb = clip.image(camera, frame)
    except ClipError:
        return None
    gray, model = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), _model(clip, camera)
    by = clip.rig.cameras[camera].width_px // model.width_px
    if by > 1:
        part = gray[: by * model.height_px, : by * model.width_px]
        gray = cv2.resize(part, (model.width_px, model.height_px), interpolation=cv2.INTER_AREA)
    return cv2.createCLAHE(2.0, (8, 8)).apply(gray)


def _followed(
    clip: Clip,
    camera: str,
    frame: int,
    later: Sequence[int],
    grays: Grays,
    still: Callable[[str, int], Bool[np.ndarray, " n"]],
    hold_out: Collection[int],
) -> FollowedPoints:
    uv, xyz = _points_in(clip, camera, frame, grays[frame], still, hold_out)
    parts = [_found(clip, camera, frame, other, grays, uv, xyz) for other in later]
    return FollowedPoints.concatenate([part for part in parts if part is not None])


def _points_in(
    clip: Clip,
    camera: str,
    frame: int,
    gray: np.ndarray,
    still: Callable[[str, int], Bool[np.ndarray, " n"]],
    hold_out: Collection[int],
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n 3"]]:
    """Standing returns of the nearest sweep on textured surfaces of an image: their pixels, and the points."""
    t_us = _middle_us(clip, camera, frame)
    near = [
        (abs(record.t_us - t_us), lidar, index)
        for lidar in clip.rig.lidars
        for index, record in enumerate(clip.sweep_records(lidar))
        if index not in hold_out and abs(record.t_us - t_us) <= APART_US
    ]
    nothing = np.zeros((0, 2)), np.zeros((0, 3))
    if not near:
        return nothing
    _, lidar, index = min(near)
    sweep = clip.sweep(lidar, index)
    pair = np.asarray(clip.world_from_camera(camera, frame), np.float64)
    depth = geometry.transform_points(geometry.inverse(pair[0]) @ sweep.world_from_lidar, sweep.xyz_m)[:, 2]
    # Most points of a turn are behind the camera.
    ahead = np.flatnonzero(still(lidar, index) & (depth > NEAREST_M))
    xyz, depth = geometry.transform_points(sweep.world_from_lidar, sweep.xyz_m[ahead]), depth[ahead]
    uv, seen, _ = sensors.project_rolling(_model(clip, camera), pair, xyz)
    height, width = gray.shape
    seen &= _inside(uv, width, height)
    uv, xyz, depth = uv[seen], xyz[seen], depth[seen]
    if len(uv) < 4:
        return nothing
    texture = cv2.cornerMinEigenVal(gray, 7)[tuple(uv.astype(int).T[::-1])]
    # The best of each square of the image, and of these the best.
    order = np.argsort(-texture, kind="stable")
    across, down = (uv[order] // SPACING_PX).astype(np.int64).T
    row = width // SPACING_PX + 1
    first = np.full(row * (height // SPACING_PX + 1), len(uv))
    np.minimum.at(first, down * row + across, np.arange(len(uv)))
    best = order[np.sort(first[first < len(uv)])[: CANDIDATES * MOST_POINTS]]
    # Of few points, the neighbours are found sooner in a tree that is not balanced.
    distance, beside = cKDTree(uv, compact_nodes=False, balanced_tree=False).query(uv[best], k=4)
    spread = depth[beside].max(axis=1) - depth[beside].min(axis=1)
    chosen = best[(distance[:, -1] < SURFACE_PX) & (spread < SURFACE_SHARE * depth[best])][:MOST_POINTS]
    return uv[chosen], xyz[chosen]


def _found(
    clip: Clip, camera: str, frame: int, other: int, grays: Grays, uv: np.ndarray, xyz: np.ndarray
) -> FollowedPoints | None:
    """Points of one image looked for in another (pyramidal Lucas-Kanade); None if that is taken too much later."""
    times = _middle_us(clip, camera, frame), _middle_us(clip, camera, other)
    if times[1] - times[0] > FARTHEST_S * 1e6:
        return None
    model, pair = _model(clip, camera), np.asarray(clip.world_from_camera(camera, other), np.float64)
    expected, seen, _ = sensors.project_rolling(model, pair, xyz)
    height, width = grays[other].shape
    rows = np.flatnonzero(seen & _inside(expected, width, height))
    if not len(rows):
        return None
    uv, xyz, expected = uv[rows], xyz[rows], expected[rows]
    # Pixel centres are at 0 there, at 0.5 here.
    start, guess = (np.ascontiguousarray(each - 0.5, np.float32)[:, None] for each in (uv, expected))
    there, ok = _flow(grays[frame], grays[other], start, guess)
    back, ok_back = _flow(grays[other], grays[frame], there, start)
    off = (there - guess)[:, 0].astype(np.float64)
    good = ok & ok_back & (np.linalg.norm((back - start)[:, 0], axis=1) < THERE_AND_BACK_PX)
    good &= np.linalg.norm(off, axis=1) < FARTHEST_PX
    # Central differences along each axis; all at once, as most of the time of a call does not depend on the points.
    steps = 0.01 * np.concatenate([np.eye(3), -np.eye(3)])
    beside, shown, _ = sensors.project_rolling(model, pair, (xyz + steps[:, None]).reshape(-1, 3))
    sides = beside.reshape(2, 3, len(rows), 2)
    by_xyz = ((sides[0] - sides[1]) / 0.02).transpose(1, 2, 0)
    good &= shown.reshape(6, len(rows)).all(axis=0)
    many = np.ones(np.count_nonzero(good), np.int64)
    return FollowedPoints(times[0] * many, times[1] * many, xyz[good], by_xyz[good], off[good])


def _flow(
    first: np.ndarray, second: np.ndarray, start: Float32[np.ndarray, "n 1 2"], guess: Float32[np.ndarray, "n 1 2"]
) -> tuple[Float32[np.ndarray, "n 1 2"], Bool[np.ndarray, " n"]]:
    """Where points of the first image are in the second, and whether they were found."""
    found, ok, _ = cv2.calcOpticalFlowPyrLK(
        first, second, start, guess.copy(), winSize=(WINDOW_PX, WINDOW_PX), maxLevel=LEVELS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return np.asarray(found, np.float32), ok[:, 0] > 0


def _inside(uv: Float64[np.ndarray, "n 2"], width: int, height: int) -> Bool[np.ndarray, " n"]:
    """Points that are not at the border of an image."""
    right, down = uv.T
    return (right > BORDER_PX) & (right < width - BORDER_PX) & (down > BORDER_PX) & (down < height - BORDER_PX)


def _middle_us(clip: Clip, camera: str, frame: int) -> int:
    return int(clip.camera_times_us(camera)[frame].sum()) // 2
