"""Do two worlds judge policies alike? Paired intervals, tests and rank statistics, clustered by scene.

A *world* is what rendered the sensors: the original one, or a reconstruction. Arrays are [policies, scenes]: means over
the trials of a scene. Scenes are the unit of resampling, because trials of one scene are not independent; every
statistic shares the same resamples, so that differences are paired. Definitions: docs/metrics.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64, Int64
from scipy.stats import rankdata

if TYPE_CHECKING:
    import polars as pl

BOOTSTRAP = 10_000
CONFIDENCE = 0.95
EQUIVALENCE_MARGIN = 0.03
"""Rates that differ by less are equivalent: 3 percentage points."""
TIE = 1e-9
"""Means closer than this are tied: sums of equal numbers differ by rounding."""

Draws = Int64[np.ndarray, "resamples scenes"]
Means = Float64[np.ndarray, "policies scenes"]


@dataclass(frozen=True)
class Estimate:
    """A value with its 95 % interval; no interval with fewer than two scenes, where nothing generalises."""

    value: float
    low: float | None = None
    high: float | None = None

    @property
    def resolved(self) -> bool:
        """Whether the interval excludes 0."""
        return self.low is not None and self.high is not None and (self.low > TIE or self.high < -TIE)


@dataclass(frozen=True)
class Difference:
    """Difference of two means over the same scenes.

    ``p_differs`` tests for a difference (two-sided), ``p_equivalent`` for equality within the margin (two one-sided
    tests); both None with fewer than two scenes.
    """

    estimate: Estimate
    p_differs: float | None = None
    p_equivalent: float | None = None


@dataclass(frozen=True)
class PairCounts:
    """Pairs of policies by what two worlds say of their order; a pair is resolved where its interval excludes 0."""

    same: int
    opposite: int
    resolved_in_one: int
    unresolved: int
    flipped: tuple[tuple[str, str], ...]
    """The pairs that both worlds resolve, in opposite order."""


@dataclass(frozen=True)
class Agreement:
    """How well one world agrees with a reference on one metric.

    ``differences`` are other minus reference by policy; ``p_by_luck`` is the probability that a random order of the
    policies is identical to the reference's.
    """

    metric: str
    policies: tuple[str, ...]
    scenes: int
    tau_b: Estimate
    spearman: Estimate
    mmrv: float
    pairs: PairCounts
    differences: tuple[Difference, ...]

    @property
    def p_by_luck(self) -> float:  # noqa: D102
        return 1 / math.factorial(len(self.policies))


@dataclass(frozen=True)
class PairedMeans:
    """One metric by world as [policies, scenes], over the trials that are valid for every policy in every world."""

    policies: tuple[str, ...]
    scenes: tuple[str, ...]
    by_world: dict[str, Means]
    left_out: tuple[str, ...] = ()
    """Policies without any valid value in some world."""
    trials_left_out: int = 0


def scene_draws(scenes: int, seed: int = 0) -> Draws:
    """How often each scene occurs in each of ``BOOTSTRAP`` resamples with replacement."""
    # Counts per scene instead of indices (a multinomial), so that one matrix product gives all resampled means.
    return np.random.default_rng(seed).multinomial(scenes, np.full(scenes, 1 / max(scenes, 1)), BOOTSTRAP)


def percentile_interval(drawn: Float64[np.ndarray, " resamples"]) -> tuple[float, float]:
    """The central ``CONFIDENCE`` of resampled values, NaN ignored."""
    low, high = np.nanquantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def paired_means(values: pl.DataFrame, metric: str, worlds: Sequence[str], trials: slice = slice(None)) -> PairedMeans:
    """Collects one metric for a comparison.

    A trial (scene and seed) that lacks a value for one policy in one world is left out for all, or else their scenes
    would not be the same.

    Args:
        values: rows of ``aggregate.rollout_values``.
        metric: a metric's name.
        worlds: names of reconstructions.
        trials: which of the sorted seeds, for halves of a world.
    """
    import polars as pl

    rows = values.filter((pl.col("name") == metric) & pl.col("reconstruction").is_in(list(worlds)))
    seeds = sorted(rows["seed"].unique().to_list())[trials]
    found: dict[tuple[str, str, str, int], float] = {
        (row["reconstruction"], row["policy"], row["clipgt_id"], row["seed"]): row["value"]
        for row in rows.filter(pl.col("valid") & pl.col("seed").is_in(seeds)).iter_rows(named=True)
    }
    everyone = sorted(rows["policy"].unique().to_list())
    seen = {(world, policy) for world, policy, _, _ in found}
    policies = [policy for policy in everyone if all((world, policy) in seen for world in worlds)]
    scenes: dict[str, list[int]] = {}
    all_trials = sorted(set(rows.select("clipgt_id", "seed").iter_rows()))
    for scene, seed in all_trials if policies else ():
        if seed in seeds and all((world, policy, scene, seed) in found for world in worlds for policy in policies):
            scenes.setdefault(scene, []).append(seed)
    by_world = {
        world: np.array(
            [[np.mean([found[world, policy, scene, seed] for seed in kept]) for scene, kept in scenes.items()]
             for policy in policies], np.float64
        ).reshape(len(policies), len(scenes))
        for world in worlds
    }  # fmt: skip
    lost = sum(seed in seeds for _, seed in all_trials) - sum(map(len, scenes.values()))
    return PairedMeans(
        tuple(policies), tuple(scenes), by_world, tuple(p for p in everyone if p not in policies), lost
    )  # fmt: skip


def compare_worlds(metric: str, policies: Sequence[str], reference: Means, other: Means) -> Agreement:
    """All statistics between two worlds for one metric.

    Args:
        metric: name of the metric, for the result.
        policies: names of the rows.
        reference: means [policies, scenes] in the world that the other is measured by.
        other: means [policies, scenes] in the other world.
    """
    draws = scene_draws(reference.shape[1])
    return Agreement(
        metric, tuple(policies), reference.shape[1],
        _rank_estimate(tau_b, reference, other, draws), _rank_estimate(spearman, reference, other, draws),
        mmrv(reference.mean(axis=1), other.mean(axis=1)), pair_counts(policies, reference, other, draws),
        tuple(difference(b - a, draws) for a, b in zip(reference, other, strict=True)),
    )  # fmt: skip


def difference(
    per_scene: Float64[np.ndarray, " scenes"], draws: Draws, margin: float = EQUIVALENCE_MARGIN
) -> Difference:
    """Mean of differences per scene, with its interval and the p-values of difference and of equivalence.

    Args:
        per_scene: differences, one per scene.
        draws: of ``scene_draws``.
        margin: of equivalence: the hypothesis is that the difference lies within it, on both sides.
    """
    mean = float(per_scene.mean())
    if len(per_scene) < 2:
        return Difference(Estimate(mean))
    drawn = draws @ per_scene / len(per_scene)
    # (k + 1) / (B + 1): a resampled p-value is never 0 (Davison and Hinkley 1997, section 4.2).
    above, below = _share(drawn >= -TIE), _share(drawn <= TIE)
    equivalent = max(_share(drawn >= margin - TIE), _share(drawn <= -margin + TIE))
    return Difference(Estimate(mean, *percentile_interval(drawn)), min(1.0, 2 * min(above, below)), equivalent)


def holm(p_values: Sequence[float]) -> list[float]:
    """P-values adjusted for their number: Holm's step-down procedure (1979)."""
    adjusted, least = [0.0] * len(p_values), 0.0
    for rank, index in enumerate(np.argsort(p_values, kind="stable")):
        least = max(least, min(1.0, (len(p_values) - rank) * p_values[index]))
        adjusted[index] = least
    return adjusted


