"""The rigid bodies of a clip, the static world and each actor, as measured surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from nurec_sim.compute.cores import in_order
from nurec_sim.reconstruct.free_space import BeamCounts, SweepBeams, balls, count_beams, in_free_space, weighed
from nurec_sim.reconstruct.lift import surfaces
from nurec_sim.reconstruct.lift.cloud import Cloud, thinned
from nurec_sim.reconstruct.lift.ground import Ground, find_ground
from nurec_sim.reconstruct.lift.points import Actor, Gathered
from nurec_sim.reconstruct.lift.settings import GroundSettings, LiftSettings
from nurec_sim.types import Clip, Gaussians, Label

LEVEL = 0.97
"""Vertical part of a normal from which a surface counts as level, as ground is that lies beyond the height grid."""
SHEET_M = 0.08
"""Points so near to the ground are part of its sheet."""
LOW_M = 0.3
"""Up to this height beams graze what stands on the ground: the depth of grass along them is not noise of returns."""


@dataclass(frozen=True)
class Surfels:
    """The measured surface of one rigid body (``actor`` None: the static world), in its frame.

    ``spacing_m`` is the distance between points, ``sigma_m`` the standard deviation of discs that close the surface.
    """

    actor: Actor | None
    cloud: Cloud
    normal: Float32[np.ndarray, "n 3"]
    spacing_m: Float32[np.ndarray, " n"]
    sigma_m: Float32[np.ndarray, " n"]
    label: UInt8[np.ndarray, " n"]

    def world_from_body(self, t_us: int) -> np.ndarray:
        """Where the body is."""
        return np.eye(4) if self.actor is None else self.actor.path.at(t_us)

    def count_beams(self, gaussians: Gaussians, beams: Sequence[SweepBeams]) -> BeamCounts:
        """Recorded beams that met Gaussians of the body, in its frame."""
        if self.actor is None:
            return count_beams(gaussians, beams)
        times_us = np.array([sweep.middle_us for sweep in beams], np.int64)
        times_us = times_us[self.actor.present(times_us)]
        # All at once: one pose of a path takes nearly as long as hundreds.
        poses = dict(zip(times_us.tolist(), self.actor.path.at(times_us), strict=True))
        return count_beams(gaussians, beams, poses.get, self.box_size_m)

    def ended_share(self, counts: BeamCounts) -> Float64[np.ndarray, " n"]:
        """Share of beams that ended at each Gaussian within their noise; if the body moves, within the margin."""
        still = self.actor is None or self.actor.standing
        return counts.ended_share if still else counts.stopped_share

    def outside_free_space(
        self, gaussians: Gaussians, beams: Sequence[SweepBeams], ground: Ground
    ) -> tuple[Gaussians, Bool[np.ndarray, " n"]]:
        """Those Gaussians of the body that are not in free space, as opaque as beams found them; and which these are.

        The ground, and what is level where none is known, stays opaque: beams graze it, and a centimetre of its height
        decides whether they pass. What is low over it is as opaque as beams found it within the margin for poses.
        """
        counts = self.count_beams(gaussians, beams)
        kept, share = ~counts.free, self.ended_share(counts)
        if self.actor is None:
            above = ground.above(gaussians.mean_m)
            level = np.isinf(above) & (gaussians.normal[:, 2] > LEVEL)
            share = np.where(above < LOW_M, counts.stopped_share, share)
            share = np.where(level | (np.abs(above) < SHEET_M), 1.0, share)
        return weighed(gaussians, share)[kept], kept

    @property
    def box_size_m(self) -> tuple[float, float, float]:
        """Size of the actor's box; infinite for the world."""
        return (np.inf,) * 3 if self.actor is None else self.actor.track.size_m

    def present(self, t_us: int) -> bool:
        """Whether the body is known to be there."""
        return self.actor is None or bool(self.actor.present(np.array(t_us)))


def surfels_of(
    clip: Clip, actors: Sequence[Actor], gathered: Gathered, settings: LiftSettings
) -> tuple[list[Surfels], Ground]:
    """Surfels of the static world and of each actor; ground within reach becomes one regular sheet.

    Args:
        clip: the driving log; its ego poses are the driven path.
        actors: movable tracks.
        gathered: the thinned points of all sweeps.
        settings: ``ground``, and the carving of ``points``.

    Returns:
        The static world's surfels first, then one entry per actor; and the ground.
    """
    ground = ground_of(clip, gathered, settings.ground)

    def made(number: int) -> Surfels:
        if number == 0:
            return _world_surfels(gathered, ground, settings.points.carve)
        return _actor_surfels(number - 1, actors[number - 1], gathered, ground)

    return list(in_order(made, range(1 + len(actors)), 1 + len(actors))), ground


def ground_of(clip: Clip, gathered: Gathered, settings: GroundSettings) -> Ground:
    """The ground under the driven path of a clip, by its gathered sweeps."""
    feet = [world for _, world in gathered.feet.values()]
    under = np.concatenate(feet) if feet else None
    return find_ground(gathered.static.xyz_m, clip.ego.world_from_body, settings, under, gathered.sweep_count)


def _world_surfels(gathered: Gathered, ground: Ground, carve: bool) -> Surfels:
    static = gathered.static
    sheet, standing = ground.sheet(static), static[~(np.abs(ground.above(static.xyz_m)) < SHEET_M)]
    if carve:
        ghosts = in_free_space(balls(standing.xyz_m, surfaces.DISC_SIGMA * standing.spacing_m), gathered.beams)
        standing = standing[~ghosts]
    standing, normal, spacing, sigma = surfaces.surface_of(standing)
    row, column, _ = ground.cells(sheet.xyz_m)
    road = ground.road[row, column]
    return Surfels(
        None,
        Cloud.concatenate([standing, sheet]),
        np.concatenate([normal, ground.normals[row, column].astype(np.float32)]),
        np.concatenate([spacing, sheet.spacing_m]),
        np.concatenate([sigma, surfaces.LATTICE_SIGMA * sheet.spacing_m]),
        np.concatenate([np.full(len(standing), Label.OTHER), np.where(road, Label.ROAD, Label.OTHER)]).astype(np.uint8),
    )


def _actor_surfels(number: int, actor: Actor, gathered: Gathered, ground: Ground) -> Surfels:
    cloud = gathered.actors[number]
    if number in gathered.feet:
        box_feet, world_feet = gathered.feet[number]
        off_ground = ~(np.abs(ground.above(world_feet)) < SHEET_M)
        cloud = Cloud.concatenate([cloud, thinned(box_feet[off_ground])])
    cloud, normal, spacing, sigma = surfaces.surface_of(cloud)
    return Surfels(actor, cloud, normal, spacing, sigma, np.full(len(cloud), Label.MOVABLE, np.uint8))
