"""How well the road of a reconstruction agrees with the true road: off-road verdicts, and where the boundary lies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from nurec_sim import geometry
from nurec_sim.metrics.offroad import TOLERANCE_M, RoadState, corners_outside_m, judge_footprints
from nurec_sim.metrics.offroad_grid import OffroadGrid
from nurec_sim.scene.opendrive.road_area import drivable_area
from nurec_sim.types import Box, RoadMap, Trajectory

STATION_M = 0.5
STEP_M = 0.02
REACH_M = 8.0


@dataclass(frozen=True)
class RoadAgreement:
    """Agreement of the Gaussian grid with the true polygon at random placements, and along its boundary.

    ``agreement`` excludes unknown placements. ``false_alarms`` are off in the grid only, ``misses`` off in the polygon
    only. ``error_margin_p95_m``: distance of the true excursion from the tolerance where the two disagree (NaN if they
    never do). ``boundary_bias_m``: see ``boundary_bias_m``, NaN where no boundary was found.
    """

    placements: int
    known: int
    agreement: float
    unknown_frac: float
    false_alarms: int
    misses: int
    error_margin_p95_m: float
    boundary_bias_m: float


def road_agreement(
    grid: OffroadGrid,
    road_map: RoadMap | None,
    ego: Trajectory,
    body: Box,
    placements: int = 900,
    seed: int = 0,
    max_offset_m: float = 5.5,
) -> RoadAgreement:
    """Compares the grid with the true drivable area at footprints beside the recorded path.

    Placements are uniform along the path and to either side, heading along it.

    Args:
        grid: road grid of the reconstruction.
        road_map: the true map.
        ego: the recorded path.
        body: the car's body in the rig frame.
        placements: number of random footprints.
        seed: of the placements.
        max_offset_m: largest lateral offset from the path, metres.

    Raises:
        ValueError: there is no map, it has no drivable area, or the path is shorter than a metre.
    """
    if road_map is None or not road_map.drivable:
        raise ValueError("there is no road map with a drivable area to compare with")
    length_m = float(_arc_length(ego)[-1])
    if length_m < 1.0:
        raise ValueError(f"the recorded path is {length_m:.2f} m long; at least 1 m is needed to place footprints")
    draw = np.random.default_rng(seed)
    at, offset = draw.uniform(0, length_m, placements), draw.uniform(-max_offset_m, max_offset_m, placements)
    poses = _poses_at(ego, at)
    poses[:, :3, 3] += offset[:, None] * poses[:, :3, 1]
    verdict = judge_footprints(grid, poses, body).verdict
    beyond = corners_outside_m(drivable_area(road_map), poses, body)
    truth, known, predicted = beyond > TOLERANCE_M, verdict != RoadState.UNKNOWN, verdict == RoadState.OFF
    wrong = known & (predicted != truth)
    margin = float(np.quantile(np.abs(beyond[wrong] - TOLERANCE_M), 0.95)) if wrong.any() else float("nan")
    count = int(known.sum())
    return RoadAgreement(
        placements, count, 1 - float(wrong.sum()) / count if count else float("nan"), 1 - count / placements,
        int((wrong & predicted).sum()), int((wrong & truth).sum()), margin, boundary_bias_m(grid, road_map, ego),
    )  # fmt: skip


def boundary_bias_m(grid: OffroadGrid, road_map: RoadMap, ego: Trajectory) -> float:
    """How much farther from the recorded path the grid's road ends than the true one: median, metres; NaN if not known.

    Every 0.5 m along the path both boundaries are looked for at a right angle to it, to the left and to the right, up
    to 8 m away. Only true boundaries nearer than that count, and only where no unknown cell lies before the grid's.
    Positive: the reconstruction's road is too wide.
    """
    import shapely

    poses = _poses_at(ego, np.arange(0.0, float(_arc_length(ego)[-1]), STATION_M))
    across = np.arange(0.0, REACH_M, STEP_M)
    sides = np.concatenate([poses[:, :2, 1], -poses[:, :2, 1]])
    points = np.tile(poses[:, :2, 3], (2, 1))[:, None] + across[:, None] * sides[:, None]
    outside = ~shapely.contains_xy(drivable_area(road_map), points[..., 0], points[..., 1])
    possible, known, inside = grid.look_up(points)
    # From the centre of a road cell to that of its neighbour the distance grows from 0 to half a cell; the edge between
    # them lies half-way.
    edge = grid.cell_m / 4
    ends, unsure = inside & (possible > edge), ~inside | (known > edge)
    true_m, found_m, unsure_m = (_first(across, each) for each in (outside, ends, unsure & ~ends))
    counted = (true_m > 0) & (true_m < REACH_M) & (found_m > 0) & (unsure_m >= np.minimum(found_m, REACH_M))
    return float(np.median(found_m[counted] - true_m[counted])) if counted.any() else float("nan")


def _first(across_m: Float64[np.ndarray, " m"], reached: Bool[np.ndarray, "n m"]) -> Float64[np.ndarray, " n"]:
    """The first distance at which each row is true, ``REACH_M`` if none is."""
    return np.where(reached.any(axis=1), across_m[reached.argmax(axis=1)], REACH_M)


def _arc_length(ego: Trajectory) -> Float64[np.ndarray, " n"]:
    return geometry.arc_length(ego.position_m[:, :2])


def _poses_at(ego: Trajectory, at_m: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 4 4"]:
    """Poses of the recorded car after so many metres."""
    t_us = np.interp(at_m, _arc_length(ego), ego.t_us - ego.t_us[0]).astype(np.int64) + ego.t_us[0]
    return ego.at(t_us)
