"""Gathers the rollouts of a study and compares its worlds."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import polars as pl

from nurec_sim.errors import RunError
from nurec_sim.metrics.agreement import (
    Agreement,
    Difference,
    Estimate,
    compare_worlds,
    paired_means,
    policy_differences,
    tau_b_drop,
)
from nurec_sim.report import Comparison
from nurec_sim.runs import folder as layout
from nurec_sim.runs.compared import COMPARED, comparison_of
from nurec_sim.study.braking import Braking, first_braking
from nurec_sim.study.config import StudyConfig, control_name
from nurec_sim.study.doubt import Doubt, doubts
from nurec_sim.study.road import Road, measure_roads
from nurec_sim.study.tasks import ROLLOUTS, VALUES

RANKED_BY = ("collision_offroad_mean", "scene_score")
"""The metrics that decide whether a study discriminates."""
AGREEMENT = "agreement.json"
OWN_ROAD = ("offroad_max_excursion_m", "offroad_area_frac", "offroad_unknown_frac")
"""Metrics by a reconstruction's own road: they differ where identical rollouts are judged by different worlds."""


@dataclass(frozen=True)
class StudyResults:
    """Everything that the report of a study shows.

    ``values`` has one row per rollout and metric (``metrics.aggregate.rollout_values``). ``comparison`` is over all
    policies, ``seeing`` the agreements of those that look at a sensor only, by metric and world: blind ones agree by
    construction. ``drops`` is by control and metric how much less than the intact reconstruction it agrees with the
    truth. ``pairs`` is by world the difference of every two policies in (C+O)/2, adjusted by Holm. ``differing`` names
    blind policies that did not drive the same in all worlds, which is a fault of the simulator. ``doubts`` is by
    reason and reconstruction how often verdicts to doubt, and all others, are wrong. ``braking`` is by world and policy
    that looks at a sensor when it first brakes, against the truth. ``roads`` is by reconstruction how its road agrees
    with the map, empty if not measured.
    """

    config: StudyConfig
    values: pl.DataFrame
    comparison: Comparison
    seeing_policies: tuple[str, ...]
    seeing: dict[tuple[str, str], Agreement]
    drops: dict[tuple[str, str], Estimate]
    pairs: dict[str, list[tuple[str, str, Difference]]]
    differing: tuple[str, ...]
    doubts: dict[str, dict[str, Doubt]] = field(default_factory=dict)
    braking: dict[tuple[str, str], Braking] = field(default_factory=dict)
    roads: dict[str, Road] = field(default_factory=dict)

    @property
    def discriminates(self) -> bool | None:
        """Whether a control ranks policies worse than the intact reconstruction, resolved; None without controls."""
        if not self.config.controls.how:
            return None
        return any(drop.resolved and drop.value > 0 for drop in self.drops.values())

    @property
    def failed(self) -> int:
        """Number of failed rollouts."""
        return self.values.filter(pl.col("status") != "ok")["rollout_id"].n_unique()


def gather(folder: Path, config: StudyConfig, seeing: Sequence[str]) -> StudyResults:
    """Reads the values of all rollouts, compares the worlds, and measures the roads of the reconstructions."""
    parts = []
    for scene_id, _, _ in config.scenes:
        for world in config.all_worlds:
            path = layout.scene_folder(folder / ROLLOUTS, scene_id, world) / VALUES
            if not path.exists():
                raise RunError(f"{path} does not exist: the study is incomplete; run it again")
            parts.append(pl.read_parquet(path))
    results = results_of(config, pl.concat(parts), seeing)
    return dataclasses.replace(results, roads=measure_roads(folder, config))


