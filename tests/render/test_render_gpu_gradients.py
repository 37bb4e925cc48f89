"""Gradients of the CUDA back end against finite differences of the float64 reference; see ``test_render_gpu``."""

import dataclasses

import numpy as np
import pytest
import torch
from gpu_on_cpu.places import PLACES, launcher_at
from render_scenes import LENSES, LIDARS, camera, cloud, moved, psnr_db, request, scene

from nurec_sim import geometry, sensors
from nurec_sim.errors import RequestError
from nurec_sim.render import spec
from nurec_sim.render.cpu.backward.gradients import GaussianTensors
from nurec_sim.render.gpu.gradients import DifferentiableRenderer
from nurec_sim.render.rays import ray_grid, reference_pose, world_rays
from nurec_sim.types import Gaussians, LidarModel, Shutter

COUNT = 40
STEP = 1e-6
"""Too small for a hit to pass one of the cuts, where there is no gradient."""
SENSORS = {
    "pinhole": camera(32, 24),
    "rolling pinhole": camera(32, 24, shutter=Shutter.TOP_TO_BOTTOM),
    "rolling fisheye": camera(
        32, 24, dataclasses.replace(LENSES["fisheye"], cx_px=16, cy_px=12), Shutter.LEFT_TO_RIGHT
    ),
    "lidar": sensors.lidar_model("VLP-16", np.eye(4), columns=120),
}


@pytest.fixture(params=PLACES)
def launcher(request):
    return launcher_at(request.param)


class Problem:
    """A weighted sum of all that a sensor sees, in float64 by the reference and in torch by the kernels."""

    def __init__(self, sensor):
        self.rng = np.random.default_rng(3)
        self.asked = request(sensor, moved(0.02, 0.1, 0.0), moved(0.09, 0.7, 0.2))
        self.grid = ray_grid(sensor)
        self.lidar = isinstance(sensor, LidarModel)
        shape = self.grid.valid.shape
        self.weights = {
            "features": self.rng.normal(size=(*shape, 3)),
            "alpha": self.rng.normal(size=shape),
            "mean": 0.1 * self.rng.normal(size=shape),
            "range": 0.1 * self.rng.normal(size=shape),
        }
        static = cloud(COUNT, 0, low=(2, -3, -2), high=(9, 3, 2))
        values = {
            "mean_m": static.mean_m,
            "quat_wxyz": static.quat_wxyz,
            "scale_m": np.maximum(static.scale_m, 0.05),
            "opacity": np.clip(static.opacity, 0.1, 0.97),
            "rgb": static.rgb,
            "intensity": self.rng.random(COUNT).astype(np.float32),
        }
        self.values = {name: value.astype(np.float64) for name, value in values.items()}

    def reference_loss(self, values, world_from_sensor=None):
        poses = self.asked.world_from_sensor if world_from_sensor is None else world_from_sensor
        asked = dataclasses.replace(self.asked, world_from_sensor=poses)
        origin, direction = world_rays(asked, self.grid)
        pose, _ = reference_pose(asked, self.grid.reference)
        known, none = np.ones(COUNT), np.zeros(COUNT)
        plain = {name: values[name] for name in ("mean_m", "quat_wxyz", "scale_m", "opacity", "rgb")}
        rest = Gaussians.empty(COUNT)
        gaussians = Gaussians(**plain, normal=rest.normal, label=rest.label, intensity=rest.intensity)
        centre = geometry.transform_points(geometry.inverse(pose), values["mean_m"])
        depth = np.linalg.norm(centre, axis=1) if self.grid.by_range else centre[:, 2]
        order = np.argsort(depth, kind="stable")
        features = np.stack([values["intensity"], known, none], axis=1) if self.lidar else values["rgb"]
        sums = spec.blend_rays(
            gaussians, features, order[depth[order] >= self.grid.near_m], origin, direction, self.grid.near_m,
            self.grid.valid,
        )  # fmt: skip
        mean = sums.distance / np.maximum(sums.alpha, spec.MIN_ALPHA)
        if self.lidar:
            intensity = sums.features[..., 0] / np.maximum(sums.features[..., 1], 1e-12)
            seen = {"features": intensity[..., None], "range": np.where(sums.half > 0, sums.half, mean), "mean": mean}
        else:
            depth = np.where(sums.alpha >= spec.SURFACE_ALPHA, mean * self.grid.direction[..., 2], 0)
            seen = {"features": sums.features, "mean": depth}
        return sum((self.weights[name] * value).sum() for name, value in {**seen, "alpha": sums.alpha}.items())

    def gradients(self, launcher):
        """Of the loss by every value and by the poses, and the loss."""
        leaves = {name: torch.tensor(value, requires_grad=True) for name, value in self.values.items()}
        poses = torch.tensor(self.asked.world_from_sensor, requires_grad=True)
        on_device = {name: leaf.to(launcher.device) for name, leaf in leaves.items()}
        (seen,) = DifferentiableRenderer([self.asked.sensor], launcher).render(GaussianTensors(**on_device), [poses])
        weights = {name: torch.tensor(weight, device=launcher.device) for name, weight in self.weights.items()}
        loss = (weights["alpha"] * seen.alpha).sum()
        if self.lidar:
            loss = loss + (weights["features"] * seen.intensity[..., None]).sum()
            loss = loss + (weights["range"] * seen.range).sum() + (weights["mean"] * seen.distance).sum()
        else:
            loss = loss + (weights["features"] * seen.rgb).sum() + (weights["mean"] * seen.depth).sum()
        loss.backward()
        return {name: leaf.grad.numpy() for name, leaf in leaves.items() if leaf.grad is not None}, poses.grad, loss


