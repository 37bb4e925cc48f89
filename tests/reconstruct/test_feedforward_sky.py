"""The sky over the world: turned without seams, complete in every direction, and never grey overhead."""

import dataclasses

import numpy as np
import pytest
import torch

from nurec_sim import geometry
from nurec_sim.network.sky import cubemap
from nurec_sim.network.sky.observed import observed_sky
from nurec_sim.network.tensors import ContextMaps, SemanticClass
from nurec_sim.reconstruct.feedforward.chunk_sky import CUBE_FROM_WORLD, observed_world_sky, world_sky
from nurec_sim.reconstruct.sky_fill import NOTHING_SEEN, fill_unseen

SIZE = 64
HORIZON, ZENITH, SUN = np.array([0.85, 0.88, 0.9]), np.array([0.35, 0.55, 0.85]), np.array([0.2, 0.15, 0.05])
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def camera_in_world(yaw_rad: float = 0.7, pitch_rad: float = 0.1) -> np.ndarray:
    """World_from_scene of a camera that looks a little down, far from the world's origin."""
    c, s = np.cos(pitch_rad), np.sin(pitch_rad)
    down = np.array([[1.0, 0, 0], [0, c, s], [0, -s, c]])
    return geometry.pose(geometry.rotation_from_yaw(yaw_rad) @ FORWARD @ down, np.array([4e5, -5e6, 30.0]))


def any_rotation(seed: int) -> np.ndarray:
    quat = np.random.default_rng(seed).normal(size=4)
    return geometry.pose(geometry.matrix_from_quat(quat), np.array([10.0, 20.0, 3.0]))


def true_sky(direction: np.ndarray) -> np.ndarray:
    """Pale at the horizon, blue overhead, warm around a sun in front to the left; the ground as the horizon."""
    height = np.clip(direction[..., 2:], 0, 1)
    sun = np.array([np.cos(1.1), np.sin(1.1), 0.3])
    glow = np.clip(direction @ sun, 0, 1)[..., None] ** 4
    return np.clip(HORIZON + (ZENITH - HORIZON) * np.sqrt(height) + SUN * glow, 0, 1)


