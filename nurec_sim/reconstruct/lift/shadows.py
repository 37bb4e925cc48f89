"""Shadows of movers: dark, translucent Gaussians on the ground, fixed to their boxes.

Where a mover is, the ground around it is darker than the same ground in other images. The share of light that is left
is the same for all ground that passes through the shadow, and so are black Gaussians of that opacity: blended over
ground of colour c, opacity 1 - s gives s c. Each cell of a grid around the box gets the share s that fits the pixels
that show it best, by least squares. A mover that turns has a shadow for each heading, as the sun casts it.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float64

from nurec_sim.reconstruct.lift import people
from nurec_sim.reconstruct.lift.actors import in_box
from nurec_sim.reconstruct.lift.points import Actor
from nurec_sim.reconstruct.lift.shade import CELL_M, LEAST_PIXELS, SHADOW_ABOVE_M, SHADOW_REACH_M, Shades
from nurec_sim.types import DynamicGaussians, Gaussians, GaussianScene, Label

FAINTEST, DARKEST = 0.06, 0.95
"""Shadows end where they take less light, and take no more."""
TOUCHING_M = 0.3
"""A shadow begins beneath its box, or so far beside it; dark spots elsewhere are something else."""
SIGMA = 0.8
"""Standard deviation of a Gaussian, in cells."""
THICKNESS_M = 0.002
STRONGER = 1.3
"""Shadows take this power of the light that is left: some ground is blended before them and stays as bright."""


def with_shadows(scene: GaussianScene, shades: Shades) -> GaussianScene:
    """The scene with the shadows of movers that have Gaussians.

    Args:
        scene: with solved colours.
        shades: of its tracks, with what its images show.
    """
    shown, parts = set(scene.dynamic.track.tolist()), []
    intensity = _intensity_of_road(scene.static)
    for ground in shades.grounds:
        track = ground.track
        if ground.number in shown and len(shadow := shadow_of(shades.sums_of(ground), track.size_m, intensity)):
            actor = Actor(ground.number, track, False, track.path, ground.window_us)
            parts.append(in_box(actor, shadow) if ground.window_us is None else people.moving(actor, shadow))
    if not parts:
        return scene
    return replace(scene, dynamic=DynamicGaussians.concatenate([scene.dynamic, *parts]))


def shadow_of(sums: Float64[np.ndarray, "x y 4"], size_m: tuple[float, float, float], intensity: float) -> Gaussians:
    """The shadow of a box, in its frame.

    Args:
        sums: of its grid, see ``Shades.sums``.
        size_m: of the box.
        intensity: of LiDAR returns from the ground.
    """
    cover, height = _cover(sums)
    row, column = np.nonzero(_one_shadow(cover > FAINTEST, size_m))
    count, half = len(row), np.array(size_m) / 2
    place = np.column_stack([
        (row + 0.5) * CELL_M - half[0] - SHADOW_REACH_M, (column + 0.5) * CELL_M - half[1] - SHADOW_REACH_M,
        height[row, column] + SHADOW_ABOVE_M - half[2],
    ])  # fmt: skip
    opacity = _opacity((1 - cover[row, column]) ** STRONGER)
    return Gaussians(
        mean_m=place.astype(np.float32),
        quat_wxyz=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        scale_m=np.tile(np.array([SIGMA * CELL_M, SIGMA * CELL_M, THICKNESS_M], np.float32), (count, 1)),
        opacity=opacity.astype(np.float32),
        rgb=np.zeros((count, 3), np.float32),
        normal=np.tile(np.array([0, 0, 1], np.float32), (count, 1)),
        label=np.full(count, Label.ROAD, np.uint8),
        intensity=np.full(count, intensity, np.float32),
    )


def _opacity(left: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Opacities with which Gaussians, one in each cell, leave these shares of the light in the middle of a cell."""
    steps = np.arange(-4, 5) / SIGMA
    response = np.exp(-(steps[:, None] ** 2 + steps**2) / 2).ravel()
    opacity = np.linspace(0.99, 0, 200)
    return np.interp(left, np.prod(1 - opacity[:, None] * response, axis=1), opacity)


def _cover(sums: Float64[np.ndarray, "x y 4"]) -> tuple[Float64[np.ndarray, "x y"], Float64[np.ndarray, "x y"]]:
    """The share of light that each cell lacks, and the height of its ground over the underside of the box."""
    kernel = np.array([0.25, 0.5, 0.25])
    smooth = cv2.sepFilter2D(sums, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_CONSTANT)
    seen = smooth[..., 2] > 0
    # A pixel of the ground, as it is on average.
    unshaded = LEAST_PIXELS * smooth[..., 1].sum() / max(smooth[..., 2].sum(), 1e-9) + 1e-9
    left = (smooth[..., 0] + unshaded) / (smooth[..., 1] + unshaded)
    height = np.divide(smooth[..., 3], smooth[..., 2], out=np.zeros(seen.shape), where=seen)
    return np.where(seen, np.clip(1 - left, 0, DARKEST), 0), height


def _one_shadow(dark: Bool[np.ndarray, "x y"], size_m: tuple[float, float, float]) -> Bool[np.ndarray, "x y"]:
    """Dark cells that are joined with dark ones beneath the box or next to it."""
    _, part = cv2.connectedComponents(dark.astype(np.uint8), connectivity=8)
    edge = int((SHADOW_REACH_M - TOUCHING_M) / CELL_M)
    near = part[edge : dark.shape[0] - edge, edge : dark.shape[1] - edge]
    return dark & np.isin(part, np.unique(near[near > 0]))


def _intensity_of_road(static: Gaussians) -> float:
    """Median intensity of road Gaussians; NaN where none is known."""
    known = static.intensity[(static.label == Label.ROAD) & np.isfinite(static.intensity)]
    return float(np.median(known)) if len(known) else float("nan")
