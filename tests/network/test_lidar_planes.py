"""Planes of returns: each as reweighted least squares gives it, one beam after the other."""

import dataclasses

import numpy as np
import pytest

from nurec_sim.network.lidar.plane_fits import COLUMNS, NOISE_M, NOISE_SHARE, PULL, ROUNDS, ROWS, SIZE, STEEPEST
from nurec_sim.network.lidar.planes import fit_planes
from nurec_sim.network.lidar.range_image import RangeImage
from nurec_sim.sensors import beam_directions
from nurec_sim.types import LidarModel


def rough_sweep(rows: int, columns: int) -> RangeImage:
    """Noisy returns at two distances, with gaps, seen by a moving sensor."""
    random = np.random.default_rng(3)
    lidar = LidarModel(
        "top", np.radians(np.linspace(4, -8, rows)), np.radians(180 - 360 / columns * np.arange(columns)),
        np.zeros(rows), np.eye(4),
    )  # fmt: skip
    reach = np.where(np.arange(columns) % 40 < 25, 8.0, 12.0) + random.normal(0, 0.03, (rows, columns))
    returned = random.random((rows, columns)) > 0.1
    eye = np.linspace([0, 0, 0], [0.5, 0.1, 0], columns)
    xyz = beam_directions(lidar) * reach[..., None] + eye
    return RangeImage.over(lidar, xyz.astype(np.float32), eye, returned, np.zeros(reach.shape, np.float32))


def plane_of(image: RangeImage, r: int, c: int) -> np.ndarray:
    """What ``fit_planes`` says of one beam, by the normal equations of all its neighbours at once."""
    rows, columns = image.returned.shape
    own = (image.xyz_m[r, c] - image.eye_m[c]).astype(np.float64)
    reach = np.linalg.norm(own)
    along = own / reach
    left = np.array([-own[1], own[0], 0]) / np.hypot(own[0], own[1])
    up = np.cross(along, left)
    h, v, y, sides = [], [], [], np.zeros(4)
    for i in range(max(r - ROWS, 0), min(r + ROWS + 1, rows)):
        for k in range(c - COLUMNS, c + COLUMNS + 1):
            if not image.returned[i, k % columns] or (not image.full_turn and not 0 <= k < columns):
                continue
            ray = image.xyz_m[i, k % columns].astype(np.float64) - image.eye_m[c]
            d = ray @ along
            if abs(d - reach) > STEEPEST * np.hypot(ray @ left, ray @ up) + NOISE_M:
                continue
            h, v, y = [*h, ray @ left / d], [*v, ray @ up / d], [*y, reach / d]
            for side, place in enumerate([(r, c - 1), (r, c + 1), (r - 1, c), (r + 1, c)]):
                if (i, k) == place:
                    sides[side] = np.log(d / reach)
    h, v, y = np.array(h), np.array(v), np.array(y)
    pull = np.diag([0, 1, 1]) * (PULL * (h**2 + v**2).max() + 1e-12)
    design, weight = np.stack([np.ones(len(h)), h, v], axis=1), np.ones(len(h))
    for _ in range(ROUNDS):
        total = weight.sum()
        plane = np.linalg.solve(design.T @ (weight[:, None] * design) + pull, design.T @ (weight * y))
        error = y - design @ plane
        weight = 1 / (1 + (error / ((NOISE_M + NOISE_SHARE * reach) / reach)) ** 2)
    roughness = (weight * np.abs(error)).sum() / total * reach
    return np.array([*plane[1:] / plane[0], (1 / plane[0] - 1) * reach, roughness, total / SIZE, *sides])


@pytest.mark.parametrize("full_turn", [True, False])
def test_every_plane_is_that_of_its_own_neighbours(full_turn):
    # Wider than the beams that are fitted at once.
    image = dataclasses.replace(rough_sweep(7, 150), full_turn=full_turn)
    found = fit_planes(image)
    assert not found[~image.returned].any() and image.returned[3].sum() > 120
    for r in (0, 1, 3, 6):
        for c in np.flatnonzero(image.returned[r]):
            np.testing.assert_allclose(found[r, c], plane_of(image, r, c), rtol=2e-4, atol=2e-5)


def test_an_image_may_be_narrower_than_a_window_and_a_return_may_lie_at_the_sensor():
    image = rough_sweep(3, 2)
    found = fit_planes(dataclasses.replace(image, full_turn=True))
    assert np.isfinite(found).all()
    image.eye_m[:], image.xyz_m[:] = 0, 1e-3
    assert not fit_planes(image).any()
