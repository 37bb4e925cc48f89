"""Matching on a world of one textured wall, whose depth every pixel should find."""

import dataclasses

import pytest
import torch
from textured_wall import LENSES, WALL_M, wall_inputs

from nurec_sim.network.car_view import CHANNELS, MATCHED_DEPTH, car_view
from nurec_sim.network.stereo.flat_ground import FARTHEST_GROUND_M, flat_ground
from nurec_sim.network.stereo.plane_sweep import plane_sweep
from nurec_sim.network.stereo.semi_global import semi_global
from nurec_sim.network.tensors import SCENE_RESCALE


@pytest.mark.parametrize("lens", LENSES)
def test_a_textured_wall_is_found_at_its_depth_through_any_lens(lens):
    found = plane_sweep(wall_inputs(LENSES[lens]))[0, 1, 12:40, 16:-16]  # the upper half, above the ground
    depth = found[..., 0].exp() / SCENE_RESCALE
    assert float((depth / WALL_M - 1).abs().median()) < 0.05
    share, better, agreed = found[..., 1:].flatten(0, 1).median(0).values.tolist()
    assert share > 0.9 and better > 0.1 and agreed > 0.8


def test_without_texture_or_motion_nothing_fits_better_than_the_rest():
    pinhole = LENSES["pinhole"]
    sure = float(plane_sweep(wall_inputs(pinhole))[..., 2].median())
    for unsure in (wall_inputs(pinhole, texture=0.0), wall_inputs(pinhole, step_m=0.0)):
        assert float(plane_sweep(unsure)[..., 2].median()) < 0.2 * sure


def test_an_image_alone_shows_flat_ground_and_above_it_what_is_usual():
    inputs = wall_inputs(LENSES["pinhole"], images=1)
    found = plane_sweep(inputs)
    assert float(found[..., 2:].abs().max()) == 0
    depth = found[..., 0].exp() / SCENE_RESCALE
    down = inputs.rays[..., 4] > 0.1
    expected = 1.5 / inputs.rays[..., 4] * inputs.distance_to_depth_scale[..., 0]
    wrong = (depth / expected - 1)[down].abs()
    assert float(wrong.median()) < 0.06 and float(wrong.quantile(0.95)) < 0.2
    assert depth[inputs.rays[..., 4] < -0.1].mean().item() == pytest.approx(40, rel=0.2)


def test_flat_ground_ends_where_rays_rise_or_get_far():
    inputs = wall_inputs(LENSES["pinhole"], images=1)
    depth, there = flat_ground(inputs)
    assert not there[inputs.rays[..., 4] <= 0].any() and there[inputs.rays[..., 4] > 0.1].all()
    assert (depth[~there] == FARTHEST_GROUND_M).all() and float(depth.max()) == FARTHEST_GROUND_M


def test_nothing_is_found_below_the_ground():
    # Seen from 1.5 m above it, the wall's lower part would be underground.
    inputs = wall_inputs(LENSES["pinhole"])
    depth = plane_sweep(inputs)[0, 1, -8:, 16:-16, 0].exp() / SCENE_RESCALE
    ground = flat_ground(inputs)[0][0, 1, -8:, 16:-16]
    assert float((depth / ground).max()) < 1.3


def test_the_cars_view_holds_the_matches_it_is_given():
    inputs = wall_inputs(LENSES["pinhole"])
    matches = plane_sweep(inputs)
    view = car_view(inputs)
    assert view.shape[-1] == CHANNELS
    assert torch.equal(view[..., MATCHED_DEPTH:], matches)
    given = car_view(dataclasses.replace(inputs, matches=torch.zeros_like(matches)))
    assert float(given[..., MATCHED_DEPTH:].abs().max()) == 0


def test_matches_are_the_same_bits_with_any_number_of_threads():
    inputs = wall_inputs(LENSES["distorted"])
    threads = torch.get_num_threads()
    try:
        found = []
        for count in (1, 2):
            torch.set_num_threads(count)
            found.append(plane_sweep(inputs))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(*found)


def test_semi_global_matching_hands_on_what_neighbours_know_but_not_across_edges():
    cost = torch.full((8, 1, 9), 0.5)
    cost[2, 0, 0] = 0  # the first pixel knows its depth, the others nothing
    even = semi_global(cost, torch.zeros(1, 9))
    assert (even.argmin(0) == 2).all()
    guide = torch.zeros(1, 9)
    guide[0, 5:] = 1
    cost[6, 0, 8] = 0  # and so does the last, behind an edge
    assert semi_global(cost, guide).argmin(0)[0].tolist() == [2] * 5 + [6] * 4