def policy_differences(means: Means) -> list[tuple[int, int, Difference]]:
    """Difference of every pair of policies (first minus second) in one world, p-values adjusted by ``holm``."""
    draws = scene_draws(means.shape[1])
    pairs = [(i, j, difference(means[i] - means[j], draws)) for i, j in combinations(range(len(means)), 2)]
    known = [found.p_differs for _, _, found in pairs if found.p_differs is not None]
    if len(known) < len(pairs):
        return pairs
    return [
        (i, j, Difference(found.estimate, p, found.p_equivalent))
        for (i, j, found), p in zip(pairs, holm(known), strict=True)
    ]


def tau_b(
    x: Float64[np.ndarray, "*batch policies"], y: Float64[np.ndarray, "*batch policies"]
) -> Float64[np.ndarray, "*batch"]:
    """Kendall's tau-b along the last axis; NaN where one side is all ties."""
    first, second = np.triu_indices(x.shape[-1], 1)
    a, b = (_sign(values[..., first] - values[..., second]) for values in (x, y))
    with np.errstate(invalid="ignore", divide="ignore"):
        return (a * b).sum(axis=-1) / np.sqrt((a * a).sum(axis=-1) * (b * b).sum(axis=-1))


def spearman(
    x: Float64[np.ndarray, "*batch policies"], y: Float64[np.ndarray, "*batch policies"]
) -> Float64[np.ndarray, "*batch"]:
    """Spearman's rank correlation along the last axis, mean ranks for ties; NaN where one side is all ties."""
    a, b = (rankdata(np.round(values / TIE), axis=-1) for values in (x, y))
    a, b = (ranks - ranks.mean(axis=-1, keepdims=True) for ranks in (a, b))
    with np.errstate(invalid="ignore", divide="ignore"):
        return (a * b).sum(axis=-1) / np.sqrt((a * a).sum(axis=-1) * (b * b).sum(axis=-1))


