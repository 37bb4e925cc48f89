"""Evidence in pairs of frames for the ego vehicle, which stays at its place, and for the street, which moves."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from nurec_sim import geometry, sensors
from nurec_sim.types import CameraModel

DEPTHS = np.geomspace(1.0, 0.25, 12)
"""Depths that are tried for the street, as parts of the depth of the ground: what hides the ground is nearer."""
MOTION_PX = 3.0
"""Image motion from which the street and the vehicle can be told apart."""
WINDOW_PX = 9
CORRELATION, MARGIN = 0.7, 0.2
"""A hypothesis holds if its correlation reaches the one and exceeds the other hypothesis by the other."""
CONTRAST = 2.0
"""Standard deviation of grey levels in a window that counts as textured."""
SMALLEST_PART = 0.002
"""Share of the image that a connected part of what moves fills, at least."""
ACROSS = 0.05
"""Share of a texture's gradient energy along the motion, at least: a line along the motion matches anywhere on it."""
ALONG_PX = (21, 9)
"""Window, columns and rows, in which the gradients of an edge agree."""
FEWEST, MOST = 0.25, 0.75
"""Quantiles over the frames of the strength of an edge: one that stays has about the same at both."""

Map = Float32[np.ndarray, "h w"]


def static_gradient(frames: Sequence[Float32[np.ndarray, "h w 3"]]) -> Float32[np.ndarray, "2 h w"]:
    """Gradient (columns, rows) that stays at its place while the camera moves, of the channel where it is steepest."""
    smooth = [cv2.GaussianBlur(frame, (0, 0), 1.0) for frame in frames]
    # A Sobel kernel of 3 x 3 sums eight differences over one pixel.
    each = np.array([[cv2.Sobel(f, cv2.CV_32F, *d, scale=1 / 8) for d in ((1, 0), (0, 1))] for f in smooth])
    mean = each.mean(axis=0)
    direction = mean / np.maximum(np.hypot(*mean), 1e-6)
    along = np.sort((each * direction).sum(axis=1), axis=0)
    few, most = (along[round(q * (len(frames) - 1))] for q in (FEWEST, MOST))
    # The texture of a street that moved is as steep in all frames by chance only, the vehicle's edge unless the light
    # changes: what is less than half as steep in some counts less.
    steady = np.maximum(few, 0) * np.minimum(2 * few / np.maximum(most, 1e-6), 1)
    channel = steady.argmax(axis=-1)[..., None]
    steepest = np.take_along_axis(steady * direction, channel[None], -1)[..., 0]
    # Along an edge gradients agree; in texture, and at both sides of a line, they cancel each other.
    sums = np.array([cv2.boxFilter(part, -1, ALONG_PX) for part in steepest])
    lengths = cv2.boxFilter(np.hypot(*steepest), -1, ALONG_PX)
    return steepest * np.hypot(*sums) / np.maximum(lengths, 1e-6)


def compare(
    camera: CameraModel,
    first: Map,
    second: Map,
    ground_points: Float64[np.ndarray, "h w 3"],
    second_from_first: Float64[np.ndarray, "4 4"],
) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Compare a frame with another, taken elsewhere.

    Args:
        camera: the camera, at the size of the frames.
        first: grey levels.
        second: grey levels of the other frame.
        ground_points: what the pixels of the first frame show if it is the ground, in its camera's frame.
        second_from_first: pose of the first frame's camera in the second's.

    Returns:
        Pixels of the first frame that stay at their place in the second, and those that move as the street does.
    """
    height, width = first.shape
    columns, rows = _pixel_centres(height, width)
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
    there = (moving > CORRELATION) & (moving > staying + MARGIN)
    # Reflections in the paint move as well, and match here and there by chance.
    most = cv2.medianBlur(there.astype(np.uint8), WINDOW_PX)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(most)
    return here, (most > 0) & (stats[labels, cv2.CC_STAT_AREA] >= SMALLEST_PART * there.size)


def flow_of(
    camera: CameraModel, ground_points: Float64[np.ndarray, "h w 3"], second_from_first: Float64[np.ndarray, "4 4"]
) -> Float64[np.ndarray, "2 h w"]:
    """Image motion of the ground in the first hundredth of the way from one frame to another; zero where unknown."""
    way = -second_from_first[:3, :3].T @ second_from_first[:3, 3]
    height, width = ground_points.shape[:2]
    uv, seen = sensors.project(camera, (ground_points - 0.01 * way).reshape(-1, 3))
    flow = uv.T.reshape(2, height, width) - _pixel_centres(height, width)
    return np.where(seen.reshape(height, width), flow, 0.0)


def _pixel_centres(height: int, width: int) -> Float64[np.ndarray, "2 h w"]:
    """Columns and rows."""
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5))


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
