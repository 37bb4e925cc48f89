import dataclasses

import numpy as np
import pytest
import torch
from wall_street import WallStreet, pixel_gaussians, street_chunk

from nurec_sim.network.tensors import ContextMaps, NetworkOutputs, SemanticClass
from nurec_sim.reconstruct.feedforward.merging.comparison import OVERLAP, OWNER_RING, SHARED_COLOUR, _ring
from nurec_sim.reconstruct.feedforward.merging.consensus import find_consensus


def street(cameras=("front",), frames=4):
    """A chunk, its true depth, and classes: sky where nothing is, others elsewhere."""
    chunk, true_m = street_chunk(WallStreet(frames=frames), cameras)
    return chunk, true_m, np.where(true_m == 500, int(SemanticClass.SKY), int(SemanticClass.OTHERS))


def grey(depth_m, colour=0.5):
    """Colours of images that are all the same."""
    return np.full((*depth_m.shape, 3), colour, np.float32)


def two_images_ten_metres_apart():
    chunk, true_m, semantic = street(frames=13)
    few = {
        name: getattr(chunk.tensors, name)[:, [0, 12]]
        for name in ("rays", "c2w", "distance_to_depth_scale", "camera_idxs")
    }
    return dataclasses.replace(chunk.tensors, **few), true_m[[0, 12]], semantic[[0, 12]]


def test_images_that_agree_keep_their_depth_and_leave_surfaces_to_the_nearer_one():
    inputs, true_m, semantic = two_images_ten_metres_apart()
    found = find_consensus(inputs, true_m, semantic, grey(true_m))
    solid = semantic == SemanticClass.OTHERS
    assert np.median(np.abs(found.factor - 1)[solid]) < 1e-3
    assert found.shown[1][solid[1]].mean() > 0.97
    # Of the first image stays what the second doesn't see: near road, and what is beside it.
    assert found.shown[0, 45:52, 80:100].mean() < 0.1 and found.shown[0, 85:].mean() > 0.97
    assert found.shown[~solid].all()


def test_surfaces_are_moved_to_where_the_owner_sees_them():
    inputs, true_m, semantic = two_images_ten_metres_apart()
    predicted = true_m * np.array([1.06, 1.0], np.float32)[:, None, None]
    error = np.abs(find_consensus(inputs, predicted, semantic, grey(true_m)).factor * predicted / true_m - 1)
    assert np.median(error[0, 35:45, 50:80]) < 0.01 and np.median(error[1]) < 1e-3


def test_what_others_look_through_is_not_shown():
    chunk, true_m, semantic = street()
    depth_m = true_m.copy()
    depth_m[1, 30:45, 60:90] *= 0.5
    found = find_consensus(chunk.tensors, depth_m, semantic, grey(depth_m))
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
    found = find_consensus(chunk.tensors, depth_m, semantic, grey(depth_m), ego)
    apart = ego | (semantic == SemanticClass.MOVABLE)
    assert found.shown[apart].all() and (found.factor[apart] == 1).all()
    rest = (semantic == SemanticClass.OTHERS) & ~ego
    assert np.median(np.abs(found.factor - 1)[rest]) < 1e-3


def test_images_that_look_through_a_point_from_nearer_count_more():
    chunk, true_m, semantic = street(frames=44)

    def shown(nearer):
        """How much is shown of a wall that three images see at 50 m instead of 70 m, where a fourth knows better."""
        few = [0, 1, 2, nearer]
        names = ("rays", "c2w", "distance_to_depth_scale", "camera_idxs")
        inputs = dataclasses.replace(chunk.tensors, **{name: getattr(chunk.tensors, name)[:, few] for name in names})
        depth_m = true_m[few].copy()
        depth_m[:3, 40:50, 95:105] *= 0.7
        return find_consensus(inputs, depth_m, semantic[few], grey(depth_m)).shown[:3, 43:47, 97:103].mean()

    assert (np.abs(true_m[:3, 43:47, 97:103] - 68) < 4).all()
    assert shown(nearer=3) > 0.2 and shown(nearer=30) < 0.05


def test_a_place_that_enough_images_call_movable_is_movable_for_all():
    chunk, true_m, semantic = street()
    patch = (slice(None), slice(35, 45), slice(60, 75))
    one_of_four, none = semantic.copy(), semantic
    one_of_four[1, 30:50, 50:85] = SemanticClass.MOVABLE
    voted = find_consensus(chunk.tensors, true_m, one_of_four, grey(true_m))
    assert (voted.semantic[patch] == SemanticClass.MOVABLE).all() and voted.shown[patch].all()
    gaussians = voted.apply(pixel_gaussians(chunk, true_m), chunk.tensors)
    assert torch.equal(gaussians.semantic.reshape(true_m.shape), torch.from_numpy(voted.semantic))
    assert np.array_equal(find_consensus(chunk.tensors, true_m, none, grey(true_m)).semantic, none)


