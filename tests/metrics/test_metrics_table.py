"""The long table, truncation, derived numbers, and summaries with their intervals."""

import dataclasses

import numpy as np
import polars as pl
import pytest
from metrics_worlds import STEP_US, T0_US, failed_rollout, rollout, standing, straight_poses

from nurec_sim.metrics import METRICS, metric_table, rollout_values, score_rollout, summarize, write_table
from nurec_sim.metrics.aggregate import DERIVED
from nurec_sim.metrics.series import make_series
from nurec_sim.metrics.table import ALPASIM_COLUMNS, OWN_COLUMNS, read_table


def with_series(run, **replaced):
    """A scored rollout in which some series are replaced by given values (NaN = invalid)."""
    series = {one.name: one for one in score_rollout(run, None, actors_known=True)}
    for name, values in replaced.items():
        series[name] = make_series(name, run.t_us, np.asarray(values, float))
    return run, list(series.values())


def step(count, at):
    return (np.arange(count) >= at).astype(float)


def drive(policy="follower", scene="s1", seed=0, count=40, **replaced):
    run = rollout(straight_poses(count), policy=policy, scene_id=scene, seed=seed)
    replaced = {"offroad": np.zeros(count), "offroad_unknown_frac": np.zeros(count), **replaced}
    return with_series(run, **replaced)


def value(values, name, **where):
    row = values.filter(pl.col("name") == name, *(pl.col(key) == text for key, text in where.items()))
    assert len(row) == 1
    return row["value"][0]


def test_columns_types_and_order_are_alpasims():
    table = metric_table([drive(), with_series(failed_rollout(policy="broken"))], "run-1")
    assert tuple(table.columns) == ALPASIM_COLUMNS + OWN_COLUMNS
    assert table.schema["timestamps_us"] == pl.Int64 and table.schema["values"] == pl.Float64
    assert table.schema["valid"] == pl.Boolean and table.schema["seed"] == pl.Int64
    assert set(table["time_aggregation"].unique()) <= {"mean", "median", "max", "min", "last"}
    assert set(table["name"].unique()) == set(METRICS)
    assert table["run_name"].unique().to_list() == ["run-1"] and table["run_uuid"].n_unique() == 1
    assert table.filter(~pl.col("valid"))["values"].is_nan().all()
    broken = table.filter(pl.col("policy") == "broken")
    assert len(broken) == len(METRICS) and broken["status"].unique().to_list() == ["failed"]
    assert broken["error"].unique().to_list() == ["PlanError: plan has NaN poses"]


def test_same_rollouts_same_bytes_in_any_order(tmp_path):
    scored = [drive(seed=seed) for seed in (0, 1)]
    for name, order in (("a", scored), ("b", scored[::-1])):
        (tmp_path / name).mkdir()
        write_table(metric_table(order, "run"), tmp_path / name)
    for file in ("metrics.parquet", "metrics.csv"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    again = read_table(tmp_path / "a" / "metrics.parquet")
    assert again.equals(metric_table(scored, "run"))
    assert sorted(again["trial"].unique().to_list()) == [0, 1]
    changed = metric_table([drive(offroad=step(40, 9)), drive(seed=1)], "run")
    assert changed["run_uuid"][0] != again["run_uuid"][0]
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == ["metrics.csv", "metrics.parquet"]


def test_twice_the_same_rollout_and_foreign_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="two rollouts of policy 'follower', seed 0, in scene 's1'"):
        metric_table([drive(), drive()], "run")
    pl.DataFrame({"name": ["x"]}).write_parquet(tmp_path / "metrics.parquet")
    with pytest.raises(ValueError, match="is not a metric table: missing columns .'timestamps_us'"):
        read_table(tmp_path / "metrics.parquet")


def test_only_the_first_event_counts():
    away = np.where(np.arange(40) < 30, 0.5, 2.0)
    values = rollout_values(
        metric_table([drive(collision_any=step(40, 10), offroad=step(40, 20), dist_to_gt_trajectory=away)], "r")
    )
    assert value(values, "collision_any") == 1 and value(values, "offroad") == 0
    assert value(values, "dist_to_gt_trajectory") == 0.5
    assert value(values, "time_to_first_event_s") == pytest.approx(1.0)
    assert value(values, "offroad_or_collision") == 1 and value(values, "collision_offroad_mean") == 0.5
    assert value(values, "progress") == pytest.approx(10 / 39)


def test_the_moment_of_first_braking():
    """From the take-over at state 5 to state 20; what comes before, or after a collision, does not count."""
    brakes = np.where(np.arange(40) == 20, 2.5, 1.5)
    run = rollout(straight_poses(40), warm_up=5)
    found = rollout_values(metric_table([with_series(run, braking_mps2=brakes)], "r"))
    assert value(found, "time_to_first_brake_s") == pytest.approx(1.5) and value(found, "braking_mps2") == 2.5
    crashed = with_series(run, braking_mps2=brakes, collision_any=step(40, 15))
    assert value(rollout_values(metric_table([crashed], "r")), "time_to_first_brake_s") is None


