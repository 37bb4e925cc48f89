"""The contact sheet of a step: everything stands where its caption says, and odd samples do not stop a run."""

import dataclasses

import numpy as np
import pytest
import torch
from training_samples import ground_sample, with_moving_block

from nurec_sim.network.tensors import ContextMaps, SemanticClass
from nurec_sim.training.view import CAPTION_PX, CLASS_COLOURS, MARGIN_PX, TILE_WIDTH_PX, sample_sheet

SAMPLE = with_moving_block(ground_sample(width=56, height=42, images=3, targets=3))
TILE_HEIGHT_PX = round(42 * TILE_WIDTH_PX / 56)


def all_knowing(sample) -> ContextMaps:
    truth = sample.truth
    logits = 9.0 * torch.nn.functional.one_hot(truth.semantic.clamp(min=0), len(SemanticClass)).bfloat16()
    return ContextMaps(truth.depth_m.bfloat16(), sample.inputs.rgb, truth.normal, logits.requires_grad_(), None)


def tile(sheet: np.ndarray, row: int, column: int) -> np.ndarray:
    top = MARGIN_PX + row * (TILE_HEIGHT_PX + CAPTION_PX + MARGIN_PX) + CAPTION_PX
    left = MARGIN_PX + column * (TILE_WIDTH_PX + MARGIN_PX)
    return sheet[top : top + TILE_HEIGHT_PX, left : left + TILE_WIDTH_PX].astype(int)


def test_the_truth_stands_beside_what_equals_it():
    renders = [view.rgb.numpy() for view in SAMPLE.targets]
    sheet = sample_sheet(SAMPLE, all_knowing(SAMPLE), renders)
    assert sheet.dtype == np.uint8
    assert sheet.shape[1] == MARGIN_PX + 7 * (TILE_WIDTH_PX + MARGIN_PX)
    assert sheet.shape[0] == MARGIN_PX + 5 * (TILE_HEIGHT_PX + CAPTION_PX + MARGIN_PX)  # 3 images, 3 views in 2 rows
    for row in range(3):
        for column in (1, 3, 5):
            difference = np.abs(tile(sheet, row, column) - tile(sheet, row, column + 1))
            assert difference.max() < 8, (row, column)  # half precision moves a colour by a step or two
    for column in (0, 3):
        assert np.array_equal(tile(sheet, 3, column), tile(sheet, 3, column + 1)) and tile(sheet, 3, column).std() > 5
        assert tile(sheet, 3, column + 2).max() == 0
    assert np.array_equal(tile(sheet, 0, 0), tile(sheet, 3, 0))  # the first view is the first image


def test_colours_say_what_is_there():
    sheet = sample_sheet(SAMPLE, all_knowing(SAMPLE))
    depth, classes, normals = (tile(sheet, 0, column) for column in (2, 4, 6))
    sky, near = (5, 100), (TILE_HEIGHT_PX - 3, 100)
    assert not depth[sky].any() and not normals[sky].any()
    assert tuple(classes[sky]) == CLASS_COLOURS[SemanticClass.SKY]
    assert tuple(classes[near]) == CLASS_COLOURS[SemanticClass.ROAD]
    assert (classes == CLASS_COLOURS[SemanticClass.MOVABLE]).all(-1).mean() == pytest.approx(60 / (42 * 56), rel=0.2)
    assert normals[near][1] > 250 and abs(normals[near][0] - 128) < 2  # the ground faces up
    assert depth[near][0] > depth[near][2]  # near is red
    far = depth[depth.any(-1)][0]
    assert far[2] > far[0] or far[1] > far[0]


def test_odd_samples_are_drawn_all_the_same():
    truth = dataclasses.replace(
        SAMPLE.truth,
        depth_m=torch.zeros_like(SAMPLE.truth.depth_m),
        semantic=torch.full_like(SAMPLE.truth.semantic, -1),
    )
    unknown = dataclasses.replace(SAMPLE, truth=truth)
    said = all_knowing(SAMPLE)
    broken = dataclasses.replace(said, depth_m=torch.full_like(said.depth_m, torch.nan))
    sheet = sample_sheet(unknown, broken, [np.full((42, 56, 3), np.nan, np.float32)])
    for column in (1, 2, 4):
        assert not tile(sheet, 0, column).any()
    many = ground_sample(images=6, targets=1)
    assert sample_sheet(many, all_knowing(many)).shape[0] == MARGIN_PX + 4 * (TILE_HEIGHT_PX + CAPTION_PX + MARGIN_PX)
