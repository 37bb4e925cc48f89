"""Objects as maps of numbers and back: what the detector's network answers, at every ``STRIDE`` pixels.

Each object has one cell, where the centre of its box is projected. Its numbers there: offset of the projected centre
from the middle of the cell in cells (2), logarithm of the depth, logarithm of the depth's relative error, logarithms of
length, width and height by the kind's mean (3), and sine and cosine of the angle at which it is looked at (2), which,
unlike the heading, is what an image shows. The idea of objects as points is that of Zhou et al. (2019), CenterNet; of
the depth's error as a part of the score that of Kendall and Gal (2017).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from nurec_sim import sensors
from nurec_sim.network.detector.objects import FOCAL_PX, KINDS, Labelled, Objects, focal_px
from nurec_sim.types import CameraModel, Pinhole

STRIDE, DEEPEST = 4, 32
"""Pixels of a cell; images are padded to whole multiples of the other."""
NUMBERS = 9
MEAN_SIZE_M = np.array([[4.7, 1.86, 1.62], [1.2, 0.62, 1.75]])
TYPICAL_M = 20.0
MOST = 64
"""Objects of an image at most."""
APART_M = np.array([1.5, 0.6])
"""Of two detections of one kind nearer than this the one with the lower score is dropped."""
MATCH_M = 2.0
"""A detection is right if it is within this distance of an object, seen from above."""
LOWEST = 0.05
"""Detections of lower scores are not kept."""


@dataclass(frozen=True, eq=False)
class Look:
    """An image as the network sees it: of focal length ``FOCAL_PX``, without distortion, padded with black.

    Attributes:
        rgb: the image.
        lens: its pinhole.
        inner_px: width and height without the padding.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    lens: Pinhole
    inner_px: tuple[int, int]

    @property
    def coordinates(self) -> Float32[np.ndarray, "2 h w"]:
        """Tangents of the ray of every pixel, to the right and downwards."""
        return ray_tangents(self.lens, self.rgb.shape[1], self.rgb.shape[0])


@dataclass(frozen=True, eq=False)
class Detections(Objects):
    """Found objects, the surest first.

    Attributes:
        score: 0 to 1; how sure it is that there is an object and that its depth is right.
    """

    score: Float64[np.ndarray, " n"]

    def above(self, scores: Float64[np.ndarray, " kinds"]) -> Detections:
        """Those whose score reaches that of their kind."""
        keep = self.score >= np.asarray(scores)[self.kind]
        return Detections(
            *(getattr(self, name)[keep] for name in ("kind", "centre_m", "size_m", "heading_rad", "score"))
        )


def ray_tangents(lens: Pinhole, width: int, height: int) -> Float32[np.ndarray, "2 h w"]:
    """Tangents of the ray of every pixel, to the right and downwards."""
    u, v = (np.arange(width) + 0.5 - lens.cx_px) / lens.fx_px, (np.arange(height) + 0.5 - lens.cy_px) / lens.fy_px
    return np.stack(np.broadcast_arrays(u[None, :], v[:, None])).astype(np.float32)


