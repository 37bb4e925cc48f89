"""Clips seen otherwise (cut, mirrored) and colours seen otherwise: geometry must stay exact, shapes as they were."""

import dataclasses

import numpy as np
import pytest
import torch
import training_clips

from nurec_sim import geometry, sensors
from nurec_sim.network.profiles import PROFILES
from nurec_sim.training.data.augment import AugmentSettings, augmented
from nurec_sim.training.data.clips import CachedClip
from nurec_sim.training.data.reframe import Cut, ReframedClip, mirrored_camera
from nurec_sim.training.data.windows import WindowSettings, sample_window
from nurec_sim.types import (
    Fisheye,
    FTheta,
    FThetaReference,
    Pinhole,
    Shutter,
    Windshield,
    WindshieldReference,
)

LENSES = {
    "pinhole": Pinhole(80, 82, 50, 33, (-0.1, 0.02, 0.01, 0.0, 0.0, 0.0), (2e-3, -4e-3), (3e-3, 1e-3, -2e-3, 1e-3)),
    "fisheye": Fisheye(70, 72, 60, 31, (0.02, -0.01, 0.0, 0.0)),
    "ftheta": FTheta(50, 31, FThetaReference.ANGLE_TO_PIXELDIST, angle_to_pixeldist=(0, 70.0, 0, 2.0),
                     linear_cde=(1.01, 0.02, -0.03)),
}  # fmt: skip
MIRROR = np.array([1.0, -1.0, 1.0])


@pytest.mark.parametrize("lens", list(LENSES))
def test_a_mirrored_camera_sees_the_mirrored_world_in_mirrored_pixels(lens):
    camera = training_clips.camera(yaw_deg=30.0, lens=LENSES[lens])
    mirrored = mirrored_camera(camera)
    ahead = np.random.default_rng(0).uniform([-0.6, -0.4, 1.0], [0.6, 0.4, 1.0], (200, 3)) * 7.0
    points = geometry.transform_points(camera.rig_from_camera, ahead)
    uv, valid = sensors.project(camera, ahead)
    assert geometry.is_rotation(mirrored.rig_from_camera[:3, :3], 1e-9)
    there = geometry.transform_points(geometry.inverse(mirrored.rig_from_camera), points * MIRROR)
    uv_mirrored, valid_mirrored = sensors.project(mirrored, there)
    assert valid.all() and valid_mirrored.all()
    np.testing.assert_allclose(uv_mirrored, [camera.width_px, 0] + uv * [-1, 1], atol=1e-6)


