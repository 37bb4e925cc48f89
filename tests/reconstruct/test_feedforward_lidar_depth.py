import dataclasses
import json

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from wall_street import EPOCH_US, STEP_US, WallStreet, chunk_of, pixel_gaussians, street_chunk

from nurec_sim import geometry, logs, sensors
from nurec_sim.errors import ReconstructError
from nurec_sim.reconstruct.feedforward.chunks import ContextImage
from nurec_sim.reconstruct.feedforward.lidar.depth import fit_depth
from nurec_sim.types import Shutter, Track, Trajectory


@pytest.mark.parametrize("shutter", [Shutter.GLOBAL, Shutter.TOP_TO_BOTTOM, Shutter.RIGHT_TO_LEFT])
def test_every_image_gets_its_own_factor_back(shutter):
    clip = WallStreet(shutter=shutter)
    chunk, true_m = street_chunk(clip)
    factors = np.exp(np.linspace(-0.6, 0.6, len(true_m)))
    fit = fit_depth(clip, chunk, (true_m / factors[:, None, None]).astype(np.float32), set(), "scale")
    assert all(image.taken_from == "own" and image.points > 200 for image in fit.images)
    assert np.allclose([image.scale for image in fit.images], factors, rtol=0.002)
    assert fit.error_before > 0.1 and fit.error_after < 0.003
    assert (fit.images[1].camera, fit.images[1].frame) == ("front", 1)


def test_moved_gaussians_lie_where_the_true_ones_do():
    clip = WallStreet(frames=2)
    chunk, true_m = street_chunk(clip)
    wrong_m = true_m / np.array([0.7, 1.4, 1.1, 0.9], np.float32)[:, None, None]
    moved = fit_depth(clip, chunk, wrong_m, set(), "scale").apply(pixel_gaussians(chunk, wrong_m), chunk)
    wanted = pixel_gaussians(chunk, true_m)
    distance = torch.tensor(true_m).reshape(1, -1, 1)
    assert ((moved.position_m - wanted.position_m).norm(dim=-1, keepdim=True) / distance).max() < 0.006
    assert torch.allclose(moved.scale_m, wanted.scale_m, rtol=0.005)
    assert torch.allclose(moved.motion_m, wanted.motion_m, rtol=0.005)
    assert torch.equal(moved.quat_wxyz, wanted.quat_wxyz) and torch.equal(moved.opacity, wanted.opacity)
    still = dataclasses.replace(pixel_gaussians(chunk, wrong_m), motion_m=None)
    assert fit_depth(clip, chunk, wrong_m, set(), "scale").apply(still, chunk).motion_m is None


def test_slopes_are_found_where_points_lie_and_do_not_reach_beyond():
    clip = WallStreet()
    chunk, true_m = street_chunk(clip, ("front",))
    scales, slopes = np.array([0.8, 1.0, 1.2, 1.3]), np.array([0.004, -0.006, 0.0, 0.005])
    shape = (-1, 1, 1)
    bent_m = 1 / (scales.reshape(shape) * np.maximum(1 / true_m - slopes.reshape(shape), 1e-4))
    fit = fit_depth(clip, chunk, bent_m.astype(np.float32), set(), "affine")
    for index, image in enumerate(fit.images):
        assert image.scale == pytest.approx(scales[index], rel=0.005)
        assert image.slope_per_m == pytest.approx(slopes[index], abs=1e-4)
        near, far = image.range_m
        inside = (bent_m[index] > near) & (bent_m[index] < far)
        fitted = bent_m[index] * image.factor(bent_m[index])
        assert np.abs(fitted / true_m[index] - 1)[inside].max() < 0.005
        # Positive and rising everywhere, far behind the last point too.
        depth = np.geomspace(0.1, 1e5, 400)
        fitted = depth * image.factor(depth)
        assert (fitted > 0).all() and (np.diff(fitted) > 0).all()
    before = pixel_gaussians(chunk, bent_m.astype(np.float32))
    moved = fit.apply(before, chunk)
    grown = (moved.scale_m / before.scale_m)[0, :, 0].reshape(bent_m.shape).numpy()
    factors = np.stack([image.factor(depth) for image, depth in zip(fit.images, bent_m, strict=True)])
    assert np.allclose(grown, factors, rtol=1e-3)
    wanted = pixel_gaussians(chunk, true_m).position_m
    close = torch.tensor((true_m < 60).reshape(1, -1)) & torch.tensor((true_m > 6).reshape(1, -1))
    error = (moved.position_m - wanted).norm(dim=-1) / torch.tensor(true_m).reshape(1, -1)
    assert error[close].max() < 0.01


