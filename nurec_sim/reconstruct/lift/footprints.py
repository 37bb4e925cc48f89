"""Footprints of lifted pixels, and those that lie in the free space of recorded beams."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from nurec_sim.compute.cores import in_order
from nurec_sim.reconstruct.free_space import SweepBeams, weighed
from nurec_sim.reconstruct.lift import surfaces
from nurec_sim.reconstruct.lift.blocks import painted
from nurec_sim.reconstruct.lift.bodies import LEVEL, Surfels
from nurec_sim.reconstruct.lift.ground import Ground
from nurec_sim.reconstruct.lift.lifting import Lifted
from nurec_sim.reconstruct.lift.pictures import DepthPicture
from nurec_sim.reconstruct.lift.settings import LiftSettings
from nurec_sim.types import Gaussians, Label

GROUND_M = 0.12
"""Points so near to the ground belong to it."""
LOW_M, GRAZING = 0.5, 0.03
"""Pixels wrongly this low over the ground show the ground, unless their rays are flatter than this slope."""
PART = 32_768
"""Points that a thread works on at a time."""


def outside_free_space(
    lifted: Lifted, body: Surfels, ground: Ground, settings: LiftSettings, beams: Sequence[SweepBeams]
) -> tuple[Gaussians, Lifted]:
    """Footprints that recorded beams did not pass through, and the pixels that have none, because their depth is wrong.

    Pixels that hover low over the road show the road, and are moved down to it along their rays; dropped, they would
    leave a hole. Footprints at which beams end, and that only reach into free space by their stretch, are made round.
    """
    solid, kept = body.outside_free_space(footprints_of(lifted, body, ground, settings), beams, ground)
    parts, rest = [solid], lifted[~kept]
    if body.actor is None:
        low = _low(rest, ground)
        footprints = footprints_of(on_ground(rest, ground), body, ground, settings)
        parts.append(body.outside_free_space(footprints, beams, ground)[0])
        rest = rest[~low]
    footprints = footprints_of(rest, body, ground, settings, 1.0)
    counts = body.count_beams(footprints, beams)
    stays = (counts.stopped > 0) & (counts.stopped >= counts.passed)
    parts.append(weighed(footprints, body.ended_share(counts))[stays])
    return Gaussians.concatenate(parts), rest[~stays]


def marked_free(pictures: Sequence[DepthPicture], wrong: Lifted) -> list[DepthPicture]:
    """The pictures with the pixels of blocks of wrong depth marked as ``free``.

    Args:
        pictures: of the views that ``Lifted.view`` indexes.
        wrong: the blocks of wrong depth.
    """

    def marked(k: int) -> DepthPicture:
        mine = wrong.view == k
        here = painted(*pictures[k].free.shape, wrong.pixel[mine], wrong.edge[mine])
        return dataclasses.replace(pictures[k], free=pictures[k].free | here)

    return [marked(k) for k in range(len(pictures))]


def _low(lifted: Lifted, ground: Ground) -> Bool[np.ndarray, " n"]:
    return (ground.above(lifted.xyz_m) < LOW_M) & (lifted.ray[:, 2] < -GRAZING)


def on_ground(lifted: Lifted, ground: Ground) -> Lifted:
    """Lifted points low over the ground, moved along their rays down to it; all others are left out."""
    moved = lifted[_low(lifted, ground)]
    step = np.zeros(len(moved))
    for _ in range(3):  # the ground is not level
        above = ground.above(moved.xyz_m + step[:, None] * moved.ray)
        step += np.where(np.isfinite(above), above, 0.0) / -moved.ray[:, 2]
    xyz = moved.xyz_m + step[:, None] * moved.ray
    row, column, _ = ground.cells(xyz)
    depth = moved.depth_m + step
    return dataclasses.replace(
        moved,
        xyz_m=xyz,
        normal=ground.normals[row, column],
        depth_m=depth,
        pixel_m=moved.pixel_m * depth / moved.depth_m,
        surfel=np.full(len(moved), -1, np.int32),
    )[(np.abs(ground.above(xyz)) < GROUND_M) & (depth > 0)]


def on_level(lifted: Lifted, ground: Ground) -> Bool[np.ndarray, " n"]:
    """Lifted points on the ground, or on a surface within 14 degrees of level."""
    return (np.abs(ground.above(lifted.xyz_m)) < GROUND_M) | (lifted.normal[:, 2] > LEVEL)


def parts_of(count: int) -> list[slice]:
    """Rows 0..count in parts for threads."""
    return [slice(start, min(start + PART, count)) for start in range(0, count, PART)]


def footprints_of(
    everything: Lifted,
    body: Surfels,
    ground: Ground,
    settings: LiftSettings,
    most_stretch: float = surfaces.MOST_STRETCH_OF_GROUND,
) -> Gaussians:
    """Footprint Gaussians; label and intensity from the surfel that gave the depth, or from the ground below.

    ``most_stretch`` bounds their length over their width.
    """
    parts = in_order(
        lambda part: _footprints(everything[part], body, ground, settings, most_stretch), parts_of(len(everything))
    )
    return Gaussians.concatenate([Gaussians.empty(), *parts])


def _footprints(
    lifted: Lifted, body: Surfels, ground: Ground, settings: LiftSettings, most_stretch: float
) -> Gaussians:
    from_surfel = lifted.surfel >= 0
    n = len(lifted)
    label = np.full(n, Label.OTHER if body.actor is None else Label.MOVABLE, np.uint8)
    intensity = np.full(n, np.nan, np.float32)
    if len(body.cloud):
        label = np.where(from_surfel, body.label[lifted.surfel], label)
        intensity = np.where(from_surfel, body.cloud.intensity[lifted.surfel], intensity)
    stretch = np.full(n, surfaces.MOST_STRETCH)
    if body.actor is None:
        stretch = np.where(on_level(lifted, ground), surfaces.MOST_STRETCH_OF_GROUND, stretch)
        label = np.where(~from_surfel & ground.is_road(lifted.xyz_m), Label.ROAD, label)
    return surfaces.footprints(lifted.xyz_m, lifted.normal, lifted.ray, lifted.pixel_m, lifted.rgb / 255, intensity,
                               label, settings.opacity, np.minimum(stretch, most_stretch))  # fmt: skip
