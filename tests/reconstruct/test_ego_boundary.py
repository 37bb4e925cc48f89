"""The boundary of the ego vehicle from maps of evidence and edges, and the edges that stay while the camera moves."""

import numpy as np
import pytest

from nurec_sim.reconstruct.ego_vehicle.boundary import _without_dents, vehicle_above, vehicle_below
from nurec_sim.reconstruct.ego_vehicle.evidence import static_gradient

HEIGHT, WIDTH, TOP = 100, 200, 60
"""Size of the maps, and the row where the vehicle begins."""


def maps() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Evidence for a vehicle in its lower half and for the street in the upper, an edge between, ground from row 20."""
    ego, street, edges = np.zeros((3, HEIGHT, WIDTH))
    ego[80:], street[:50], edges[TOP] = 1.0, 1.0, 1.0
    near = np.arange(HEIGHT)[:, None] >= np.full(WIDTH, 20)
    return ego, street, edges, near


def first_rows(mask: np.ndarray) -> np.ndarray:
    return np.where(mask.any(axis=0), mask.argmax(axis=0), len(mask))


def test_the_vehicle_begins_at_the_edge_between_its_evidence_and_the_streets():
    np.testing.assert_array_equal(first_rows(vehicle_below(*maps())), TOP)


def test_without_an_edge_it_begins_half_a_window_within_its_evidence():
    """A window of 9 pixels that touches it from above has its centre 4 pixels above it."""
    ego, street, edges, near = maps()
    edges[:] = 0
    np.testing.assert_array_equal(first_rows(vehicle_below(ego, street, edges, near)), 84)


def test_the_blur_of_its_edge_belongs_to_it():
    """Rows down to a quarter of the edge."""
    ego, street, edges, near = maps()
    edges[TOP - 3 : TOP] = np.array([0.1, 0.3, 0.6])[:, None]
    np.testing.assert_array_equal(first_rows(vehicle_below(ego, street, edges, near)), TOP - 2)


@pytest.mark.parametrize(("strength", "row"), [(1.0, TOP), (0.5, 70)])
def test_of_two_edges_the_upper_one_counts_if_no_line_of_the_street_would_stay_there(strength: float, row: int):
    """Edges of 0.5 may be lines along the motion: the vehicle is what is certain of it."""
    ego, street, edges, near = maps()
    edges[[TOP, 70]] = strength
    np.testing.assert_array_equal(first_rows(vehicle_below(ego, street, edges, near)), row)


@pytest.mark.parametrize(("width", "closed"), [(12, True), (40, False)])
def test_narrow_dents_are_closed(width: int, closed: bool):
    """8 % of 200 columns are 16, an odd window 17."""
    ego, street, edges, near = maps()
    edges[TOP, 80 : 80 + width], edges[75, 80 : 80 + width] = 0.0, 1.0
    street[:75, 80 : 80 + width] = 1.0
    rows = first_rows(vehicle_below(ego, street, edges, near))
    assert (rows[:80] == TOP).all() and (rows[80 + width :] == TOP).all()
    assert (rows[85 : 75 + width] == (TOP if closed else 75)).all()


@pytest.mark.parametrize(
    ("cut", "bottom", "street_seen", "closed"),
    [(0.5, 0.55, 0.0, True), (0.5, 0.6, 0.0, False), (0.5, 0.55, 0.2, False), (0.0, 0.5, 0.0, False)],
)
def test_wide_dents_are_closed_where_the_paint_mirrors_an_edge(
    cut: float, bottom: float, street_seen: float, closed: bool
):
    """40 columns: an edge that goes on across the dent, one at its bottom, and what in it speaks for the street."""
    ego, street, edges, near = maps()
    edges[TOP, 80:120], edges[TOP + 2, 80:120], edges[70, 80:120] = 0.0, cut, bottom
    street[TOP:70, 80:120] = street_seen
    rows = first_rows(vehicle_below(ego, street, edges, near))
    assert (rows[:80] == TOP).all() and (rows[120:] == TOP).all()
    assert (rows[85:115] == (TOP if closed else 70)).all()


def test_dents_of_a_slanted_boundary_are_closed_along_its_slope():
    """One row down every four columns; a dent of 12 columns, 15 rows deep."""
    ego, street, edges, near = maps()
    rows, columns = np.indices((HEIGHT, WIDTH))
    side = 30 + columns[0] // 4
    ego, street = (rows > side + 15) * 1.0, (rows < side - 5) * 1.0
    edges[:] = 0
    edges[side, columns[0]] = 1.0
    # Closed along its rows, the dent would be closed up to its lower end, three rows below the upper one.
    street[:, 90:102] = rows[:, 90:102] < side[90:102] + 15
    edges[:, 90:102] = rows[:, 90:102] == side[90:102] + 15
    found = first_rows(vehicle_below(ego, street, edges, near))
    assert np.abs(found - side).max() <= 1


def test_a_dent_between_what_reaches_the_upper_end_of_the_image_ends_there():
    """A boundary that rises by a row every column up to the first row, and a dent beside it."""
    rows = np.maximum(60 - np.arange(WIDTH), 0)
    rows[55:63] = 20
    closed = _without_dents(rows, HEIGHT, 0.25)
    assert closed.min() == 0 and (closed <= rows).all()


@pytest.mark.parametrize("doubt", ["too little evidence", "contradicted", "too small"])
def test_what_is_in_doubt_is_no_vehicle(doubt: str):
    ego, street, edges, near = maps()
    if doubt == "too little evidence":
        # In half of its rows: 0.04 per pixel.
        ego[80:] = 0.08
    elif doubt == "contradicted":
        ego[80:], street[TOP:] = 0.3, 0.1
    else:
        ego[80:], edges[:], edges[99] = 0.0, 0.0, 1.0
        ego[99] = 1.0
        near[:, 100:] = False
    assert not vehicle_below(ego, street, edges, near).any()


def hanging() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ten dark rows above an edge, sky below it, ground from row 60."""
    bright, edges = np.ones((HEIGHT, WIDTH), bool), np.zeros((HEIGHT, WIDTH))
    bright[:10], edges[9] = False, 1.0
    return bright, edges, np.arange(HEIGHT)[:, None] >= np.full(WIDTH, 60)


