"""Does low support warn? Verdicts after images with little support, against all others, by how often they are wrong."""

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
    """Verdicts of one reconstruction: a verdict is wrong if the same rollout ends otherwise in the true world.

    A verdict is ``doubtful`` if an image that the policy got before the first event had support below ``LOW``.
    """

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


def doubts(values: pl.DataFrame, worlds: Sequence[str]) -> dict[str, Doubt]:
    """Doubtful and other verdicts of every reconstruction in which support is known.

    Args:
        values: rows of ``rollout_values`` of all rollouts of a study.
        worlds: the true world first.
    """
    wide = values.filter(pl.col("name").is_in([*VERDICT, "support_least"])).pivot(
        on="name", index=[*KEYS, "reconstruction"], values="value"
    )
    truth = wide.filter(reconstruction=worlds[0]).drop("support_least")
    found = {}
    for world in worlds[1:]:
        pairs = wide.filter(reconstruction=world).join(truth, on=KEYS, suffix="_true")
        pairs = pairs.drop_nulls(["support_least", *VERDICT, *(f"{name}_true" for name in VERDICT)])
        if not len(pairs):
            continue
        wrong = pl.any_horizontal([pl.col(name) != pl.col(f"{name}_true") for name in VERDICT])
        low, other = pairs.filter(pl.col("support_least") < LOW), pairs.filter(pl.col("support_least") >= LOW)
        found[world] = Doubt(len(low), len(low.filter(wrong)), len(other), len(other.filter(wrong)))
    return found