def test_mirroring_swaps_sideways_shutters_and_refuses_windshields():
    camera = training_clips.camera(shutter=Shutter.LEFT_TO_RIGHT)
    assert mirrored_camera(camera).shutter is Shutter.RIGHT_TO_LEFT
    glass = Windshield(WindshieldReference.FORWARD, (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="windshield"):
        mirrored_camera(dataclasses.replace(camera, windshield=glass))


@pytest.mark.parametrize("shutter", [Shutter.GLOBAL, Shutter.TOP_TO_BOTTOM, Shutter.RIGHT_TO_LEFT])
@pytest.mark.parametrize("mirrored", [False, True])
def test_pixels_of_a_reframed_clip_look_where_they_looked(tmp_path, shutter, mirrored):
    camera = training_clips.camera(shutter=shutter)
    clip = CachedClip(training_clips.write_clip(tmp_path / "clip", (camera,), frames=2))
    cut = Cut(20, 9, 70, 48)
    seen = ReframedClip(clip, {camera.id: cut}, mirrored)
    rays, times = world_rays(clip, camera.id)
    part_rays, part_times = world_rays(seen, camera.id)
    window = np.s_[cut.y_px : cut.y_px + cut.height_px, cut.x_px : cut.x_px + cut.width_px]
    wanted, wanted_times, wanted_rgb = rays[window], times[window], clip.image(camera.id, 1)[window]
    wanted_normal = clip.truth(camera.id, 1).normal[window]
    if mirrored:
        wanted, wanted_times, wanted_rgb = (
            wanted[:, ::-1] * np.tile(MIRROR, 2),
            wanted_times[:, ::-1],
            wanted_rgb[:, ::-1],
        )
        wanted_normal = wanted_normal[:, ::-1] * [-1, 1, 1]
    np.testing.assert_allclose(part_rays, wanted, atol=2e-6)
    assert np.abs(part_times - wanted_times).max() <= 1
    assert np.array_equal(seen.image(camera.id, 1), wanted_rgb)
    np.testing.assert_allclose(seen.truth(camera.id, 1).normal, wanted_normal)
    assert seen.truth(camera.id, 1).depth_m.shape == (cut.height_px, cut.width_px)


def world_rays(clip, camera_id):
    """Origin and direction of every pixel of frame 1 in the world [h,w,6], and when it was exposed."""
    camera = clip.rig.cameras[camera_id]
    rays, _ = sensors.pixel_rays(camera)
    v, u = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
    fraction = sensors.shutter_fraction(camera, np.stack([u, v], axis=-1).reshape(-1, 2))
    poses = geometry.interpolate_pose_pair(clip.world_from_camera(camera_id, 1), fraction)
    direction = np.einsum("nij,nj->ni", poses[:, :3, :3], rays.reshape(-1, 3))
    start_us, end_us = clip.camera_times_us(camera_id)[1]
    return (np.concatenate([poses[:, :3, 3], direction], axis=1).reshape(*rays.shape[:2], 6),
            (start_us + fraction * (end_us - start_us)).reshape(rays.shape[:2]))  # fmt: skip


def test_mirrored_tracks_and_rig_stay_together(tmp_path):
    clip = CachedClip(training_clips.write_clip(tmp_path / "clip", frames=2))
    seen = ReframedClip(clip, {}, mirrored=True)
    for track, other in zip(clip.tracks, seen.tracks, strict=True):
        at, there = track.path.at(2_050_000), other.path.at(2_050_000)
        corner = np.array([2.0, 0.7, 0.5])
        world = geometry.transform_points(at, corner)
        np.testing.assert_allclose(geometry.transform_points(there, corner * MIRROR), world * MIRROR, atol=1e-9)
    camera = next(iter(seen.rig.cameras.values()))
    for index in range(2):
        t_us = int(seen.camera_times_us(camera.id)[index, 0])
        pose = seen.ego.at(t_us) @ camera.rig_from_camera
        np.testing.assert_allclose(pose, seen.world_from_camera(camera.id, index)[0], atol=1e-9)


def test_cuts_outside_of_the_image_are_refused(tmp_path):
    clip = CachedClip(training_clips.write_clip(tmp_path / "clip", frames=2))
    with pytest.raises(ValueError, match="reaches out"):
        ReframedClip(clip, {"camera_front": Cut(80, 0, 40, 40)})


# ------------------------------------------------------------------------------------------------------------ colours


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    cameras = [training_clips.camera(f"c{k}", yaw, (70, 42)) for k, yaw in enumerate((0, 50, -50))]
    clip = CachedClip(training_clips.write_clip(tmp_path_factory.mktemp("clips") / "three", cameras))
    profile = dataclasses.replace(PROFILES["tiny"], width_px=70, height_px=42)
    settings = WindowSettings(profile, cameras={3: 1.0}, frames={2: 1.0}, augment=None, targets=12)
    return sample_window(np.random.default_rng(0), clip, settings)


def test_augmented_samples_keep_shapes_and_geometry(sample):
    settings = AugmentSettings(clean=0.0, blurred=1.0, noisy=1.0, jpeg=1.0)
    changed = augmented(np.random.default_rng(1), sample, settings)
    again = augmented(np.random.default_rng(1), sample, settings)
    assert changed.truth is sample.truth and changed.inputs.rays is sample.inputs.rays
    for rgb, before, repeated in [
        (changed.inputs.rgb, sample.inputs.rgb, again.inputs.rgb),
        *((t.rgb, b.rgb, r.rgb) for t, b, r in zip(changed.targets, sample.targets, again.targets, strict=True)),
    ]:
        assert rgb.shape == before.shape and rgb.dtype == torch.float32 and torch.equal(rgb, repeated)
        assert rgb.min() >= 0 and rgb.max() <= 1 and not torch.equal(rgb, before)
    for target, before in zip(changed.targets, sample.targets, strict=True):
        assert target.camera is before.camera and target.time == before.time


def test_clean_samples_stay_as_they_are(sample):
    assert augmented(np.random.default_rng(0), sample, AugmentSettings(clean=1.0)) is sample


def test_targets_share_the_response_of_their_camera(sample):
    quiet = AugmentSettings(clean=0.0, noisy=0.0, jpeg=0.0, blurred=0.0, vignette=0.0, gamma=0.0)
    changed = augmented(np.random.default_rng(2), sample, quiet)
    maps = []
    for camera in range(3):
        views = (sample.inputs.camera_idxs[0] == camera).tolist()
        before = [sample.inputs.rgb[0, k] for k, mine in enumerate(views) if mine]
        after = [changed.inputs.rgb[0, k] for k, mine in enumerate(views) if mine]
        before += [t.rgb for t in sample.targets if t.camera_idx == camera]
        after += [t.rgb for t in changed.targets if t.camera_idx == camera]
        a, b = (torch.cat([image.reshape(-1, 3) for image in images]).double() for images in (before, after))
        free = (b > 0.01).all(1) & (b < 0.99).all(1)
        solution = torch.linalg.lstsq(a[free], b[free]).solution
        # One matrix explains all images of a camera, context and targets alike.
        assert (a[free] @ solution - b[free]).abs().max() < 1e-5
        maps.append(solution)
    assert (maps[0] - maps[1]).abs().max() > 1e-3