def test_what_hangs_into_the_image_ends_at_its_edge():
    mask = vehicle_above(*hanging())
    assert mask[:10].all() and not mask[10:].any()


def test_it_does_not_reach_through_what_is_bright():
    """An edge 30 rows further down earns as much, and costs what lies between."""
    bright, edges, near = hanging()
    edges[9], edges[40] = 0.9, 1.0
    bright[30:41] = False
    mask = vehicle_above(bright, edges, near)
    assert mask[:10].all() and not mask[10:].any()


@pytest.mark.parametrize("doubt", ["bright", "open", "brighter than what is below", "a sky"])
def test_what_is_in_doubt_does_not_hang(doubt: str):
    bright, edges, near = hanging()
    if doubt == "bright":
        bright[2:10] = True
    elif doubt == "open":
        edges[9] = 0.4
    elif doubt == "brighter than what is below":
        edges[9] = -1.0
    else:
        bright[:50], edges[:], edges[49] = False, 0.0, 1.0
    assert not vehicle_above(bright, edges, near).any()


def steps(*rows: int, width: int = 30) -> list[np.ndarray]:
    """Frames of 30 rows, dark down to a row and bright below."""
    return [
        np.repeat(100.0 * (np.arange(30) > row)[:, None, None], width, 1).repeat(3, 2).astype(np.float32)
        for row in rows
    ]


def test_edges_that_stay_have_a_gradient_and_those_that_move_have_none():
    """A step of 100 levels, blurred by one pixel: 40 per pixel, less for the kernel."""
    stays = static_gradient(steps(15, 15, 15))
    assert 20 < stays[1, 14:18].max() < 40 and stays[0] == pytest.approx(0)
    assert abs(static_gradient(steps(8, 15, 22))).max() < 1


def test_an_edge_that_is_weak_in_some_frames_counts_less():
    """In two of five frames a third as steep: two thirds of that third."""
    frames = steps(15, 15, 15, 15, 15)
    weak = [frames[0] / 3, frames[1] / 3, *frames[2:]]
    whole, part = static_gradient(frames)[1].max(), static_gradient(weak)[1].max()
    assert part == pytest.approx(whole / 3 * 2 / 3, rel=1e-3)


def test_the_sides_of_a_line_and_texture_cancel():
    line = np.zeros((30, 30, 3), np.float32)
    line[14:16] = 200.0
    edge = abs(static_gradient(steps(15, 15))).max()
    assert abs(static_gradient([line, line])).max() < 0.2 * edge
    texture = np.random.default_rng(1).uniform(0, 255, (60, 60, 1)).repeat(3, 2).astype(np.float32)
    inside = static_gradient([texture, texture])[:, 12:-12, 12:-12]
    assert np.median(np.hypot(*inside)) < 0.25 * edge
