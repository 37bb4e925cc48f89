"""Who owns a static Gaussian: the chunk that saw its place from nearest, for every lens and shutter."""

import dataclasses

import numpy as np
import pytest
from chunk_worlds import chunk, drive, image
from hypothesis import given, settings
from hypothesis import strategies as st
from render_scenes import LENSES, camera, gaussians

from nurec_sim import geometry, sensors
from nurec_sim.reconstruct.feedforward.merging.ownership import nearest_view_m, owned, sees
from nurec_sim.types import Fisheye, FTheta, FThetaReference, Shutter, Windshield, WindshieldReference

SMALL = settings(max_examples=25, deadline=None)
GLASS = Windshield(
    WindshieldReference.FORWARD, (0.01, 1.02, 0.01, 0.005, 0.01, 0.003), (0.004, 0.01, 0.003, 1.01, 0.01, 0.002)
)
CAMERAS = {
    **{name: camera(lens=lens) for name, lens in LENSES.items()},
    "f-theta by angle": camera(
        lens=FTheta(36.0, 24.0, FThetaReference.ANGLE_TO_PIXELDIST, (), (0.0, 25.0, 0.0, -0.4), max_angle_rad=1.4)
    ),
    "full turn": camera(48, 48, Fisheye(8.0, 8.0, 24.0, 24.0, max_angle_rad=np.pi)),
    "behind glass": camera(windshield=GLASS),
}


def points_around(n=4000, seed=0, low=(-10, -25, -6), high=(60, 25, 12)):
    return np.random.default_rng(seed).uniform(low, high, (n, 3)).astype(np.float32)


def nearest_by_the_book(images, points):
    """D of the paper, image by image and point by point, with the row of every point solved for."""
    result = np.full(len(points), np.inf)
    for one in images:
        uv_px, valid, _ = sensors.project_rolling(one.camera, one.world_from_camera, points)
        seen = valid & sensors.in_image(one.camera, uv_px)
        distance = np.linalg.norm(points - one.world_from_camera[1, :3, 3], axis=1)
        result = np.where(seen, np.minimum(result, distance), result)
    return result


@pytest.mark.parametrize("shutter", list(Shutter), ids=lambda shutter: shutter.value)
@pytest.mark.parametrize("kind", CAMERAS)
def test_the_nearest_view_is_the_papers_for_every_lens_and_shutter(kind, shutter):
    sensor = dataclasses.replace(CAMERAS[kind], shutter=shutter)
    images, points = drive(sensor, 0.0), points_around(1500)
    found, expected = nearest_view_m(images, points), nearest_by_the_book(images, points)
    assert 0.05 < np.isfinite(expected).mean() <= 1.0
    # In the row that moves off its point while it is exposed, the fixed point may not settle; nothing else differs.
    assert np.mean(~np.isclose(found, expected)) <= 0.002
    assert np.array_equal(found, nearest_view_m(images, points))
    limit = np.random.default_rng(1).uniform(0, 40, len(points))
    assert np.array_equal(nearest_view_m(images, points, limit), np.where(found < limit, found, np.inf))


@pytest.mark.parametrize("shutter", [Shutter.TOP_TO_BOTTOM, Shutter.RIGHT_TO_LEFT], ids=lambda shutter: shutter.value)
@pytest.mark.parametrize("kind", CAMERAS)
def test_a_point_lifted_from_a_pixel_is_seen_by_its_image(kind, shutter):
    """Also at the border, by a camera that drives and turns while it is exposed."""
    sensor = dataclasses.replace(CAMERAS[kind], shutter=shutter)
    one = image(sensor, moves_m=0.6, turns_rad=0.03)
    rays, valid = sensors.pixel_rays(sensor)
    rows, columns = np.nonzero(valid)
    uv_px = np.stack([columns, rows], axis=1) + 0.5
    poses = geometry.interpolate_pose_pair(one.world_from_camera, sensors.shutter_fraction(sensor, uv_px))
    ray = np.einsum("nij,nj->ni", poses[:, :3, :3], rays[valid])
    for range_m in (5.0, 50.0):
        # A lens ends where it is hardly one-to-one any more: there, rounding decides what it still sees.
        assert sees(one, poses[:, :3, 3] + range_m * ray).mean() > 0.995


