"""All metrics of one rollout, with fixed names and order."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from nurec_sim.metrics.collision import check_profile, collision_series
from nurec_sim.metrics.comfort import braking_series, comfort_series, feasibility_series
from nurec_sim.metrics.offroad import offroad_series, true_offroad_series
from nurec_sim.metrics.offroad_grid import OffroadGrid
from nurec_sim.metrics.plans import plan_series
from nurec_sim.metrics.progress import progress_series, proximity_series
from nurec_sim.metrics.series import METRICS, make_series, times_of, unknown_series
from nurec_sim.types import RoadMap, Rollout, Series


def score_rollout(
    rollout: Rollout,
    grid: OffroadGrid | None,
    road_map: RoadMap | None = None,
    profile: str = "strict",
    actors_known: bool | None = None,
    support: Mapping[int, float] | None = None,
) -> list[Series]:
    """Computes the metrics of a rollout, including failed ones up to their last state.

    A metric that cannot be computed is a series without valid samples; none is missing or defaults to 0. States of the
    log replay (before ``rollout.first_closed_loop_us``) are invalid in every metric but ``eval_relevant``.

    Args:
        rollout: the rollout.
        grid: road grid of the reconstruction; None makes ``offroad`` invalid.
        road_map: the log's map, for ``offroad_true``.
        profile: ``strict`` or ``alpasim``, see ``metrics.collision``.
        actors_known: whether the log has actor labels; None: if the rollout has any actor.
        support: of the images that the policy got, 0..1 by time in microseconds; None if not known.

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
        braking_series(rollout),
        *comfort_series(rollout),
        *feasibility_series(rollout),
        *plan_series(rollout),
        *_support_series(rollout, support or {}),
    ]
    by_name = {series.name: series for series in found}
    assert by_name.keys() == METRICS.keys(), sorted(by_name.keys() ^ METRICS.keys())
    return [_only_relevant(by_name[name], rollout.first_closed_loop_us) for name in METRICS]


def _support_series(rollout: Rollout, support: Mapping[int, float]) -> list[Series]:
    names = ("support", "support_least")
    if not support:
        return [unknown_series(name, times_of(rollout)) for name in names]
    return [make_series(name, np.array(list(support), np.int64), np.array(list(support.values()))) for name in names]


def _only_relevant(series: Series, from_us: int) -> Series:
    if series.name == "eval_relevant":
        return series
    valid = series.valid & (series.t_us >= from_us)
    return dataclasses.replace(series, values=np.where(valid, series.values, np.nan), valid=valid)
