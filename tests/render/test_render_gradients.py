"""Gradients of the renderer against finite differences of its float64 reference."""

import dataclasses

import numpy as np
import pytest
import torch
from gradient_worlds import SMALL, drawn, loss_of, motion, moved_world, poses_of, reference, weights, world
from repetition import slow_after

from nurec_sim import geometry
from nurec_sim.render import spec
from nurec_sim.render.cpu.backward.frame import shared_workers
from nurec_sim.render.cpu.backward.gradients import GaussianTensors
from nurec_sim.render.cpu.blend.background import draw_sky
from nurec_sim.types import Gaussians

PARAMETERS = ("mean_m", "quat_wxyz", "scale_m", "opacity", "rgb", "intensity", "ray_drop")
LIDAR_ONLY = ("intensity", "ray_drop")
STEP = 1e-6


def assert_slopes_agree(function, values, gradient, picked, least=0.9):
    """Central differences of ``function`` at the picked entries of ``values`` against ``gradient``, within 1 %.

    Entries at which two step sizes disagree lie at a jump (a hit at the cut, a swap, the half); few may.
    """
    slopes, got = [], []
    for entry in picked:
        pair = []
        for step in (STEP, STEP / 2):
            ends = []
            for sign in (1, -1):
                shifted = values.copy()
                shifted[entry] += sign * step
                ends.append(function(shifted))
            pair.append((ends[0] - ends[1]) / (2 * step))
        if abs(pair[0] - pair[1]) <= 1e-3 * abs(pair[0]) + 1e-5:
            slopes.append(pair[1])
            got.append(gradient[entry])
    slopes, got = np.array(slopes), np.array(got)
    assert len(slopes) >= least * len(picked)
    assert np.abs(slopes).max() > 1e-3
    error = np.abs(got - slopes)
    assert (error <= 0.01 * np.abs(slopes) + 1e-3 * np.sqrt(np.mean(slopes**2))).all(), np.c_[got, slopes]


CASES = [(name, p) for name in SMALL for p in PARAMETERS if p not in (("rgb",) if name == "lidar" else LIDAR_ONLY)]


@pytest.mark.parametrize(("name", "parameter"), CASES)
def test_every_parameter(name, parameter):
    sensor, made, pair = SMALL[name], world(around=name == "lidar"), poses_of(name)
    tensors = GaussianTensors.of(made)
    leaf = getattr(tensors, parameter).requires_grad_()
    outputs = drawn(tensors, sensor, torch.from_numpy(pair))
    expected = reference(made, sensor, pair)
    for key, value in expected.items():
        difference = np.abs(outputs[key].detach().numpy() - value)
        assert np.median(difference) < 1e-4 and np.quantile(difference, 0.98) < 1e-2, key
    weight = weights(expected)
    loss_of(outputs, weight).backward()
    gradient = leaf.grad.double().numpy()
    assert np.isfinite(gradient).all()
    seen = np.flatnonzero(np.abs(gradient).reshape(len(made), -1).max(axis=1) > 0)[: 16 if name == "lidar" else 8]
    assert len(seen) >= 8
    picked = [(i, *rest) for i in seen for rest in np.ndindex(gradient.shape[1:])]

    def loss(values):
        return loss_of(reference(dataclasses.replace(made, **{parameter: values}), sensor, pair), weight)

    assert_slopes_agree(loss, getattr(made, parameter), gradient, picked)


@pytest.mark.parametrize("k", slow_after(1, [3, 8, 15]))
def test_view_dependent_colours(k):
    sensor, made, pair = SMALL["pinhole"], world(20, sh=k), poses_of("pinhole")
    tensors = GaussianTensors.of(made)
    leaves = {name: getattr(tensors, name).requires_grad_() for name in ("sh_rest", "mean_m")}
    weight = weights(reference(made, sensor, pair))
    loss_of(drawn(tensors, sensor, torch.from_numpy(pair)), weight).backward()
    for name, leaf in leaves.items():

        def loss(values, name=name):
            return loss_of(reference(dataclasses.replace(made, **{name: values}), sensor, pair), weight)

        gradient = leaf.grad.double().numpy()
        seen = np.flatnonzero(np.abs(gradient).reshape(len(made), -1).max(axis=1) > 0)[:4]
        picked = [(i, *rest) for i in seen for rest in np.ndindex(gradient.shape[1:])]
        assert_slopes_agree(loss, getattr(made, name), gradient, picked)