@pytest.mark.parametrize("kind", ["pinhole", "fisheye", "f-theta", "full turn"])
def test_owners_are_those_of_the_papers_equation(kind):
    sensor = dataclasses.replace(CAMERAS[kind], shutter=Shutter.TOP_TO_BOTTOM)
    points = points_around(3000)
    chunks = [
        chunk(gaussians(points[k::3]), drive(sensor, x)) for k, x in enumerate((0.0, 15.0, 35.0))
    ]  # overlapping views
    for tolerance_m in (0.0, 5.0):
        masks = owned(chunks, tolerance_m)
        for k, mask in enumerate(masks):
            distance = np.stack([nearest_by_the_book(c.images, points[k::3]) for c in chunks])
            expected = distance[k] <= distance.min(axis=0) + tolerance_m
            assert mask.dtype == bool and mask.shape == expected.shape
            assert np.mean(mask != expected) <= 0.002
        assert 0.02 < np.mean(~np.concatenate(masks)) < 0.9


def test_a_gaussian_stays_with_who_saw_it_from_nearer():
    far, near = [image(camera(), 0.0)], [image(camera(), 30.0)]
    places = gaussians([[40.0, 0, 0], [20.0, 0, 0], [-5.0, 0, 0]])
    first, second = owned([chunk(places, far), chunk(places, near)], 5.0)
    # At 40 m: 40 m against 10 m. At 20 m: only the first looks there. At -5 m: nobody does, so it stays where it is.
    assert first.tolist() == [False, True, True]
    assert second.tolist() == [True, False, True]


def test_the_tolerance_keeps_what_both_chunks_saw_alike():
    places = gaussians([[50.0, 0, 0]])
    chunks = [chunk(places, [image(camera(), 0.0)]), chunk(places, [image(camera(), 4.0)])]
    assert [mask.tolist() for mask in owned(chunks, 5.0)] == [[True], [True]]
    assert [mask.tolist() for mask in owned(chunks, 3.0)] == [[False], [True]]


@pytest.mark.parametrize("name", ["fisheye", "f-theta"])
def test_defect_9_fields_of_view_beyond_180_degrees(name):
    """Rays of the border point backwards there: a pyramid through the corners has no inside any more."""
    lens = {
        "fisheye": Fisheye(10.0, 10.0, 24.0, 24.0, max_angle_rad=np.radians(110)),
        "f-theta": FTheta(24.0, 24.0, FThetaReference.ANGLE_TO_PIXELDIST, (), (0.0, 10.0), np.radians(110)),
    }[name]
    sensor = camera(48, 48, lens)
    corner, valid = sensors.unproject(sensor, np.array([[24.0, 6.0], [6.0, 24.0]]))
    assert valid.all() and (corner[:, 2] < 0).all()
    sideways = np.radians([0.0, 80.0, 89.0, 95.0, 105.0, 115.0])
    ring = np.stack([np.cos(sideways), np.sin(sideways), np.zeros(6)], axis=1)
    places = gaussians(np.concatenate([ring, ring * (1, -1, 1)]) * 6.0 + (20.0, 0, 0))
    assert sees(image(sensor, 20.0), places.mean_m).tolist() == [True, True, True, True, True, False] * 2
    # A chunk behind looks at the same places from 20 m away and more.
    behind, beside = chunk(places, [image(sensor, 0.0)]), chunk(places, [image(sensor, 20.0)])
    lost, kept = owned([behind, beside], 5.0)
    assert lost.tolist() == [False, False, False, False, False, True] * 2
    assert kept.tolist() == [True, True, True, True, True, False] * 2


@SMALL
@given(seed=st.integers(0, 10_000), order=st.permutations(range(3)))
def test_owners_do_not_depend_on_the_order_of_the_chunks(seed, order):
    points = points_around(300, seed)
    chunks = [chunk(gaussians(points[k::3]), drive(camera(), 12.0 * k, frames=2)) for k in range(3)]
    masks = owned(chunks, 5.0)
    shuffled = owned([chunks[k] for k in order], 5.0)
    assert all(np.array_equal(masks[k], mask) for k, mask in zip(order, shuffled, strict=True))
