"""What a turning LiDAR measures: exactly, a ray per beam, or read from OpenGL images; echoes and lost beams."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8

from nurec_sim import geometry, sensors
from nurec_sim.types import LidarModel, SensorRequest
from nurec_sim.world.model.assemble import Town
from nurec_sim.world.sense import rays
from nurec_sim.world.sense.faces import Seen
from nurec_sim.world.sense.shutter import lidar_patches
from nurec_sim.world.sense.stage import Stage, named

UNKNOWN_COSINE = 0.7
"""Incidence where a drawn surface is too thin to tell its normal."""
FAINTEST_ECHO = 0.008
ECHO_AT_M = 50.0
CLEAR = 0.06
"""Surfaces that reflect less than this let most of the light through or mirror it away: glass, wet paint, water."""


@dataclass(frozen=True)
class TrueScan:
    """A LiDAR turn as measured, ``[rows, columns]``: range (0 no return), intensity 0..1, class and instance."""

    range_m: Float64[np.ndarray, "r c"]
    intensity: Float32[np.ndarray, "r c"]
    surface: UInt8[np.ndarray, "r c"]
    instance: Int32[np.ndarray, "r c"]


@dataclass(frozen=True)
class LidarResponse:
    """How a real LiDAR differs from an ideal one.

    Args:
        drop: scales the probability that a faint echo, or one of glass, is lost; 0 keeps all, 1 is usual.
        range_noise_m: standard deviation of the measured range.

    Raises:
        ValueError: a value is negative or not finite.
    """

    drop: float = 1.0
    range_noise_m: float = 0.0

    def __post_init__(self) -> None:
        if not (0 <= self.drop < np.inf and 0 <= self.range_noise_m < np.inf):
            raise ValueError(
                "drop and range_noise_m must be finite and not negative, "
                f"got drop={self.drop}, range_noise_m={self.range_noise_m}"
            )


@dataclass(frozen=True, eq=False)
class Turn:
    """What all beams of a turn meet: geom ids (-1 nothing), distance and cosine of the incidence."""

    geom: Int32[np.ndarray, "r c"]
    range_m: Float64[np.ndarray, "r c"]
    cosine: Float64[np.ndarray, "r c"]


def cast_turn(stage: Stage, request: SensorRequest, lidar: LidarModel) -> Turn:
    """A turn by one ray per beam, each column from where the sensor and the actors are when it fires."""
    beams, fractions = sensors.beam_directions(lidar), sensors.column_fraction(lidar)
    moments, shape = stage.moments(request, fractions), beams.shape[:2]
    turn = Turn(np.empty(shape, np.int32), np.empty(shape), np.empty(shape))
    for column in range(shape[1]):
        pose = moments.enter(column)
        direction = beams[:, column] @ pose[:3, :3].T
        geom, range_m, normal = rays.cast(stage.town, stage.data, pose[:3, 3], direction, lidar.range_m[1])
        turn.geom[:, column], turn.range_m[:, column] = geom, range_m
        turn.cosine[:, column] = -np.einsum("nc,nc->n", normal, direction)
    return turn


def drawn_turn(stage: Stage, request: SensorRequest, lidar: LidarModel) -> Turn:
    """A turn from OpenGL images: a sector at a time, seen from the sector's middle instant.

    Every beam then meets the plane that was seen in its direction from where the sensor really is when it fires, so
    that surfaces are exact although the sensor moves; edges may be off by as much as it moves within half a sector,
    actors by as much as they do.
    """
    columns = sensors.column_fraction(lidar)
    moments = stage.moments(request, columns)
    patches = lidar_patches(lidar)
    middles = stage.moments(request, np.array([patch.fraction for patch in patches]))
    shape = (len(lidar.elevation_rad), len(lidar.azimuth_rad))
    seen = Seen.nothing(*shape)
    range_m, cosine = np.zeros(shape), np.full(shape, UNKNOWN_COSINE)
    for index, patch in enumerate(patches):
        pose = middles.enter(index)
        part = seen.part(patch.rows, patch.columns)
        stage.look(patch, pose, part, colours=False)
        middle_from_fired = geometry.inverse(pose) @ moments.world_from_sensor[patch.columns]
        direction = np.einsum("cij,rcj->rci", middle_from_fired[:, :3, :3], patch.rays)
        origin = middle_from_fired[:, :3, 3]
        normal, distance = part.normal.astype(np.float64), part.range_m.astype(np.float64)
        known = normal.any(axis=-1)
        met = np.where(known, -np.einsum("rci,rci->rc", normal, direction), 1.0)
        height = -np.einsum("rci,rci->rc", normal, distance[..., None] * patch.rays - origin)
        straight = distance - np.einsum("ci,rci->rc", origin, direction)
        # A beam along the surface meets its plane anywhere.
        on_plane = np.where(met > 1e-3, height / np.maximum(met, 1e-3), straight)
        near = known & (np.abs(on_plane - straight) < 0.2 * distance)
        range_m[:, patch.columns] = np.where(near, on_plane, straight)
        cosine[:, patch.columns] = np.where(known, met, UNKNOWN_COSINE)
    return Turn(seen.geom, range_m, cosine)


def measure(
    town: Town, lidar: LidarModel, turn: Turn, response: LidarResponse | None = None, seed: Sequence[int] = ()
) -> TrueScan:
    """What the sensor reports of a turn; without a response all surfaces within its range return."""
    near, far = lidar.range_m
    # mj_multiRay leaves out whole geoms by their distance, so a large one still answers beyond the reach.
    returned = (turn.geom >= 0) & (turn.range_m >= near) & (turn.range_m <= far)
    reflectivity = town.geom_reflectivity[turn.geom]
    range_m = turn.range_m
    if response is not None:
        rng = np.random.default_rng(list(seed))
        lost = drop_probability(reflectivity, turn.cosine, np.maximum(range_m, near)) * response.drop
        returned &= rng.random(lost.shape) >= lost
        range_m = np.maximum(range_m + response.range_noise_m * rng.standard_normal(lost.shape), near)
    intensity = np.where(returned, rays.reflected(reflectivity, turn.cosine), np.float32(0))
    surface, instance = named(town, np.where(returned, turn.geom, -1))
    return TrueScan(np.where(returned, range_m, 0.0), intensity, surface, instance)


def drop_probability(
    reflectivity: Float64[np.ndarray, "*n"], cosine: Float64[np.ndarray, "*n"], range_m: Float64[np.ndarray, "*n"]
) -> Float64[np.ndarray, "*n"]:
    """How likely a beam is lost: its echo fades with distance and grazing incidence, and glass gives hardly any.

    A model of ours in the shape of measured ones: asphalt is lost half of the time at 50 m for a sensor at 1.9 m.
    """
    echo = reflectivity * np.clip(cosine, 0, 1) * (ECHO_AT_M / range_m) ** 2
    through = np.exp(-((reflectivity / CLEAR) ** 2))
    return 1 - (1 - np.exp(-echo / FAINTEST_ECHO)) * (1 - through)


def measured_points(
    lidar: LidarModel, scan: TrueScan
) -> tuple[Float64[np.ndarray, "n 3"], Float32[np.ndarray, " n"], Int32[np.ndarray, " n"]]:
    """Returns of a turn: points in the frame of the LiDAR at their own instant, intensity, beam (row-major)."""
    beam = np.flatnonzero(scan.range_m.ravel() > 0).astype(np.int32)
    directions = sensors.beam_directions(lidar).reshape(-1, 3)[beam]
    return directions * scan.range_m.ravel()[beam, None], scan.intensity.ravel()[beam], beam
