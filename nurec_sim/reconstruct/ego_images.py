"""What cameras see of the ego vehicle: found in the frames of a log, so that it is not rebuilt as part of the street.

The bonnet or the boot stays at its place in the image while the car drives; the street moves as its depth predicts.
Textured pixels that match better at their own place than along their epipolar line are evidence for the vehicle, those
that match along the line are evidence for the street. The vehicle fills the image from its lower edge up to a boundary
of one row per column: the one that contradicts the least evidence, found by dynamic programming.

A car ahead that keeps its distance stays at its place too. What stands beyond the ego vehicle by LiDAR returns or boxes
of the log is evidence for the street, unless the lower body of the car may hide it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8

from nurec_sim import geometry, sensors
from nurec_sim.compute.cores import in_order
from nurec_sim.reconstruct.around_ego import shows_others
from nurec_sim.types import Box, CameraModel, Clip

EGO_HEIGHT_M = 0.75
"""Bonnet and boot of a car lie at about this height: what is lower within its outline is the car itself."""
WIDTH_PX = 400
"""Width at which frames are compared, about."""
PAIRS = 6
"""Pairs of frames that are compared, at most."""
BASELINE_M = 1.0
"""How far the camera moves between the frames of a pair, at least."""
GROUND_RANGE_M = 30.0
"""Ground further away moves too little."""
DEPTHS = np.geomspace(1.0, 0.25, 12)
"""Depths that are tried for the street, as parts of the depth of the ground: what hides the ground is nearer."""
MOTION_PX = 3.0
"""Image motion from which the street and the vehicle can be told apart."""
WINDOW_PX = 9
CORRELATION, MARGIN = 0.7, 0.2
"""A hypothesis holds if its correlation reaches the one and exceeds the other hypothesis by the other."""
CONTRAST = 2.0
"""Standard deviation of grey levels in a window that counts as textured."""
ACROSS = 0.05
"""Share of a texture's gradient energy along the motion, at least: a line along the motion matches anywhere on it."""
PRIOR, SLOPE = 0.006, 0.8
"""Cost of a vehicle pixel without evidence, and of a step of the boundary by one row; a contradiction costs one."""
SMALLEST_SHARE = 0.01
"""Share of the image that the vehicle fills, at least; less is not believed."""
LEAST_EVIDENCE = 0.15
"""Mean evidence over the vehicle's pixels, at least."""
PICTURES = 16
"""Frames whose median is the image of the vehicle, at most."""
FEATHER_PX = 1.5


def find_ego_images(
    clip: Clip,
    cameras: Sequence[str],
    progress: Callable[[float], None] = lambda fraction: None,
    hold_out: Collection[int] = (),
) -> dict[str, UInt8[np.ndarray, "h w 4"]]:
    """Images of the ego vehicle as each camera sees it, RGBA of the camera's size; none of cameras that do not see it.

    Sweeps of ``hold_out`` are not read. The log's own masks (``Clip.ego_mask``) come first. Without two frames at least
    ``BASELINE_M`` apart the vehicle is taken to be where its outline is, below ``EGO_HEIGHT_M``.
    """
    images = {}
    for number, camera in enumerate(cameras):
        progress(number / len(cameras))
        mask = clip.ego_mask(camera)
        if mask is None:
            mask = _find_mask(clip, camera, hold_out)
        if mask is not None and mask.any():
            images[camera] = _picture(clip, camera, mask)
    return images


def shows_ego(rays: Float64[np.ndarray, "h w 3"], camera: CameraModel, body: Box) -> Bool[np.ndarray, "h w"]:
    """Which of a camera's rays, of any length, pass through the lower body of the car; none if it is within."""
    centre, size = np.asarray(body.center_m), np.asarray(body.size_m)
    low, high = centre - size / 2, centre + size / 2
    high[2] = min(high[2], low[2] + EGO_HEIGHT_M)
    origin = camera.rig_from_camera[:3, 3]
    if np.all((origin >= low) & (origin <= high)):
        return np.zeros(rays.shape[:2], bool)
    rays = rays @ camera.rig_from_camera[:3, :3].T
    # Slab test against the box; no division by zero for rays along a face.
    rays = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    near, far = (low - origin) / rays, (high - origin) / rays
    enter, leave = np.minimum(near, far).max(axis=-1), np.maximum(near, far).min(axis=-1)
    return (enter < leave) & (leave > 0)


