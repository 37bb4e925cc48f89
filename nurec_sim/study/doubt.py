"""Which verdicts to doubt? Those after images with little support, and those that another reconstruction contradicts.

Both are known without the truth. A study counts how often such verdicts are wrong, against all others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import polars as pl

from nurec_sim.report.support import LOW

VERDICT = ("collision_any", "offroad")
ENOUGH = 10
"""With fewer verdicts on either side nothing can be said."""
KEYS = ("clipgt_id", "policy", "seed")


@dataclass(frozen=True)
class Doubt:
    """Verdicts of one reconstruction: a verdict is wrong if the same rollout ends otherwise in the true world."""

    doubtful: int
    doubtful_wrong: int
    others: int
    others_wrong: int

    @property
    def ratio(self) -> float | None:
        """How many times as often doubtful verdicts are wrong; None with few verdicts, or if no other is wrong."""
        if min(self.doubtful, self.others) < ENOUGH or not self.others_wrong:
            return None
        return (self.doubtful_wrong / self.doubtful) / (self.others_wrong / self.others)


def after_low_support(values: pl.DataFrame, worlds: Sequence[str]) -> dict[str, Doubt]:
    """Verdicts after an image with support below ``LOW``; of every reconstruction in which support is known.

    Args:
        values: rows of ``rollout_values`` of all rollouts of a study.
        worlds: the true world first.
    """
    ends = _ends(values, "support_least")
    truth = ends[worlds[0]].drop("support_least")
    found = {}
    for world in worlds[1:]:
        pairs = ends[world].drop_nulls().join(truth, on=KEYS, suffix="_true").drop_nulls()
        if len(pairs):
            found[world] = _count(pairs, pl.col("support_least") < LOW)
    return found


def contradicted(values: pl.DataFrame, worlds: Sequence[str], policies: Sequence[str]) -> dict[str, Doubt]:
    """Verdicts of every reconstruction where another one says otherwise.

    Empty without two reconstructions, and without policies that look at something.

    Args:
        values: rows of ``rollout_values`` of all rollouts of a study.
        worlds: the true world first, then intact reconstructions.
        policies: those that look at a rendered sensor; all others end alike by construction.
    """
    if len(worlds) < 3 or not policies:
        return {}
    ends = _ends(values.filter(pl.col("policy").is_in(list(policies))))
    found = {}
    for world in worlds[1:]:
        rivals = [other for other in worlds[1:] if other != world]
        pairs = ends[world].join(ends[worlds[0]], on=KEYS, suffix="_true")
        for rival in rivals:
            pairs = pairs.join(ends[rival], on=KEYS, suffix=f"_{rival}")
        pairs = pairs.drop_nulls()
        if len(pairs):
            found[world] = _count(pairs, pl.any_horizontal([_differs(f"_{rival}") for rival in rivals]))
    return found


def _ends(values: pl.DataFrame, *also: str) -> dict[str, pl.DataFrame]:
    """By world, one row per rollout with its verdict and more metrics; missing ones are null."""
    wide = values.filter(pl.col("name").is_in([*VERDICT, *also])).pivot(
        on="name", index=[*KEYS, "reconstruction"], values="value"
    )
    return {str(world): rows.drop("reconstruction") for (world,), rows in wide.group_by("reconstruction")}


def _differs(suffix: str) -> pl.Expr:
    """Whether the verdict is another than that of the columns with a suffix."""
    return pl.any_horizontal([pl.col(name) != pl.col(f"{name}{suffix}") for name in VERDICT])


def _count(pairs: pl.DataFrame, doubtful: pl.Expr) -> Doubt:
    wrong, doubted = pairs.select(_differs("_true")).to_series(), pairs.select(doubtful).to_series()
    return Doubt(int(doubted.sum()), int((doubted & wrong).sum()), int((~doubted).sum()), int((~doubted & wrong).sum()))
