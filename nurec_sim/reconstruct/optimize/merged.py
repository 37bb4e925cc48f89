"""Fewer static Gaussians to begin a fit with: those that are alike for the images become one.

A method makes Gaussians of single pixels and returns, so where many images saw a surface from nearby it has more of
them than a fit can make use of: each gets less of the gradient, and steps cost more. What a merged one no longer shows
comes back in a few steps.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from nurec_sim.errors import ReconstructError
from nurec_sim.reconstruct.budget import merge_voxels, reduce_to_budget
from nurec_sim.render.cpu.backward.frame import SENSORS
from nurec_sim.types import CameraModel, GaussianScene

AT_M = 10.0
"""Voxels have one size everywhere: some pixels of the finest camera, as seen from here. Voxels that grow with the
distance from the path were no better."""
LARGEST_M = 0.07
"""Of the edge of a voxel, however coarse cameras are: LiDAR knows surfaces better. Budgets may need larger ones."""


def merged(
    scene: GaussianScene, cameras: Sequence[CameraModel], voxel_px: float, max_gaussians: int | None = None
) -> GaussianScene:
    """The scene with one static Gaussian for all of one label in a voxel (``budget.merge_voxels``).

    The provenance gets ``merged``: the number before, and the size of the voxels.

    Args:
        scene: moving Gaussians, sky and the rest stay as they are.
        cameras: whose images are fitted, at least one.
        voxel_px: edge of the voxels in pixels of the finest camera, ``AT_M`` away, ``LARGEST_M`` at most; 0 merges
            nothing.
        max_gaussians: voxels are larger where these leave more than so many; None for any number.

    Raises:
        ReconstructError: there are more labels than ``max_gaussians``.
    """
    static, before = scene.static, len(scene.static)
    voxel_m = min(LARGEST_M, voxel_px * AT_M * min(SENSORS.tables(camera).spacing_rad for camera in cameras))
    if before and voxel_m > 0:
        static = merge_voxels(static, voxel_m)
    if max_gaussians is not None and len(static) > max_gaussians:
        try:
            static, found = reduce_to_budget(scene.static, max_gaussians)
        except ValueError as error:
            raise ReconstructError(f"max_gaussians: {error}") from None
        voxel_m = found or voxel_m
    if len(static) == before:
        return scene
    told = {"merged": {"from": before, "voxel_m": round(voxel_m, 4)}}
    return dataclasses.replace(scene, static=static, provenance={**scene.provenance, **told})
