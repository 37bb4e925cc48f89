"""Cells of a sweep's beams, by hand: 0.2 degrees wide, columns from straight back, counterclockwise."""

import numpy as np
import pytest

from nurec_sim.reconstruct import free_space


def beams_of(*along):
    fired = np.linspace(0.2, 0.8, len(along))
    return free_space._beams((0, 1), np.eye(4), np.zeros(3), np.array(along, float), fired)


@pytest.mark.parametrize(
    ("along", "column"),
    [((5.0, 0.0, 0.0), 900), ((0.0, 5.0, 0.0), 1350), ((-5.0, 0.0, 0.0), 0), ((-5.0, -0.01, 0.0), 0)],
)
def test_beams_are_found_in_the_cell_of_their_direction(along, column):
    beams = beams_of(along)
    assert np.argwhere(beams.image >= 0).tolist() == [[0, column]]
    assert beams.reach_m[0, column] == pytest.approx(5.0, abs=1e-4)


def test_rows_are_numbered_from_the_lowest_beam():
    low, high = (10 * np.array([np.cos(a), 0, np.sin(a)]) for a in np.radians([-1.1, 2.3]))
    beams = beams_of(low, high)
    assert beams.low == -6
    assert np.argwhere(beams.image >= 0).tolist() == [[0, 900], [17, 900]]


def test_returns_within_a_metre_and_those_of_no_place_are_no_beams():
    beams = beams_of((0.9, 0.0, 0.0), (np.nan, 0.0, 0.0), (3.0, 0.0, 4.0))
    assert beams.beams == pytest.approx(np.array([[0.6, 0.0, 0.8, 5.0, 0.8]]))
    assert beams.fraction == pytest.approx(0.8), "of the only column with a beam"