@pytest.mark.parametrize("name", list(SENSORS))
def test_gradients_are_finite_differences(launcher, name):
    problem = Problem(SENSORS[name])
    gradients, pose_gradient, loss = problem.gradients(launcher)
    assert loss.item() == pytest.approx(problem.reference_loss(problem.values), abs=1e-3)
    for field, gradient in gradients.items():
        sampled = [tuple(index) for index in np.argwhere(problem.rng.random(gradient.shape) < 0.15)]
        expected = []
        for index in sampled:
            sides = []
            for sign in (1, -1):
                values = {**problem.values, field: problem.values[field].copy()}
                values[field][index] += sign * STEP
                sides.append(problem.reference_loss(values))
            expected.append((sides[0] - sides[1]) / (2 * STEP))
        got = np.array([gradient[index] for index in sampled])
        assert np.linalg.norm(got - expected) < 0.01 * np.linalg.norm(expected) != 0, field
    for k in range(6):
        # The sensor and its path moved rigidly: turned about the world's axes, or shifted along them.
        step = np.zeros(6)
        step[k] = STEP
        moves = [rigid(sign * step) @ problem.asked.world_from_sensor for sign in (1, -1)]
        sides = [problem.reference_loss(problem.values, poses) for poses in moves]
        expected = (sides[0] - sides[1]) / (2 * STEP)
        got = (pose_gradient.numpy() * (moves[0] - moves[1])).sum() / (2 * STEP)
        assert got == pytest.approx(expected, rel=0.01, abs=0.05), f"pose {k}"


def rigid(motion):
    """The pose of a small rotation vector and a translation."""
    x, y, z = motion[:3]
    pose = np.eye(4)
    pose[:3, :3] += [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    pose[:3, 3] = motion[3:]
    return pose


def test_several_sensors_add_up_and_repeat(launcher):
    cameras, world = [SENSORS["pinhole"], SENSORS["rolling fisheye"]], cloud(COUNT)
    poses = [torch.tensor(request(sensor, moved(0.1), moved(0.1, 0.3)).world_from_sensor) for sensor in cameras]

    def gradients(chosen):
        tensors = {
            name: torch.tensor(getattr(world, name), device=launcher.device, requires_grad=True)
            for name in ("mean_m", "quat_wxyz", "scale_m", "opacity", "rgb")
        }
        images = DifferentiableRenderer([cameras[k] for k in chosen], launcher).render(
            GaussianTensors(**tensors), [poses[k] for k in chosen], sky=torch.ones(3, device=launcher.device)
        )
        sum((image.rgb**2).sum() + image.depth.sum() for image in images).backward()
        return torch.cat([tensor.grad.reshape(-1) for tensor in tensors.values()]).cpu().numpy()

    together = gradients([0, 1])
    assert np.allclose(together, gradients([0]) + gradients([1]), rtol=1e-4, atol=1e-3 * np.abs(together).max())
    assert np.array_equal(together, gradients([0, 1]))


@pytest.mark.parametrize("name", ["rolling pinhole", "rolling fisheye"])
def test_the_sky_is_that_of_frames(launcher, name):
    cubemap = np.random.default_rng(1).random((6, 4, 4, 3)).astype(np.float32)
    asked = request(SENSORS[name], moved(0.6, 0.1, 0.0), moved(1.2, 0.7, 0.2))
    static, sky = cloud(COUNT), torch.tensor(cubemap, device=launcher.device, requires_grad=True)
    tensors = {field.name: None for field in dataclasses.fields(GaussianTensors)}
    for field in ("mean_m", "quat_wxyz", "scale_m", "opacity", "rgb"):
        tensors[field] = torch.tensor(getattr(static, field), device=launcher.device)
    renderer = DifferentiableRenderer([SENSORS[name]], launcher)
    (image,) = renderer.render(GaussianTensors(**tensors), [torch.tensor(asked.world_from_sensor)], sky)
    expected = spec.render_camera(scene(static, sky=cubemap), asked)
    assert psnr_db(spec.to_uint8(image.rgb.detach().cpu().numpy()), expected.rgb) >= 60
    image.rgb.sum().backward()
    assert sky.grad.sum().item() == pytest.approx(3 * (1 - expected.alpha)[expected.rgb.any(axis=-1)].sum(), rel=1e-3)


def test_malformed_arguments(launcher):
    with pytest.raises(RequestError, match="not both"):
        DifferentiableRenderer([SENSORS["pinhole"], LIDARS["full"]], launcher)
    renderer = DifferentiableRenderer([SENSORS["pinhole"]], launcher)
    with pytest.raises(RequestError, match="one pose"):
        renderer.render(GaussianTensors.of(cloud(5)), [torch.eye(3)])
    with pytest.raises(RequestError, match="rigid"):
        renderer.render(GaussianTensors.of(cloud(5)), [2 * torch.eye(4)])
