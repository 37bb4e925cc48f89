"""Matching and counts of detections, by hand."""

import numpy as np

from nurec_sim.metrics.detection import Places, added, agreement, count, match, range_bin, share

KINDS = ("vehicle", "person")


def places(*rows):
    return Places(
        np.array([row[0] for row in rows], np.int64), np.array([row[1:] for row in rows], float).reshape(-1, 2)
    )


def test_the_surest_detection_takes_the_nearest_free_object_of_its_kind():
    there = places((0, 0, 10), (0, 3, 10), (1, 0, 10.5))
    # The first is 1.6 m from the second object and 1.4 m from the first; the second detection gets what is left.
    found = places((0, 1.4, 10), (0, 0.2, 10), (0, 1.5, 10), (1, 0, 12.4), (1, 0, 12.4))
    owner, taken = match(found, there)
    assert owner.tolist() == [0, -1, 1, 2, -1]  # 0.2 m beside an object that is taken, 2.8 m from the other
    assert taken.tolist() == [True, True, True]


def test_two_metres_seen_from_above_are_the_limit():
    there = places((0, 0, 10))
    assert match(places((0, 0, 12.0)), there)[0].tolist() == [0]
    assert match(places((0, 0, 12.01)), there)[0].tolist() == [-1]
    assert match(places((1, 0, 10)), there)[0].tolist() == [-1]


def test_objects_that_are_not_to_be_found_take_detections_without_counting():
    there, visible = places((0, 0, 10), (0, 0, 11)), np.array([True, False])
    owner, taken = match(places((0, 0, 11), (0, 0, 11.2), (0, 9, 9)), there, visible)
    # The first choice is a visible object, although a hidden one is nearer.
    assert owner.tolist() == [0, -2, -1] and taken.tolist() == [True, False]


def test_counts_bin_detections_and_objects_by_their_own_distance():
    there = places((0, 0, 29), (0, 0, 31), (0, 0, 58), (1, 5, 5))
    found = places((0, 0, 30.5), (0, 0, 10), (0, 0, 61), (1, 5, 6))
    counts = count(found, there, np.ones(4, bool), KINDS)
    # 30.5 m takes 31 m, which is nearer; 61 m is beyond the bins, 3 m from anything.
    assert counts["vehicle 0-30 m"] == {"found": 1, "right": 0, "there": 1, "seen": 0}
    assert counts["vehicle 30-60 m"] == {"found": 1, "right": 1, "there": 2, "seen": 1}
    assert counts["person 0-30 m"] == {"found": 1, "right": 1, "there": 1, "seen": 1}
    total = added([counts, counts])["vehicle 30-60 m"]
    assert total == {"found": 2, "right": 2, "there": 4, "seen": 2} and share(total["seen"], total["there"]) == 0.5
    assert share(0, 0) is None and range_bin(np.array([[18.0, 24.0], [0, 60]])).tolist() == [1, -1]


def test_agreement_counts_detections_that_are_there_again():
    one, other = places((0, 0, 10), (0, 0, 40)), places((0, 0, 11), (0, 0, 43))
    assert agreement(one, other, KINDS)["vehicle 0-30 m"] == {"found": 1, "again": 1}
    assert agreement(one, other, KINDS)["vehicle 30-60 m"] == {"found": 1, "again": 0}
