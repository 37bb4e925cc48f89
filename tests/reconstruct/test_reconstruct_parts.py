"""Normals, footprints, points of bodies, depth, responses and sky of `lift` one at a time."""

import dataclasses

import numpy as np
import pytest
from clouds import cloud_of
from hypothesis import given, settings
from hypothesis import strategies as st
from reconstruct_street import Street, camera

from nurec_sim import geometry
from nurec_sim.reconstruct.lift import colour, depth, lifting
from nurec_sim.reconstruct.lift.matching import census
from nurec_sim.reconstruct.lift.points import actors_of, gather
from nurec_sim.reconstruct.lift.settings import (
    PointSettings,
    ViewSettings,
)
from nurec_sim.reconstruct.lift.sky_cubemap import make_sky
from nurec_sim.reconstruct.lift.surfaces import footprints, surface_of
from nurec_sim.reconstruct.lift.views import read_views


@given(st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_normals_of_a_plane_face_the_sensor(seed):
    random = np.random.default_rng(seed)
    normal = random.normal(size=3)
    normal /= np.linalg.norm(normal)
    basis = np.linalg.svd(normal[None])[2][1:]
    xyz = random.uniform(-2, 2, (400, 2)) @ basis + random.normal(0, 0.02, (400, 1)) * normal
    moved, found, spacing, _ = surface_of(cloud_of(xyz, eye=5 * normal))
    assert np.median(found @ normal) > 0.98
    assert (found @ normal > 0).all()
    assert np.std(moved.xyz_m @ normal) < 0.7 * np.std(xyz @ normal)
    assert (spacing >= 0.1 - 1e-6).all() and (spacing <= 0.3 + 1e-6).all()


def test_census_tells_the_clearly_darker_neighbours_row_by_row():
    """Of the middle of 7 x 7 equal pixels the first neighbour is 2 darker, the last 3, the second 1: too little."""
    gray = np.full((7, 7), 100, np.uint8)
    gray[0, 0], gray[0, 1], gray[6, 6] = 98, 99, 97
    assert int(census(gray)[3, 3]) == (1 << 47) | 1


def test_one_scan_line_faces_the_sensor():
    xyz = np.column_stack([np.linspace(-1, 1, 50), np.full(50, 5.0), np.zeros(50)])
    _, normal, _, _ = surface_of(cloud_of(xyz, eye=(0, 0, 0)))
    assert np.median(-normal[:, 1]) > 0.99


def test_footprints_cover_their_pixels_on_the_surface():
    ray = np.array([[0.8, 0.0, -0.6], [1.0, 0, 0]])
    normal = np.array([[0.0, 0, 1], [-1.0, 0, 0]])
    gaussians = footprints(np.zeros((2, 3)), normal, ray, np.array([0.1, 0.1]), np.zeros((2, 3)), np.zeros(2),
                           np.zeros(2, np.uint8), 0.9)  # fmt: skip
    axes = geometry.matrix_from_quat(gaussians.quat_wxyz)
    stretched = axes[0][:, 0]
    assert abs(stretched[0]) == pytest.approx(1, abs=1e-6)
    assert gaussians.scale_m[0, 0] / gaussians.scale_m[0, 1] == pytest.approx(1 / 0.6, rel=1e-5)
    assert gaussians.scale_m[1, 0] == pytest.approx(gaussians.scale_m[1, 1], rel=1e-5)
    assert (gaussians.scale_m[:, 2] < 0.2 * gaussians.scale_m[:, 1]).all()


def test_every_point_goes_to_one_body():
    clip = Street(boxes={"a": ((4.0, 1.8, 1.5), np.array([12.0, -2.0]))})
    actors = actors_of(clip, PointSettings())
    fine = PointSettings(min_voxel_m=0.001, max_voxel_m=0.001)
    gathered = gather(clip, actors, set(), fine)
    feet = sum(len(box) for box, _ in gathered.feet.values())
    total = len(gathered.static) + sum(map(len, gathered.actors.values())) + feet
    assert 0.97 * gathered.point_count <= total <= gathered.point_count
    box = clip.tracks[0].path.world_from_body[0]
    local = geometry.transform_points(geometry.inverse(box), gathered.static.xyz_m)
    assert not geometry.points_in_box(local, (4.0, 1.8, 1.5), 0.14).any()


def test_returns_of_a_scanner_that_reaches_far_are_kept():
    """A Pandar128 measures up to 200 m; beyond ``max_range_m`` returns are errors."""
    street = Street(frames=1)
    near = street.sweep("top", 0)
    xyz = np.array([[180.0, 3.0, 2.0], [255.0, 3.0, 2.0]])
    far = dataclasses.replace(near, xyz_m=xyz, intensity=None, point_t_us=np.full(2, near.t_us))
    street.sweep = lambda lidar, index: far
    gathered = gather(street, [], set(), PointSettings())
    assert len(gathered.static) == 1
    assert gathered.static.xyz_m[0] == pytest.approx(far.xyz_world_m[0], abs=1e-3)


def test_depth_is_found_by_matching_where_nothing_was_measured():
    clip = Street(frames=3)
    views = read_views(clip, ["front"], {}, ViewSettings())
    step, levels = 1 / 3.5 / 47, 48
    empty = np.zeros((96, 192), np.float32)
    around = [(v.packed, v.rgb, census(v.rgb.mean(axis=-1).astype(np.uint8))) for v in views[1:]]
    no_sky = np.full((96, 192), depth.NOT_SKY, np.uint8)
    found = depth.dense_inverse_depth(views[0].packed, views[0].world_from_view, views[0].rgb, empty, no_sky, around,
                                      step * np.arange(levels))  # fmt: skip
    pose = views[0].world_from_view
    rays = lifting.rays_of(views[0]).reshape(-1, 3)
    distance, what = clip.cast(pose[:3, 3], rays @ pose[:3, :3].T, 0)
    true = (1 / distance).reshape(96, 192)
    walls = (what.reshape(96, 192) == 4) & (true > 1 / 25)
    walls[:, :20], walls[:, -20:] = False, False
    assert np.median(np.abs(found - true)[walls]) < step


def test_measured_depth_stays():
    prior = np.full((20, 30), 0.123, np.float32)
    view = read_views(Street(frames=1, cameras=(camera(width=30, height=20),)), ["front"], {}, ViewSettings())[0]
    no_sky = np.full(prior.shape, depth.NOT_SKY, np.uint8)
    found = depth.dense_inverse_depth(
        view.packed, view.world_from_view, view.rgb, prior, no_sky, [], 0.01 * np.arange(32)
    )
    assert np.array_equal(found, prior)


def test_isp_of_cameras_that_share_points():
    random = np.random.default_rng(0)
    true = random.uniform(0.1, 0.9, (2000, 3)).astype(np.float32)
    gain = np.array([[0.9, 0.05, 0, 0.02], [0, 0.8, 0, 0.03], [0, 0, 1.1, -0.02]])
    other = (np.column_stack([true, np.ones(2000)]) @ gain.T).astype(np.float32)
    everything = np.ones(2000, bool)
    nothing = np.zeros(2000, bool)
    isp, unaligned_cameras = colour.solve_isp(
        ["a", "b", "c"], {"a": (true, everything), "b": (other, everything), "c": (true, nothing)}
    )
    assert np.allclose(isp["a"], np.eye(3, 4)) and np.allclose(isp["c"], np.eye(3, 4))
    assert np.abs(isp["b"] - gain).max() < 0.06
    assert unaligned_cameras == ["c"]
    assert np.abs(colour.to_canonical(other * 255, isp["b"]) - true * 255).mean() < 4


def test_sky_without_any_view_is_grey():
    sky = make_sky([], [], [], 8)
    assert sky.shape == (6, 8, 8, 3) and (sky == sky[0, 0, 0]).all()