def results_of(config: StudyConfig, values: pl.DataFrame, seeing: Sequence[str]) -> StudyResults:
    """All statistics of the rollouts of a study.

    Args:
        config: the study.
        values: rows of ``rollout_values`` of all its rollouts.
        seeing: policies that look at a rendered sensor.
    """
    worlds = config.all_worlds
    truth = worlds[0]
    looked = values.filter(pl.col("policy").is_in(list(seeing)))
    seen: dict[tuple[str, str], Agreement] = {}
    for metric in COMPARED:
        for world in worlds[1:]:
            paired = paired_means(looked, metric, (truth, world))
            if len(paired.policies) > 1 and paired.scenes:
                means = paired.by_world
                seen[metric, world] = compare_worlds(metric, paired.policies, means[truth], means[world])
    drops = {}
    for how in config.controls.how:
        for metric in RANKED_BY:
            intact, control = config.controls.of, control_name(config.controls.of, how)
            paired = paired_means(values, metric, (truth, intact, control))
            if len(paired.policies) > 1 and paired.scenes:
                drops[how, metric] = tau_b_drop(*(paired.by_world[world] for world in (truth, intact, control)))
    pairs = {}
    for world in worlds:
        paired = paired_means(values, RANKED_BY[0], (world,))
        if len(paired.policies) > 1 and paired.scenes:
            names = paired.policies
            pairs[world] = [(names[i], names[j], d) for i, j, d in policy_differences(paired.by_world[world])]
    comparison = comparison_of(values, worlds, "the map of the towns")
    return StudyResults(
        config,
        values,
        comparison,
        tuple(sorted(seeing)),
        seen,
        drops,
        pairs,
        _differing(values, seeing),
        doubts(values, config.worlds, seeing),
        first_braking(values, worlds, sorted(seeing)),
    )


def _differing(values: pl.DataFrame, seeing: Sequence[str]) -> tuple[str, ...]:
    """Blind policies whose rollouts are not the same, number by number, in all worlds."""
    blind = values.filter(~pl.col("policy").is_in(list(seeing)) & ~pl.col("name").is_in(OWN_ROAD))
    # A missing value counts as a value of its own.
    kinds = blind.group_by("clipgt_id", "policy", "seed", "name").agg(pl.col("value").n_unique().alias("kinds"))
    return tuple(sorted(kinds.filter(pl.col("kinds") > 1)["policy"].unique().to_list()))


def as_json(results: StudyResults) -> dict[str, Any]:
    """The statistics as plain values."""
    comparison = results.comparison

    def plain(found: Agreement | None) -> dict[str, Any] | None:
        if found is None:
            return None
        return {**asdict(found), "p_by_luck": found.p_by_luck}

    return _finite({
        "study": results.config.name,
        "scenes": len(results.config.scenes),
        "rollouts": results.config.rollouts,
        "failed": results.failed,
        "reference": comparison.reference,
        "agreement": {f"{world}/{metric}": plain(found) for (metric, world), found in comparison.agreements.items()},
        "agreement_of_policies_that_see": {
            f"{world}/{metric}": plain(found) for (metric, world), found in results.seeing.items()
        },
        "noise_ceiling": {metric: plain(found) for metric, found in comparison.ceilings.items()},
        "controls": {f"{how}/{metric}": asdict(drop) for (how, metric), drop in results.drops.items()},
        "discriminates": results.discriminates,
        "blind_policies_that_differ": list(results.differing),
        "first_braking": {f"{world}/{policy}": asdict(each) for (world, policy), each in results.braking.items()},
        "verdicts_to_doubt": {
            reason: {world: asdict(each) for world, each in by_world.items()}
            for reason, by_world in results.doubts.items()
        },
        "road": {world: asdict(each) for world, each in results.roads.items()},
    })  # fmt: skip


def read_agreement(folder: Path) -> dict[str, Any]:
    """The content of ``agreement.json`` of a finished study.

    Raises:
        RunError: it cannot be read.
    """
    try:
        return json.loads((folder / AGREEMENT).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RunError(f"{folder / AGREEMENT} cannot be read: {error}") from None


def agreement_rows(results: dict[str, Any]) -> list[tuple[str, ...]]:
    """World, metric, tau-b, its interval, and the four counts of pairs, as text; of ``read_agreement``."""
    found = [*results["agreement"].items()]
    found += [(f"noise ceiling/{metric}", each) for metric, each in results["noise_ceiling"].items() if each]
    rows = []
    for key, each in found:
        world, metric = key.split("/")
        if metric in RANKED_BY:
            tau, pairs = each["tau_b"], each["pairs"]
            value = "all tied" if tau["value"] is None else f"{tau['value']:.2f}"
            interval = "" if tau["low"] is None else f"{tau['low']:.2f} to {tau['high']:.2f}"
            counts = (pairs[name] for name in ("same", "opposite", "resolved_in_one", "unresolved"))
            rows.append((world, metric, value, interval, *map(str, counts)))
    return rows


def _finite(value: Any) -> Any:
    """The same without NaN, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and value != value else value