def test_local_factors_follow_the_points_from_surface_to_surface():
    clip = WallStreet()
    chunk, true_m = street_chunk(clip, ("front",))
    # Wrong by another factor on every surface, and on the left and the right of it.
    near = (np.abs(true_m - 20) < 6) & (np.arange(98)[:, None] < 52)
    wrong = np.where(near, 1.25, 0.9) * (1 + 0.1 * np.sin(np.arange(168) / 20))
    predicted = (true_m * wrong).astype(np.float32)
    fit = fit_depth(clip, chunk, predicted, set(), "local")
    assert fit.error_after < 0.01 < 0.08 < fit.error_before
    measured = np.zeros_like(near)
    measured[:, 40:80] = True  # the beams look a little up and 25 degrees down
    measured &= true_m < 100
    error = np.abs(fit.factor * predicted / true_m - 1)
    assert np.median(error[measured]) < 0.01 and np.percentile(error[measured], 90) < 0.05
    moved = fit.apply(pixel_gaussians(chunk, predicted), chunk)
    wanted = pixel_gaussians(chunk, (predicted * fit.factor).astype(np.float32))
    assert torch.allclose(moved.position_m, wanted.position_m, rtol=1e-4, atol=1e-3)


def test_local_factors_are_one_where_nothing_was_measured():
    clip = WallStreet(frames=2)
    chunk, true_m = street_chunk(clip, ("front",))
    nothing = fit_depth(clip, dataclasses.replace(chunk, ego=np.ones_like(chunk.ego)), true_m, set(), "local")
    assert (nothing.factor == 1).all() and nothing.error_after is None


def test_a_fifth_of_wrong_depths_does_not_matter():
    clip = WallStreet()
    chunk, true_m = street_chunk(clip, ("front",))
    rng = np.random.default_rng(3)
    # In blocks, as wrongly predicted objects are; single wrong pixels would only look like edges.
    wrong = np.kron(rng.random((len(true_m), 14, 24)) < 0.2, np.ones((1, 7, 7), bool))
    noise = rng.uniform(1.5, 4.0, wrong.shape)
    predicted = np.where(wrong, noise * true_m, true_m).astype(np.float32) / 1.25
    for kind in ("scale", "affine"):
        for image in fit_depth(clip, chunk, predicted, set(), kind).images:
            assert image.scale == pytest.approx(1.25, rel=0.005)
            assert abs(image.slope_per_m) < 1e-4


def test_points_behind_what_the_camera_sees_are_left_out():
    clip = WallStreet(frames=1)
    chunk, true_m = street_chunk(clip, ("front",))
    # Another sensor saw a plane 10 m behind the near wall: three points for each one of the wall.
    y, z = np.meshgrid(np.linspace(0.5, 10, 120), np.linspace(0.1, 5.5, 100))
    clip.added = np.stack([np.full(y.size, 35.0), y.ravel(), z.ravel()], axis=1)
    image = fit_depth(clip, chunk, true_m, set(), "scale").images[0]
    assert image.error_before < 0.005 and image.scale == pytest.approx(1, rel=0.005)


def test_returns_from_the_recording_car_are_left_out():
    clip = WallStreet(frames=1)
    chunk, true_m = street_chunk(clip, ("front",))
    x, y = np.meshgrid(np.linspace(2.6, 3.5, 200), np.linspace(-0.8, 0.8, 200))
    bonnet = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.9)], axis=1)
    clip.added = geometry.transform_points(clip.ego.at(EPOCH_US), bonnet)
    assert fit_depth(clip, chunk, true_m, set(), "scale").error_before < 0.005


def test_held_out_sweeps_are_not_read_and_their_images_take_neighbours():
    clip = WallStreet(frames=6)
    chunk, true_m = street_chunk(clip, ("front",))
    fit = fit_depth(clip, chunk, true_m / np.float32(1.5), {1, 2, 3, 4}, "scale")
    assert set(clip.read) == {0, 5}
    # Images 2 and 3 are 0.2 s away from any sweep that is left.
    assert [image.points > 0 for image in fit.images] == [True, True, False, False, True, True]
    assert [image.taken_from for image in fit.images] == ["own", "own", "camera", "camera", "own", "own"]
    assert all(image.scale == pytest.approx(1.5, rel=0.005) for image in fit.images)
    assert fit.images[2].error_after is None
    report = fit.report()
    assert report["images_without_own_points"] == 2
    assert report["images"][2]["taken_from"] == "camera"


def test_cameras_without_points_take_the_factor_of_the_chunk_and_without_any_point_it_is_one():
    clip = WallStreet(frames=2)
    chunk, true_m = street_chunk(clip)
    covered = chunk.ego.copy()
    covered[2:] = True
    half = fit_depth(clip, dataclasses.replace(chunk, ego=covered), true_m / np.float32(1.5), set(), "affine")
    assert [image.taken_from for image in half.images] == ["own", "own", "chunk", "chunk"]
    assert all(image.scale == pytest.approx(1.5, rel=0.005) for image in half.images)
    nothing = fit_depth(clip, dataclasses.replace(chunk, ego=np.ones_like(covered)), true_m, set(), "scale")
    assert {(image.taken_from, image.scale, image.points) for image in nothing.images} == {("none", 1.0, 0)}
    assert (nothing.error_before, nothing.error_after) == (None, None)