def test_movable_things_that_stand_are_agreed_on_like_walls_and_stay_movable_where_images_disagree():
    inputs, true_m, semantic = two_images_ten_metres_apart()
    cars = np.where(semantic == SemanticClass.OTHERS, int(SemanticClass.MOVABLE), semantic)
    stands = cars == SemanticClass.MOVABLE
    wall = find_consensus(inputs, true_m, semantic, grey(true_m))
    car = find_consensus(inputs, true_m, cars, grey(true_m), None, stands)
    agreed = car.semantic == semantic
    assert agreed.mean() > 0.98 and np.array_equal(car.shown[agreed], wall.shown[agreed])
    assert find_consensus(inputs, true_m, cars, grey(true_m)).shown.all()
    chunk, true_m, semantic = street()
    cars = np.where(semantic == SemanticClass.OTHERS, int(SemanticClass.MOVABLE), semantic)
    depth_m = true_m.copy()
    patch = (1, slice(32, 43), slice(64, 86))
    depth_m[patch] *= 0.5
    found = find_consensus(chunk.tensors, depth_m, cars, grey(depth_m), None, cars == SemanticClass.MOVABLE)
    assert (found.semantic[patch] == SemanticClass.MOVABLE).mean() > 0.95
    moves = found.semantic == SemanticClass.MOVABLE
    assert found.shown[moves].all() and (found.factor[moves] == 1).all()


def test_one_of_many_images_cannot_make_a_place_movable():
    chunk, true_m, semantic = street(frames=8)
    wrong = semantic.copy()
    wrong[3, 35:45, 60:75] = SemanticClass.MOVABLE
    assert (find_consensus(chunk.tensors, true_m, wrong, grey(true_m)).semantic == semantic)[:, 36:44, 62:73].all()


def test_points_before_movable_things_are_looked_through_too():
    chunk, true_m, semantic = street()
    depth_m = true_m.copy()
    depth_m[1, 30:45, 60:90] *= 0.5
    semantic[[0, 2, 3], 25:50, 55:95] = SemanticClass.MOVABLE
    found = find_consensus(chunk.tensors, depth_m, semantic, grey(depth_m))
    assert found.shown[1, 30:45, 60:90].mean() < 0.05


@pytest.mark.slow
def test_only_what_stands_may_own_a_surface():
    """Far images agree on a wall; a near one too, but two beside it look through: it is dropped and owns nothing."""
    chunk, true_m, semantic = street(frames=16)
    order = [0, 1, 2, 3] * 3 + [14, 15, 15]
    names = ("rays", "c2w", "distance_to_depth_scale", "camera_idxs")
    inputs = dataclasses.replace(chunk.tensors, **{name: getattr(chunk.tensors, name)[:, order] for name in names})
    depth_m, classes = true_m[order].copy(), semantic[order]
    depth_m[13:][np.abs(true_m[order][13:] - 11.5) < 1] *= 1.5
    shown = find_consensus(inputs, depth_m, classes, grey(depth_m)).shown
    assert (np.abs(true_m[:4, 40:46, 70:78] - 22) < 2).all()
    assert shown[12, 40:46, 55:68].mean() < 0.05 and shown[:12, 40:46, 70:78].any(axis=0).mean() > 0.95


def test_where_rings_meet_both_images_show_the_surface():
    chunk, true_m, semantic = street(frames=1)
    twice = {name: getattr(chunk.tensors, name)[:, [0, 0]] for name in ("rays", "c2w", "distance_to_depth_scale")}
    inputs = dataclasses.replace(chunk.tensors, **twice, camera_idxs=torch.zeros(1, 2, dtype=torch.int64))
    shown = find_consensus(inputs, true_m[[0, 0]], semantic[[0, 0]], grey(true_m[[0, 0]])).shown
    solid = semantic[0] == SemanticClass.OTHERS
    distance = true_m[0] / chunk.tensors.distance_to_depth_scale[0, 0, ..., 0].numpy()
    height, width = solid.shape
    ring = np.array(
        [
            [_ring(distance[v, u], 2 * (u + 0.5) / width - 1, 2 * (v + 0.5) / height - 1) for u in range(width)]
            for v in range(height)
        ]
    )
    above = ring - np.floor(ring)
    inner = np.zeros_like(solid)
    inner[5:-5, 10:-10] = True
    apart = np.abs(above - (1 - OVERLAP / OWNER_RING)) > 0.02
    assert shown[0].all()
    chosen = solid & inner & apart
    assert (shown[1] == (above > 1 - OVERLAP / OWNER_RING))[chosen].mean() > 0.9


