"""Does a policy brake at the same moment in a reconstruction as in the true world?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

SAME_S = 0.1
"""Interval of recorded states: two moments this close cannot be told apart."""
KEYS = ("clipgt_id", "policy", "seed")


@dataclass(frozen=True)
class Braking:
    """First braking of one policy in one world, against the same rollouts in the true world.

    ``median_s`` and ``worst_s`` are of the absolute difference of the two moments, over the rollouts that brake in
    both; None without any. ``early`` and ``late`` count those that brake more than ``SAME_S`` before and after the
    truth, ``missed`` the rollouts that brake in the truth only, ``false`` those that brake in this world only.
    """

    both: int
    early: int
    late: int
    missed: int
    false: int
    neither: int
    median_s: float | None
    worst_s: float | None


def first_braking(
    values: pl.DataFrame, worlds: Sequence[str], policies: Sequence[str]
) -> dict[tuple[str, str], Braking]:
    """By world and policy, in this order; without those that have no rollout that ended well in both worlds.

    Args:
        values: rows of ``rollout_values`` of all rollouts of a study.
        worlds: the true world first.
        policies: names of the policies to compare.
    """
    moments = values.filter((pl.col("name") == "time_to_first_brake_s") & (pl.col("status") == "ok"))
    truth = moments.filter(reconstruction=worlds[0])
    found = {}
    for world in worlds[1:]:
        pairs = moments.filter(reconstruction=world).join(truth, on=KEYS, suffix="_true")
        for policy in policies:
            mine = pairs.filter(policy=policy)
            if len(mine):
                found[world, policy] = _compare(mine["value"], mine["value_true"])
    return found


def _compare(here_s: pl.Series, true_s: pl.Series) -> Braking:
    brakes, brakes_true = here_s.is_not_null().to_numpy(), true_s.is_not_null().to_numpy()
    both = brakes & brakes_true
    later_s = (here_s - true_s).drop_nulls().to_numpy()
    # Times are whole states, their difference is not exactly one: 0.1 s is no more than 0.1 s.
    bound_s = SAME_S + 1e-6
    return Braking(
        both=int(both.sum()),
        early=int((later_s < -bound_s).sum()),
        late=int((later_s > bound_s).sum()),
        missed=int((brakes_true & ~brakes).sum()),
        false=int((brakes & ~brakes_true).sum()),
        neither=int((~brakes & ~brakes_true).sum()),
        median_s=float(np.median(np.abs(later_s))) if len(later_s) else None,
        worst_s=float(np.abs(later_s).max()) if len(later_s) else None,
    )
