"""LiDAR measurements: exact, with one ray per beam, or resampled from OpenGL images; echoes and dropped beams."""

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
"""Cosine of incidence where a rendered surface is too thin for a normal."""
FAINTEST_ECHO = 0.008
ECHO_AT_M = 50.0
CLEAR = 0.06
"""Surfaces of lower reflectivity transmit most of the light or mirror it away: glass, wet paint, water."""


@dataclass(frozen=True)
class TrueScan:
    """A LiDAR turn as measured, ``[rows, columns]``: range (0 no return), intensity 0..1, class and instance."""

    range_m: Float64[np.ndarray, "r c"]
    intensity: Float32[np.ndarray, "r c"]
    surface: UInt8[np.ndarray, "r c"]
    instance: Int32[np.ndarray, "r c"]


@dataclass(frozen=True)
class LidarResponse:
    """Deviations of a real LiDAR from an ideal one.

    Args:
        drop: factor on the probability that a faint echo, or one from glass, is lost; 0 keeps all, 1 is usual.
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
class BeamHits:
    """First hits of all beams of a turn: geom ids (-1 no hit), distance (m) and cosine of incidence."""

    geom: Int32[np.ndarray, "r c"]
    range_m: Float64[np.ndarray, "r c"]
    cosine: Float64[np.ndarray, "r c"]


def cast_turn(stage: Stage, request: SensorRequest, lidar: LidarModel) -> BeamHits:
    """A turn with one ray per beam, each column from the poses of sensor and actors at its firing time."""
    beams, fractions = sensors.beam_directions(lidar), sensors.column_fraction(lidar)
    moments, shape = stage.moments(request, fractions), beams.shape[:2]
    turn = BeamHits(np.empty(shape, np.int32), np.empty(shape), np.empty(shape))
    for column in range(shape[1]):
        pose = moments.enter(column)
        direction = beams[:, column] @ pose[:3, :3].T
        geom, range_m, normal = rays.cast(stage.town, stage.data, pose[:3, 3], direction, lidar.range_m[1])
        turn.geom[:, column], turn.range_m[:, column] = geom, range_m
        turn.cosine[:, column] = -np.einsum("nc,nc->n", normal, direction)
    return turn


def rasterised_turn(stage: Stage, request: SensorRequest, lidar: LidarModel) -> BeamHits:
    """A turn from OpenGL images: one sector at a time, rendered at the sector's middle instant.

    Every beam is then intersected, from the sensor's true position at firing, with the plane seen in its direction, so
    that surfaces are exact although the sensor moves. Edges may be off by the sensor's motion within half a sector,
    actors by their own.
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
        # Beams in the frame of the rendered image: origin o and direction d per column.
        middle_from_fired = geometry.inverse(pose) @ moments.world_from_sensor[patch.columns]
        direction = np.einsum("cij,rcj->rci", middle_from_fired[:, :3, :3], patch.rays)
        origin = middle_from_fired[:, :3, 3]
        normal, distance = part.normal.astype(np.float64), part.range_m.astype(np.float64)
        known = normal.any(axis=-1)
        # Plane through p = distance * ray with normal n: the beam o + t d meets it at t = n (p - o) / (n d), where
        # height is -n (p - o) and met is -n d.
        met = np.where(known, -np.einsum("rci,rci->rc", normal, direction), 1.0)
        height = -np.einsum("rci,rci->rc", normal, distance[..., None] * patch.rays - origin)
        # Without a plane only the motion along the beam is compensated.
        straight = distance - np.einsum("ci,rci->rc", origin, direction)
        # A beam almost parallel to the surface intersects its plane at an arbitrary distance.
        on_plane = np.where(met > 1e-3, height / np.maximum(met, 1e-3), straight)
        # Large corrections are no longer on the visible part of the plane.
        near = known & (np.abs(on_plane - straight) < 0.2 * distance)
        range_m[:, patch.columns] = np.where(near, on_plane, straight)
        cosine[:, patch.columns] = np.where(known, met, UNKNOWN_COSINE)
    return BeamHits(seen.geom, range_m, cosine)


def measure(
    town: Town, lidar: LidarModel, turn: BeamHits, response: LidarResponse | None = None, seed: Sequence[int] = ()
) -> TrueScan:
    """The measurement that the sensor reports for a turn.

    Args:
        town: the compiled town, for class, instance and reflectivity of geoms.
        lidar: the sensor, for its range.
        turn: first hits of all beams.
        response: drop-outs and noise; if None every surface within range returns, without noise.
        seed: of the random drop-outs and noise.
    """
    near, far = lidar.range_m
    # mj_multiRay culls whole geoms by distance, so a large one may still be hit beyond the reach.
    returned = (turn.geom >= 0) & (turn.range_m >= near) & (turn.range_m <= far)
    reflectivity = town.geom_reflectivity[turn.geom]
    range_m = turn.range_m
    if response is not None:
        rng = np.random.default_rng(list(seed))
        # Misses have distance 0; the lower bound keeps it out of the division.
        lost = drop_probability(reflectivity, turn.cosine, np.maximum(range_m, near)) * response.drop
        returned &= rng.random(lost.shape) >= lost
        range_m = np.maximum(range_m + response.range_noise_m * rng.standard_normal(lost.shape), near)
    intensity = np.where(returned, rays.reflected(reflectivity, turn.cosine), np.float32(0))
    surface, instance = named(town, np.where(returned, turn.geom, -1))
    return TrueScan(np.where(returned, range_m, 0.0), intensity, surface, instance)


def drop_probability(
    reflectivity: Float64[np.ndarray, "*n"], cosine: Float64[np.ndarray, "*n"], range_m: Float64[np.ndarray, "*n"]
) -> Float64[np.ndarray, "*n"]:
    """Probability that a beam is lost: echoes fade with distance and grazing incidence, and glass hardly returns any.

    Our own model, with the shape of measured drop-out: asphalt is lost half of the time at 50 m for a sensor at 1.9 m.
    """
    # Received power of a Lambertian surface that fills the beam falls with the square of the distance.
    echo = reflectivity * np.clip(cosine, 0, 1) * (ECHO_AT_M / range_m) ** 2
    through = np.exp(-((reflectivity / CLEAR) ** 2))
    # A beam returns if its echo is detected and the surface does not transmit it.
    return 1 - (1 - np.exp(-echo / FAINTEST_ECHO)) * (1 - through)


def measured_points(
    lidar: LidarModel, scan: TrueScan
) -> tuple[Float64[np.ndarray, "n 3"], Float32[np.ndarray, " n"], Int32[np.ndarray, " n"]]:
    """Returns of a turn: points in the LiDAR frame at their own firing time, intensity, and beam index (row-major)."""
    beam = np.flatnonzero(scan.range_m.ravel() > 0).astype(np.int32)
    directions = sensors.beam_directions(lidar).reshape(-1, 3)[beam]
    return directions * scan.range_m.ravel()[beam, None], scan.intensity.ravel()[beam], beam
