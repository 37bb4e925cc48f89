"""Agreement between worlds: against scipy, against values by hand, and on worlds whose answer is known."""

import numpy as np
import polars as pl
import pytest
from scipy import stats

from nurec_sim.metrics import agreement as ag

RNG = np.random.default_rng(5)
POLICIES = ("a", "b", "c", "d", "e")


def table(by_world: dict[str, np.ndarray], missing=()) -> pl.DataFrame:
    """Rows as ``rollout_values`` gives them, from arrays [policies, scenes, seeds]."""
    rows = []
    for world, values in by_world.items():
        for (p, s, k), value in np.ndenumerate(values):
            valid = (world, p, s, k) not in missing
            rows.append((world, POLICIES[p], f"s{s}", k, "offroad", float(value) if valid else None, valid))
    columns = ["reconstruction", "policy", "clipgt_id", "seed", "name", "value", "valid"]
    return pl.DataFrame(rows, columns, orient="row")


@pytest.mark.parametrize("levels", [3, 1000], ids=["with ties", "without ties"])
def test_rank_statistics_are_scipys(levels):
    x, y = (RNG.integers(0, levels, (20, 7)) / levels for _ in range(2))
    for ours, theirs in ((ag.tau_b, stats.kendalltau), (ag.spearman, stats.spearmanr)):
        assert ours(x, y) == pytest.approx([theirs(a, b).statistic for a, b in zip(x, y, strict=True)])
    assert np.isnan(ag.tau_b(np.ones(4), np.arange(4.0))) and np.isnan(ag.spearman(np.ones(4), np.arange(4.0)))
    assert ag.tau_b(np.array([0.1 + 0.2, 0.3, 0.5]), np.array([1.0, 1.0, 2.0])) == pytest.approx(1), "rounding is a tie"


def test_mmrv_by_hand():
    """Truth 0, 0.1, 0.5; the other world swaps the last two: each of those is 0.4 off, the first is right."""
    truth = np.array([0.0, 0.1, 0.5])
    assert ag.mmrv(truth, np.array([0.0, 0.5, 0.1])) == pytest.approx((0 + 0.4 + 0.4) / 3)
    assert ag.mmrv(truth, truth * 2 + 1) == 0.0


def test_holm_by_hand():
    """Sorted 0.01, 0.02, 0.03, 0.9: times 4, 3, 2, 1, never decreasing."""
    assert ag.holm([0.03, 0.01, 0.9, 0.02]) == pytest.approx([0.06, 0.04, 0.9, 0.06])
    assert ag.holm([0.5, 0.6]) == [1.0, 1.0] and ag.holm([]) == []


def test_two_scenes_have_the_three_resamples_of_two():
    """Differences 0 and 1: means 0, 0.5, 1 with probabilities 1/4, 1/2, 1/4."""
    found = ag.difference(np.array([0.0, 1.0]), ag.scene_draws(2))
    assert (found.estimate.value, found.estimate.low, found.estimate.high) == (0.5, 0.0, 1.0)
    assert found.p_differs == pytest.approx(0.5, abs=0.02) and found.p_equivalent == pytest.approx(0.75, abs=0.02)
    lone = ag.difference(np.array([1.0]), ag.scene_draws(1))
    assert lone.estimate == ag.Estimate(1.0) and lone.p_differs is lone.p_equivalent is None
    assert not lone.estimate.resolved, "one scene resolves nothing"


def test_interval_and_tests_are_students_for_many_scenes():
    """200 normal differences: the bootstrap agrees with the t distribution."""
    sample = RNG.normal(0.0, 0.15, 200)
    sample += 0.012 - sample.mean()
    found = ag.difference(sample, ag.scene_draws(200))
    interval = stats.ttest_1samp(sample, 0).confidence_interval()
    assert (found.estimate.low, found.estimate.high) == pytest.approx(tuple(interval), abs=0.0025)
    assert found.p_differs == pytest.approx(stats.ttest_1samp(sample, 0).pvalue, abs=0.03)
    sides = [stats.ttest_1samp(sample, limit, alternative=side).pvalue
             for limit, side in ((-0.03, "greater"), (0.03, "less"))]  # fmt: skip
    assert found.p_equivalent == pytest.approx(max(sides), abs=0.02)


def test_resolved_pairs_are_counted_by_order():
    """b is above a in both worlds, c above b only in the first, d and c are swapped in the second."""
    level = np.array([0.0, 0.2, 0.4, 0.6])[:, None]
    noise = RNG.normal(0, 0.01, (4, 30))
    other = np.array([0.0, 0.2, 0.6, 0.4])[:, None] + noise
    counts = ag.pair_counts(POLICIES[:4], level + noise, other, ag.scene_draws(30))
    assert (counts.same, counts.opposite, counts.flipped) == (5, 1, (("c", "d"),))
    vague = ag.pair_counts(POLICIES[:4], level + noise, RNG.normal(0, 1, (4, 30)) * 1e-12, ag.scene_draws(30))
    assert (vague.same, vague.opposite, vague.resolved_in_one, vague.unresolved) == (0, 0, 6, 0)


def test_a_trial_that_lacks_a_value_is_left_out_for_everyone():
    values = {"x": RNG.random((3, 2, 2)), "y": RNG.random((3, 2, 2))}
    gone = {("y", 1, 0, 0)} | {("x", 2, s, k) for s in range(2) for k in range(2)}
    paired = ag.paired_means(table(values, gone), "offroad", ["x", "y"])
    assert (paired.policies, paired.left_out, paired.trials_left_out) == (("a", "b"), ("c",), 1)
    assert paired.by_world["x"][0] == pytest.approx([values["x"][0, 0, 1], values["x"][0, 1].mean()])
    assert paired.by_world["y"][1] == pytest.approx([values["y"][1, 0, 1], values["y"][1, 1].mean()])


def test_a_world_agrees_with_its_double_up_to_the_noise_ceiling():
    """Equal worlds agree perfectly; the noise ceiling of a world without noise is 1, of pure noise it is not."""
    steady = np.broadcast_to(np.arange(5.0)[:, None, None] / 5, (5, 12, 4))
    noisy = (RNG.random((5, 12, 4)) > 0.5).astype(float)
    values = table({"steady": steady, "noisy": noisy})
    means = ag.paired_means(values, "offroad", ["steady", "noisy"]).by_world
    same = ag.compare_worlds("offroad", POLICIES, means["steady"], means["steady"])
    assert same.tau_b == ag.Estimate(1.0, 1.0, 1.0) and same.mmrv == 0 and same.pairs.same == 10
    assert [each.p_equivalent < 0.001 for each in same.differences] == [True] * 5
    assert same.p_by_luck == pytest.approx(1 / 120)
    assert ag.noise_ceiling(values, "offroad", "steady").tau_b.value == 1.0
    assert ag.noise_ceiling(values, "offroad", "noisy").tau_b.low < 0.5
    one_seed = table({"steady": steady[..., :1]})
    assert ag.noise_ceiling(one_seed, "offroad", "steady") is None


def test_pairs_of_policies_are_adjusted_for_their_number():
    means = np.stack([RNG.normal(0.0, 0.1, 12), RNG.normal(0.08, 0.1, 12), RNG.normal(0.5, 0.1, 12)])
    adjusted = [found.p_differs for _, _, found in ag.policy_differences(means)]
    draws = ag.scene_draws(12)
    raw = [ag.difference(means[i] - means[j], draws).p_differs for i, j in ((0, 1), (0, 2), (1, 2))]
    assert adjusted == ag.holm(raw) and adjusted[1] < 0.01
