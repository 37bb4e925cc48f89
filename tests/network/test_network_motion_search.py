"""Things that go past a camera in front of a wall, and where they are found again."""

import dataclasses

import numpy as np
import pytest
import torch

from nurec_sim import network
from nurec_sim.network.stereo.motion_search import LEAST_PIXELS, objects_of, searched_motion
from nurec_sim.network.tensors import NetworkInputs
from nurec_sim.reconstruct.feedforward.inputs.rays import camera_rays, pinhole_field_rad
from nurec_sim.types import CameraModel, Fisheye, Pinhole

THING_M, WALL_M = 10.0, 25.0
SIZE_M = (1.6, 0.8)
RIG_FROM_CAMERA = torch.tensor([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1.0]])
LENSES = {
    "pinhole": Pinhole(110.0, 110.0, 70.0, 49.0),
    "fisheye": Fisheye(100.0, 100.0, 70.0, 49.0, (0.02, -0.01, 0.0, 0.0), 1.4),
}


def scene(shift_m, images=3, lens=LENSES["pinhole"], times=None):
    """A standing camera; a thing of one colour pattern moves by ``shift_m`` (right, down, ahead) from image to image.

    Returns:
        Inputs, true depth, and which pixels show the thing.
    """
    camera = CameraModel("front", 140, 98, lens, np.eye(4))
    rays = torch.tensor(camera_rays(camera)[0], dtype=torch.float32)
    generator = torch.Generator().manual_seed(5)
    waves, phase = torch.randn(30, 2, generator=generator) * 3, torch.rand(30, 3, generator=generator) * 6.28

    def texture(place, tint):
        return tint + 0.05 * ((place @ waves.T)[..., None] + phase).sin().sum(-2)

    rgb, depth, mask = [], [], []
    shift = torch.tensor(shift_m)
    for k in range(images):
        distance = THING_M + float(shift[2]) * k
        place = rays[..., :2] * (distance / rays[..., 2:]) - shift[:2] * k
        on = (place.abs() < torch.tensor(SIZE_M)).all(-1)
        wall = texture(rays[..., :2] * (WALL_M / rays[..., 2:]) * 0.3, torch.tensor([0.5, 0.5, 0.5]))
        rgb.append(torch.where(on[..., None], texture(place, torch.tensor([0.7, 0.4, 0.3])), wall))
        depth.append(torch.where(on, distance, WALL_M))
        mask.append(on)
    time = torch.linspace(0, 1, images)[None] if times is None else torch.tensor(times)[None]
    gap = (time[:, 1:] - time[:, :-1]) if images > 1 else torch.full((1, 1), 0.5)
    inputs = NetworkInputs(
        rgb=torch.stack(rgb)[None].clamp(0, 1),
        c2w=torch.eye(4).repeat(1, images, 1, 1),
        fov=torch.tensor([pinhole_field_rad(camera)] * images, dtype=torch.float32)[None],
        rays=torch.cat([torch.zeros_like(rays), rays], dim=-1).repeat(1, images, 1, 1, 1),
        distance_to_depth_scale=rays[None, None, ..., 2:].repeat(1, images, 1, 1, 1),
        camera_idxs=torch.zeros(1, images, dtype=torch.int64),
        time=time,
        time_before=time - torch.cat([gap[:, :1], gap], dim=1),
        time_after=time + torch.cat([gap, gap[:, -1:]], dim=1),
        rig_from_scene=RIG_FROM_CAMERA[None],
    )
    return inputs, torch.stack(depth)[None], torch.stack(mask)[None]


def search(inputs, depth, movable, before=0.0):
    return searched_motion(inputs, depth, movable, torch.full((*depth.shape, 2, 3), before))


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("shift_m", [(0.6, 0.0, 0.0), (-1.1, 0.0, 0.0), (0.3, 0.0, 2.0)])
def test_a_thing_is_found_where_it_went(lens, shift_m):
    inputs, depth, movable = scene(shift_m, lens=LENSES[lens])
    found = search(inputs, depth, movable)
    error = (found - torch.tensor([[-1.0], [1.0]]) * torch.tensor(shift_m))[movable]
    # Across the view to a fraction of a pixel; along it, where metres change the picture little, no worse than unmoved.
    pixel_m = THING_M / LENSES["pinhole"].fx_px
    assert float(error[..., 0].abs().median()) < (pixel_m if shift_m[2] else 0.5 * pixel_m)
    assert float(error[..., 2].abs().median()) < max(shift_m[2], 0.5)
    assert float(error[..., 1].abs().max()) < 1e-5  # things stay on the ground
    assert float(found[~movable].abs().max()) == 0


def test_what_stands_does_not_move():
    inputs, depth, movable = scene((0.0, 0.0, 0.0))
    assert float(search(inputs, depth, movable, before=1.0)[movable].abs().max()) == 0


def test_what_is_seen_once_or_is_nothing_movable_keeps_the_motion_it_had():
    inputs, depth, movable = scene((0.6, 0.0, 0.0), images=1)
    assert bool((search(inputs, depth, movable, before=0.25) == 0.25).all())
    inputs, depth, movable = scene((0.6, 0.0, 0.0))
    assert bool((search(inputs, depth, torch.zeros_like(movable), before=0.25) == 0.25).all())


def test_frames_may_be_unevenly_spaced():
    inputs, depth, movable = scene((0.5, 0.0, 0.0), times=[0.0, 0.5, 1.0])
    # The third image shows the thing after as long again; said to be taken later, it must have been slower.
    uneven = dataclasses.replace(inputs, time_after=inputs.time + 1.0)
    found = search(uneven, depth, movable)
    first = movable[0, 0]
    assert float(found[0, 0][first][:, 1, 0].median()) == pytest.approx(1.0, abs=0.1)
    assert float(found[0, 0][first][:, 0, 0].median()) == pytest.approx(-0.5, abs=0.1)


def test_things_end_at_edges_of_the_depth_and_small_ones_are_left_out():
    depth, movable = torch.full((20, 40), 10.0), torch.zeros(20, 40, dtype=torch.bool)
    movable[5:15, 5:25] = True
    depth[5:15, 15:25] = 20.0  # another thing behind the first
    movable[1:3, 30:33] = True
    assert 2 * 3 < LEAST_PIXELS
    numbers = objects_of(depth, movable)
    assert set(np.unique(numbers)) == {0, 1, 2}
    assert len(np.unique(numbers[5:15, 5:15])) == 1 and len(np.unique(numbers[5:15, 17:25])) == 1
    assert numbers[8, 8] != numbers[8, 20] and (numbers[5:15, 5:25] > 0).all() and (numbers[:4] == 0).all()


def test_the_same_bits_every_time():
    inputs, depth, movable = scene((0.6, 0.0, 0.0))
    assert torch.equal(search(inputs, depth, movable), search(inputs, depth, movable))


def test_the_network_searches_only_in_profiles_that_say_so_and_needs_the_cars_place():
    assert network.PROFILES["tiny"].log_geometry and not network.PROFILES["pa-front"].log_geometry
    inputs, depth, movable = scene((0.6, 0.0, 0.0))
    with pytest.raises(ValueError, match="rig_from_scene"):
        search(dataclasses.replace(inputs, rig_from_scene=None), depth, movable)
