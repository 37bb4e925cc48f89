"""Which pixels of a view show what an input image shows too (co-visibility masks, Gao et al. 2022).

Beside the driven path surfaces come into view that no image shows. No method can know their colours, so errors there
tell methods apart less than errors of what images do show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from nurec_sim import geometry, sensors
from nurec_sim.types import CameraModel, SensorRequest, Track
from nurec_sim.world.plan.surface import SurfaceClass
from nurec_sim.world.sense.truth import TrueView

SAME_M, SAME_SHARE = 0.15, 0.03
"""Surfaces are the same if their ranges differ by less than this plus a share of the range: a pixel's width along
grazing ground."""


@dataclass(frozen=True, eq=False)
class TrueImage:
    """An instantaneous image with its ground truth."""

    request: SensorRequest
    view: TrueView

    @property
    def sky(self) -> Bool[np.ndarray, "h w"]:
        """Which pixels show the sky."""
        return self.view.surface == SurfaceClass.SKY


def covisible(image: TrueImage, inputs: Sequence[TrueImage], tracks: Sequence[Track]) -> Bool[np.ndarray, "h w"]:
    """Which pixels of an image show a surface, or a part of the sky, that one of the inputs shows.

    Args:
        image: the image.
        inputs: others, with actors at other places.
        tracks: of the actors, in the order of ``TrueView.instance``.
    """
    pose, rays = image.request.world_from_sensor[0], sensors.pixel_rays(_camera(image))[0]
    ray = geometry.rotate_vectors(pose[:3, :3], rays)
    hit = pose[:3, 3] + ray * image.view.range_m[..., None]
    found = np.zeros(hit.shape[:2], bool)
    for other in inputs:
        moved = _moved(hit, image, other, tracks)
        found |= np.where(image.sky, _shows_sky(other, ray), _shows(other, moved))
    return found


def _camera(image: TrueImage) -> CameraModel:
    camera = image.request.sensor
    assert isinstance(camera, CameraModel)
    return camera


def _moved(
    hit: Float64[np.ndarray, "h w 3"], image: TrueImage, other: TrueImage, tracks: Sequence[Track]
) -> Float64[np.ndarray, "h w 3"]:
    """Points of an image where they are at the instant of another one."""
    moved = hit.copy()
    for number in np.unique(image.view.instance[image.view.instance > 0]):
        path, mine = tracks[number - 1].path, image.view.instance == number
        there_from_here = path.at(other.request.start_us) @ geometry.inverse(path.at(image.request.start_us))
        moved[mine] = geometry.transform_points(there_from_here, hit[mine])
    return moved


def _shows(image: TrueImage, points: Float64[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Which points the image shows: those at the range of its pixel at their place."""
    local = geometry.transform_points(geometry.inverse(image.request.world_from_sensor[0]), points)
    row, column, inside = _pixels(image, local)
    range_m = np.linalg.norm(local, axis=-1)
    near = np.abs(image.view.range_m[row, column] - range_m) < SAME_M + SAME_SHARE * range_m
    return inside & near & ~image.sky[row, column]


def _shows_sky(image: TrueImage, direction: Float64[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """In which directions the image shows the sky."""
    turn = image.request.world_from_sensor[0, :3, :3].T
    row, column, inside = _pixels(image, geometry.rotate_vectors(turn, direction))
    return inside & image.sky[row, column]


def _pixels(image: TrueImage, local: Float64[np.ndarray, "h w 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows and columns of the pixels that points in the frame of the camera fall on, and whether they do."""
    camera = _camera(image)
    uv_px, known = sensors.project(camera, local.reshape(-1, 3))
    inside = known & sensors.in_image(camera, uv_px)
    column, row = np.where(inside[:, None], uv_px, 0).astype(np.int64).T
    shape = local.shape[:2]
    return row.reshape(shape), column.reshape(shape), inside.reshape(shape)
