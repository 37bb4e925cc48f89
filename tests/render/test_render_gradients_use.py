"""Gradients in use: any thread count, hostile Gaussians, fits, and refusals."""

import dataclasses

import numpy as np
import pytest
import torch
from gradient_worlds import SMALL, drawn, leaves_of, poses_of, world
from render_scenes import camera, cloud, gaussians

from nurec_sim.errors import RequestError
from nurec_sim.render.cpu.backward.gradients import GaussianTensors, render_camera, render_lidar
from nurec_sim.types import Gaussians, Pinhole


@pytest.mark.parametrize("name", list(SMALL))
def test_gradients_do_not_depend_on_threads(name):
    made, pair = cloud(1500, 2, low=(2, -6, -3), high=(14, 6, 3)), poses_of(name)
    results = []
    for threads in (1, 2, 5):
        tensors, poses = GaussianTensors.of(made), torch.from_numpy(pair).requires_grad_()
        leaves = [*leaves_of(tensors), poses]
        render = render_lidar if name == "lidar" else render_camera
        images = render(tensors, SMALL[name], poses, threads=threads)
        sum((getattr(images, f.name) ** 2).sum() for f in dataclasses.fields(images)).backward()
        results.append([None if leaf.grad is None else leaf.grad.numpy().tobytes() for leaf in leaves])
    assert results[0] == results[1] == results[2]


@pytest.mark.parametrize("name", list(SMALL))
def test_what_is_not_drawn_has_no_gradient(name):
    good = world(10)
    bad = {
        "behind": {"mean_m": (-5.0, 0, 0)},
        "at the sensor": {"mean_m": (0.0, 0, 0)},
        "nowhere": {"mean_m": (np.nan, 0, 0)},
        "faint": {"opacity": 0.001},
        "flat": {"scale_m": (0.0, 1, 1)},
        "not turned": {"quat_wxyz": (0.0, 0, 0, 0)},
        "huge": {"scale_m": (1e20, 1, 1)},
        "no opacity": {"opacity": np.nan},
    }
    if name == "lidar":  # looks there, too
        bad.pop("behind")
    rows = [good]
    for fields in bad.values():
        row = gaussians([[5.0, 0, 0]], intensity=0.5)
        rows.append(dataclasses.replace(row, **{k: np.array([v], np.float32) for k, v in fields.items()}))
    tensors = GaussianTensors.of(Gaussians.concatenate(rows))
    pair = poses_of(name)
    pair[..., :3, 3] = 0
    leaves = leaves_of(tensors)
    outputs = drawn(tensors, SMALL[name], torch.from_numpy(pair))
    sum(value.sum() for value in outputs.values()).backward()
    assert all(torch.isfinite(value).all() for value in outputs.values())
    for leaf in leaves:
        if leaf.grad is not None:
            assert torch.isfinite(leaf.grad).all()
            assert not leaf.grad[10:].any() and leaf.grad[:10].any()


def test_needles_flakes_and_giants_have_finite_gradients():
    rng = np.random.default_rng(0)
    made = cloud(300, 6, low=(0, -4, -3), high=(8, 4, 3))
    made = dataclasses.replace(made, scale_m=np.exp(rng.uniform(-11, 4, (300, 3))).astype(np.float32))
    for name in SMALL:
        tensors = GaussianTensors.of(made)
        leaves = leaves_of(tensors)
        sum(value.sum() for value in drawn(tensors, SMALL[name], torch.from_numpy(poses_of(name))).values()).backward()
        assert all(torch.isfinite(leaf.grad).all() for leaf in leaves if leaf.grad is not None)


def test_no_gaussians():
    empty = GaussianTensors.of(Gaussians.empty())
    leaf = empty.mean_m.requires_grad_()
    images = render_camera(empty, SMALL["pinhole"], torch.from_numpy(poses_of("pinhole")), torch.ones(3))
    assert torch.equal(images.rgb, torch.ones(16, 24, 3)) and not images.alpha.any() and not images.depth.any()
    images.rgb.sum().backward()
    assert leaf.grad.shape == (0, 3)


def test_saturated_opacity_and_tiny_scales_are_held():
    made = gaussians([[5.0, 0, 0], [6.0, 0.5, 0]], scale=0.4, opacity=[1.0, 0.99])
    tensors = GaussianTensors.of(made)
    opacity = tensors.opacity.requires_grad_()
    render_camera(tensors, SMALL["pinhole"], torch.from_numpy(poses_of("pinhole"))).alpha.sum().backward()
    assert not opacity.grad.any()


