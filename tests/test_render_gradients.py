"""Gradients of the renderer against finite differences of its float64 reference."""

import dataclasses

import numpy as np
import pytest
import torch
from render_scenes import CAMERA_AXES, START_US, camera, cloud, gaussians, moved

from nurec_sim import geometry, sensors
from nurec_sim.errors import RequestError
from nurec_sim.render import spec
from nurec_sim.render.cpu.background import draw_sky
from nurec_sim.render.cpu.frame import shared_workers
from nurec_sim.render.gradients import GaussianTensors, render_camera, render_lidar
from nurec_sim.render.layers import view_colour
from nurec_sim.render.rays import ray_grid, reference_pose, world_rays
from nurec_sim.types import Fisheye, Gaussians, Pinhole, SensorRequest, Shutter

PARAMETERS = ("mean_m", "quat_wxyz", "scale_m", "opacity", "rgb", "intensity")
SMALL = {
    "pinhole": camera(24, 16, Pinhole(17.0, 18.0, 11.5, 8.5)),
    "fisheye": camera(24, 16, Fisheye(8.0, 8.0, 12.0, 8.0, (0.02, -0.005, 0, 0), max_angle_rad=1.3)),
    "rolling": camera(24, 16, Pinhole(17.0, 18.0, 11.5, 8.5), Shutter.TOP_TO_BOTTOM),
    "lidar": sensors.lidar_model("VLP-16", np.eye(4), columns=40),
}
STEP = 1e-6


def world(n=40, sh=0, seed=1):
    """Gaussians in front of the sensor, float64, quaternions of any norm, every intensity known."""
    made = cloud(n, seed, low=(3, -3, -2), high=(9, 3, 2), sh=sh)
    rng = np.random.default_rng(seed)
    made = dataclasses.replace(
        made, intensity=rng.random(n), scale_m=made.scale_m * 1.5 + 0.03, quat_wxyz=made.quat_wxyz * 2
    )
    values = {f.name: getattr(made, f.name) for f in dataclasses.fields(made)}
    # What float32 holds exactly, so that both renderers see the same.
    return Gaussians(
        **{
            k: v.astype(np.float32).astype(np.float64) if v is not None and k != "label" else v
            for k, v in values.items()
        }
    )


def reference(made, sensor, pair, sky=None):
    """The outputs of ``gradients`` by the float64 reference."""
    request = SensorRequest("test", sensor, START_US, START_US + 30_000, pair)
    grid = ray_grid(sensor)
    pose, _ = reference_pose(request, grid.reference)
    centre = geometry.transform_points(geometry.inverse(pose), made.mean_m)
    depth = np.linalg.norm(centre, axis=-1) if grid.by_range else centre[:, 2]
    order = np.argsort(depth, kind="stable")
    order = order[depth[order] >= grid.near_m]
    lidar = sensor is SMALL["lidar"]
    colour = made.rgb if made.sh_rest is None else view_colour(made.rgb, made.sh_rest, made.mean_m - pose[:3, 3])
    known = np.isfinite(made.intensity)
    values = np.stack([np.where(known, made.intensity, 0), known], axis=1) if lidar else colour
    origin, direction = world_rays(request, grid)
    sums = spec.blend_rays(made, values, order, origin, direction, grid.near_m, grid.valid)
    mean = sums.distance / np.maximum(sums.alpha, spec.MIN_ALPHA)
    if lidar:
        intensity = sums.features[..., 0] / np.maximum(sums.features[..., 1], 1e-12)
        return {"range": np.where(sums.half > 0, sums.half, mean), "distance": mean, "intensity": intensity,
                "alpha": sums.alpha}  # fmt: skip
    behind = np.zeros((*sums.alpha.shape, 3)) if sky is None else spec.sky_colour(sky, direction)
    rgb = np.where(grid.valid[..., None], spec.finish_colour(sums.features, sums.alpha, behind, None), 0)
    surface = sums.alpha >= spec.SURFACE_ALPHA
    return {"rgb": rgb, "depth": np.where(surface, mean * grid.direction[..., 2], 0), "alpha": sums.alpha}


def weights(outputs, seed=3):
    """A smooth random weight per value of each output."""
    rng = np.random.default_rng(seed)
    made = {}
    for name, value in outputs.items():
        rows, columns = np.indices(value.shape[:2])
        waves = [np.sin(rows * rng.uniform(0.1, 0.6) + columns * rng.uniform(0.1, 0.6) + rng.uniform(0, 6))
                 for _ in range(3)]  # fmt: skip
        made[name] = np.stack(waves, axis=-1) if value.ndim == 3 else waves[0]
    return made


def drawn(tensors, sensor, poses, sky=None):
    """Outputs by name."""
    if sensor is SMALL["lidar"]:
        images = render_lidar(tensors, sensor, poses, threads=2)
    else:
        images = render_camera(tensors, sensor, poses, sky, threads=2)
    return {f.name: getattr(images, f.name) for f in dataclasses.fields(images)}


def loss_of(outputs, weight, only=None):
    total = 0.0
    for name in only or outputs:
        value = outputs[name]
        total = total + (value * (torch.from_numpy(weight[name]) if torch.is_tensor(value) else weight[name])).sum()
    return total


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


def poses_of(name):
    """Poses at the start and the end of the exposure; the LiDAR and the rolling shutter move."""
    first, last = moved(0.02, 0.1, 0.0), moved(0.06, 0.5, 0.1)
    mount = np.eye(4) if name == "lidar" else CAMERA_AXES
    return np.stack([first @ mount, (last if name in ("rolling", "lidar") else first) @ mount])


def motion(twist):
    """A small rigid motion: three translations, three rotations about the world's axes."""
    x, y, z = twist[3:]
    zero = 0 * x
    rows = [[zero, -z, y, twist[0]], [z, zero, -x, twist[1]], [-y, x, zero, twist[2]], [zero] * 4]
    return torch.linalg.matrix_exp(torch.stack([torch.stack(row) for row in rows]))


def moved_world(made, new_from_old):
    """Gaussians carried along by a motion."""
    turn = geometry.quat_from_matrix(new_from_old[:3, :3])
    quat = geometry.quat_multiply(np.broadcast_to(turn, (len(made), 4)), made.quat_wxyz)
    return dataclasses.replace(made, mean_m=geometry.transform_points(new_from_old, made.mean_m), quat_wxyz=quat)


CASES = [(name, p) for name in SMALL for p in PARAMETERS if p != ("rgb" if name == "lidar" else "intensity")]


@pytest.mark.parametrize(("name", "parameter"), CASES)
def test_every_parameter(name, parameter):
    sensor, made, pair = SMALL[name], world(), poses_of(name)
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
    seen = np.flatnonzero(np.abs(gradient).reshape(len(made), -1).max(axis=1) > 0)[:12]
    assert len(seen) >= 8
    picked = [(i, *rest) for i in seen for rest in np.ndindex(gradient.shape[1:])]

    def loss(values):
        return loss_of(reference(dataclasses.replace(made, **{parameter: values}), sensor, pair), weight)

    assert_slopes_agree(loss, getattr(made, parameter), gradient, picked)


@pytest.mark.parametrize("k", [3, 8, 15])
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
    sensor, made, pair = SMALL[name], world(), poses_of(name)
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


def leaves_of(tensors):
    return [
        value.requires_grad_() for f in dataclasses.fields(tensors) if (value := getattr(tensors, f.name)) is not None
    ]


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
