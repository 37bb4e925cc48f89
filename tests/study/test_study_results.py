"""The statistics and the report of studies whose answer is known."""

import json

import numpy as np
import polars as pl
import pytest

from nurec_sim.metrics.aggregate import DERIVED
from nurec_sim.metrics.agreement import tau_b_drop
from nurec_sim.metrics.series import METRICS
from nurec_sim.study import make_study
from nurec_sim.study.doubt import ANY, LOW_SUPPORT, OTHER_START, OTHER_WORLD, Doubt
from nurec_sim.study.page import render_study
from nurec_sim.study.results import agreement_rows, as_json, results_of

SCENES = 10
POLICIES = ("blind_a", "blind_b", "sees_a", "sees_b")
SEEING = ("sees_a", "sees_b")
CONFIG = make_study(
    {
        "name": "known",
        "families": [{"name": "bend", "seeds": list(range(SCENES))}],
        "policies": list(POLICIES),
        "worlds": ["truth", "lift"],
        "controls": {"of": "lift", "how": ["faint"]},
        "trials": 2,
    }
)  # fmt: skip
SHOWN = ("collision_any", "offroad", "offroad_unknown_frac", "progress", "collision_offroad_mean",
         "offroad_or_collision", "scene_score")  # fmt: skip
TRUE_FRACTIONS = (0.9, 0.6, 0.8, 0.1)


def values(by_world, failed=()):
    """Rows as ``rollout_values`` gives them; policy p has an event in the first ``fraction`` of the scenes."""
    rows = []
    units = {name: metric.unit for name, metric in METRICS.items()} | {
        name: unit for name, (unit, _) in DERIVED.items()
    }
    for world, fractions in by_world.items():
        for policy, fraction in zip(POLICIES, fractions, strict=True):
            for scene_id, _, town in CONFIG.scenes:
                for trial, seed in enumerate(CONFIG.seeds(town)):
                    event = float(town < round(fraction * SCENES))
                    key = (world, policy, scene_id, seed)
                    ok = key not in failed
                    for name, unit in units.items():
                        found = {"offroad": event, "collision_offroad_mean": event / 2, "offroad_or_collision": event,
                                 "scene_score": 1 - event, "support_least": None}  # fmt: skip
                        rows.append((scene_id, "reconstruction", world, policy, trial, seed, "/".join(map(str, key)),
                                     "ok" if ok else "failed", "" if ok else "lens <cap> on", name, unit,
                                     found.get(name, 0.0) if ok else None, ok))  # fmt: skip
    columns = ["clipgt_id", "world", "reconstruction", "policy", "trial", "seed", "rollout_id", "status", "error",
               "name", "unit", "value", "valid"]  # fmt: skip
    return pl.DataFrame(rows, columns, orient="row", infer_schema_length=None)


GOOD = {"truth": TRUE_FRACTIONS, "lift": TRUE_FRACTIONS, "lift-faint": (0.9, 0.6, 0.1, 0.8)}


@pytest.fixture(scope="module")
def good():
    return results_of(CONFIG, values(GOOD), SEEING)


def test_a_perfect_reconstruction_and_a_control_that_swaps_two_policies(good):
    """Four policies have six pairs; to swap 0.8 and 0.1 puts three of them in the other order: tau (3 - 3) / 6."""
    found = as_json(good)
    assert found["agreement"]["lift/scene_score"]["tau_b"]["value"] == pytest.approx(1.0)
    assert found["agreement"]["lift-faint/scene_score"]["tau_b"]["value"] == pytest.approx(0.0)
    assert found["agreement_of_policies_that_see"]["lift-faint/scene_score"]["tau_b"]["value"] == pytest.approx(-1.0)
    assert found["controls"]["faint/scene_score"]["value"] == pytest.approx(1.0)
    assert found["noise_ceiling"]["scene_score"]["tau_b"]["value"] == pytest.approx(1.0)
    assert found["failed"] == 0 and found["rollouts"] == SCENES * 3 * 4 * 2
    assert ("lift-faint", "scene_score", "0.00") in [row[:3] for row in agreement_rows(json.loads(json.dumps(found)))]