def test_images_that_agree_share_their_colours():
    inputs, true_m, semantic = two_images_ten_metres_apart()
    rgb = np.stack([grey(true_m[0], 0.2), grey(true_m[1], 0.6)])
    found = find_consensus(inputs, true_m, semantic, rgb)
    seen_by_both = found.rgb[1, 42:48, 95:110]
    assert ((seen_by_both < 0.6) & (seen_by_both > 0.6 - 0.4 * SHARED_COLOUR / (1 + SHARED_COLOUR))).mean() > 0.95
    assert np.allclose(found.rgb[1][semantic[1] == SemanticClass.SKY], 0.6)


def test_cameras_are_made_as_bright_as_each_other_and_show_their_images_as_before():
    chunk, true_m, semantic = street()
    camera = torch.tensor([[0, 0, 1, 1]])
    inputs = dataclasses.replace(chunk.tensors, camera_idxs=camera)
    factor = np.array([0.5, 0.6, 0.8], np.float32)
    rgb = grey(true_m)
    rgb[2:] *= factor
    found = find_consensus(inputs, true_m, semantic, rgb)
    assert np.allclose(found.gain[1], 1) and np.allclose(found.gain[0], factor, rtol=1e-3)
    assert np.ptp(found.rgb[semantic == SemanticClass.OTHERS], axis=0).max() < 1e-3
    gaussians = pixel_gaussians(chunk, true_m)
    maps = torch.zeros(1, *true_m.shape, 3)
    context = ContextMaps(torch.from_numpy(true_m)[None], torch.from_numpy(rgb)[None], maps, maps, None)
    isp = torch.eye(3, 4).expand(1, 2, 3, 4)
    sky = torch.full((1, 6, 4, 4, 3), 0.5)
    outputs = found.coloured(NetworkOutputs(context, gaussians, sky, sky[..., :1], True, isp), inputs)
    for image in range(4):
        shown = outputs.context.rgb[0, image] @ outputs.isp[0, camera[0, image], :, :3].T
        assert torch.allclose(shown, context.rgb[0, image], atol=1e-5)
    assert torch.allclose(outputs.sky[0, 0, 0, 0], torch.from_numpy(0.5 * factor), atol=1e-3)
    assert torch.equal(outputs.gaussians.rgb.reshape(found.rgb.shape), torch.from_numpy(found.rgb))


def test_cameras_of_one_car_agree_and_one_image_agrees_with_itself():
    chunk, true_m, semantic = street(("front", "left"), 2)
    found = find_consensus(chunk.tensors, true_m, semantic, grey(true_m))
    assert np.isfinite(found.factor).all()
    assert np.median(np.abs(found.factor - 1)) < 1e-3
    chunk, true_m, semantic = street(frames=1)
    alone = find_consensus(chunk.tensors, true_m, semantic, grey(true_m))
    assert alone.shown.all() and (alone.factor == 1).all()


def test_the_same_input_gives_the_same_bytes():
    chunk, true_m, semantic = street()
    rng = np.random.default_rng(0)
    noisy = (true_m * np.exp(rng.normal(0, 0.05, true_m.shape))).astype(np.float32)
    first, second = (find_consensus(chunk.tensors, noisy, semantic, grey(noisy)) for _ in range(2))
    assert first.factor.tobytes() == second.factor.tobytes() and first.shown.tobytes() == second.shown.tobytes()


def test_what_lies_at_the_edge_of_an_image_counts_as_farther():
    """By exp(0.2) at the middle of an edge, exp(0.4) in a corner: two and four rings of exp(0.1)."""
    middle = _ring(7.0, 0.0, 0.0)
    assert _ring(7.0, 1.0, 0.0) - middle == pytest.approx(2) and _ring(7.0, 1.0, -1.0) - middle == pytest.approx(4)


def test_surfaces_move_twice_so_that_a_chain_of_images_meets():
    """The first image agrees with the second only, the second with the third, which is right."""
    chunk, true_m, semantic = street(frames=13)
    order = [0, 6, 12]
    names = ("rays", "c2w", "distance_to_depth_scale", "camera_idxs")
    inputs = dataclasses.replace(chunk.tensors, **{name: getattr(chunk.tensors, name)[:, order] for name in names})
    true_m, semantic = true_m[order], semantic[order]
    predicted = true_m * np.array([1.12, 1.06, 1.0], np.float32)[:, None, None]
    error = np.abs(find_consensus(inputs, predicted, semantic, grey(true_m)).factor * predicted / true_m - 1)
    assert np.median(error[0, 35:45, 50:80]) < 0.02
