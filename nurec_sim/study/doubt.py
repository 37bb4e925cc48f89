"""Which verdicts to doubt? A study counts how often those with a reason for doubt are wrong, against all others.

Reasons are known without the truth: an image with little support, another start or another reconstruction that ends
otherwise.
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
LOW_SUPPORT, OTHER_START, OTHER_WORLD = "low support", "another start differs", "another reconstruction differs"
ANY = "any of these"


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


def doubts(values: pl.DataFrame, worlds: Sequence[str], policies: Sequence[str]) -> dict[str, dict[str, Doubt]]:
    """Doubtful verdicts by reason and reconstruction; without what is not known.

    ``LOW_SUPPORT``: before its end the policy got an image with support below ``LOW``. ``OTHER_START``: another trial
    in the same scene and reconstruction ends otherwise. ``OTHER_WORLD``: so does the same trial in another
    reconstruction. ``ANY``: one of these, if several are known.

    Args:
        values: rows of ``rollout_values`` of all rollouts of a study.
        worlds: the true world first, then intact reconstructions.
        policies: those that look at a rendered sensor; all others end alike by construction.
    """
    ends = _ends(values.filter(pl.col("policy").is_in(list(policies))))
    found: dict[str, dict[str, Doubt]] = {}
    for world in [world for world in worlds[1:] if world in ends]:
        pairs = ends[world].join(ends[worlds[0]], on=KEYS, suffix="_true").drop_nulls(_columns("", "_true"))
        rivals = [other for other in worlds[1:] if other != world and other in ends]
        for rival in rivals:
            pairs = pairs.join(ends[rival], on=KEYS, suffix=f"_{rival}", how="left")
        several = pl.len().over("clipgt_id", "policy") > 1
        changes = pl.any_horizontal([pl.col(name).n_unique().over("clipgt_id", "policy") > 1 for name in VERDICT])
        reasons = {
            LOW_SUPPORT: pl.col("support_least") < LOW,
            OTHER_START: pl.when(several).then(changes),
            OTHER_WORLD: pl.any_horizontal([_differs(f"_{rival}") for rival in rivals]) if rivals else pl.lit(None),
        }
        rows = pairs.select(_differs("_true").alias("wrong"), **reasons)
        known = [reason for reason in reasons if rows[reason].count()]
        if len(known) > 1:
            rows, known = rows.with_columns(pl.any_horizontal(known).fill_null(False).alias(ANY)), [*known, ANY]
        for reason in known:
            found.setdefault(reason, {})[world] = _count(rows.drop_nulls(reason), reason)
    return found


def _ends(values: pl.DataFrame) -> dict[str, pl.DataFrame]:
    """By world, one row per rollout with its verdict and ``support_least``; missing ones are null."""
    names = [*VERDICT, "support_least"]
    wide = values.filter(pl.col("name").is_in(names)).pivot(
        on="name", on_columns=names, index=[*KEYS, "reconstruction"], values="value"
    )
    return {str(world): rows.drop("reconstruction") for (world,), rows in wide.group_by("reconstruction")}


def _columns(*suffixes: str) -> list[str]:
    return [name + suffix for suffix in suffixes for name in VERDICT]


def _differs(suffix: str) -> pl.Expr:
    """Whether the verdict is another than that of the columns with a suffix."""
    return pl.any_horizontal([pl.col(name) != pl.col(f"{name}{suffix}") for name in VERDICT])


def _count(rows: pl.DataFrame, reason: str) -> Doubt:
    doubted, others = rows.filter(reason)["wrong"], rows.filter(~pl.col(reason))["wrong"]
    return Doubt(len(doubted), int(doubted.sum()), len(others), int(others.sum()))
