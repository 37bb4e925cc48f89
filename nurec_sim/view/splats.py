"""Gaussians that the browser draws itself, as an alternative to the renderer's pictures."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from nurec_sim import geometry
from nurec_sim.render.layers import drawable, moving_gaussians, view_colour
from nurec_sim.types import Gaussians, Matrix4
from nurec_sim.view.state import Stage, View

MOST = 1_000_000
"""Gaussians that are sent to a browser: 32 bytes each."""


class Splats(NamedTuple):
    """Arguments of viser's ``add_gaussian_splats``."""

    centers: Float32[np.ndarray, "n 3"]
    covariances: Float32[np.ndarray, "n 3 3"]
    rgbs: Float32[np.ndarray, "n 3"]
    opacities: Float32[np.ndarray, "n 1"]


def static_splats(stage: Stage, view: View, origin_m: np.ndarray, most: int = MOST) -> tuple[Splats, int]:
    """Static Gaussians, and how many were left out: those that cover least.

    Args:
        stage: where everything is.
        view: what is looked at; its world must be rendered in this process.
        origin_m: what is subtracted from positions, so that they fit single precision.
        most: how many at most.
    """
    scene = stage.world(view).scene
    assert scene is not None
    static = scene.static
    rows = np.flatnonzero(drawable(static))
    if len(rows) > most:
        size = np.sort(static.scale_m[rows], axis=1)
        cover = static.opacity[rows] * size[:, 1] * size[:, 2]
        rows = np.sort(rows[np.argpartition(-cover, most)[:most]])
    return _splats(static[rows], origin_m, scene.ego.at(view.t_us)[:3, 3]), int(len(static) - len(rows))


def moving_splats(stage: Stage, view: View, origin_m: np.ndarray) -> Splats:
    """Gaussians of everything that moves, at the view's time and with its actors; arguments as ``static_splats``."""
    scene = stage.world(view).scene
    assert scene is not None
    eye = scene.ego.at(view.t_us)[:3, 3]
    boxes: dict[str, Matrix4] = {name: pair[0] for name, pair in stage.overrides(view, view.t_us, view.t_us).items()}
    return _splats(moving_gaussians(scene.dynamic, scene.tracks, view.t_us, boxes, eye), origin_m, eye)


def _splats(gaussians: Gaussians, origin_m: np.ndarray, eye_m: np.ndarray) -> Splats:
    rotation = geometry.matrix_from_quat(gaussians.quat_wxyz.astype(np.float64))
    root = (rotation * gaussians.scale_m[:, None, :]).astype(np.float32)
    rgb = gaussians.rgb
    if gaussians.sh_rest is not None:
        rgb = view_colour(rgb, gaussians.sh_rest, gaussians.mean_m - eye_m)
    return Splats(
        (gaussians.mean_m - origin_m).astype(np.float32),
        root @ root.transpose(0, 2, 1),
        np.clip(rgb, 0, 1).astype(np.float32),
        np.clip(gaussians.opacity, 0, 1).astype(np.float32)[:, None],
    )