def test_a_moved_gaussian_finds_back():
    sensor, poses = camera(48, 32), torch.from_numpy(poses_of("pinhole"))
    target = gaussians([[6.0, 0.2, 0.1]], scale=(0.5, 0.3, 0.4), rgb=(0.9, 0.4, 0.1))
    images = render_camera(GaussianTensors.of(target), sensor, poses)
    start = dataclasses.replace(target, mean_m=target.mean_m + np.float32([0.8, -0.3, 0.2]))
    tensors = GaussianTensors.of(start)
    mean = tensors.mean_m.requires_grad_()
    optimizer = torch.optim.Adam([mean], lr=0.03)
    for _ in range(120):
        optimizer.zero_grad()
        got = render_camera(tensors, sensor, poses)
        ((got.rgb - images.rgb) ** 2).sum().add(0.05 * (got.depth - images.depth).abs().sum()).backward()
        optimizer.step()
    assert np.abs(mean.detach().numpy() - target.mean_m).max() < 0.03


def test_changing_gaussians_before_the_gradients_are_taken_is_refused():
    tensors = GaussianTensors.of(world(5))
    leaves_of(tensors)
    images = render_camera(tensors, SMALL["pinhole"], torch.from_numpy(poses_of("pinhole")))
    with torch.no_grad():
        tensors.mean_m.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        images.rgb.sum().backward()


def test_two_hundred_gaussians_become_an_image():
    rows, columns = torch.meshgrid(torch.arange(32), torch.arange(48), indexing="ij")
    checks = ((rows // 8 + columns // 8) % 2)[..., None] * torch.tensor([0.7, 0.3, -0.2]) + 0.2
    seeded = torch.Generator().manual_seed(0)
    spread = torch.tensor([6.0, 4.0, 1.0])
    leaves = [
        torch.rand(200, 3, generator=seeded) * spread + torch.tensor([-3.0, -2.0, 4.5]),
        torch.randn(200, 4, generator=seeded),
        torch.full((200, 3), -1.5),
        torch.zeros(200),
        torch.full((200, 3), 0.5),
    ]
    mean, quat, log_scale, logit, rgb = (leaf.requires_grad_() for leaf in leaves)
    optimizer = torch.optim.Adam(leaves, lr=0.03)
    errors = []
    for _ in range(150):
        fitted = GaussianTensors(mean, quat, log_scale.exp(), logit.sigmoid(), rgb)
        error = (
            (render_camera(fitted, camera(48, 32, Pinhole(40.0, 40.0, 24.0, 16.0)), torch.eye(4)).rgb - checks) ** 2
        ).mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
        errors.append(error.item())
    assert errors[-1] < 0.01 * errors[0] and errors[-1] < 2e-3  # 27 dB


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"mean_m": torch.zeros(3, 2)}, r"mean_m must be \[3, 3\], got \[3, 2\]"),
        ({"opacity": torch.zeros(2)}, r"opacity must be \[3\], got \[2\]"),
        (
            {"sh_rest": torch.zeros(3, 4, 3)},
            r"sh_rest must be \[3, 3, 3\] or \[3, 8, 3\] or \[3, 15, 3\], got \[3, 4, 3\]",
        ),
        (
            {"rgb": torch.zeros(3, 3, dtype=torch.int32)},
            "rgb must be a floating-point tensor on the CPU, got torch.int32",
        ),
    ],
)
def test_wrong_tensors_are_refused(change, text):
    tensors = dataclasses.replace(GaussianTensors.of(world(3)), **change)
    with pytest.raises(RequestError, match=text):
        render_camera(tensors, SMALL["pinhole"], torch.from_numpy(poses_of("pinhole")))


def test_wrong_sensors_and_poses_are_refused():
    tensors, poses = GaussianTensors.of(world(3)), torch.from_numpy(poses_of("pinhole"))
    with pytest.raises(RequestError, match="needs a CameraModel"):
        render_camera(tensors, SMALL["lidar"], poses)
    with pytest.raises(RequestError, match="needs a LidarModel"):
        render_lidar(tensors, SMALL["pinhole"], poses)
    with pytest.raises(RequestError, match=r"one pose \[4,4\] or two \[2,4,4\], got \[3, 4, 4\]"):
        render_camera(tensors, SMALL["pinhole"], torch.eye(4).expand(3, 4, 4))
    with pytest.raises(RequestError, match="must be finite and rigid"):
        render_camera(tensors, SMALL["pinhole"], 2 * torch.eye(4))
    with pytest.raises(RequestError, match=r"sky must be \[3\] or \[6, 's', 's', 3\], got \[6, 2, 3, 3\]"):
        render_camera(tensors, SMALL["pinhole"], poses, torch.zeros(6, 2, 3, 3))
    with pytest.raises(RequestError, match="needs eye_m"):
        GaussianTensors.of(world(3, sh=3)).moved(torch.eye(4))
    with pytest.raises(RequestError, match="with and without sh_rest"):
        GaussianTensors.joined([tensors, GaussianTensors.of(world(3, sh=3))])