def _find_mask(clip: Clip, camera: str, hold_out: Collection[int]) -> Bool[np.ndarray, "h w"] | None:
    """Where the camera sees the vehicle, at the size of the camera; None if nowhere."""
    model = clip.rig.cameras[camera]
    reduction = max(1, round(model.width_px / WIDTH_PX))
    small = sensors.scaled_camera(model, model.width_px // reduction, model.height_px // reduction)
    poses = [
        geometry.interpolate_pose_pair(np.asarray(clip.world_from_camera(camera, frame), np.float64), np.array(0.5))
        for frame in range(len(clip.camera_times_us(camera)))
    ]
    pairs = _pairs(poses)
    if not pairs:
        return shows_ego(sensors.pixel_rays(model)[0], model, clip.rig.body)
    rays, depth_m = _ground(small, clip)
    near = np.isfinite(depth_m)
    if not near.any():
        return None
    ego, street = np.zeros(near.shape), np.zeros(near.shape)
    size = small.width_px, small.height_px
    frames = sorted({i for pair in pairs for i in pair})
    grey = dict(zip(frames, in_order(lambda i: _grey(clip.image(camera, i), size), frames), strict=True))
    hidden, points = shows_ego(rays, small, clip.rig.body), np.where(near, depth_m, 1.0)[..., None] * rays

    def compared(pair: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        first, second = pair
        others = shows_others(clip, small, first, hold_out) & ~hidden
        second_from_first = geometry.inverse(poses[second]) @ poses[first]
        here, there = _evidence(small, grey[first], grey[second], points, second_from_first)
        return here & near & ~others, (there | others) & near

    for here, there in in_order(compared, pairs):
        ego += here
        street += there
    mask = _believed(_below_boundary(ego / len(pairs), street / len(pairs), near), ego / len(pairs))
    if not mask.any():
        return None
    full = cv2.resize(mask.astype(np.float32), (model.width_px, model.height_px), interpolation=cv2.INTER_LINEAR)
    return full > 0.25


def _pairs(poses: Sequence[Float64[np.ndarray, "4 4"]]) -> list[tuple[int, int]]:
    """Pairs of frames, in both orders, with the baseline between them; spread evenly over the drive."""
    places = np.array([pose[:3, 3] for pose in poses])
    pairs = []
    for first in range(len(places)):
        away = np.nonzero(np.linalg.norm(places[first + 1 :] - places[first], axis=1) >= BASELINE_M)[0]
        if len(away):
            pairs.append((first, first + 1 + int(away[0])))
    pairs += [(second, first) for first, second in pairs]
    chosen = np.linspace(0, len(pairs) - 1, min(PAIRS, len(pairs))).astype(int)
    return [pairs[k] for k in chosen]


def _ground(camera: CameraModel, clip: Clip) -> tuple[Float64[np.ndarray, "h w 3"], Float64[np.ndarray, "h w"]]:
    """Rays of the pixels in the camera frame, and the distance at which each meets the ground, or nan."""
    rays, seen = sensors.pixel_rays(camera)
    body = clip.rig.body
    ground_z = body.center_m[2] - body.size_m[2] / 2
    down = (rays @ camera.rig_from_camera[:3, :3].T)[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        length = (ground_z - camera.rig_from_camera[2, 3]) / down
    return rays, np.where(seen & (length > 0) & (length < GROUND_RANGE_M), length, np.nan)


def _grey(rgb: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> np.ndarray:
    return cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA).astype(np.float32)


def _evidence(
    camera: CameraModel,
    first: np.ndarray,
    second: np.ndarray,
    ground_points: Float64[np.ndarray, "h w 3"],
    second_from_first: Float64[np.ndarray, "4 4"],
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Pixels of the first frame that stay at their place in the second, and those that move as the street does."""
    height, width = first.shape
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    moving = np.full(first.shape, -1.0)
    flow = None
    for part in DEPTHS:
        points = geometry.transform_points(second_from_first, (part * ground_points).reshape(-1, 3))
        uv, seen = sensors.project(camera, points)
        inside = (seen & sensors.in_image(camera, uv)).reshape(first.shape)
        u, v = np.where(seen[:, None], uv, -1e4).T.reshape(2, height, width)
        du, dv = u - columns, v - rows
        motion = np.hypot(du, dv)
        if flow is None:
            flow, known = np.stack([du, dv]), seen.reshape(first.shape) & (motion >= MOTION_PX)
        warped = cv2.remap(second, (u - 0.5).astype(np.float32), (v - 0.5).astype(np.float32), cv2.INTER_LINEAR)
        moving = np.maximum(moving, np.where(inside & (motion >= MOTION_PX), _correlation(first, warped), -1.0))
    assert flow is not None
    staying = _correlation(first, second)
    clear = known & _textured(first, flow) & _textured(second, flow)
    here = clear & (staying > CORRELATION) & (staying > moving + MARGIN)
    return here, (moving > CORRELATION) & (moving > staying + MARGIN)


def _mean(values: np.ndarray) -> np.ndarray:
    return cv2.boxFilter(values, -1, (WINDOW_PX, WINDOW_PX))


def _correlation(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Normalised cross-correlation of windows; 1 is added to the variances, so that noise does not correlate."""
    mean_1, mean_2 = _mean(first), _mean(second)
    variance_1, variance_2 = _mean(first * first) - mean_1**2, _mean(second * second) - mean_2**2
    return (_mean(first * second) - mean_1 * mean_2) / np.sqrt(
        (np.maximum(variance_1, 0) + 1) * (np.maximum(variance_2, 0) + 1)
    )


def _textured(image: np.ndarray, flow: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """Windows with contrast whose gradient does not only lie across the expected motion."""
    dx, dy = cv2.Sobel(image, cv2.CV_32F, 1, 0), cv2.Sobel(image, cv2.CV_32F, 0, 1)
    along = (dx * flow[0] + dy * flow[1]) / np.maximum(np.hypot(*flow), 1e-6)
    contrast = _mean(image * image) - _mean(image) ** 2 > CONTRAST**2
    return contrast & (_mean((along**2).astype(np.float32)) > ACROSS * _mean(dx * dx + dy * dy))


def _below_boundary(ego: np.ndarray, street: np.ndarray, near: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """Pixels at and below the boundary with the least cost.

    The cost of a column's boundary is the evidence for the vehicle above it, the evidence for the street and the prior
    below it, and ``SLOPE`` times its distance in rows from that of the column before.
    """
    height, width = ego.shape
    none = np.zeros((1, width))
    cost = np.vstack([none, np.cumsum(ego, axis=0)])
    cost += np.vstack([np.cumsum((street + PRIOR)[::-1], axis=0)[::-1], none])
    horizon = np.where(near.any(axis=0), near.argmax(axis=0), height)
    rows = np.arange(height + 1)
    cost[rows[:, None] < horizon] = np.inf
    # The best predecessor of each row under |step| * SLOPE, from prefix minima in both directions.
    total, chosen = cost[:, 0], np.zeros((width, height + 1), int)
    for column in range(1, width):
        down, from_above = _running_minimum(total - SLOPE * rows)
        up, from_below = _running_minimum((total + SLOPE * rows)[::-1])
        up, from_below = up[::-1] - SLOPE * rows, height - from_below[::-1]
        above = down + SLOPE * rows
        chosen[column] = np.where(above <= up, from_above, from_below)
        total = np.minimum(above, up) + cost[:, column]
    boundary = np.empty(width, int)
    boundary[-1] = total.argmin()
    for column in range(width - 1, 0, -1):
        boundary[column - 1] = chosen[column][boundary[column]]
    # A window that touches the vehicle is evidence at its centre already: the edge lies half a window further down.
    return np.arange(height)[:, None] >= boundary + WINDOW_PX // 2


def _believed(mask: Bool[np.ndarray, "h w"], ego: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """The connected parts of a mask that are large enough and rest on evidence."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    evidence = np.bincount(labels.ravel(), weights=ego.ravel(), minlength=count)
    area = stats[:, cv2.CC_STAT_AREA]
    good = (area >= SMALLEST_SHARE * mask.size) & (evidence >= LEAST_EVIDENCE * area)
    good[0] = False
    return good[labels]


def _running_minimum(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minimum of all values up to each one, and where it lies."""
    least = np.minimum.accumulate(values)
    return least, np.maximum.accumulate(np.where(values <= least, np.arange(len(values)), 0))


def _picture(clip: Clip, camera: str, mask: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 4"]:
    """Median of frames where the mask is set, with a soft edge."""
    count = len(clip.camera_times_us(camera))
    frames = sorted(set(np.linspace(0, count - 1, min(PICTURES, count)).astype(int).tolist()))
    top = int(mask.any(axis=1).argmax())
    cover = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), FEATHER_PX)
    stack = np.stack([clip.image(camera, frame)[top:] for frame in frames])
    picture = np.zeros((*mask.shape, 4), np.uint8)
    picture[top:, :, :3] = np.median(stack, axis=0) * (cover[top:, :, None] > 0)
    picture[..., 3] = np.rint(255 * cover)
    return picture
