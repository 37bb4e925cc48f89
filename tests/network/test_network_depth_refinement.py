"""Refinement on a textured wall, whose depth the network gets wrong by some per cent."""

import pytest
import torch
from textured_wall import LENSES, WALL_M, wall_inputs

from nurec_sim.network.stereo import depth_refinement
from nurec_sim.network.stereo.depth_refinement import LARGEST, depth_factor

INSIDE = (slice(12, -12), slice(16, -16))


def predicted(inputs, wrong, like_far=True, monkeypatch=None):
    """A depth map that is wrong by a factor everywhere; ``like_far`` lets matches count as for far points."""
    if like_far:
        monkeypatch.setattr(depth_refinement, "DOUBT_M", 2.0)
    return torch.full(inputs.rgb.shape[:-1], WALL_M * wrong)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("wrong", [0.85, 1.0, 1.18])
def test_the_wall_is_found_where_it_is_through_any_lens(lens, wrong, monkeypatch):
    inputs = wall_inputs(LENSES[lens])
    depth = predicted(inputs, wrong, monkeypatch=monkeypatch)
    factor = depth_factor(inputs, depth, torch.ones_like(depth, dtype=torch.bool))
    error = (depth * factor / WALL_M - 1).abs()[0, 1][INSIDE]
    assert float(error.median()) < 0.03
    assert float(factor.log().abs().max()) <= LARGEST + 1e-6


def test_the_nearer_a_thing_the_more_counts_what_the_network_says(monkeypatch):
    inputs = wall_inputs(LENSES["pinhole"])
    depth = predicted(inputs, 1.15, like_far=False)
    kept = []
    for doubt_m in (2.0, 60.0, 180.0):
        monkeypatch.setattr(depth_refinement, "DOUBT_M", doubt_m)
        factor = depth_factor(inputs, depth, torch.ones_like(depth, dtype=torch.bool))
        kept.append(float(factor[0, 1][INSIDE].median()))
    assert kept[0] < kept[1] < kept[2] and kept[2] > 0.97


def test_what_moves_or_has_no_other_frame_keeps_its_depth(monkeypatch):
    inputs = wall_inputs(LENSES["pinhole"])
    depth = predicted(inputs, 0.85, monkeypatch=monkeypatch)
    is_static = torch.ones_like(depth, dtype=torch.bool)
    is_static[..., :40] = False
    factor = depth_factor(inputs, depth, is_static)
    assert (factor[..., :40] == 1).all() and (factor[..., 40:] != 1).any()
    alone = wall_inputs(LENSES["pinhole"], images=1)
    depth = predicted(alone, 0.85, monkeypatch=monkeypatch)
    assert (depth_factor(alone, depth, torch.ones_like(depth, dtype=torch.bool)) == 1).all()


def test_without_texture_the_depth_stays(monkeypatch):
    inputs = wall_inputs(LENSES["pinhole"], texture=0.0)
    depth = predicted(inputs, 1.1, monkeypatch=monkeypatch)
    factor = depth_factor(inputs, depth, torch.ones_like(depth, dtype=torch.bool))
    assert float(factor.log()[0, 1][INSIDE].abs().median()) < 0.02


def test_the_same_input_gives_the_same_bytes():
    inputs = wall_inputs(LENSES["fisheye"])
    depth = torch.full(inputs.rgb.shape[:-1], 10.0)
    is_static = torch.ones_like(depth, dtype=torch.bool)
    assert torch.equal(depth_factor(inputs, depth, is_static), depth_factor(inputs, depth, is_static))
