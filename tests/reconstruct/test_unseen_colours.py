"""Gaussians that no image shows take the colours of what is like them."""

import dataclasses

import numpy as np
import pytest

from nurec_sim.reconstruct import unseen_colours
from nurec_sim.reconstruct.unseen_colours import colours_by_likeness
from nurec_sim.types import Gaussians, Label

GREEN, RED, GREY = np.array([[0, 1, 0], [1, 0, 0], [0.5, 0.5, 0.5]], np.float32)


def street(place_m, colours, intensity=np.nan, normal=(1.0, 0, 0), label=Label.OTHER) -> Gaussians:
    """Gaussians with one of each property, or the same for all."""
    count = len(place_m)
    empty = Gaussians.empty()
    zeros = {
        field.name: np.zeros((count, *getattr(empty, field.name).shape[1:]), getattr(empty, field.name).dtype)
        for field in dataclasses.fields(Gaussians)
        if getattr(empty, field.name) is not None
    }
    return dataclasses.replace(
        empty,
        **zeros
        | {
            "mean_m": np.asarray(place_m, np.float32),
            "rgb": np.broadcast_to(np.asarray(colours, np.float32), (count, 3)).copy(),
            "intensity": np.broadcast_to(np.float32(intensity), count).copy(),
            "normal": np.broadcast_to(np.asarray(normal, np.float32), (count, 3)).copy(),
            "label": np.broadcast_to(np.asarray(label, zeros["label"].dtype), count).copy(),
        },
    )


def test_the_mean_is_weighted_by_the_squares_of_likeness():
    """1 and 2 units of height away (1 m each) weigh 1 and 1/4, to the 1e-3 that keeps a distance of 0 finite."""
    made = street([[0, 0, 0], [0, 0, 1], [0, 0, -2]], [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    got = colours_by_likeness(made, np.array([False, True, True]))
    assert got[0] == pytest.approx([0.8, 0.2, 0.0], abs=1e-3)
    np.testing.assert_array_equal(got[1:], made.rgb[1:])


def test_ten_metres_along_the_street_count_like_one_metre_of_height():
    made = street([[0, 0, 0], [10, 0, 0], [0, 0, 1]], [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert colours_by_likeness(made, np.array([False, True, True]))[0] == pytest.approx([0.5, 0.5, 0.0], abs=1e-3)


@pytest.mark.parametrize(
    ("unlike", "alike"),
    [
        ({"intensity": [0.1, 0.9, 0.1]}, "intensity"),
        ({"normal": [[1.0, 0, 0], [0, 0, 1], [1, 0, 0]]}, "normal"),
        ({"label": [Label.ROAD, Label.OTHER, Label.ROAD]}, "label"),
    ],
)
def test_what_differs_in_kind_counts_less_than_what_is_farther_away(unlike, alike):
    """The second is nearer (1 m against 5 m) but of another kind than the first; the third is of its kind."""
    made = street([[0, 0, 0], [1, 0, 0], [5, 0, 0]], [GREY, RED, GREEN], **unlike)
    red, green, _ = colours_by_likeness(made, np.array([False, True, True]))[0]
    assert green > red, alike


def test_one_return_brighter_than_those_around_it_keeps_their_colour():
    """Of 24 on dark ground one that no image shows is as bright as the green wall; most around it are dark."""
    place = [*np.column_stack([np.arange(24) * 0.1, np.zeros((24, 2))]), [3, 0, 0]]
    made = street(place, [*[RED] * 24, GREEN], intensity=[0.1] * 12 + [0.9] + [0.1] * 11 + [0.9])
    # The 13th is one of every third, whose median is taken.
    assert colours_by_likeness(made, np.arange(25) != 12)[12] == pytest.approx(RED, abs=0.02)


def test_thirty_two_are_mixed_and_nothing_changes_if_all_or_none_are_seen(monkeypatch):
    made = street([[0, 0, 0], *[[0, 0, 1.0]] * 32, [0, 0, 1.1]], [GREY, *[RED] * 32, GREEN])
    some = np.arange(34) > 0
    assert colours_by_likeness(made, some)[0] == pytest.approx(RED), "the 33rd does not count"
    for seen in (np.ones(34, bool), np.zeros(34, bool)):
        np.testing.assert_array_equal(colours_by_likeness(made, seen), made.rgb)
    monkeypatch.setattr(unseen_colours, "MOST_SEEN", 1)
    assert colours_by_likeness(made, np.arange(34) > 32)[0] == pytest.approx(GREEN)


def test_what_shares_a_cell_shares_neighbours_and_weighs_them_by_its_own_place():
    made = street([[0, 0, 0], [0, 0, 0.04], [0, 0, 1], [0, 0, -1]], [GREY, GREY, RED, GREEN])
    first, second, *_ = colours_by_likeness(made, np.arange(4) > 1)
    assert first == pytest.approx([0.5, 0.5, 0])
    near, far = 1 / 0.961**2, 1 / 1.041**2
    assert second == pytest.approx([near / (near + far), far / (near + far), 0], abs=1e-4)


def test_cells_part_what_differs_along_any_feature():
    """Numbers of cells start anew only after 65 km."""
    for column in range(6):
        features = np.zeros((4, 6))
        features[:, column] = [0, 0.04, 0.1, -0.1]
        centre, cell = unseen_colours._cells(features)
        assert cell[0] == cell[1]
        assert len({*cell[1:]}) == 3
        np.testing.assert_allclose(centre[cell, column], [0, 0, 0.1, -0.1])
