"""Found actors against the boxes of a log: counted by hand."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from nurec_sim import geometry
from nurec_sim.evaluate.actor_scores import score_actors
from nurec_sim.evaluate.log_tables import figure_rows
from nurec_sim.types import Track, Trajectory

T_US = 1_000_000 + 100_000 * np.arange(11)


def track(id, x_m, y_m, x_mps, label="automobile", labelled=True):
    poses = np.stack([geometry.pose_from_xyyaw(x_m + x_mps * (t - T_US[0]) / 1e6, y_m, 0) for t in T_US])
    return Track(id, label, (4.0, 1.8, 1.5), Trajectory(T_US, poses), labelled=labelled)


CLIP = SimpleNamespace(
    ego=Trajectory(T_US, np.tile(np.eye(4), (11, 1, 1))),
    tracks=(
        track("seen", 10.0, 0.0, 5.0),
        track("missed", 10.0, 8.0, -5.0),
        track("parked", 20.0, 12.0, 0.0),
        track("far", 60.0, 0.0, 5.0),
        track("walker", 5.0, -6.0, 1.5, "person"),
    ),
)


def scores(*found):
    return score_actors(CLIP, SimpleNamespace(tracks=found))


def test_instants_near_the_car_are_counted():
    found = (
        track("found-1", 10.5, 0.5, 5.4, labelled=False),  # beside the one that is seen
        track("found-2", 20.0, 12.0, 0.0, labelled=False),  # at the parked car: a right place, but nothing that moves
        track("found-3", -20.0, 0.0, 5.0, labelled=False),  # at nothing
        track("found-4", 60.0, 0.0, 5.0, labelled=False),  # too far away
    )
    got = scores(*found)
    assert got["instants"] == {"moving vehicles": 22, "moving people": 11, "found actors": 33}
    assert got["recall"] == 0.5 and got["recall_people"] == 0.0 and got["precision"] == pytest.approx(2 / 3)
    assert got["centre_m"] == pytest.approx(np.hypot(0.7, 0.5)) and got["speed_mps"] == pytest.approx(0.4)


def test_a_found_actor_counts_for_one_box_only():
    assert scores(track("found-1", 5.0, -5.0, 1.5, labelled=False))["recall_people"] == 1.0
    two = (track("a", 5.0, -6.5, 1.5, labelled=False), track("b", 5.0, -5.5, 1.5, labelled=False))
    assert scores(*two)["precision"] == 0.5


def test_centres_more_than_two_metres_apart_do_not_match():
    assert scores(track("found-1", 10.0, -1.9, 5.0, labelled=False))["recall"] == 0.5
    assert scores(track("found-1", 10.0, -2.1, 5.0, labelled=False))["recall"] == 0.0


def test_nothing_is_compared_without_boxes_or_found_actors():
    assert scores(*CLIP.tracks) is None
    bare = SimpleNamespace(ego=CLIP.ego, tracks=())
    assert score_actors(bare, SimpleNamespace(tracks=[track("found-1", 0, 0, 1, labelled=False)])) is None
    rendered_only = dataclasses.replace(track("moving-1", 10, 0, 5, labelled=False), actor=False)
    assert scores(rendered_only) is None


def test_the_table_names_what_is_compared():
    figures = {"image": {}, "lidar": None, "free_space": None, "road": None, "counts": {"static": 1, "dynamic": 1}}
    rows = figure_rows(figures | {"seconds": {}, "actors": scores(track("found-1", 10, 0, 5, labelled=False))})
    texts = {row.name: row.text for row in rows if row.group == "Found actors against the log's boxes, up to 40 m"}
    assert texts["recall of moving vehicles"] == "0.500" and texts["precision"] == "1.000"
    assert texts["instants of moving vehicles"] == "22" and texts["recall of moving people"] == "0.000"
