"""Alignment score of LiDAR points and images for a hypothetical camera pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from nurec_sim import geometry, sensors
from nurec_sim.logs.checks.borders import Pairs
from nurec_sim.logs.checks.sampling import Points
from nurec_sim.types import CameraModel, Matrix4

WIDEST_PX = 960
LEVELS = 65
MOST_PAIRS = 1000
MOST_PAIRS_OF_ALL = 3000
FEWEST_IN_IMAGE = 10
FEWEST_PAIRS = 30
LEAST_GAIN = 0.02
"""Smallest meaningful gain: real images gain 0.1 to 0.7, an image without content only rounding errors."""
SHIFTS = np.array(
    [(x * step, y * step) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y for step in (0.03, 0.05, 0.08)]
)
"""Offsets of the control positions, as fractions of the image width."""
FEWEST_SHIFTS = 4


@dataclass(frozen=True, eq=False)
class CalibrationView:
    """An image and the LiDAR points measured at about the same time."""

    camera: CameraModel
    lab: Float32[np.ndarray, "h w 3"]
    rig_m: Points
    pairs: Pairs


@dataclass(frozen=True)
class Fit:
    """How much better points fit an image at their projection than at shifted control positions.

    Attributes:
        gain: excess of log colour difference at LiDAR edges over that elsewhere, relative to the control positions.
        errors: the gain in standard errors; 0 if it is negligible, or too few points project into the images.
    """

    gain: float
    errors: float


def comparable_image(rgb: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    """An image in CIELAB, at most 960 px wide, lightness equalised so that edges in shade and glare weigh alike."""
    import cv2

    scale = WIDEST_PX / rgb.shape[1]
    if scale < 1:
        rgb = cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    lab = cv2.GaussianBlur(cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB), (0, 0), 1.0)
    # The small ramp keeps the quantiles of a flat image increasing.
    levels = np.quantile(lab[::4, ::4, 0], np.linspace(0, 1, LEVELS)) + 1e-4 * np.arange(LEVELS)
    lab[..., 0] = np.interp(lab[..., 0], levels, np.linspace(0, 100, LEVELS))
    return lab


def fit(views: Sequence[CalibrationView], rig_from_camera: Matrix4) -> Fit:
    """Alignment of the views for a camera pose.

    If the pose is right, image colour changes across LiDAR edges and is constant elsewhere. The score is the mean log
    colour difference over edge pairs minus that over other pairs, each relative to its mean over the same pairs shifted
    by a few percent of the image: texture that is everywhere, or concentrated at the bottom, gains nothing. Pairs from
    one patch of directions are not independent; the standard error treats each patch as a single observation.
    """
    most = min(MOST_PAIRS, MOST_PAIRS_OF_ALL // max(len(views), 1))
    found = [values for view in views if (values := _gains(view, rig_from_camera, most)) is not None]
    if not found:
        return Fit(0.0, 0.0)
    gain, border = np.concatenate([values[0] for values in found]), np.concatenate([values[1] for values in found])
    patch = np.concatenate(
        [np.stack([values[2], np.full_like(values[2], n)]) for n, values in enumerate(found)], axis=1
    )
    if min(border.sum(), (~border).sum()) < FEWEST_PAIRS:
        return Fit(0.0, 0.0)
    means = gain[border].mean(), gain[~border].mean()
    # Influence of each pair on the difference of both means. Summed within patches, then squared: the cluster-robust
    # standard error.
    share = np.where(border, (gain - means[0]) / border.sum(), (means[1] - gain) / (~border).sum())
    _, number = np.unique(patch, axis=1, return_inverse=True)
    error = float(np.linalg.norm(np.bincount(number.reshape(-1), share)))
    difference = float(means[0] - means[1])
    return Fit(difference, difference / error if abs(difference) > LEAST_GAIN else 0.0)


def _gains(
    view: CalibrationView, rig_from_camera: Matrix4, most: int
) -> tuple[Float64[np.ndarray, " n"], np.ndarray, np.ndarray] | None:
    """Per pair: its colour difference relative to the control positions, whether it is an edge, and its patch."""
    height, width = view.lab.shape[:2]
    points = geometry.transform_points(geometry.inverse(rig_from_camera), view.rig_m)
    uv, seen = sensors.project(view.camera, points)
    seen &= sensors.in_image(view.camera, uv)
    place = uv * (width / view.camera.width_px, height / view.camera.height_px)
    pairs = view.pairs
    inside = seen[pairs.first] & seen[pairs.second]
    kinds = [np.flatnonzero(inside & pairs.border), np.flatnonzero(inside & ~pairs.border)]
    if min(len(kind) for kind in kinds) < FEWEST_IN_IMAGE:
        return None
    draw = np.random.default_rng(0)
    # Equal limits for both kinds bound the time; a fixed seed makes the result reproducible.
    chosen = np.concatenate([kind if len(kind) <= most else draw.choice(kind, most, replace=False) for kind in kinds])
    ends = np.stack([place[pairs.first[chosen]], place[pairs.second[chosen]]])
    here = _difference(view.lab, ends)
    around = np.stack([_difference(view.lab, ends + shift * width) for shift in SHIFTS])
    valid = np.isfinite(around)
    enough = valid.sum(axis=0) >= FEWEST_SHIFTS
    mean = np.where(valid, around, 0.0).sum(axis=0)[enough] / valid.sum(axis=0)[enough]
    return here[enough] - mean, pairs.border[chosen][enough], pairs.block[chosen][enough]


def _difference(lab: Float32[np.ndarray, "h w 3"], ends: Float64[np.ndarray, "2 n 2"]) -> Float64[np.ndarray, " n"]:
    """Log colour difference between both ends of each pair; NaN if one is outside the image."""
    height, width = lab.shape[:2]
    columns, rows = np.floor(ends).astype(np.int64).transpose(2, 0, 1)
    inside = ((columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)).all(axis=0)
    one, two = lab.reshape(-1, 3)[np.where(inside, rows * width + columns, 0)]
    distance = np.sqrt(np.square(one - two).sum(axis=1))
    # CIELAB differences of about 2 are the threshold of visibility; the offset also keeps the logarithm finite.
    return np.where(inside, np.log(distance + 2.0), np.nan)
