"""The LiDAR branch: planes and footprints by hand, what it starts from, and that azimuth wraps."""

import dataclasses

import numpy as np
import pytest
import torch

from nurec_sim import geometry
from nurec_sim.network.checkpoints.fit import count_parameters, needed_state
from nurec_sim.network.lidar.branch import FREE_SCALE_M, build_lidar
from nurec_sim.network.lidar.footprints import FLOOR, surface_axes
from nurec_sim.network.lidar.inputs import lidar_inputs
from nurec_sim.network.lidar.planes import fit_planes
from nurec_sim.network.lidar.profiles import LIDAR_PROFILES
from nurec_sim.network.lidar.range_image import RangeImage, row_steps
from nurec_sim.sensors import beam_directions
from nurec_sim.types import LidarModel

ROWS, COLUMNS = 8, 64
LIDAR = LidarModel(
    "top",
    np.radians(np.linspace(4, -24, ROWS)),
    np.radians(180 - 360 / COLUMNS * np.arange(COLUMNS)),
    np.zeros(ROWS),
    np.eye(4),
)


def room(half_m: float = 10.0, height_m: float = 2.0) -> RangeImage:
    """A square room around the sensor, on flat ground."""
    ray = beam_directions(LIDAR)
    wall = half_m / np.abs(ray[..., :2]).max(axis=-1)
    ground = np.where(ray[..., 2] < 0, height_m / np.maximum(-ray[..., 2], 1e-9), np.inf)
    reach = np.minimum(wall, ground)
    returned = np.ones(reach.shape, bool)
    returned[2, 5] = False
    shown = np.where(wall < ground, 0.4, 0.1).astype(np.float32)
    eye = np.zeros((COLUMNS, 3))
    return RangeImage.over(LIDAR, (ray * reach[..., None]).astype(np.float32), eye, returned, shown)


@pytest.fixture(scope="module")
def image():
    return room()


@pytest.fixture(scope="module")
def trained():
    """A branch that says something about every beam."""
    model = build_lidar(LIDAR_PROFILES["lidar"], 1)
    torch.nn.init.normal_(model.head.weight, std=0.1, generator=torch.Generator().manual_seed(2))
    return model


def covariance(quat, scale):
    turn = geometry.matrix_from_quat(quat.numpy().astype(np.float64))
    return np.einsum("nij,nj,nkj->nik", turn, scale.numpy().astype(np.float64) ** 2, turn)


def test_the_shadow_of_a_footprint_along_the_beam_is_the_floor():
    slope = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, -20.0], [3.0, 4.0], [-0.3, 0.7]])
    sigma = torch.tensor([[0.1, 0.1], [0.1, 0.2], [0.05, 0.02], [0.3, 0.1], [0.1, 0.1]])
    quat, wide = surface_axes(slope, sigma)
    found = covariance(quat, torch.cat([wide, torch.zeros(5, 1)], dim=1))
    # Beams run along the third axis: what they see of a disc is the covariance across it.
    wanted = np.stack([np.diag(row) for row in sigma.numpy().astype(np.float64) ** 2])
    np.testing.assert_allclose(found[:, :2, :2], wanted, rtol=2e-4, atol=1e-6)
    normal = np.concatenate([slope.numpy(), np.ones((5, 1))], axis=1)
    assert np.abs(np.einsum("nij,nj->ni", found, normal)).max() < 1e-4
    # A plane that falls by one metre per metre makes a footprint of 0.1 m longer by the square root of two.
    assert wide[1].max().item() == pytest.approx(max(0.1 * 2**0.5, 0.2)) and wide[1].min().item() == pytest.approx(
        min(0.1 * 2**0.5, 0.2)
    )


def test_planes_are_those_of_the_walls_and_the_ground(image):
    planes, ray = fit_planes(image), image.xyz_m.astype(np.float64)
    # Straight ahead the wall faces the beam but for its elevation.
    ahead = COLUMNS // 2
    elevation = LIDAR.elevation_rad[1]
    assert ray[1, ahead, 0] == pytest.approx(10, abs=1e-5)
    np.testing.assert_allclose(planes[1, ahead, :2], [0, -np.tan(elevation)], atol=2e-3)
    # On the ground the range grows by 1 / tan(depression) per metre up.
    np.testing.assert_allclose(planes[7, ahead, 1], -1 / np.tan(-LIDAR.elevation_rad[7]), rtol=0.02)
    assert np.abs(planes[1, ahead, 2]) < 0.005 and not planes[2, 5].any()