def mmrv(truth: Float64[np.ndarray, " policies"], other: Float64[np.ndarray, " policies"]) -> float:
    """Mean maximum rank violation (SIMPLER, arXiv 2405.05941), in the metric's unit; 0 is perfect.

    For each policy the largest true difference to one that ``other`` puts on the wrong side of it.
    """
    gap = truth[:, None] - truth[None, :]
    violated = (other[:, None] - other[None, :] < -TIE) != (gap < -TIE)
    return float(np.where(violated, np.abs(gap), 0.0).max(axis=1).mean()) if len(truth) else math.nan


def tau_b_drop(reference: Means, better: Means, worse: Means) -> Estimate:
    """By how much tau-b with the reference falls from one world to another, with a paired interval.

    Args:
        reference: means [policies, scenes] in the world that both are measured by.
        better: means in the one world.
        worse: means in the other.
    """
    count, draws = reference.shape[1], scene_draws(reference.shape[1])
    # A world in which all policies are tied ranks none: no agreement.
    taus = [np.nan_to_num(tau_b(reference.mean(axis=1), world.mean(axis=1))) for world in (better, worse)]
    value = float(taus[0] - taus[1])
    if count < 2:
        return Estimate(value)
    of_scenes = draws @ reference.T / count
    drawn = [np.nan_to_num(tau_b(of_scenes, draws @ world.T / count)) for world in (better, worse)]
    return Estimate(value, *percentile_interval(drawn[0] - drawn[1]))


def pair_counts(policies: Sequence[str], reference: Means, other: Means, draws: Draws) -> PairCounts:
    """Counts pairs of policies by whether their order is resolved in one world, in both, and the same in both."""
    same, opposite, one, none = 0, [], 0, 0
    for i, j in combinations(range(len(policies)), 2):
        a, b = (difference(world[i] - world[j], draws).estimate for world in (reference, other))
        if a.resolved and b.resolved:
            if a.value * b.value > 0:
                same += 1
            else:
                opposite.append((policies[i], policies[j]))
        elif a.resolved or b.resolved:
            one += 1
        else:
            none += 1
    return PairCounts(same, len(opposite), one, none, tuple(opposite))


def noise_ceiling(values: pl.DataFrame, metric: str, world: str) -> Agreement | None:
    """Agreement of a world with itself: odd against even trials. No other world can be expected to agree better.

    Returns:
        None with fewer than two seeds, two policies or one scene.
    """
    halves = [paired_means(values, metric, [world], slice(start, None, 2)) for start in (0, 1)]
    policies = [policy for policy in halves[0].policies if policy in halves[1].policies]
    scenes = [scene for scene in halves[0].scenes if scene in halves[1].scenes]
    if len(policies) < 2 or not scenes:
        return None
    a, b = (
        half.by_world[world][np.ix_([half.policies.index(p) for p in policies], [half.scenes.index(s) for s in scenes])]
        for half in halves
    )
    return compare_worlds(metric, policies, a, b)


def _rank_estimate(statistic: Callable, reference: Means, other: Means, draws: Draws) -> Estimate:
    value = float(statistic(reference.mean(axis=1), other.mean(axis=1)))
    count = reference.shape[1]
    if count < 2 or not math.isfinite(value):
        return Estimate(value)
    drawn = statistic(draws @ reference.T / count, draws @ other.T / count)
    return Estimate(value, *percentile_interval(drawn))


def _sign(gaps: np.ndarray) -> np.ndarray:
    return np.where(np.abs(gaps) <= TIE, 0.0, np.sign(gaps))


def _share(hit: np.ndarray) -> float:
    return float((hit.sum() + 1) / (len(hit) + 1))
