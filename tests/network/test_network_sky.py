"""Cubemaps of the network, and the sky that the released model ships with, against its outputs and in closed form."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import ndimage
from torch.nn import functional

from nurec_sim import geometry
from nurec_sim.network.sky import cubemap
from nurec_sim.network.sky.observed import NOTHING_SEEN, observed_sky
from nurec_sim.network.tensors import SemanticClass

SIZE = 16
FACES = {"+X": (1, 0, 0), "-X": (-1, 0, 0), "-Y": (0, -1, 0), "+Y": (0, 1, 0), "+Z": (0, 0, 1), "-Z": (0, 0, -1)}


@pytest.fixture(scope="session")
def parity() -> Path:
    folder = Path(__file__).parents[1] / "data" / "reference_network"
    if not folder.is_dir():
        pytest.skip(f"no parity cases of the reference network at {folder}; set NUREC_SIM_PARITY to their folder")
    return folder


def random_rays(count: int, seed: int = 0) -> torch.Tensor:
    rays = np.random.default_rng(seed).normal(size=(count, 3))
    return torch.from_numpy(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def view_of_sky(seed: int = 0, views: int = 3):
    """Colours, logits and rays of images that look forward and see sky above a wavy line."""
    rng = np.random.default_rng(seed)
    v, u = np.meshgrid(np.linspace(-0.7, 0.7, 24), np.linspace(-1.1, 1.1, 36), indexing="ij")
    turned = [np.stack([u + 0.1 * k, v, np.ones_like(u)], axis=-1) for k in range(views)]
    direction = np.stack(turned) / np.linalg.norm(turned, axis=-1, keepdims=True)
    logits = rng.normal(size=(views, 24, 36, 5))
    logits[..., SemanticClass.SKY] += np.where(v < 0.2 * np.sin(4 * u), 6.0, -6.0)
    rgb = 0.5 + 0.4 * direction + 0.1 * rng.random((views, 24, 36, 3))
    arrays = rgb.clip(0, 1), logits, np.concatenate([np.zeros_like(direction), direction], axis=-1)
    return tuple(torch.from_numpy(array.astype(np.float32))[None] for array in arrays)


# -------------------------------------------------------------------------------------------------------- cubemaps


def test_faces_look_along_their_axes_and_stand_upright():
    rays = cubemap.directions(3, dtype=torch.float64)
    assert torch.allclose(rays[:, 1, 1], torch.tensor(list(FACES.values()), dtype=torch.float64))
    right, down = rays[:, 1, 2] - rays[:, 1, 1], rays[:, 2, 1] - rays[:, 1, 1]
    for face in (0, 1, 4, 5):  # scene y is down
        assert down[face, 1] > 0.5 and abs(right[face, 1]) < 1e-12
    assert right[4, 0] > 0.5 and right[5, 0] < -0.5 and right[0, 2] < -0.5 and right[1, 2] > 0.5
    assert right[2, 0] > 0.5 and down[2, 2] > 0.5  # top: forward at its lower edge
    assert right[3, 0] > 0.5 and down[3, 2] < -0.5  # bottom: forward at its upper edge
    # Seen from inside no face is mirrored: right x down points where one looks.
    assert (torch.linalg.cross(right, down) * rays[:, 1, 1]).sum(dim=-1).min() > 0.3


def test_directions_are_unit_rays_of_the_texels_they_hit():
    rays = cubemap.directions(SIZE)
    assert np.allclose(rays, geometry.released_cubemap_directions(SIZE), atol=1e-7)  # what sky files are read with
    assert rays.dtype == torch.float32 and torch.allclose(rays.norm(dim=-1), torch.ones(6, SIZE, SIZE))
    assert torch.equal(cubemap.texels(rays, SIZE).flatten(), torch.arange(6 * SIZE * SIZE))
    face, u, v = cubemap.coordinates(3.7 * rays)
    centres = (torch.arange(SIZE) + 0.5) / SIZE
    assert torch.equal(face, torch.arange(6)[:, None, None].expand(6, SIZE, SIZE))
    assert torch.allclose(u, centres[None, None, :].expand_as(u), atol=1e-6)
    assert torch.allclose(v, centres[None, :, None].expand_as(v), atol=1e-6)


def test_edges_belong_to_a_texel():
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * 3)
    hit = cubemap.texels(corners[corners.abs().sum(dim=1) > 0], 8)
    assert hit.min() >= 0 and hit.max() < 6 * 64


def test_sample_is_grid_sample_of_the_face():
    faces, rays = torch.rand(6, SIZE, SIZE, 2, dtype=torch.float64), random_rays(2000)
    face, u, v = cubemap.coordinates(rays)
    grid = torch.stack([2 * u - 1, 2 * v - 1], dim=-1)
    expected = torch.zeros(len(rays), 2, dtype=torch.float64)
    for number in range(6):
        mine = face == number
        picture = faces[number].movedim(-1, 0)[None]
        sampled = functional.grid_sample(picture, grid[mine][None, None], padding_mode="border", align_corners=False)
        expected[mine] = sampled[0, :, 0].T
    assert torch.allclose(cubemap.sample(faces, rays), expected, atol=1e-12)


def test_seamless_sampling_crosses_faces_without_a_step():
    slope = torch.tensor([[0.3, -0.2, 0.5], [0.1, 0.4, -0.3], [0.2, 0.2, 0.2]], dtype=torch.float64)
    faces, rays = cubemap.directions(32, dtype=torch.float64) @ slope, random_rays(20000)
    assert (cubemap.sample_seamless(faces, rays) - rays @ slope).abs().max() < 3e-3
    # Pairs of rays on both sides of the edge between +Z and +X, a hair apart.
    height = torch.linspace(-0.9, 0.9, 500, dtype=torch.float64)
    one = torch.ones_like(height)
    noise = torch.rand(6, 32, 32, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    inside = cubemap.sample_seamless(noise, torch.stack([0.99999 * one, height, one], dim=1))
    beyond = cubemap.sample_seamless(noise, torch.stack([one, height, 0.99999 * one], dim=1))
    held = cubemap.sample(noise, torch.stack([0.99999 * one, height, one], dim=1))
    assert (inside - beyond).abs().mean() < 0.3 * (held - beyond).abs().mean()


# ---------------------------------------------------------------------------------------------- sky of the release


@pytest.mark.parametrize("case", ["pa_front", "pq_road"])
def test_observed_sky_is_that_of_the_reference(parity, case):
    with np.load(parity / f"{case}.npz") as file:
        raw = torch.from_numpy(file["mid/context_head_raw"]).movedim(1, -1)[None]
        rays, wanted, wanted_seen = (
            torch.from_numpy(file[f"{name}"]) for name in ("in/rays", "out/sky_cubemap", "out/sky_cubemap_mask")
        )
    sky, seen = observed_sky(torch.sigmoid(2 * raw[..., :3]), raw[..., 6:], rays, 64)
    assert sky.shape == wanted.shape and seen.shape == wanted_seen.shape and sky.dtype == torch.float32
    assert (sky - wanted).abs().max() < 1e-6 and (seen - wanted_seen).abs().max() < 2e-6


def test_observed_sky_by_the_rules():
    size = 80
    rgb, logits, rays = view_of_sky()
    sky, seen = (values[0].numpy() for values in observed_sky(rgb, logits, rays, size))
    is_sky = (logits.argmax(dim=-1) == SemanticClass.SKY)[0].numpy()
    colour, direction = rgb[0].numpy()[is_sky].astype(float), rays[0, ..., 3:].numpy()[is_sky]
    place = cubemap.texels(torch.from_numpy(direction), size).numpy()
    count = np.bincount(place, minlength=6 * size * size)
    hit = count > 0
    for channel in range(3):
        mean = np.bincount(place, colour[:, channel], len(count))[hit] / count[hit]
        assert np.allclose(sky[..., channel].ravel()[hit], mean, atol=1e-6)
        slope, at_zero = np.polyfit(direction[:, 2], colour[:, channel], 1)
        if abs(slope) > 0.5:
            slope = 0.5 * np.sign(slope)
            at_zero = colour[:, channel].mean() - slope * direction[:, 2].mean()
        line = np.clip(at_zero + slope * cubemap.directions(size)[..., 2].numpy(), 0, 1)
        assert np.allclose(sky[..., channel].ravel()[~hit], line.ravel()[~hit], atol=1e-5)
    for face in range(6):
        grown = ndimage.maximum_filter(hit.reshape(6, size, size)[face].astype(float), 31, mode="constant")
        soft = ndimage.gaussian_filter(grown, 8, truncate=3, mode="nearest")
        assert np.allclose(seen[face, ..., 0], soft, atol=1e-5)


def test_half_precision_around_it_changes_nothing():
    inputs = view_of_sky()
    with torch.autocast("cpu", torch.bfloat16):
        inside = observed_sky(*inputs, 40)
    assert all(torch.equal(a, b) for a, b in zip(inside, observed_sky(*inputs, 40), strict=True))


def test_clips_of_a_batch_do_not_mix():
    first, second = view_of_sky(1), view_of_sky(2)
    together = observed_sky(*(torch.cat(pair) for pair in zip(first, second, strict=True)), 24)
    for clip, alone in enumerate((observed_sky(*first, 24), observed_sky(*second, 24))):
        assert all(torch.equal(both[clip], one[0]) for both, one in zip(together, alone, strict=True))


def test_without_sky_pixels_nothing_is_seen():
    rgb, logits, rays = view_of_sky()
    logits[..., SemanticClass.SKY] = -100
    sky, seen = observed_sky(rgb, logits, rays, 8)
    assert torch.all(sky == NOTHING_SEEN) and not seen.any()


def test_one_sky_pixel_is_enough():
    rgb, logits, rays = view_of_sky()
    logits[..., SemanticClass.SKY] = -100
    logits[0, 1, 2, 3, SemanticClass.SKY] = 100
    sky, _ = observed_sky(rgb, logits, rays, 8)
    assert torch.allclose(sky, rgb[0, 1, 2, 3].expand_as(sky), atol=1e-6)


def test_sky_is_the_same_at_any_thread_count_and_pixel_order():
    inputs = view_of_sky(3, views=6)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        alone = observed_sky(*inputs, 96)
        torch.set_num_threads(4)
        many = observed_sky(*inputs, 96)
    finally:
        torch.set_num_threads(threads)
    shuffled = observed_sky(*(values.flip(1, 2, 3) for values in inputs), 96)
    assert all(torch.equal(a, b) for a, b in zip(alone, many, strict=True))
    assert all(torch.equal(a, b) for a, b in zip(alone, shuffled, strict=True))
