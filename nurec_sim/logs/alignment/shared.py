"""Features that two cameras show at about the same time: where the second should show them, and where it does.

Cameras of a car are calibrated to some tenths of a degree, which are several pixels. What both show in the overlap of
their fields of view is then there twice, or blurred. The LiDAR tells how far a feature of one image is, and so where
the other camera should show it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from nurec_sim import geometry, sensors
from nurec_sim.compute.cores import in_order
from nurec_sim.errors import ClipError
from nurec_sim.logs.clip import Clip
from nurec_sim.logs.odometry.static_points import moving_tracks, standing
from nurec_sim.types import Track

MOST_SWEEPS = 6
"""Sweeps, evenly over the log, at whose times images are compared."""
APART_US = 100_000
"""Images are those nearest to a sweep, if so near."""
NEAREST_M = 2.0
FEWEST_POINTS = 100
"""Returns that two cameras must share."""
MARGIN_PX = 24
FEATURES = 1_500
"""Per image and overlap, those of most contrast."""
SURFACE_PX, SURFACE_SHARE = 14.0, 0.03
"""A feature is as far as the three nearest returns, if within so many pixels, and alike far up to this share."""
SEARCH_PX = 40.0
STEP = 1e-4
"""Of derivatives: radian, metres, share of the distance."""
LIKENESS = 0.8
"""The best match must be nearer than the second best by this factor (Lowe 2004)."""
Described = tuple[Float64[np.ndarray, "n 2"], Float32[np.ndarray, "n 128"]]


@dataclass(frozen=True, eq=False)
class SharedFeatures:
    """Features of a first camera found in a second one.

    Attributes:
        group: number of the pair of images, by which they err alike.
        cameras: numbers of both cameras.
        off_px: where it was found minus where it was expected.
        by_mounting: pixels in the second image per radian and metre by which both cameras are turned and shifted, each
            about and along its own axes.
        by_depth: pixels in the second image per share of the distance from the first camera.
    """

    group: Int64[np.ndarray, " n"]
    cameras: Int64[np.ndarray, "n 2"]
    off_px: Float64[np.ndarray, "n 2"]
    by_mounting: Float64[np.ndarray, "n 2 2 6"]
    by_depth: Float64[np.ndarray, "n 2"]

    def __len__(self) -> int:
        return len(self.off_px)


def shared_features(
    clip: Clip, cameras: Sequence[str], hold_out: Collection[int], held_images: Mapping[str, Collection[int]]
) -> SharedFeatures:
    """What any two of these cameras share at the times of some sweeps; images that cannot be read are left out.

    Args:
        clip: the log.
        cameras: whose images may be read; ``SharedFeatures.cameras`` are indices of them.
        hold_out: indices of sweeps that must not be read, of every LiDAR.
        held_images: indices of images that must not be read, by camera.

    Raises:
        ClipError: a sweep cannot be read.
    """
    moving = moving_tracks(clip)
    at_sweeps = in_order(lambda each: _at_sweep(clip, cameras, held_images, moving, *each), _sweeps(clip, hold_out))
    parts = [part for found in at_sweeps for part in found]
    sizes = [len(part[1]) for part in parts]
    shapes = ((2,), (2, 2, 6), (2,))
    rows = [np.concatenate([np.zeros((0, *shape)), *(part[1 + k] for part in parts)]) for k, shape in enumerate(shapes)]
    pairs = np.array([part[0] for part in parts], np.int64).reshape(-1, 2)
    return SharedFeatures(np.repeat(np.arange(len(parts)), sizes), np.repeat(pairs, sizes, axis=0), *rows)


def _sweeps(clip: Clip, hold_out: Collection[int]) -> list[tuple[str, int]]:
    every = [(record.t_us, lidar, index) for lidar in clip.rig.lidars
             for index, record in enumerate(clip.sweep_records(lidar)) if index not in hold_out]  # fmt: skip
    every.sort()
    chosen = np.unique(np.linspace(0, len(every) - 1, min(MOST_SWEEPS, len(every))).round().astype(int))
    return [every[k][1:] for k in chosen]


def _at_sweep(
    clip: Clip,
    cameras: Sequence[str],
    held_images: Mapping[str, Collection[int]],
    moving: Sequence[Track],
    lidar: str,
    index: int,
) -> list[tuple]:
    """Of each pair of cameras: their numbers, and the last three fields of ``SharedFeatures``."""
    sweep = clip.sweep(lidar, index)
    xyz = geometry.transform_points(sweep.world_from_lidar, sweep.xyz_m)[standing(clip, sweep, moving)[0]]
    frames = {
        number: _frame(clip, camera, held_images.get(camera, ()), sweep.t_us) for number, camera in enumerate(cameras)
    }
    views = {
        number: _View.of(clip, cameras[number], frame, xyz) for number, frame in frames.items() if frame is not None
    }
    found = []
    for pair in combinations(views, 2):
        shared = views[pair[0]].seen & views[pair[1]].seen
        if np.count_nonzero(shared) < FEWEST_POINTS:
            continue
        described = {number: views[number].features(shared) for number in pair}
        for a, b in (pair, pair[::-1]):
            part = _found(views[a], views[b], described[a], described[b], xyz, shared)
            if part is not None:
                found.append(((a, b), *part))
    return found


def _frame(clip: Clip, camera: str, held: Collection[int], t_us: int) -> int | None:
    """The image of a camera that is nearest in time."""
    middle = clip.camera_times_us(camera).sum(axis=1) // 2
    apart = np.abs(middle - t_us).astype(np.float64)
    apart[[k for k in held if k < len(apart)]] = np.inf
    if not len(apart) or apart.min() > APART_US:
        return None
    return int(np.argmin(apart))


@dataclass(eq=False)
class _View:
    """An image of a camera: pixels of the returns of a sweep, and which it shows; its grey values, read on demand."""

    clip: Clip
    camera: str
    frame: int
    pair: Float64[np.ndarray, "2 4 4"]
    uv: Float64[np.ndarray, "n 2"]
    seen: np.ndarray
    gray: UInt8[np.ndarray, "h w"] | None = None

    @classmethod
    def of(cls, clip: Clip, camera: str, frame: int, xyz: np.ndarray) -> _View:
        model = clip.rig.cameras[camera]
        pair = np.asarray(clip.world_from_camera(camera, frame), np.float64)
        ahead = geometry.transform_points(geometry.inverse(pair[0]), xyz)[:, 2] > NEAREST_M
        uv, seen, _ = sensors.project_rolling(model, pair, xyz)
        return cls(clip, camera, frame, pair, uv, seen & ahead & sensors.in_image(model, uv))

    def features(self, shared: np.ndarray) -> Described | None:
        """Features around the shared returns and their descriptions (Lowe 2004); None if the image cannot be read."""
        if self.gray is None:
            try:
                rgb = self.clip.image(self.camera, self.frame)
            except ClipError:
                return None
            self.gray = cv2.createCLAHE(3.0, (8, 8)).apply(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
        height, width = self.gray.shape
        low = np.maximum(self.uv[shared].min(axis=0).astype(int) - MARGIN_PX, 0)
        high = np.minimum(self.uv[shared].max(axis=0).astype(int) + MARGIN_PX, (width, height))
        part = self.gray[low[1] : high[1], low[0] : high[0]]
        points, described = cv2.SIFT.create(
            FEATURES, contrastThreshold=0.02, enable_precise_upscale=True
        ).detectAndCompute(part, None)
        if described is None:
            return None
        # Pixel centres are at 0 there, at 0.5 here.
        return np.array([point.pt for point in points]) + low + 0.5, described


def _found(
    first: _View,
    second: _View,
    mine: Described | None,
    theirs: Described | None,
    xyz: Float64[np.ndarray, "n 3"],
    shared: Bool[np.ndarray, " n"],
) -> tuple | None:
    """The last three fields of ``SharedFeatures``, of the features of both views; None if there are none."""
    if mine is None or theirs is None:
        return None
    range_m = np.linalg.norm(xyz[shared] - first.pair[0, :3, 3], axis=1)
    apart, near = cKDTree(first.uv[shared]).query(mine[0], k=3)
    ranges_m = range_m[near]
    alike = np.ptp(ranges_m, axis=1) < SURFACE_SHARE * ranges_m.min(axis=1)
    rays, valid = sensors.unproject(first.clip.rig.cameras[first.camera], mine[0])
    good = np.flatnonzero(valid & alike & (apart[:, -1] < SURFACE_PX))
    points = rays[good] * ranges_m[good].mean(axis=1)[:, None]
    expected, seen = _shown(second, first.pair[0], points)
    match = _matches(mine[1][good], theirs, expected)
    kept = np.flatnonzero(seen & (match >= 0))
    if not len(kept):
        return None
    points, expected = points[kept], expected[kept]
    by_mounting = np.zeros((len(kept), 2, 2, 6))
    for axis, part in enumerate(STEP * np.eye(3)):
        turn, shift = geometry.pose(rotation(part), np.zeros(3)), geometry.pose(np.eye(3), part)
        for column, move in ((axis, turn), (3 + axis, shift)):
            there = geometry.transform_points(move, points)
            by_mounting[:, :, 0, column] = (_shown(second, first.pair[0], there)[0] - expected) / STEP
            by_mounting[:, :, 1, column] = (_shown(second, first.pair[0], points, move)[0] - expected) / STEP
    by_depth = (_shown(second, first.pair[0], points * (1 + STEP))[0] - expected) / STEP
    off = theirs[0][match[kept]] - expected
    finite = np.isfinite(by_mounting).all(axis=(1, 2, 3)) & np.isfinite(by_depth).all(axis=1)
    return off[finite], by_mounting[finite], by_depth[finite]


def _shown(view: _View, world_from_first: np.ndarray, points: np.ndarray, move: np.ndarray | None = None) -> tuple:
    """Pixels in a view, maybe moved, of points in the frame of another camera, and which it shows."""
    pair = view.pair if move is None else view.pair @ move
    uv, seen, _ = sensors.project_rolling(
        view.clip.rig.cameras[view.camera], pair, geometry.transform_points(world_from_first, points)
    )
    return uv, seen


def _matches(described: np.ndarray, theirs: Described, expected: np.ndarray) -> Int64[np.ndarray, " n"]:
    """For each description the number of the feature that matches it best near where it is expected; -1 without."""
    match = np.full(len(described), -1, np.int64)
    tree = cKDTree(theirs[0])
    for row, near in enumerate(tree.query_ball_point(np.nan_to_num(expected, nan=-1e6), SEARCH_PX)):
        if len(near) < 2:
            continue
        distance = np.linalg.norm(theirs[1][near] - described[row], axis=1)
        first, second = np.argsort(distance, kind="stable")[:2]
        if distance[first] < LIKENESS * distance[second]:
            match[row] = near[first]
    return match


def rotation(vector: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """The rotation about a vector, by its length in radian."""
    return Rotation.from_rotvec(vector).as_matrix()
