"""Every metric of one rollout, always the same names in the same order."""

from __future__ import annotations

import dataclasses

import numpy as np

from nurec_sim.metrics.collision import check_profile, collision_series
from nurec_sim.metrics.comfort import comfort_series, feasibility_series
from nurec_sim.metrics.offroad import offroad_series, true_offroad_series
from nurec_sim.metrics.offroad_grid import OffroadGrid
from nurec_sim.metrics.plans import plan_series
from nurec_sim.metrics.progress import progress_series, proximity_series
from nurec_sim.metrics.series import METRICS, make_series, times_of
from nurec_sim.types import RoadMap, Rollout, Series


def score_rollout(
    rollout: Rollout,
    grid: OffroadGrid | None,
    road_map: RoadMap | None = None,
    profile: str = "strict",
    actors_known: bool | None = None,
) -> list[Series]:
    """Score one rollout, also a failed one, as far as it came.

    A metric that cannot be computed is a series that is nowhere valid; none is ever missing, none falls back to 0.
    States of the forced replay (before ``rollout.first_closed_loop_us``) are invalid in every metric but
    ``eval_relevant``.

    Args:
        rollout: what happened.
        grid: where the reconstruction has road; None makes ``offroad`` invalid.
        road_map: the log's map, for ``offroad_true``.
        profile: ``strict`` or ``alpasim``, see ``metrics.collision``.
        actors_known: whether the log knows its actors; None means it does if the rollout has any.

    Raises:
        ValueError: unknown profile, or actors that do not fit the states.
    """
    check_profile(profile)
    t_us = times_of(rollout)
    relevant = (t_us >= rollout.first_closed_loop_us) & bool(rollout.states)
    found = [
        make_series("eval_relevant", t_us, relevant),
        *collision_series(rollout, profile, actors_known),
        *offroad_series(rollout, grid),
        true_offroad_series(rollout, road_map),
        *progress_series(rollout),
        *proximity_series(rollout),
        *comfort_series(rollout),
        *feasibility_series(rollout),
        *plan_series(rollout),
    ]
    by_name = {series.name: series for series in found}
    assert by_name.keys() == METRICS.keys(), sorted(by_name.keys() ^ METRICS.keys())
    return [_only_relevant(by_name[name], rollout.first_closed_loop_us) for name in METRICS]


def _only_relevant(series: Series, from_us: int) -> Series:
    if series.name == "eval_relevant":
        return series
    valid = series.valid & (series.t_us >= from_us)
    return dataclasses.replace(series, values=np.where(valid, series.values, np.nan), valid=valid)