def look(rgb: UInt8[np.ndarray, "h w 3"], camera: CameraModel) -> Look:
    """An image of a camera as the network sees it."""
    height, width = rgb.shape[:2]
    factor = FOCAL_PX / focal_px(camera)
    pinhole = camera.ideal_pinhole
    if pinhole is None:
        size = (round(width * factor), round(height * factor))
        lens = Pinhole(FOCAL_PX, FOCAL_PX, size[0] / 2, size[1] / 2)
        small = _without_distortion(rgb, camera, lens, size, factor)
    else:
        size = (max(1, round(width * FOCAL_PX / pinhole.fx_px)), max(1, round(height * FOCAL_PX / pinhole.fy_px)))
        x, y = size[0] / width, size[1] / height  # the exact factors
        lens = Pinhole(pinhole.fx_px * x, pinhole.fy_px * y, pinhole.cx_px * x, pinhole.cy_px * y)
        small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR)
    padded = [-(-side // DEEPEST) * DEEPEST for side in size]
    framed = np.zeros((padded[1], padded[0], 3), np.uint8)
    framed[: size[1], : size[0]] = small
    return Look(framed, lens, size)


def _without_distortion(
    rgb: UInt8[np.ndarray, "h w 3"], camera: CameraModel, lens: Pinhole, size: tuple[int, int], factor: float
) -> UInt8[np.ndarray, "h w 3"]:
    """The image through a pinhole; black where the camera does not look."""
    tangents = ray_tangents(lens, *size).reshape(2, -1).T.astype(np.float64)
    uv, valid = sensors.project(camera, np.concatenate([tangents, np.ones((len(tangents), 1))], axis=1))
    uv = np.where(valid[:, None], uv, -1e4).astype(np.float32).reshape(size[1], size[0], 2) - np.float32(0.5)
    sharp = cv2.GaussianBlur(rgb, (0, 0), 0.4 / factor) if factor < 0.8 else rgb
    return cv2.remap(sharp, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR)


# --------------------------------------------------------------------------------------------------- objects to maps


@dataclass(frozen=True, eq=False)
class Targets:
    """Maps that the network should answer.

    Attributes:
        heat: of each kind, 1 at the cells of visible objects and falling off around them.
        weight: 0 where it does not matter what the network says, in the outlines of objects that are not visible.
        numbers: see above; the second logarithm is 0.
        known: cells whose numbers are known: those of the objects and their neighbours.
    """

    heat: Float32[np.ndarray, "kinds h w"]
    weight: Float32[np.ndarray, "kinds h w"]
    numbers: Float32[np.ndarray, "numbers h w"]
    known: Bool[np.ndarray, "h w"]


def encode(objects: Labelled, lens: Pinhole, width: int, height: int) -> Targets:
    """The maps of an image of this size (pixels, multiples of ``STRIDE``) through a pinhole."""
    rows, columns = height // STRIDE, width // STRIDE
    heat = np.zeros((len(KINDS), rows, columns), np.float32)
    weight, numbers = np.ones_like(heat), np.zeros((NUMBERS, rows, columns), np.float32)
    nearest = np.full((rows, columns), np.inf)
    visible = objects.visible
    down, right = np.mgrid[:rows, :columns] + 0.5
    for k in np.argsort(-objects.centre_m[:, 2]):  # the nearest last
        (x, y, z), kind = objects.centre_m[k], int(objects.kind[k])
        if z < 1.0:
            continue
        u, v = (lens.fx_px * x / z + lens.cx_px) / STRIDE, (lens.fy_px * y / z + lens.cy_px) / STRIDE
        # Half the extent in cells, of something between its ends and its side.
        half_u = lens.fx_px / z / STRIDE * (0.3 * objects.size_m[k, 0] + 0.5 * objects.size_m[k, 1]) / 1.3
        half_v = lens.fy_px / z / STRIDE * objects.size_m[k, 2] / 2
        if not visible[k] or not (0 <= u < columns and 0 <= v < rows):
            hidden = (np.abs(right - u) <= half_u + 1) & (np.abs(down - v) <= half_v + 1)
            weight[kind][hidden & (heat[kind] < 0.99)] = 0
            continue
        i, j = int(v), int(u)
        spread_u, spread_v = max(half_u / 2.5, 0.55), max(half_v / 2.5, 0.55)
        bump = np.exp(-(((right - j - 0.5) / spread_u) ** 2 + ((down - i - 0.5) / spread_v) ** 2) / 2)
        bump[i, j] = 1
        heat[kind] = np.maximum(heat[kind], bump)
        weight[kind, i, j] = 1
        around = (np.abs(right - j - 0.5) <= 1) & (np.abs(down - i - 0.5) <= 1) & (nearest >= z)
        around &= bump > 0.2
        nearest[around] = z
        looked_at = objects.heading_rad[k] - np.arctan2(x, z)
        answer = np.array([np.log(z / TYPICAL_M), 0, *np.log(objects.size_m[k] / MEAN_SIZE_M[kind]),
                           np.sin(looked_at), np.cos(looked_at)])  # fmt: skip
        numbers[:, around] = np.concatenate([[u, v], answer])[:, None]
        numbers[0][around] -= right[around]
        numbers[1][around] -= down[around]
    return Targets(heat, weight, numbers, np.isfinite(nearest))


# --------------------------------------------------------------------------------------------------- maps to objects


def decode(
    heat: Float32[np.ndarray, "kinds h w"], numbers: Float32[np.ndarray, "numbers h w"], lens: Pinhole
) -> Detections:
    """The objects of maps.

    Args:
        heat: of each kind, 0 to 1.
        numbers: see above.
        lens: pinhole of the image.

    Returns:
        At most ``MOST`` detections with scores of at least ``LOWEST``. A score is the heat times the probability that
        the depth is within ``MATCH_M`` of the true one, which is Laplace's: 1 - exp(-MATCH_M / scale).
    """
    highest = np.stack([cv2.dilate(plane, np.ones((3, 3), np.uint8)) for plane in heat])
    kind, row, column = np.nonzero((heat >= highest) & (heat >= LOWEST))
    u, v, depth, error, *rest = numbers[:, row, column].astype(np.float64)
    z = TYPICAL_M * np.exp(np.clip(depth, -4, 2.5))
    score = heat[kind, row, column] * (1 - np.exp(-MATCH_M / (z * np.exp(np.clip(error, -8, 3)))))
    x = z * ((column + 0.5 + u) * STRIDE - lens.cx_px) / lens.fx_px
    y = z * ((row + 0.5 + v) * STRIDE - lens.cy_px) / lens.fy_px
    size_m = MEAN_SIZE_M[kind] * np.exp(np.clip(np.array(rest[:3]).T.reshape(-1, 3), -1.5, 1.5))
    heading = np.arctan2(rest[3], rest[4]) + np.arctan2(x, z)
    centre_m = np.stack([x, y, z], axis=1)
    order = _kept(kind, centre_m, score)
    turned = (heading[order] + np.pi) % (2 * np.pi) - np.pi
    return Detections(kind[order], centre_m[order], size_m[order], turned, score[order])


def _kept(
    kind: Int64[np.ndarray, " n"], centre_m: Float64[np.ndarray, "n 3"], score: Float64[np.ndarray, " n"]
) -> Int64[np.ndarray, " k"]:
    """The surest ones first, without those that are at the place of a surer one."""
    kept: list[int] = []
    for k in np.argsort(-score, kind="stable"):
        if score[k] < LOWEST or len(kept) == MOST:
            break
        same = [other for other in kept if kind[other] == kind[k]]
        away = np.linalg.norm(centre_m[same][:, [0, 2]] - centre_m[k, [0, 2]], axis=1)
        if not len(same) or away.min() >= APART_M[kind[k]]:
            kept.append(int(k))
    return np.array(kept, np.int64)
