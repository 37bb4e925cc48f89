"""Three-valued off-road test of the ego's footprint against the Gaussian road grid, and against the map if any.

A footprint is *off* if it extends more than ``TOLERANCE_M`` beyond all cells that may be road, *unknown* if that
depends on unknown cells, else *on*. Off counts from the second consecutive state on. Unknown states count as neither
(docs/metrics.md).
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from nurec_sim import geometry
from nurec_sim.metrics.boxes import body_boxes
from nurec_sim.metrics.offroad_grid import OffroadGrid
from nurec_sim.metrics.series import make_series, times_of, unknown_series
from nurec_sim.scene.opendrive.road_area import drivable_area
from nurec_sim.types import Box, RoadMap, Rollout, Series

TOLERANCE_M = 0.3
SAMPLE_STEP_M = 0.1
MAX_OUTSIDE_FRAC = 0.25


class RoadState(enum.IntEnum):
    """Result for one footprint."""

    ON = 0
    OFF = 1
    UNKNOWN = 2


@dataclass(frozen=True)
class FootprintStates:
    """Results for n footprints: verdict, largest excursion beyond possible road, fraction of area beyond it."""

    verdict: UInt8[np.ndarray, " n"]
    excursion_m: Float64[np.ndarray, " n"]
    area_frac: Float64[np.ndarray, " n"]


def judge_footprints(
    grid: OffroadGrid, world_from_rig: Float64[np.ndarray, "n 4 4"], body: Box, tolerance_m: float = TOLERANCE_M
) -> FootprintStates:
    """Classifies the body's footprint, sampled every 0.1 m, at n rig poses.

    Args:
        grid: road grid of the scene.
        world_from_rig: rig poses.
        body: the car's body in the rig frame.
        tolerance_m: excursion beyond the road that is still accepted.
    """
    centre = body_boxes(world_from_rig, body).world_from_box
    along, across = (
        np.linspace(-size / 2, size / 2, int(np.ceil(size / SAMPLE_STEP_M)) + 1) for size in body.size_m[:2]
    )
    offsets = np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1).reshape(-1, 2)
    yaw = geometry.yaw_of(centre)[:, None]
    x = centre[:, None, 0, 3] + offsets[:, 0] * np.cos(yaw) - offsets[:, 1] * np.sin(yaw)
    y = centre[:, None, 1, 3] + offsets[:, 0] * np.sin(yaw) + offsets[:, 1] * np.cos(yaw)
    possible, known, inside = grid.look_up(np.stack([x, y], axis=-1))
    # Points off the grid are neither off nor on; they count through their share of the footprint only.
    possible, known = np.where(inside, possible, 0.0), np.where(inside, known, 0.0)
    # Beyond all cells that *may* be road: off whatever the unknown cells are. Only beyond those that *are* road:
    # undecidable.
    off = (possible > tolerance_m).any(axis=1)
    unsure = (known > tolerance_m).any(axis=1) | ((~inside).mean(axis=1) > MAX_OUTSIDE_FRAC)
    verdict = np.where(off, RoadState.OFF, np.where(unsure, RoadState.UNKNOWN, RoadState.ON)).astype(np.uint8)
    return FootprintStates(verdict, possible.max(axis=1), (possible > 0).mean(axis=1))


def debounced(verdict: UInt8[np.ndarray, " t"]) -> tuple[Float64[np.ndarray, " t"], Bool[np.ndarray, " t"]]:
    """Off-road values and validity: 1 from the second consecutive ``OFF``; invalid where undecidable."""
    verdict = np.asarray(verdict)
    before = np.concatenate([[RoadState.ON], verdict[:-1]])
    off = verdict == RoadState.OFF
    # An OFF after an UNKNOWN may be the first or the second in a row, so it is undecidable too.
    values = (off & (before == RoadState.OFF)).astype(np.float64)
    valid = (verdict != RoadState.UNKNOWN) & ~(off & (before == RoadState.UNKNOWN))
    return values, valid


def offroad_series(rollout: Rollout, grid: OffroadGrid | None) -> list[Series]:
    """``offroad`` with excursion, area and unknown fractions; all invalid without a grid.

    Start rule: if both ego and recorded ego are off or unknown at the first evaluated state, the grid does not fit the
    scene and everything is invalid.
    """
    t_us = times_of(rollout)
    names = ("offroad", "offroad_max_excursion_m", "offroad_area_frac", "offroad_unknown_frac")
    if grid is None or not rollout.states:
        return [unknown_series(name, t_us) for name in names]
    found = judge_footprints(grid, rollout.world_from_rig, rollout.rig.body)
    first = _first_relevant(rollout)
    if found.verdict[first] != RoadState.ON:
        recorded = rollout.recorded.at(np.array([t_us[first]]))
        if judge_footprints(grid, recorded, rollout.rig.body).verdict[0] != RoadState.ON:
            return [unknown_series(name, t_us) for name in names]
    values, valid = debounced(found.verdict)
    known = found.verdict != RoadState.UNKNOWN
    return [
        make_series("offroad", t_us, values, valid),
        make_series("offroad_max_excursion_m", t_us, found.excursion_m, known),
        make_series("offroad_area_frac", t_us, found.area_frac, known),
        make_series("offroad_unknown_frac", t_us, ~known),
    ]


def true_offroad_series(rollout: Rollout, road_map: RoadMap | None) -> Series:
    """``offroad_true`` against the map's drivable polygons; invalid without one, or if it does not fit at the start."""
    t_us = times_of(rollout)
    if road_map is None or not road_map.drivable or not rollout.states:
        return unknown_series("offroad_true", t_us)
    area = drivable_area(road_map)
    outside = corners_outside_m(area, rollout.world_from_rig, rollout.rig.body) > TOLERANCE_M
    first = _first_relevant(rollout)
    if outside[first]:
        recorded = rollout.recorded.at(np.array([t_us[first]]))
        if corners_outside_m(area, recorded, rollout.rig.body)[0] > TOLERANCE_M:
            return unknown_series("offroad_true", t_us)
    values, valid = debounced(np.where(outside, RoadState.OFF, RoadState.ON))
    return make_series("offroad_true", t_us, values, valid)


def corners_outside_m(area, world_from_rig: Float64[np.ndarray, "n 4 4"], body: Box) -> Float64[np.ndarray, " n"]:
    """Largest distance of a body corner outside a shapely area, 0 if all are inside."""
    import shapely

    corners = geometry.box_corners_xy(body_boxes(world_from_rig, body).world_from_box, *body.size_m[:2])
    return shapely.distance(area, shapely.points(corners)).max(axis=1)


def _first_relevant(rollout: Rollout) -> int:
    relevant = np.flatnonzero(rollout.t_us >= rollout.first_closed_loop_us)
    return int(relevant[0]) if len(relevant) else 0