def test_verdicts_with_low_support_are_counted_apart():
    """In lift sees_b has an event in the first three scenes instead of one; in these its images had little support."""
    table = values({"truth": TRUE_FRACTIONS, "lift": (0.9, 0.6, 0.8, 0.3), "lift-faint": TRUE_FRACTIONS})
    town = pl.col("clipgt_id").str.split("-").list.last().cast(pl.Int64)
    mine = (pl.col("name") == "support_least") & (pl.col("reconstruction") == "lift")
    least = pl.when(town < 3).then(0.3).otherwise(0.9)
    sees = pl.col("policy").is_in(list(SEEING))
    table = table.with_columns(pl.when(mine & sees).then(least).otherwise("value").alias("value"))
    results = results_of(CONFIG, table, SEEING)
    # Two policies, ten scenes, two trials: 12 of 40 have low support, and of these sees_b is wrong in scenes 1 and 2.
    assert results.doubts[LOW_SUPPORT] == {"lift": Doubt(12, 4, 28, 0)}
    assert results.doubts[LOW_SUPPORT]["lift"].ratio is None
    assert Doubt(12, 4, 28, 2).ratio == pytest.approx((4 / 12) / (2 / 28))
    assert Doubt(9, 9, 28, 2).ratio is None and Doubt(12, 4, 9, 2).ratio is None
    assert as_json(results)["verdicts_to_doubt"][LOW_SUPPORT]["lift"]["doubtful_wrong"] == 4
    page = render_study(results)
    assert "low support" in page and "too few to say" in page and "4 of 12<small>33 %</small>" in page
    assert OTHER_WORLD not in results.doubts and f"{OTHER_WORLD}</b>" not in page, "there is no other"


def test_verdicts_that_another_start_changes_are_counted_apart():
    """In lift both policies end otherwise in one trial of scenes 8 and 9, where in truth none has an event."""
    table = values({"truth": TRUE_FRACTIONS, "lift": TRUE_FRACTIONS, "lift-faint": TRUE_FRACTIONS})
    late = pl.col("clipgt_id").str.ends_with("-8") | pl.col("clipgt_id").str.ends_with("-9")
    mine = (pl.col("reconstruction") == "lift") & (pl.col("name") == "collision_any") & (pl.col("trial") == 1)
    table = table.with_columns(pl.when(late & mine).then(1.0).otherwise("value").alias("value"))
    results = results_of(CONFIG, table, SEEING)
    # Two policies, two scenes: both trials are doubted, and the second is wrong.
    assert results.doubts[OTHER_START] == {"lift": Doubt(8, 4, 32, 0)}
    assert ANY not in results.doubts, "no other reason is known"
    once = results_of(CONFIG, table.filter(pl.col("trial") == 1), SEEING)
    assert OTHER_START not in once.doubts, "a single trial says nothing of another"


def test_verdicts_that_another_reconstruction_contradicts_are_counted_apart():
    """sees_b has an event in scene 0 in truth, in 0 to 2 in lift, in 0 and 1 in dense; sees_a in 0 to 7, 7 and 8.

    So they contradict each other in scene 2, where lift is wrong, and in scene 8, where dense is; in scene 1 both are
    wrong. Blind policies differ as well here, and do not count; the control contradicts nobody.
    """
    config = CONFIG.model_copy(update={"worlds": ("truth", "lift", "dense")})
    table = values(
        {"truth": TRUE_FRACTIONS, "lift": (0.9, 0.6, 0.8, 0.3), "dense": (0.5, 0.6, 0.9, 0.2)},
    )
    control = table.filter(reconstruction="lift").with_columns(
        pl.lit("lift-faint").alias("reconstruction"),
        (pl.col("rollout_id") + "-c"),
        (1 - pl.col("value")).alias("value"),
    )
    results = results_of(config, pl.concat([table, control]), SEEING)
    # 2 policies x 10 scenes x 2 trials; both trials end alike, so either reason for doubt is this one.
    assert results.doubts[OTHER_WORLD] == {"lift": Doubt(4, 2, 36, 2), "dense": Doubt(4, 2, 36, 2)}
    assert results.doubts[ANY] == results.doubts[OTHER_WORLD]
    page = render_study(results)
    assert page.count(f"{OTHER_WORLD}</b>") == 2 and "2 of 36<small>6 %</small>" in page
    assert results_of(config, pl.concat([table, control]), ()).doubts == {}, "blind policies end alike anyway"