def test_an_untrained_branch_gives_the_footprints_of_the_returns(image):
    with torch.inference_mode():
        found = build_lidar(LIDAR_PROFILES["lidar"])(lidar_inputs(image))
    reach = np.linalg.norm(image.xyz_m[image.returned], axis=1)
    assert len(found.position_m) == image.returned.sum() == ROWS * COLUMNS - 1
    np.testing.assert_allclose(found.position_m, image.xyz_m[image.returned], atol=1e-5)
    np.testing.assert_allclose(found.intensity, image.intensity[image.returned], atol=1e-6)
    # Across the beams no footprint is narrower than half of the distance to the next beam.
    ray = image.xyz_m[image.returned] / reach[:, None]
    level = np.stack([-ray[:, 1], ray[:, 0], np.zeros(len(ray))], axis=1)
    level /= np.linalg.norm(level, axis=1)[:, None]
    across = np.hypot(ray[:, 0], ray[:, 1])
    shadow = np.einsum("ni,nij,nj->n", level, covariance(found.quat_wxyz, found.scale_m), level)
    assert (np.sqrt(shadow) >= 0.999 * FLOOR * reach * across * 2 * np.pi / COLUMNS).all()


def test_without_the_floor_scales_start_as_in_the_camera_branch(image):
    with torch.inference_mode():
        found = build_lidar(LIDAR_PROFILES["lidar-no-floor"])(lidar_inputs(image))
    np.testing.assert_allclose(found.scale_m, FREE_SCALE_M, rtol=1e-6)


def test_azimuth_wraps(image, trained):
    turned = dataclasses.replace(
        image, xyz_m=np.roll(image.xyz_m, 16, 1), returned=np.roll(image.returned, 16, 1),
        intensity=np.roll(image.intensity, 16, 1),
    )  # fmt: skip
    with torch.inference_mode():
        first, second = trained(lidar_inputs(image)), trained(lidar_inputs(turned))
    place = np.full(image.returned.shape, -1)
    place[image.returned] = np.arange(image.returned.sum())
    order = np.roll(place, 16, 1)[turned.returned]
    assert first.opacity.std() > 0.005
    for name in ("position_m", "scale_m", "opacity"):
        torch.testing.assert_close(getattr(first, name)[order], getattr(second, name), rtol=1e-3, atol=1e-4)


def test_chosen_returns_are_decoded_as_among_all(image, trained):
    chosen = np.zeros_like(image.returned)
    chosen[1::2, ::3] = True
    with torch.inference_mode():
        every, some = trained(lidar_inputs(image)), trained(lidar_inputs(image, chosen))
    assert len(some.opacity) == (chosen & image.returned).sum()
    torch.testing.assert_close(every.scale_m[chosen[image.returned]], some.scale_m)


def test_several_gaussians_share_the_footprint_of_a_return(image):
    three = dataclasses.replace(LIDAR_PROFILES["lidar"], per_return=3)
    with torch.inference_mode():
        one, many = (build_lidar(each)(lidar_inputs(image)) for each in (LIDAR_PROFILES["lidar"], three))
    assert len(many.position_m) == 3 * len(one.position_m)
    torch.testing.assert_close(many.position_m.reshape(-1, 3, 3)[:, 1], one.position_m, rtol=0, atol=1e-5)
    aside = (many.position_m.reshape(-1, 3, 3)[:, 0] - one.position_m).norm(dim=1)
    assert (aside > 0.01).all() and torch.equal(many.beam, torch.arange(len(one.beam)).repeat_interleave(3))


def test_profiles_have_the_same_parameters_and_are_small():
    assert needed_state("lidar").keys() == needed_state("lidar-no-floor").keys()
    assert 100_000 < count_parameters("lidar") < 300_000


def test_steps_of_rows_are_the_mean_of_both_sides():
    np.testing.assert_allclose(row_steps(np.array([0.5, 0.3, 0.2])), [0.2, 0.15, 0.1])
    assert row_steps(np.array([0.5])).tolist() == [np.radians(1.0)]