def test_a_slope_needs_points_at_several_depths():
    clip = WallStreet()
    chunk, true_m = street_chunk(clip, ("front",))
    # Only the near wall is left.
    chunk = dataclasses.replace(chunk, ego=(np.abs(true_m - 22) > 3) | (np.arange(98)[:, None] > 52))
    fit = fit_depth(clip, chunk, true_m / np.float32(1.1), set(), "affine")
    for image in fit.images:
        assert image.points >= 200 and image.slope_per_m == 0
        assert image.scale == pytest.approx(1.1, rel=0.005)


def test_points_on_moving_objects_go_along_to_the_time_of_the_image():
    # A truck fills the view and drives ahead at 20 m/s; the only sweep left is 0.1 s older than the image.
    t_us = EPOCH_US + STEP_US * np.arange(-3, 6)
    poses = np.array([geometry.pose_from_xyyaw(20 + 20 * (t - EPOCH_US) * 1e-6, 0, 0, z=3) for t in t_us])
    truck = Track("truck", "heavy_truck", (6.0, 12.0, 5.8), Trajectory(t_us, poses))
    y, z = np.meshgrid(np.linspace(-5, 5, 80), np.linspace(0.5, 5.5, 60))
    rear = np.stack([np.full(y.size, 17.0), y.ravel(), z.ravel()], axis=1)
    for tracks in ((truck,), ()):
        clip = WallStreet(frames=2, tracks=tracks)
        clip.added = rear
        chunk, _ = street_chunk(clip, ("front",))
        image = chunk.images[1]
        depth = np.full(chunk.ego.shape, 19.0 - image.world_from_camera[0, 0, 3], np.float32)
        rows = np.abs(np.arange(98)[:, None] - 40) > 20
        covered = np.broadcast_to(rows | (np.abs(np.arange(168) - 84) > 30), chunk.ego.shape)
        fit = fit_depth(clip, dataclasses.replace(chunk, ego=covered), depth, {1}, "scale").images[1]
        assert fit.points > 300
        camera_x = image.world_from_camera[:, 0, 3].mean()
        truth = 1.0 if tracks else (17 - camera_x) / (19 - camera_x)
        assert fit.scale == pytest.approx(truth, rel=0.01)


def test_the_same_input_gives_the_same_report():
    clip = WallStreet(frames=2)
    chunk, true_m = street_chunk(clip)
    first, second = (fit_depth(clip, chunk, true_m, set(), "affine").report() for _ in range(2))
    assert json.dumps(first) == json.dumps(second)


def test_logs_without_sweeps_are_refused():
    clip = WallStreet(frames=2)
    chunk, true_m = street_chunk(clip)
    with pytest.raises(ReconstructError, match="has 2, of which all are held out"):
        fit_depth(clip, chunk, true_m, {0, 1}, "scale")
    clip.rig = dataclasses.replace(clip.rig, lidars={})
    with pytest.raises(ReconstructError, match="fitting depth to LiDAR needs sweeps, and clip 'wall-street' has"):
        fit_depth(clip, chunk, true_m, set(), "scale")


@pytest.mark.realdata
def test_real_sweeps_agree_with_the_sweep_that_they_do_not_know(realdata):
    clip = logs.open_clip(realdata / "kitti_raw_0002")
    images, depths = [], []
    for frame in (2, 5):
        camera = sensors.scaled_camera(clip.rig.cameras["cam_left"], 784, 236)
        t_us = tuple(int(t) for t in clip.camera_times_us("cam_left")[frame])
        images.append(ContextImage(camera, frame, t_us, t_us, clip.world_from_camera("cam_left", frame)))
        # A depth map that only this sweep has made: every pixel takes that of the nearest point.
        xyz = clip.sweep("lidar", frame).xyz_world_m
        uv, valid, _ = sensors.project_rolling(camera, images[-1].world_from_camera, xyz)
        seen = valid & sensors.in_image(camera, uv)
        depth = geometry.transform_points(geometry.inverse(images[-1].world_from_camera[0]), xyz[seen])[:, 2]
        pixels = np.stack(np.meshgrid(np.arange(784) + 0.5, np.arange(236) + 0.5), axis=-1)
        depths.append(depth[cKDTree(uv[seen]).query(pixels)[1]])
    chunk, _ = chunk_of(images)
    factors = np.array([1.3, 0.8])
    predicted = (np.stack(depths) / factors[:, None, None]).astype(np.float32)
    fit = fit_depth(clip, chunk, predicted, {2, 5}, "scale")
    assert all(image.points > 3000 for image in fit.images)
    assert np.allclose([image.scale for image in fit.images], factors, rtol=0.005)
    assert fit.error_before > 0.15 and fit.error_after < 0.02
