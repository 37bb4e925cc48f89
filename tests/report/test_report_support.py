"""Support in the report: the curve, the mark of doubtful verdicts, and the distance from which they are."""

import re
from dataclasses import replace

import numpy as np
import pytest
from metrics_worlds import rollout, standing, straight_poses

from nurec_sim.metrics import find_contacts, score_rollout
from nurec_sim.report import ReportRollout
from nurec_sim.report.charts import time_view
from nurec_sim.report.events import changed_by_seed, drive_of
from nurec_sim.report.rollout_card import _tags
from nurec_sim.report.support import LOW, low_support, support_by_distance, verdict_support
from nurec_sim.report.trust import trust


def entry(support, y=0.0, actors=None, first=0):
    """A straight drive of 3 s at 10 m/s beside the recorded x axis; support by seconds after the start."""
    run = rollout(straight_poses(30, y=y), actors or {}, straight_poses(60), first)
    found = {int(run.t_us[0]) + round(1e6 * s): value for s, value in support.items()}
    series = score_rollout(run, None, support=found)
    return ReportRollout(run, {one.name: one for one in series}, tuple(find_contacts(run)))


def test_a_verdict_is_worth_its_least_supported_image():
    assert verdict_support(entry({0.0: 0.9, 1.0: 0.7, 2.0: 0.8})) == pytest.approx(0.7)
    assert verdict_support(entry({})) is None


def test_images_after_the_event_do_not_count():
    """A parked car about 10 m ahead of the front bumper: contact after about a second."""
    hit = entry({0.0: 0.9, 1.0: 0.7, 2.0: 0.1}, actors={"parked": standing(30, 16.0, 0.0)})
    assert hit.contacts and (hit.contacts[0].t_us - hit.rollout.t_us[0]) / 1e6 == pytest.approx(1.0, abs=0.2)
    assert verdict_support(hit) == pytest.approx(0.7)


def test_images_of_the_replayed_log_do_not_count():
    assert verdict_support(entry({0.0: 0.2, 1.0: 0.8, 2.0: 0.7}, first=5)) == pytest.approx(0.7)


def test_a_doubtful_verdict_is_marked():
    assert low_support(entry({1.0: LOW - 0.2})) == f"low support: {100 * (LOW - 0.2):.0f} %"
    assert low_support(entry({1.0: LOW})) == "" and low_support(entry({})) == ""
    assert "low support" in _tags(entry({1.0: 0.1}), ()) and "low support" not in _tags(entry({1.0: 0.9}), ())


def test_verdicts_that_change_with_the_seed_are_marked():
    """The second seed meets a parked car; another policy's seeds end alike."""
    parked = {"parked": standing(30, 16.0, 0.0)}
    free, hit, other = entry({}), entry({}, actors=parked), entry({})
    hit = replace(hit, rollout=replace(hit.rollout, seed=1))
    others = [replace(other, rollout=replace(other.rollout, policy="other", seed=seed)) for seed in (0, 1)]
    changing = changed_by_seed([free, hit, *others])
    assert changing == {drive_of(free)} == {drive_of(hit)} and drive_of(others[0]) not in changing
    tag = "another seed ends differently"
    assert tag in _tags(free, changing) and tag in _tags(hit, changing) and tag not in _tags(others[0], changing)
    said = words(trust([free, hit, *others], [free.rollout.reconstruction]))
    assert f"from one seed to another: {free.rollout.policy} in {free.rollout.scene_id}" in said and "None" not in said
    assert "All seeds drove the same" in words(trust(others, [free.rollout.reconstruction]))
    beside = replace(others[1], rollout=replace(entry({}, y=0.1).rollout, policy="other", seed=1))
    assert "None does." in words(trust([others[0], beside], [free.rollout.reconstruction]))
    assert "change with the seed" not in words(trust([free], [free.rollout.reconstruction])), "one seed says nothing"


def test_the_curve_stands_below_the_others_where_support_is_known():
    known, unknown = (time_view([entry(support)]) for support in ({0.5: 0.9, 1.5: 0.4}, {}))
    (curve,) = [trace for trace in known["data"] if trace["yaxis"] == "y5"]
    assert curve["x"] == [0.5, 1.5] and curve["y"] == [0.9, 0.4]
    assert known["layout"]["yaxis5"]["range"] == [0, 1.02] and known["layout"]["xaxis"]["anchor"] == "y5"
    assert "yaxis5" not in unknown["layout"] and unknown["layout"]["xaxis"]["anchor"] == "y4"
    assert known["layout"]["yaxis5"]["domain"][0] == pytest.approx(0, abs=1e-3)
    assert known["layout"]["height"] > unknown["layout"]["height"]


def words(text):
    return " ".join(re.sub(r"<[^>]+>", " ", text).split())


def test_the_distance_from_which_verdicts_rest_on_invention_is_said():
    times = np.arange(0.5, 2.5, 0.5)
    near = entry(dict.fromkeys(times, 0.9), y=0.2)
    far = entry(dict.fromkeys(times, 0.3), y=-1.7)
    said = words(support_by_distance([near, far], ["lift"]))
    assert "In lift what policies saw rests on invention from 1.5 m beside the recorded path on" in said
    # Columns: instants, then 0 to 0.5 m, 0.5 to 1 m, 1 to 1.5 m, 1.5 to 2 m, 2 to 3 m, beyond.
    assert "lift 8 90 % none none 30 % none none" in said
    good = words(support_by_distance([near], ["lift"]))
    assert f"In lift images kept {100 * LOW:.0f} % support as far as policies drove (0.2 m" in good
    assert "Support is not known" in words(support_by_distance([entry({})], ["lift"]))
