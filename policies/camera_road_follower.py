"""Sees one front image, calls road what looks like the road under its bonnet, and drives where it is free.

The image is laid out on the ground (z = 0 of the rig) as a grid, colours are compared with those just ahead of the
car, and of a fan of two-arc paths the one with the most room is driven. No route, no map, no actors, no depth.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from nurec_sim import geometry
from nurec_sim.policies._paths import make_plan, pursue, toward_speed
from nurec_sim.types import CameraFrame, CameraModel, Needs, Observation, Plan, Rig

CELL_M, AHEAD_M, SIDE_M = 0.25, 32.0, 10.0
SEED_LENGTH_M, SEED_HALF_WIDTH_M = 4.0, 1.0
TINT_TOLERANCE, DARKER, BRIGHTER = 0.09, -0.9, 0.28
"""Road differs from the seed by at most this in log colour ratios, and by this in log brightness."""
SUNLIGHT, SUN_TOLERANCE, SUN_RANGE = (0.16, -0.17), 0.055, 2.0
"""Out of a shadow, lit by the sky, into the sun, log r/g and log b/g of asphalt change in this ratio to brightness."""
CAR_HALF_WIDTH_M, ROOM_WANTED_M = 1.15, 1.0
CURVATURES = np.array([-0.12, -0.08, -0.05, -0.03, -0.015, -0.006, 0.0, 0.006, 0.015, 0.03, 0.05, 0.08, 0.12])
FIRST_ARC_M = 10.0
BRAKE_MPS2, STOP_GAP_M, START_SPEED_MPS = 3.0, 3.0, 4.0


class CameraRoadFollower:
    """Steers for room on road-coloured ground; drives as fast as it can stop in what it sees free."""

    name = "camera_road_follower"
    needs = Needs(cameras=("front",), image_width_px=320)

    def __init__(self) -> None:
        self.reset(Rig({}, {}), 0)

    def reset(self, rig: Rig, seed: int) -> None:
        """Forget the road's colour and the speed at the start."""
        self.front_m = rig.body.center_m[0] + rig.body.size_m[0] / 2
        self.road_colour: Float64[np.ndarray, " 3"] | None = None
        self.cruise_mps: float | None = None
        self.curvature = 0.0

    def plan(self, observation: Observation) -> Plan:
        """Five seconds along the roomiest path."""
        if self.cruise_mps is None:
            self.cruise_mps = max(observation.ego.speed_mps, START_SPEED_MPS)
        frame = observation.cameras["front"]
        seen, colours = ground_view(frame)
        path, free_m = self.roomiest(self.blocked(seen, colours), seen)
        to_bumper = max(0.0, free_m - self.front_m - STOP_GAP_M)

        def accel_of(t_s: float, driven_m: float, speed: float) -> float:
            safe = math.sqrt(2 * BRAKE_MPS2 * max(0.0, to_bumper - driven_m))
            wanted = min(self.cruise_mps or 0.0, safe)
            return max(-6.0, 4 * (wanted - speed)) if safe < speed else toward_speed(wanted, speed)

        return make_plan(observation, pursue(path, observation.ego.speed_mps, accel_of))

    def blocked(self, seen: Bool[np.ndarray, "x y"], colours: Float64[np.ndarray, "x y 3"]) -> Bool[np.ndarray, "x y"]:
        """Seen ground cells that do not look like road; learns the road's colour from the seed ahead of the car."""
        first = int(np.argmax(seen[:, seen.shape[1] // 2]))
        rows, half = int(SEED_LENGTH_M / CELL_M), int(SEED_HALF_WIDTH_M / CELL_M)
        middle = seen.shape[1] // 2
        seed = np.zeros_like(seen)
        seed[first : first + rows, middle - half : middle + half] = True
        seed &= seen
        if seed.any():
            here = np.median(colours[seed], axis=0)
            if self.road_colour is None:
                self.road_colour = here
            elif looks_like(colours[seed], self.road_colour).mean() > 0.5:
                # The road's colour drifts; a car right ahead must not become "road".
                self.road_colour = 0.7 * self.road_colour + 0.3 * here
        if self.road_colour is None:
            return seen
        road = looks_like(colours, self.road_colour) | ~seen
        # Markings, cracks and single pixels are thinner than half a metre: opening the blocked cells removes them.
        return grown(~grown(road, 1), 1) & seen

    def roomiest(
        self, blocked: Bool[np.ndarray, "x y"], seen: Bool[np.ndarray, "x y"]
    ) -> tuple[Float64[np.ndarray, "k 2"], float]:
        """The best two-arc path and how far it is free: room and distance for it, bends against it."""
        first, second = (c.ravel() for c in np.meshgrid(CURVATURES, CURVATURES, indexing="ij"))
        station = np.arange(0.0, AHEAD_M, 0.5)
        paths = two_arcs(first, second, station)
        row = np.clip((paths[..., 0] / CELL_M).astype(np.int64), 0, blocked.shape[0] - 1)
        column = np.floor((paths[..., 1] + SIDE_M) / CELL_M).astype(np.int64)
        outside = (column < 0) | (column >= blocked.shape[1])
        column = np.clip(column, 0, blocked.shape[1] - 1)
        room = distance_to(blocked)[row, column]
        near = paths[..., 0] < np.argmax(seen.any(axis=1)) * CELL_M  # below the image's lower edge
        hidden = outside | (~seen[row, column] & ~near)
        stops = (room < CAR_HALF_WIDTH_M) | hidden
        free = np.where(stops.any(axis=1), station[np.argmax(stops, axis=1)], AHEAD_M)
        reached = station[None] < free[:, None]
        spare = np.clip(room - CAR_HALF_WIDTH_M, 0.0, ROOM_WANTED_M)
        mean_spare = (spare * reached).sum(axis=1) / np.maximum(reached.sum(axis=1), 1)
        bends = 25 * np.abs(first) + 12 * np.abs(second - first) + 20 * np.abs(first - self.curvature)
        best = int(np.argmax(free + 6 * mean_spare - bends))
        self.curvature = float(first[best])
        return paths[best, : max(2, int(free[best] / 0.5))], float(free[best])


def ground_view(frame: CameraFrame) -> tuple[Bool[np.ndarray, "x y"], Float64[np.ndarray, "x y 3"]]:
    """The image laid on the ground: which cells it shows, and their (log r/g, log b/g, log brightness)."""
    pixels = ground_pixels(frame.camera)
    seen = pixels[..., 0] >= 0
    rgb = smoothed(frame.rgb)[pixels[..., 1], pixels[..., 0]]
    logs = np.log(rgb + 4.0)
    return seen, np.stack([logs[..., 0] - logs[..., 1], logs[..., 2] - logs[..., 1], logs.mean(axis=-1)], axis=-1)


def ground_pixels(camera: CameraModel) -> np.ndarray:
    """Image column and row [x, y, 2] at which an ideal pinhole sees each ground cell; -1 where it does not."""
    x = (np.arange(int(AHEAD_M / CELL_M)) + 0.5) * CELL_M
    y = (np.arange(int(2 * SIDE_M / CELL_M)) + 0.5) * CELL_M - SIDE_M
    ground = np.stack(np.broadcast_arrays(x[:, None], y[None, :], 0.0), axis=-1)
    inside_camera = geometry.transform_points(geometry.inverse(camera.rig_from_camera), ground)
    depth = np.maximum(inside_camera[..., 2], 0.1)
    lens = camera.lens
    u = np.floor(lens.fx_px * inside_camera[..., 0] / depth + lens.cx_px)
    v = np.floor(lens.fy_px * inside_camera[..., 1] / depth + lens.cy_px)
    good = (inside_camera[..., 2] > 0.5) & (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px)
    return np.where(good[..., None], np.stack([u, v], axis=-1), -1).astype(np.int64)


def smoothed(rgb: UInt8[np.ndarray, "h w 3"]) -> Float64[np.ndarray, "h w 3"]:
    """Mean over 3 x 3 pixels."""
    padded = np.pad(rgb.astype(np.float64), ((1, 1), (1, 1), (0, 0)), mode="edge")
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 9


def looks_like(colours: Float64[np.ndarray, "*n 3"], road: Float64[np.ndarray, " 3"]) -> Bool[np.ndarray, "*n"]:
    """Whether log colours are the road's: same tint, and not much darker or brighter."""
    difference = colours - road
    brighter = difference[..., 2]
    tint = np.abs(difference[..., :2]).max(axis=-1)
    alike = (tint < TINT_TOLERANCE) & (brighter > DARKER) & (brighter < BRIGHTER)
    unsunned = np.abs(difference[..., :2] - brighter[..., None] * SUNLIGHT).max(axis=-1)
    return alike | ((unsunned < SUN_TOLERANCE) & (np.abs(brighter) < SUN_RANGE))


def grown(mask: Bool[np.ndarray, "x y"], cells: int) -> Bool[np.ndarray, "x y"]:
    """A mask widened by ``cells`` on every side."""
    padded = np.pad(mask, cells)
    n, m = mask.shape
    across = np.logical_or.reduce([padded[:, j : j + m] for j in range(2 * cells + 1)])
    return np.logical_or.reduce([across[i : i + n] for i in range(2 * cells + 1)])


def distance_to(blocked: Bool[np.ndarray, "x y"]) -> Float64[np.ndarray, "x y"]:
    """Metres to the next blocked cell, up to what matters, in steps of one cell (octagonal neighbourhoods)."""
    near, distance = blocked, np.zeros(blocked.shape)
    for i in range(int((CAR_HALF_WIDTH_M + ROOM_WANTED_M) / CELL_M) + 1):
        distance += ~near * CELL_M
        padded = np.pad(near, 1)
        cross = padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:] | near
        near = grown(near, 1) if i % 2 else cross
    return distance


def two_arcs(
    first: Float64[np.ndarray, " p"], second: Float64[np.ndarray, " p"], station: Float64[np.ndarray, " s"]
) -> Float64[np.ndarray, "p s 2"]:
    """Points of paths that bend by ``first`` for 10 m and by ``second`` from there."""
    bend = np.where(station < FIRST_ARC_M, first[:, None], second[:, None])
    step = np.diff(station, prepend=0.0)
    yaw = np.cumsum(bend * step, axis=1)
    middle = yaw - bend * step / 2
    return np.stack([np.cumsum(step * np.cos(middle), axis=1), np.cumsum(step * np.sin(middle), axis=1)], axis=-1)
