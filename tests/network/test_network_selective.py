"""The point-query decoder: which points it takes, and that only those count."""

import dataclasses

import pytest
import torch
from network_inputs import straight_drive

from nurec_sim import network
from nurec_sim.network.tensors import SemanticClass

HEIGHT, WIDTH = 56, 84
REGULAR = 3 * 5


@pytest.fixture(scope="module")
def model():
    small = network.PROFILES["tiny-selective"]
    slots = dataclasses.replace(small.selective, road_slots=512)
    profile = dataclasses.replace(small, sky=None, observed_sky_px=14, selective=slots)
    return network.build(profile, seed=2)


def logits_of_road(road):
    logits = torch.zeros(*road.shape, len(SemanticClass))
    logits[..., SemanticClass.ROAD] = torch.where(road, 2.0, -2.0)
    return logits


def test_regular_cells_take_every_second_pixel(model):
    cells = model.decoder.regular_cells(torch.zeros(2, HEIGHT, WIDTH))
    assert cells.shape == (2 * REGULAR, 64)
    row, column = cells[1] // WIDTH, cells[1] % WIDTH
    assert row.reshape(8, 8)[:, 0].tolist() == list(range(0, 16, 2))
    assert column.reshape(8, 8)[0].tolist() == list(range(16, 32, 2))


def test_road_cells_are_all_road_and_nothing_else(model):
    road = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool)
    road[0, 32:56, :40] = True
    road[0, 40, 3] = False
    road[1, 51:56, :] = True
    cells, filled = model.decoder.road_cells(logits_of_road(road))
    assert len(cells) == 3 * 5 - 1
    assert filled.all()
    assert road.flatten()[cells].all()
    assert sorted(cells.flatten().tolist()) == sorted(set(cells.flatten().tolist()))


def test_more_road_than_slots_is_taken_evenly(model, monkeypatch):
    monkeypatch.setattr(model.decoder, "size", type(model.decoder.size)(depth=1, heads=6, road_slots=10))
    road = torch.ones(1, HEIGHT, WIDTH, dtype=torch.bool)
    cells, filled = model.decoder.road_cells(logits_of_road(road))
    assert len(cells) == 10
    assert filled.all()
    numbers = (cells[:, 0] // WIDTH) // 8 * 10 + (cells[:, 0] % WIDTH) // 8
    assert numbers.tolist() == list(range(0, 70, 7))


def test_the_release_fills_its_slots_with_what_is_not_road(model, monkeypatch):
    monkeypatch.setattr(model.decoder, "fill_road_slots", True)
    road = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.bool)
    road[0, 48:56, :16] = True
    cells, filled = model.decoder.road_cells(logits_of_road(road))
    assert len(cells) == 70
    assert filled.sum() == 2


def test_defect_9_selection_does_not_draw_lots(model):
    """The release picks road cells at random, and cells that are not road change the others' answer."""
    inputs = straight_drive(2)
    with torch.inference_mode():
        torch.manual_seed(1)
        first = model(inputs).gaussians
        torch.manual_seed(2)
        second = model(inputs).gaussians
    assert torch.equal(first.source, second.source)
    assert torch.equal(first.opacity, second.opacity)
    road = first.semantic[0, 2 * REGULAR * 64 :]
    assert (road == SemanticClass.ROAD).all()


def test_cells_that_are_not_road_do_not_change_the_others(model, monkeypatch):
    inputs = straight_drive(2)
    with torch.inference_mode():
        ours = model(inputs).gaussians
        monkeypatch.setattr(model.decoder, "fill_road_slots", True)
        filled = model(inputs).gaussians
    count = 2 * REGULAR * 64
    assert filled.source.shape[1] > ours.source.shape[1]
    assert torch.equal(ours.source[:, :count], filled.source[:, :count])
    assert not torch.equal(ours.scale_m[:, :count], filled.scale_m[:, :count])


def test_one_clip_at_a_time(model):
    with pytest.raises(ValueError, match="one clip at a time, got 2"), torch.inference_mode():
        model(straight_drive(2, clips=2))


def test_far_fewer_gaussians_than_dense(model):
    inputs = straight_drive(3)
    with torch.inference_mode():
        count = model(inputs).gaussians.source.shape[1]
    assert count < 0.4 * 3 * HEIGHT * WIDTH + 3 * 70 * 64