def test_two_events_at_once_both_count():
    values = rollout_values(metric_table([drive(collision_any=step(40, 10), offroad=step(40, 10))], "r"))
    assert value(values, "collision_any") == value(values, "offroad") == value(values, "collision_offroad_mean") == 1


def test_alpasim_drops_what_is_four_metres_off_strict_does_not():
    table = metric_table([drive(dist_to_gt_trajectory=np.linspace(0, 8, 40), offroad=step(40, 35))], "r")
    strict, alpasim = rollout_values(table), rollout_values(table, "alpasim")
    assert value(strict, "offroad") == 1 and value(alpasim, "offroad") == 0
    assert value(strict, "censored_4m") == value(alpasim, "censored_4m") == 1
    assert 4 <= value(alpasim, "dist_to_gt_trajectory") < 4.3, "the state that crosses stays"


def test_scene_score():
    good = rollout_values(metric_table([drive(collision_at_fault=np.zeros(40))], "r"))
    assert value(good, "scene_score") == 1.0
    bad = rollout_values(metric_table([drive(collision_any=step(40, 5), collision_at_fault=step(40, 5))], "r"))
    assert value(bad, "scene_score") == 0.0
    unseen = rollout_values(metric_table([drive(offroad=np.full(40, np.nan), collision_at_fault=np.zeros(40))], "r"))
    assert value(unseen, "scene_score") is None and value(unseen, "collision_offroad_mean") is None


def test_a_scene_that_is_mostly_unknown_is_left_out_of_offroad_for_every_policy():
    scored = [
        drive("a", "dark", offroad_unknown_frac=np.full(40, 0.5)),
        drive("b", "dark"),
        drive("a", "bright"),
        drive("b", "bright", offroad=step(40, 4)),
    ]
    values = rollout_values(metric_table(scored, "r"))
    for policy in "ab":
        assert value(values, "offroad", clipgt_id="dark", policy=policy) is None
        assert value(values, "offroad", clipgt_id="bright", policy=policy) == (policy == "b")
    assert value(values, "offroad_unknown_frac", clipgt_id="dark", policy="a") == 0.5


def test_failed_rollouts_are_counted_and_never_averaged():
    scored = [drive(offroad=step(40, 4)), with_series(failed_rollout(policy="follower", scene_id="s1", seed=7))]
    values = rollout_values(metric_table(scored, "r"))
    assert len(values) == 2 * (len(METRICS) + len(DERIVED))
    row = summarize(values).row(by_predicate=pl.col("name") == "offroad", named=True)
    assert (row["n"], row["n_failed"], row["n_valid"], row["mean"]) == (2, 1, 1, 1.0)
    assert values.filter(pl.col("seed") == 7)["error"].unique().to_list() == ["PlanError: plan has NaN poses"]


def test_mean_is_the_scene_mean_of_trial_means_with_an_interval_over_scenes():
    scored = [drive(scene="s1", seed=seed, offroad=step(40, 4)) for seed in range(3)]
    scored += [drive(scene="s2", seed=0), drive(scene="s3", seed=0)]
    table = metric_table(scored, "r")
    row = summarize(rollout_values(table)).row(by_predicate=pl.col("name") == "offroad", named=True)
    assert row["mean"] == pytest.approx(1 / 3) and row["scenes"] == 3
    assert row["low"] == 0.0 and row["high"] == 1.0
    assert summarize(rollout_values(table)).equals(summarize(rollout_values(table)))
    one_scene = summarize(rollout_values(metric_table(scored[:3], "r")))
    assert one_scene["low"].is_null().all() and one_scene["high"].is_null().all()


@pytest.mark.slow
def test_interval_matches_theory_for_many_scenes():
    rng = np.random.default_rng(5)
    hits = rng.random(60) < 0.3
    scored = [drive(scene=f"s{i:02}", count=3, offroad=np.full(3, float(hit))) for i, hit in enumerate(hits)]
    row = summarize(rollout_values(metric_table(scored, "r"))).row(by_predicate=pl.col("name") == "offroad", named=True)
    share = hits.mean()
    half = 1.96 * np.sqrt(share * (1 - share) / 60)
    assert row["low"] == pytest.approx(share - half, abs=0.03) and row["high"] == pytest.approx(share + half, abs=0.03)


def test_time_to_event_counts_from_take_over():
    run = rollout(straight_poses(40), {"parked": standing(40, 25.0, 0.0)}, warm_up=5)
    values = rollout_values(metric_table([(run, score_rollout(run, None))], "r"))
    first = next(t for t, hit in zip(run.t_us, score_rollout(run, None)[1].values, strict=True) if hit == 1)
    assert value(values, "time_to_first_event_s") == pytest.approx((first - T0_US - 5 * STEP_US) / 1e6)
    empty = dataclasses.replace(run, actors={}, actor_sizes_m={})
    assert value(rollout_values(metric_table([(empty, score_rollout(empty, None))], "r")), "collision_any") is None


def test_scene_score_reaches_one_at_four_fifths_of_the_way():
    for progress, score in ((0.6, 0.75), (0.8, 1.0), (0.4, 0.5)):
        run = drive(collision_at_fault=np.zeros(40), progress=np.linspace(0, progress, 40))
        assert value(rollout_values(metric_table([run], "r")), "scene_score") == pytest.approx(score)