def test_moments_of_first_braking_are_compared_with_the_truth():
    """sees_a brakes at 3.0 s in truth; in lift 0.1 s later in scenes 0 to 5, 0.7 s earlier in 6, not at all in 7.

    In scene 8 it brakes in lift only, in scene 9 in neither; two trials each.
    """
    later = {6: -0.7, 7: None, 8: 0.0, 9: None}
    table = values({"truth": TRUE_FRACTIONS, "lift": TRUE_FRACTIONS, "lift-faint": TRUE_FRACTIONS})
    town = pl.col("clipgt_id").str.split("-").list.last().cast(pl.Int64)
    moment = pl.when(pl.col("reconstruction") == "truth").then(pl.when(town < 8).then(3.0)).when(
        pl.col("reconstruction") == "lift"
    ).then(3.0 + town.replace_strict(later, default=0.1, return_dtype=pl.Float64))  # fmt: skip
    mine = (pl.col("name") == "time_to_first_brake_s") & (pl.col("policy") == "sees_a")
    table = table.with_columns(pl.when(mine).then(moment).otherwise("value").alias("value"))
    results = results_of(CONFIG, table, SEEING)
    found = results.braking["lift", "sees_a"]
    assert (found.both, found.early, found.late, found.missed, found.false, found.neither) == (14, 2, 0, 2, 2, 2)
    assert found.median_s == pytest.approx(0.1) and found.worst_s == pytest.approx(0.7)
    control = results.braking["lift-faint", "sees_a"]
    assert (control.both, control.missed, control.neither, control.median_s) == (0, 16, 4, None)
    assert ("lift", "blind_a") not in results.braking
    assert as_json(results)["first_braking"]["lift/sees_a"]["false"] == 2
    page = render_study(results)
    assert "When policies first brake" in page and "0.1<small>at most 0.7</small>" in page


def test_the_drop_of_tau_by_hand():
    """Three policies that both worlds and every resample order alike, against one that reverses them."""
    truth = np.repeat([[0.1], [0.5], [0.9]], 5, axis=1)
    drop = tau_b_drop(truth, truth, 1 - truth)
    assert (drop.value, drop.low, drop.high) == (2.0, 2.0, 2.0) and drop.resolved
    assert tau_b_drop(truth, truth, np.ones_like(truth)).value == 1.0, "a world that ties all ranks none"
    assert tau_b_drop(truth[:, :1], truth[:, :1], truth[:, :1]).low is None


def test_controls_that_rank_as_well_show_that_the_study_cannot_discriminate(good):
    same = results_of(CONFIG, values(GOOD | {"lift-faint": TRUE_FRACTIONS}), SEEING)
    assert good.discriminates is True and same.discriminates is False
    assert "This study cannot discriminate" in render_study(same)
    assert "The study discriminates" in render_study(good)
    without = CONFIG.model_copy(update={"controls": CONFIG.controls.model_copy(update={"how": ()})})
    assert results_of(without, values({"truth": TRUE_FRACTIONS, "lift": TRUE_FRACTIONS}), SEEING).discriminates is None


def test_blind_policies_that_drive_differently_are_named(good):
    assert good.differing == ()
    odd = values(GOOD | {"lift": (0.9, 0.5, 0.8, 0.1)})
    found = results_of(CONFIG, odd, SEEING)
    assert found.differing == ("blind_b",)
    assert "fault of the simulator" in render_study(found)


def test_a_blind_policy_judged_by_another_road_is_no_difference():
    other = values(GOOD).with_columns(
        pl.when((pl.col("reconstruction") == "lift") & (pl.col("name") == "offroad_unknown_frac"))
        .then(0.5).otherwise(pl.col("value")).alias("value")
    )  # fmt: skip
    assert results_of(CONFIG, other, SEEING).differing == ()


def test_failed_rollouts_are_counted_and_escaped():
    failed = {("lift", "sees_a", "bend-0", 0), ("lift", "sees_b", "bend-0", 0)}
    found = results_of(CONFIG, values(GOOD, failed), SEEING)
    assert found.failed == 2
    page = render_study(found)
    assert "2 failed" in page and "lens &lt;cap&gt; on" in page and "lens <cap>" not in page


def test_few_scenes_are_warned_of(good):
    few = good.config.families[0].model_copy(update={"seeds": (0, 1)})
    small = CONFIG.model_copy(update={"families": (few,)})
    kept = good.values.filter(pl.col("clipgt_id").is_in(["bend-0", "bend-1"]))
    assert "Only 2 scenes" in render_study(results_of(small, kept, SEEING))
    assert "Only 10 scenes" not in render_study(good)


def test_the_same_values_give_the_same_page(good):
    page = render_study(good)
    assert page == render_study(results_of(CONFIG, values(GOOD), SEEING))
    for text in (
        "Noise ceiling",
        "What the scenes expose",
        "Pairs of policies",
        "No rollout ends differently",
        "none failed",
    ):
        assert text in page, text
