"""Matching on a world of one textured wall, whose depth every pixel should find."""

import dataclasses

import numpy as np
import pytest
import torch

from nurec_sim.network.car_view import CHANNELS, MATCHED_DEPTH, car_view
from nurec_sim.network.flat_ground import FARTHEST_GROUND_M, flat_ground
from nurec_sim.network.plane_sweep import plane_sweep
from nurec_sim.network.semi_global import semi_global
from nurec_sim.network.tensors import SCENE_RESCALE, NetworkInputs
from nurec_sim.reconstruct.feedforward.rays import camera_rays, pinhole_field_rad
from nurec_sim.types import CameraModel, Fisheye, Pinhole

WALL_M, STEP_M = 9.0, 0.6
RIG_FROM_CAMERA = torch.tensor([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])
LENSES = {
    "pinhole": Pinhole(90.0, 90.0, 56.0, 40.0),
    "off centre": Pinhole(90.0, 96.0, 49.0, 45.0),
    "distorted": Pinhole(90.0, 90.0, 56.0, 40.0, radial=(-0.12, 0.02, 0.0, 0.0, 0.0, 0.0)),
    "fisheye": Fisheye(75.0, 75.0, 56.0, 40.0, (0.02, -0.01, 0.0, 0.0), 1.4),
}


def wall_inputs(lens, images=3, step_m=STEP_M, texture=1.0):
    """A camera that moves to the right past a wall of smooth noise, ``WALL_M`` ahead."""
    camera = CameraModel("front", 112, 80, lens, np.eye(4))
    rays, _ = camera_rays(camera)
    rays = torch.tensor(rays, dtype=torch.float32)
    generator = torch.Generator().manual_seed(5)
    waves = torch.randn(40, 2, generator=generator) * 3.0
    phase = torch.rand(40, 3, generator=generator) * 6.28
    rgb, all_rays, c2w = [], [], torch.eye(4).repeat(images, 1, 1)
    for k in range(images):
        origin = torch.tensor([k * step_m, 0.0, 0.0])
        c2w[k, :3, 3] = origin * SCENE_RESCALE
        place = origin[:2] + rays[..., :2] * (WALL_M / rays[..., 2:])
        look = (place @ waves.T)[..., None] + phase
        rgb.append(0.5 + texture * 0.06 * look.sin().sum(-2))
        all_rays.append(torch.cat([origin.expand_as(rays), rays], dim=-1))
    time = torch.linspace(0, 1, images)[None]
    return NetworkInputs(
        rgb=torch.stack(rgb)[None].clamp(0, 1),
        c2w=c2w[None],
        fov=torch.tensor([pinhole_field_rad(camera)] * images, dtype=torch.float32)[None],
        rays=torch.stack(all_rays)[None],
        distance_to_depth_scale=rays[None, None, ..., 2:].repeat(1, images, 1, 1, 1),
        camera_idxs=torch.zeros(1, images, dtype=torch.int64),
        time=time,
        time_before=time - 0.1,
        time_after=time + 0.1,
        rig_from_scene=RIG_FROM_CAMERA[None],
    )


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
