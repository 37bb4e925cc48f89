"""The ground as the LiDAR measured it, for methods that make their Gaussians and labels from images.

Images show asphalt in the shade and far away as they show pavement; sweeps measure the kerb between the two. So where
sweeps have measured the ground, Gaussians near it are road as far as a car can drive from the path without meeting a
step (``lift.road``), and nothing else there is. And images show no ground under and behind the car at the start, or
beside it where no camera looks; sweeps measure it, and the car drove over it.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from nurec_sim.errors import ReconstructError
from nurec_sim.reconstruct.lift import surfaces
from nurec_sim.reconstruct.lift.bodies import ground_of
from nurec_sim.reconstruct.lift.ground import Ground
from nurec_sim.reconstruct.lift.points import Gathered, actors_of, gather
from nurec_sim.reconstruct.lift.settings import GroundSettings, PointSettings
from nurec_sim.reconstruct.unseen_colours import colours_by_likeness
from nurec_sim.types import Clip, Gaussians, GaussianScene, Label

NEAR_M = 0.7
"""Gaussians within this height of the ground are part of it, for depth from images is no better: what hovers over
measured road is road that images put too high, since the LiDAR saw nothing upright there."""
REACH, LEAST_REACH_M = 2.0, 0.3
"""A Gaussian covers the ground as far as this many of its standard deviations, and at least so far."""
VISIBLE, OPACITY = 0.1, 0.95
"""Opacity from which a Gaussian covers the ground, and that of those which are added."""
NOTE = "no map: the road is grown from the driven path up to height steps that the LiDAR has measured"


def with_measured_ground(scene: GaussianScene, clip: Clip, hold_out: set[int]) -> GaussianScene:
    """A scene whose ground is road where the sweeps of its log say so, and has no holes where they measured it.

    Args:
        scene: a reconstruction.
        clip: the log that it was made from.
        hold_out: sweeps that must not be read, by index, of every LiDAR.

    Raises:
        ReconstructError: the log has no sweep that may be read.
    """
    points = PointSettings(carve=False)
    gathered = gather(clip, actors_of(clip, points), hold_out, points)
    if not len(gathered.static):
        raise ReconstructError(
            f"clip {clip.id!r} has no LiDAR returns to find the ground by, with sweeps {sorted(hold_out)} held out; "
            "the network's own labels need road_labels='network'"
        )
    ground = ground_of(clip, gathered, GroundSettings())
    static = scene.static
    near = np.isin(static.label, (Label.ROAD, Label.OTHER)) & (np.abs(ground.above(static.mean_m)) < NEAR_M)
    label: UInt8[np.ndarray, " n"] = static.label.copy()
    label[near] = _labels(ground, static.mean_m[near])
    static = dataclasses.replace(static, label=label)
    added = _discs(ground, gathered, ~_covered(ground, static[near]))
    if len(added) and static.sh_rest is not None:
        harmonics = np.zeros((len(added), *static.sh_rest.shape[1:]), np.float32)
        added = dataclasses.replace(added, sh_rest=harmonics)
    everything = Gaussians.concatenate([static, added]) if len(added) else static
    seen = np.arange(len(everything)) < len(static)
    rgb = colours_by_likeness(everything, seen)
    return dataclasses.replace(scene, static=dataclasses.replace(everything, rgb=rgb))


def _labels(ground: Ground, xyz_m: Float32[np.ndarray, "n 3"]) -> UInt8[np.ndarray, " n"]:
    row, column, _ = ground.cells(xyz_m)
    return np.where(ground.road[row, column], Label.ROAD, Label.OTHER).astype(np.uint8)


def _covered(ground: Ground, near: Gaussians) -> Bool[np.ndarray, "rows columns"]:
    """Cells of the ground that Gaussians near it cover; their reach is rounded down to powers of two."""
    near = near[near.opacity >= VISIBLE]
    reach_m = np.maximum(REACH * near.scale_m.max(axis=1), LEAST_REACH_M)
    octave = np.floor(np.log2(reach_m / LEAST_REACH_M)).astype(int)
    row, column, _ = ground.cells(near.mean_m)
    covered = np.zeros(ground.height_m.shape, bool)
    for each in np.unique(octave):
        empty = np.ones(covered.shape, np.uint8)
        empty[row[octave == each], column[octave == each]] = 0
        distance_m = cv2.distanceTransform(empty, cv2.DIST_L2, 5) * ground.cell_m
        covered |= distance_m <= LEAST_REACH_M * 2.0**each
    return covered


def _discs(ground: Ground, gathered: Gathered, where: Bool[np.ndarray, "rows columns"]) -> Gaussians:
    """The sheet of the ground in some of its cells, black."""
    sheet = ground.sheet(gathered.static)
    row, column, _ = ground.cells(sheet.xyz_m)
    sheet, normal = sheet[where[row, column]], ground.normals[row, column][where[row, column]].astype(np.float32)
    black, sigma_m = np.zeros((len(sheet), 3), np.float32), surfaces.LATTICE_SIGMA * sheet.spacing_m
    label = _labels(ground, sheet.xyz_m)
    return surfaces.discs(sheet.xyz_m, normal, sigma_m, black, sheet.intensity, label, OPACITY)