@pytest.mark.parametrize("name", list(SMALL))
def test_sensor_pose(name):
    sensor, made, pair = SMALL[name], world(sh=3 if name == "pinhole" else 0), poses_of(name)
    sky = None if name == "lidar" else np.random.default_rng(4).random((6, 4, 4, 3))
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    poses = motion(twist) @ torch.from_numpy(pair)
    weight = weights(reference(made, sensor, pair))
    outputs = drawn(GaussianTensors.of(made), sensor, poses, None if sky is None else torch.from_numpy(sky))
    loss_of(outputs, weight).backward()
    if sky is not None:
        error = np.abs(outputs["rgb"].detach().numpy() - reference(made, sensor, pair, sky)["rgb"])
        assert np.quantile(error, 0.98) < 1e-3

    def loss(values):
        return loss_of(reference(made, sensor, motion(torch.from_numpy(values)).numpy() @ pair, sky), weight)

    assert_slopes_agree(loss, np.zeros(6), twist.grad.numpy(), range(6), least=0.8)


def test_the_sky_in_every_direction():
    rng = np.random.default_rng(7)
    direction, sky = rng.normal(size=(20, 30, 3)).astype(np.float32), rng.random((6, 5, 5, 3)).astype(np.float32)
    turn = geometry.matrix_from_quat(rng.normal(size=4))
    behind = draw_sky(direction, turn, sky, shared_workers(2))
    assert np.abs(behind.transpose(1, 2, 0) - spec.sky_colour(sky, direction @ turn.T)).max() < 1e-5


def test_sky_texels():
    sensor, made, pair = SMALL["fisheye"], world(15), poses_of("fisheye")
    sky = np.random.default_rng(4).random((6, 4, 4, 3))
    leaf = torch.from_numpy(sky).requires_grad_()
    weight = weights(reference(made, sensor, pair))
    loss_of(drawn(GaussianTensors.of(made), sensor, torch.from_numpy(pair), leaf), weight, ["rgb"]).backward()
    gradient = leaf.grad.numpy()
    picked = [tuple(entry) for entry in np.argwhere(np.abs(gradient) > 1e-3)[::7]]

    def loss(values):
        return loss_of(reference(made, sensor, pair, values), weight, ["rgb"])

    assert_slopes_agree(loss, sky, gradient, picked)


@pytest.mark.parametrize("name", ["pinhole", "lidar"])
def test_actor_pose(name):
    sensor, pair = SMALL[name], poses_of(name)
    still, actor = world(30, seed=1), world(15, seed=2)
    recorded = geometry.pose(geometry.rotation_from_yaw(2.5), np.array([0.3, -0.2, 0.1]))
    actor = moved_world(actor, geometry.inverse(recorded))
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    carried = GaussianTensors.of(actor).moved(motion(twist) @ torch.from_numpy(recorded))
    weight = weights(reference(still, sensor, pair))
    outputs = drawn(GaussianTensors.joined([GaussianTensors.of(still), carried]), sensor, torch.from_numpy(pair))
    loss_of(outputs, weight).backward()

    def loss(values):
        new = moved_world(actor, motion(torch.from_numpy(values)).numpy() @ recorded)
        return loss_of(reference(Gaussians.concatenate([still, new]), sensor, pair), weight)

    assert_slopes_agree(loss, np.zeros(6), twist.grad.numpy(), range(6), least=0.8)


@pytest.mark.parametrize("output", ["depth", "range", "distance"])
def test_ranges_alone(output):
    name = "pinhole" if output == "depth" else "lidar"
    sensor, made, pair = SMALL[name], world(), poses_of(name)
    tensors = GaussianTensors.of(made)
    leaf = tensors.mean_m.requires_grad_()
    weight = weights(reference(made, sensor, pair))
    loss_of(drawn(tensors, sensor, torch.from_numpy(pair)), weight, [output]).backward()
    gradient = leaf.grad.double().numpy()
    picked = [(i, axis) for i in np.flatnonzero(np.abs(gradient).max(axis=1) > 0)[:10] for axis in range(3)]

    def loss(values):
        return loss_of(reference(dataclasses.replace(made, mean_m=values), sensor, pair), weight, [output])

    assert_slopes_agree(loss, made.mean_m, gradient, picked)