def seen_from(world_from_scene: np.ndarray, size: int = SIZE) -> np.ndarray:
    """Which texels of the world's sky a camera sees over a jagged skyline."""
    ray = geometry.cubemap_directions(size) @ world_from_scene[:3, :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = ray[..., 0] / ray[..., 2], ray[..., 1] / ray[..., 2]
    above = v < -0.2 - 0.1 * (np.sin(15 * u) > 0)
    return ((ray[..., 2] > 0) & (np.abs(u) < 1.2) & above & (v > -0.8)).astype(np.float32)


def camera_maps(world_from_scene: np.ndarray, views: int = 2):
    """Context maps and rays of images that see the true sky above the horizon, and dark houses below."""
    v, u = np.meshgrid(np.linspace(-0.7, 0.7, 70), np.linspace(-1.1, 1.1, 110), indexing="ij")
    ray = np.stack([u, v, np.ones_like(u)], axis=-1)
    ray = np.broadcast_to(ray / np.linalg.norm(ray, axis=-1, keepdims=True), (views, *ray.shape))
    world = ray @ world_from_scene[:3, :3].T
    sky = world[..., 2] > 0.03
    rgb = np.where(sky[..., None], true_sky(world), 0.1)
    logits = np.zeros((*sky.shape, 5))
    logits[..., SemanticClass.SKY] = np.where(sky, 3.0, -3.0)
    rgb, logits, ray = (torch.from_numpy(x.astype(np.float32))[None] for x in (rgb, logits, ray))
    context = ContextMaps(torch.ones(logits.shape[:-1]), rgb, torch.zeros_like(rgb), logits, None)
    return context, torch.cat([torch.zeros_like(ray), ray], dim=-1)


def steps_over_edges(sky: np.ndarray) -> tuple[float, float]:
    """Largest step between neighbouring texels within faces, and over the edges between faces."""
    within = max(np.abs(np.diff(sky, axis=1)).max(), np.abs(np.diff(sky, axis=2)).max())
    faces = torch.from_numpy(np.asarray(sky, np.float64))
    size = sky.shape[1]
    beyond = cubemap.framed(faces)  # its rim is looked up on the neighbours, where their texels are
    rims = [(beyond[:, 0, 1:-1], faces[:, 0]), (beyond[:, -1, 1:-1], faces[:, size - 1])]
    rims += [(beyond[:, 1:-1, 0], faces[:, :, 0]), (beyond[:, 1:-1, -1], faces[:, :, size - 1])]
    return within, max(float((a - b).abs().max()) for a, b in rims)


# --------------------------------------------------------------------------------------------------------- turning


def test_scene_skies_are_the_same_cubemap_in_other_axes():
    rays = cubemap.directions(8, dtype=torch.float64).numpy()
    assert np.allclose(rays @ CUBE_FROM_WORLD, geometry.cubemap_directions(8), atol=1e-12)
    direction = np.random.default_rng(0).normal(size=(500, 3))
    ours = cubemap.coordinates(torch.from_numpy(direction @ CUBE_FROM_WORLD.T))
    for value, expected in zip(ours, geometry.cubemap_coordinates(direction), strict=True):
        assert np.allclose(value.numpy(), expected)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sizes", [(32, 32), (96, 40), (24, 64)])
def test_turned_sky_shows_the_same_colours_in_the_same_directions(seed, sizes):
    given, wanted = sizes
    slope = np.random.default_rng(seed).uniform(-0.3, 0.3, (3, 3))
    pose = any_rotation(seed)
    scene = (0.5 + cubemap.directions(given, dtype=torch.float64).numpy() @ slope).astype(np.float32)
    sky, seen = world_sky(scene, np.ones((6, given, given), np.float32), pose, wanted)
    expected = 0.5 + geometry.cubemap_directions(wanted) @ pose[:3, :3] @ slope
    assert sky.shape == (6, wanted, wanted, 3) and sky.dtype == seen.dtype == np.float32
    assert np.abs(sky - expected).max() < 1e-2 and (seen == 1).all()
    within, over = steps_over_edges(sky)
    assert over <= 1.25 * within


def test_constant_sky_stays_constant():
    constant = np.full((6, 20, 20, 3), [0.3, 0.6, 0.9], np.float32)
    sky, seen = world_sky(constant, np.full((6, 20, 20), 0.25, np.float32), any_rotation(9), 33)
    assert np.allclose(sky, [0.3, 0.6, 0.9], atol=1e-6) and np.allclose(seen, 0.25, atol=1e-6)


def test_what_was_seen_turns_with_the_sky():
    scene = np.zeros((6, 32, 32), np.float32)
    scene[4] = 1  # forward
    _, seen = world_sky(np.zeros((6, 32, 32, 3), np.float32), scene, camera_in_world(0.7, 0.0), 32)
    ahead = geometry.cubemap_directions(32) @ np.array([np.cos(0.7), np.sin(0.7), 0.0])
    assert seen[ahead > 0.9].min() > 0.99 and seen[ahead < 0.5].max() == 0


# --------------------------------------------------------------------------------------------------------- filling


def test_filled_sky_keeps_what_was_seen_and_goes_on_without_seams():
    truth, seen = true_sky(geometry.cubemap_directions(SIZE)).astype(np.float32), seen_from(camera_in_world())
    sky = fill_unseen(truth * seen[..., None], seen)
    assert sky.dtype == np.float32 and np.array_equal(sky[seen == 1], truth[seen == 1])
    assert np.array_equal(sky, fill_unseen(truth * seen[..., None], seen))
    within, over = steps_over_edges(sky)
    assert over <= 1.25 * within and within < 0.1
    above = geometry.cubemap_directions(SIZE)[..., 2] > 0
    assert np.abs(sky - truth)[above].mean() < 0.1
    behind = (geometry.cubemap_directions(SIZE) @ camera_in_world()[:3, 2] < -0.8) & above
    assert np.abs(sky[behind].mean(axis=0) - truth[behind].mean(axis=0)).max() < 0.15


@pytest.mark.parametrize("size", [1, 7, 20, 33])
def test_constant_sky_fills_with_itself(size):
    seen = np.zeros((6, size, size), np.float32)
    seen[1, size // 2, size // 3] = 1
    given = np.where(seen[..., None] > 0, np.array([0.4, 0.5, 0.7], np.float32), 0).astype(np.float32)
    assert np.allclose(fill_unseen(given, seen), [0.4, 0.5, 0.7], atol=1e-6)


def test_elevation_gradient_goes_round():
    """What a camera in front sees at some height is what the sky behind has at that height."""
    direction = geometry.cubemap_directions(SIZE)
    truth = (0.4 + 0.5 * np.clip(direction[..., 2:], 0.1, 0.5) * np.ones(3)).astype(np.float32)
    seen = ((direction[..., 0] > 0.6) & (direction[..., 2] > 0.05)).astype(np.float32)
    sky = fill_unseen(truth * seen[..., None], seen)
    assert np.abs(sky - truth)[direction[..., 2] > 0].max() < 0.02


def test_fully_and_never_seen_skies():
    given = np.random.default_rng(0).random((6, 8, 8, 3)).astype(np.float32)
    assert np.array_equal(fill_unseen(given, np.ones((6, 8, 8), np.float32)), given)
    assert np.all(fill_unseen(given, np.zeros((6, 8, 8), np.float32)) == np.float32(NOTHING_SEEN))


def test_half_seen_texels_are_a_blend():
    seen = np.zeros((6, 16, 16), np.float32)
    seen[4] = 1
    seen[4, 8, 8] = 0.25
    given = np.full((6, 16, 16, 3), 0.5, np.float32)
    given[4, 8, 8] = 0.9
    assert 0.6 < fill_unseen(given, seen)[4, 8, 8, 0] < 0.8


# -------------------------------------------------------------------------------------------- what the images show


def test_observed_sky_lies_where_the_camera_saw_it():
    pose = camera_in_world()
    context, rays = camera_maps(pose)
    observed = observed_world_sky(context, rays, pose, 48)
    sky, seen = observed.rgb, observed.shown
    direction = geometry.cubemap_directions(48)
    ahead = direction @ pose[:3, :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = ahead[..., 0] / ahead[..., 2], ahead[..., 1] / ahead[..., 2]
    inside = (ahead[..., 2] > 0) & (np.abs(u) < 1.0) & (v > -0.6) & (direction[..., 2] > 0.08)
    assert inside.sum() > 300 and np.abs(sky - true_sky(direction))[inside].max() < 0.03
    assert seen[inside].min() > 0.5 and seen[ahead[..., 2] < 0].max() < 1e-3
    ego = np.ones((2, 70, 110), bool)
    ego[:, :, :55] = False  # the right half shows the car
    half = observed_world_sky(context, rays, pose, 48, ego).shown
    assert half[inside & (u > 0.1)].max() < 0.4 and half[inside & (u < -0.1)].min() > 0.5


def test_defect_4_sky_goes_on_by_height_and_not_by_the_scene_z():
    pose = camera_in_world()
    context, rays = camera_maps(pose)
    direction = geometry.cubemap_directions(48)
    ours = observed_world_sky(context, rays, pose, 48).rgb
    sky, seen = (values[0].numpy() for values in observed_sky(context.rgb, context.logits, rays, 48))
    released, _ = world_sky(sky, seen[..., 0], pose, 48)
    # Behind the car red falls from the horizon up, as it does in front. Along the scene's z there is no such thing.
    behind = direction @ pose[:3, 2] < -0.6
    low, high = (behind & (np.abs(direction[..., 2] - height) < 0.06) for height in (0.1, 0.5))
    assert ours[low][:, 0].mean() - ours[high][:, 0].mean() > 0.1
    assert released[low][:, 0].mean() - released[high][:, 0].mean() < 0.05
    ours_off, released_off = (
        np.abs(sky - true_sky(direction))[behind & (direction[..., 2] > 0)] for sky in (ours, released)
    )
    assert ours_off.mean() < 0.7 * released_off.mean()


def test_defect_7_the_zenith_is_sky_and_not_road():
    pose = camera_in_world()
    context, rays = camera_maps(pose)
    sky = observed_world_sky(context, rays, pose, 48).rgb
    direction = geometry.cubemap_directions(48)
    overhead = sky[direction[..., 2] > 0.8]
    assert (overhead[:, 2] - overhead[:, 0]).min() > 0.1  # blue, as high up as anyone looked; houses are 0.1 grey
    assert overhead.min() > 0.4
    unseen_sky = sky[(direction[..., 2] > 0.05) & (direction @ pose[:3, 2] < 0)]
    assert unseen_sky.min() > 0.35


def test_observed_sky_is_the_same_at_any_thread_count():
    pose = camera_in_world()
    context, rays = camera_maps(pose)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        alone = observed_world_sky(context, rays, pose, 64)
        torch.set_num_threads(4)
        many = observed_world_sky(context, rays, pose, 64)
    finally:
        torch.set_num_threads(threads)
    assert all(np.array_equal(getattr(alone, name), getattr(many, name)) for name in ("rgb", "shown", "weight"))


def test_what_stands_before_the_sky_leaves_no_outline_in_it():
    """Pixels at the edge of the sky are half house; where another image shows sky, they count for nothing."""
    pose = camera_in_world()
    context, rays = camera_maps(pose)
    rgb, logits = context.rgb.clone(), context.logits.clone()
    logits[0, 0, :30, 40:70, SemanticClass.SKY] = -3  # a house in the first image
    rgb[0, 0, :30, 40:70] = 0.1
    rgb[0, 0, :31, [39, 70]] = 0.3
    edged = observed_world_sky(dataclasses.replace(context, rgb=rgb, logits=logits), rays, pose, 96)
    clean = observed_world_sky(context, rays, pose, 96)
    assert np.abs(edged.rgb - clean.rgb)[clean.weight > 0.5].max() < 0.02


def test_skies_of_chunks_meet_softly():
    pose = camera_in_world()
    context, rays = camera_maps(pose)
    observed = observed_world_sky(context, rays, pose, 96)
    assert (observed.weight <= observed.shown + 1e-6).all() and observed.weight.max() > 0.95
    along = observed.weight[observed.shown > 0.999]
    assert along.min() < 0.1 and ((along > 0.2) & (along < 0.8)).mean() > 0.1
