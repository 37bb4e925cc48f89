"""Compares the reconstructions of a run: every rollout judged by the same actors and the same road."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from nurec_sim.metrics.aggregate import rollout_values, summarize
from nurec_sim.metrics.agreement import compare_worlds, noise_ceiling, paired_means
from nurec_sim.metrics.score import score_rollout
from nurec_sim.metrics.table import metric_table
from nurec_sim.report import Comparison
from nurec_sim.runs.scene_file import SceneRecord
from nurec_sim.types import Rollout, Series

if TYPE_CHECKING:
    import polars as pl

COMPARED = ("collision_any", "offroad", "collision_offroad_mean", "scene_score", "progress")


def compare_reconstructions(
    scored: Sequence[tuple[Rollout, Sequence[Series]]], records: Sequence[SceneRecord], profile: str
) -> tuple[Comparison, list[tuple[Rollout, Sequence[Series]]]] | None:
    """The comparison of a run and its rollouts, judged alike; None unless every scene has the same reconstructions.

    Off-road is judged by the log's map where all scenes have one, otherwise by the road of the first reconstruction:
    rollouts that are identical get identical values.

    Args:
        scored: the rollouts with their series.
        records: all scenes of the run.
        profile: of the metrics.
    """
    by_scene: dict[str, list[SceneRecord]] = {}
    for record in sorted(records, key=lambda record: (record.id, record.place)):
        by_scene.setdefault(record.id, []).append(record)
    orders = {tuple(record.reconstruction for record in group) for group in by_scene.values()}
    if len(orders) != 1 or len(worlds := next(iter(orders))) < 2:
        return None
    first: Mapping[str, SceneRecord] = {scene_id: group[0] for scene_id, group in by_scene.items()}
    if all(record.road_map is not None and record.road_map.drivable for record in first.values()):
        road, name = "offroad_true", "the map of the log"
        judged: list[tuple[Rollout, Sequence[Series]]] = [(rollout, _by_map(series)) for rollout, series in scored]
    else:
        road, name = "offroad", f"the road-class Gaussians of {worlds[0]}, because the log has no map"
        judged = [
            (rollout, score_rollout(rollout, record.grid, record.road_map, profile, record.actors_known))
            for rollout, record in ((rollout, first[rollout.scene_id]) for rollout, _ in scored)
        ]
    values = rollout_values(metric_table(judged, "comparison"), profile, road)
    return comparison_of(values, worlds, name), judged


def comparison_of(values: pl.DataFrame, worlds: Sequence[str], road: str) -> Comparison:
    """Every world against the first one.

    Args:
        values: rows of ``rollout_values``, judged by the same road and actors in all worlds.
        worlds: names of reconstructions, two or more.
        road: name of that road.
    """
    agreements, ceilings = {}, {}
    notes: dict[str, None] = {}
    for metric in COMPARED:
        for other in worlds[1:]:
            paired = paired_means(values, metric, (worlds[0], other))
            for policy in paired.left_out:
                notes[f"{policy}: no value of {metric} in {worlds[0]} or {other}"] = None
            if paired.trials_left_out:
                notes[f"{metric}: {paired.trials_left_out} trials left out, not known for every policy"] = None
            if paired.policies and paired.scenes:
                means = paired.by_world
                agreements[metric, other] = compare_worlds(metric, paired.policies, means[worlds[0]], means[other])
        ceilings[metric] = noise_ceiling(values, metric, worlds[0])
    return Comparison(tuple(worlds), road, values, summarize(values), agreements, ceilings, tuple(notes))


def _by_map(series: Sequence[Series]) -> list[Series]:
    """The same series, off-road by the map instead of by the Gaussians."""
    true = next(one for one in series if one.name == "offroad_true")
    return [dataclasses.replace(true, name="offroad") if one.name == "offroad" else one for one in series]
