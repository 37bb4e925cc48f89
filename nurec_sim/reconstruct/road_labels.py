"""Road and other ground told apart by the LiDAR, for methods whose own labels come from images.

Images show asphalt in the shade and far away as they show pavement; sweeps measure the kerb between the two. So where
sweeps have measured the ground, Gaussians near it are road as far as a car can drive from the path without meeting a
step (``lift.road``), and nothing else there is.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import UInt8

from nurec_sim.errors import ReconstructError
from nurec_sim.reconstruct.lift.bodies import ground_of
from nurec_sim.reconstruct.lift.points import actors_of, gather
from nurec_sim.reconstruct.lift.settings import GroundSettings, PointSettings
from nurec_sim.types import Clip, GaussianScene, Label

NEAR_M = 0.7
"""Gaussians within this height of the ground are part of it, for depth from images is no better: what hovers over
measured road is road that images put too high, since the LiDAR saw nothing upright there."""
NOTE = "no map: the road is grown from the driven path up to height steps that the LiDAR has measured"


def with_measured_road(scene: GaussianScene, clip: Clip, hold_out: set[int]) -> GaussianScene:
    """A scene whose static Gaussians are road where the sweeps of its log say so.

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
            f"clip {clip.id!r} has no LiDAR returns to label the road by, with sweeps {sorted(hold_out)} held out; "
            "the network's own labels need road_labels='network'"
        )
    ground = ground_of(clip, gathered, GroundSettings())
    static = scene.static
    near = np.isin(static.label, (Label.ROAD, Label.OTHER)) & (np.abs(ground.above(static.mean_m)) < NEAR_M)
    row, column, _ = ground.cells(static.mean_m[near])
    label: UInt8[np.ndarray, " n"] = static.label.copy()
    label[near] = np.where(ground.road[row, column], Label.ROAD, Label.OTHER)
    return dataclasses.replace(scene, static=dataclasses.replace(static, label=label))
