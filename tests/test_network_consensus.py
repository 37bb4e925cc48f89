import dataclasses

import numpy as np
import torch
from wall_street import WallStreet, pixel_gaussians, street_chunk

from nurec_sim.network.consensus import find_consensus
from nurec_sim.network.tensors import SemanticClass


def street(cameras=("front",), frames=4):
    """A chunk, its true depth, and classes: sky where nothing is, others elsewhere."""
    chunk, true_m = street_chunk(WallStreet(frames=frames), cameras)
    return chunk, true_m, np.where(true_m == 500, int(SemanticClass.SKY), int(SemanticClass.OTHERS))


def two_images_ten_metres_apart():
    chunk, true_m, semantic = street(frames=13)
    few = {name: getattr(chunk.tensors, name)[:, [0, 12]] for name in ("rays", "c2w", "distance_to_depth_scale")}
    return dataclasses.replace(chunk.tensors, **few), true_m[[0, 12]], semantic[[0, 12]]


def test_images_that_agree_keep_their_depth_and_leave_surfaces_to_the_nearer_one():
    inputs, true_m, semantic = two_images_ten_metres_apart()
    found = find_consensus(inputs, true_m, semantic)
    solid = semantic == SemanticClass.OTHERS
    assert np.median(np.abs(found.factor - 1)[solid]) < 1e-3
    assert found.shown[1][solid[1]].mean() > 0.97
    # Of the first image stays what the second doesn't see: near road, and what is beside it.
    assert found.shown[0, 45:52, 80:100].mean() < 0.1 and found.shown[0, 85:].mean() > 0.97
    assert found.shown[~solid].all()


def test_surfaces_are_moved_to_where_the_owner_sees_them():
    inputs, true_m, semantic = two_images_ten_metres_apart()
    predicted = true_m * np.array([1.06, 1.0], np.float32)[:, None, None]
    error = np.abs(find_consensus(inputs, predicted, semantic).factor * predicted / true_m - 1)
    assert np.median(error[0, 35:45, 50:80]) < 0.01 and np.median(error[1]) < 1e-3


def test_what_others_look_through_is_not_shown():
    chunk, true_m, semantic = street()
    depth_m = true_m.copy()
    depth_m[1, 30:45, 60:90] *= 0.5
    found = find_consensus(chunk.tensors, depth_m, semantic)
    assert found.shown[1, 30:45, 60:90].mean() < 0.05 and found.shown[1, :25].mean() > found.shown[1, 30:45].mean()
    shown = found.apply(pixel_gaussians(chunk, depth_m), chunk.tensors).opacity.reshape(true_m.shape)
    assert torch.equal(shown > 0, torch.from_numpy(found.shown))


def test_what_can_move_and_the_own_car_take_no_part():
    chunk, true_m, semantic = street()
    ego = np.zeros(true_m.shape, bool)
    depth_m = true_m.copy()
    depth_m[:, 60:], ego[:, 60:] = 2.0, True
    semantic[2, 30:45, 60:90] = SemanticClass.MOVABLE
    depth_m[2, 30:45, 60:90] = 5.0
    found = find_consensus(chunk.tensors, depth_m, semantic, ego)
    apart = ego | (semantic == SemanticClass.MOVABLE)
    assert found.shown[apart].all() and (found.factor[apart] == 1).all()
    rest = (semantic == SemanticClass.OTHERS) & ~ego
    assert np.median(np.abs(found.factor - 1)[rest]) < 1e-3


def test_cameras_of_one_car_agree_and_one_image_agrees_with_itself():
    chunk, true_m, semantic = street(("front", "left"), 2)
    found = find_consensus(chunk.tensors, true_m, semantic)
    assert np.isfinite(found.factor).all()
    assert np.median(np.abs(found.factor - 1)) < 1e-3
    chunk, true_m, semantic = street(frames=1)
    alone = find_consensus(chunk.tensors, true_m, semantic)
    assert alone.shown.all() and (alone.factor == 1).all()


def test_the_same_input_gives_the_same_bytes():
    chunk, true_m, semantic = street()
    rng = np.random.default_rng(0)
    noisy = (true_m * np.exp(rng.normal(0, 0.05, true_m.shape))).astype(np.float32)
    first, second = (find_consensus(chunk.tensors, noisy, semantic) for _ in range(2))
    assert first.factor.tobytes() == second.factor.tobytes() and first.shown.tobytes() == second.shown.tobytes()
