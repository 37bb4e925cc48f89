"""Samples of clips known in closed form: depth, normals, labels and motion must agree with every other frame."""

import dataclasses

import numpy as np
import pytest
import torch
import training_clips
from repetition import slow_after

from nurec_sim import geometry, sensors
from nurec_sim.errors import ClipError
from nurec_sim.network.profiles import PROFILES
from nurec_sim.network.tensors import SemanticClass
from nurec_sim.training.data.clips import CachedClip
from nurec_sim.training.data.windows import WindowSettings, sample_window
from nurec_sim.types import FTheta, FThetaReference, Pinhole, Shutter

PROFILE = dataclasses.replace(PROFILES["tiny"], width_px=112, height_px=70)
SETTINGS = WindowSettings(PROFILE, frames={3: 1.0}, spacing_s=(0.2, 0.3), usual_share=0.0, targets=6, augment=None)
WAYS = {
    "plain": training_clips.camera(),
    "rolling": training_clips.camera(shutter=Shutter.TOP_TO_BOTTOM),
    "sideways": training_clips.camera(yaw_deg=-15.0, shutter=Shutter.LEFT_TO_RIGHT),
    "distorted": training_clips.camera(
        lens=Pinhole(80, 80, 57, 33, (-0.12, 0.02, 0, 0, 0, 0), (2e-3, -3e-3), (1e-3, 0, -1e-3, 0))
    ),
    "ftheta": training_clips.camera(
        lens=FTheta(55, 34, FThetaReference.ANGLE_TO_PIXELDIST, angle_to_pixeldist=(0, 78.0, 0, 1.5),
                    linear_cde=(1.0, 0.01, -0.01)), shutter=Shutter.BOTTOM_TO_TOP,
    ),
}  # fmt: skip


@pytest.fixture(scope="module", params=list(WAYS))
def clip(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("clips") / request.param
    return CachedClip(training_clips.write_clip(folder, (WAYS[request.param],)))


def lifted(sample, view):
    """Scene points of a context image [n,3], its pixels that have depth, and the displacement per fraction of time."""
    rays, depth = sample.inputs.rays[0, view].double().numpy(), sample.truth.depth_m[0, view].numpy()
    scale = sample.inputs.distance_to_depth_scale[0, view].double().numpy()
    known = depth > 0
    points = rays[..., :3] + rays[..., 3:] * depth[..., None] / scale
    ahead = float(sample.inputs.time_after[0, view] - sample.inputs.time[0, view])
    speed = sample.truth.motion_m[0, view, :, :, 1].double().numpy() / ahead
    return points[known], known, speed[known]


def seen_by(target, points):
    """Where a target view sees scene points: pixel indices, z-depth, and which lie in its image."""
    uv, valid, fraction = sensors.project_rolling(target.camera, target.scene_from_camera, points)
    poses = geometry.inverse(geometry.interpolate_pose_pair(target.scene_from_camera, fraction))
    z = np.einsum("ni,ni->n", poses[:, 2, :3], points) + poses[:, 2, 3]
    valid &= sensors.in_image(target.camera, np.nan_to_num(uv, nan=-1.0))
    column, row = np.where(valid[:, None], uv, 0).astype(int).T
    return row, column, z, valid


@pytest.mark.parametrize("mirror", [0.0, 1.0])
@pytest.mark.parametrize("seed", slow_after(1, range(3)))
def test_context_points_land_on_the_same_surface_in_every_target(clip, mirror, seed):
    settings = dataclasses.replace(SETTINGS, mirror=mirror)
    moving = 0
    sample = sample_window(np.random.default_rng(seed), clip, settings)
    assert sample.id.startswith(clip.id) and sample.id.endswith("m") == bool(mirror)
    for view in range(3):
        points, known, speed = lifted(sample, view)
        label, colour = sample.truth.semantic[0, view].numpy()[known], sample.inputs.rgb[0, view].numpy()[known]
        # The turning car does not move along a line.
        straight = np.linalg.norm(speed, axis=1) > 1.0
        straight |= label != SemanticClass.MOVABLE
        moving += int((straight & (label == SemanticClass.MOVABLE)).sum())
        for target in sample.targets:
            moved = points + speed * (target.time - float(sample.inputs.time[0, view]))
            row, column, z, valid = seen_by(target, moved)
            valid &= straight & (target.semantic.numpy()[row, column] == label)
            true = target.depth_m.numpy()[row, column]
            # A surface nearer than the point hides it.
            relative = (np.abs(true - z) / z)[valid & (true > 0.9 * z)]
            assert np.median(relative) < 2e-2 and np.quantile(relative, 0.9) < 0.06
            difference = np.abs(target.rgb.numpy()[row, column] - colour).max(axis=1)[valid & (true > 0.9 * z)]
            assert np.median(difference) < 0.05
    assert moving > 100


def test_motion_follows_the_turning_box(clip):
    settings = dataclasses.replace(SETTINGS, mirror=0.0, zoom=1.0)
    sample = sample_window(np.random.default_rng(1), clip, settings)
    turning = 0
    for view in range(3):
        motion = sample.truth.motion_m[0, view].numpy()
        movable = (sample.truth.semantic[0, view] == SemanticClass.MOVABLE).numpy()
        assert (np.abs(motion[~movable]) == 0).all()
        assert sample.truth.motion_known[0, view].numpy()[movable].all()
        assert not sample.truth.motion_known[0, view].numpy()[sample.truth.depth_m[0, view].numpy() == 0].any()
        length = np.linalg.norm(motion, axis=-1)[movable, 1]
        gap_s = float(sample.inputs.time_after[0, view] - sample.inputs.time[0, view]) * span_s(sample)
        # Lines of a rolling shutter are exposed up to 15 ms before or after the image's own time.
        van = np.abs(length - 5.0 * gap_s) < 5.0 * 0.016
        # The car turns at 0.8 rad/s around its centre: no point of it is farther than 2.6 m from there.
        assert (length[~van] < 2 * 2.6 * np.sin(0.8 * (gap_s + 0.016) / 2)).all()
        turning += int((~van).sum())
    assert turning > 30


def span_s(sample):
    """Seconds of the sample's span, from the frames that its name tells."""
    step = int(sample.id.split("+")[1].split("x")[0])
    ahead = float(sample.inputs.time_after[0, 0] - sample.inputs.time[0, 0])
    return step * training_clips.PERIOD_US / 1e6 / ahead


def test_normals_agree_with_depth(clip):
    sample = sample_window(np.random.default_rng(2), clip, dataclasses.replace(SETTINGS, zoom=1.0))
    normal, depth = sample.truth.normal[0, 0].numpy(), sample.truth.depth_m[0, 0].numpy()
    rays = sample.inputs.rays[0, 0].numpy()
    points = rays[..., :3] + rays[..., 3:] * depth[..., None] / sample.inputs.distance_to_depth_scale[0, 0].numpy()
    flat = sample.truth.semantic[0, 0].numpy() == SemanticClass.ROAD
    flat &= np.roll(flat, 1, 1) & (depth < 15)
    flat[:, 0] = False
    step = (points - np.roll(points, 1, axis=1))[flat]
    assert (np.abs((step * normal[flat]).sum(-1)) < 0.15 * np.linalg.norm(step, axis=-1)).all()
    known = depth > 0
    np.testing.assert_allclose(np.linalg.norm(normal[known], axis=-1), 1, atol=1e-4)
    assert ((normal * rays[..., 3:]).sum(-1)[known] < 0).all() and (normal[~known] == 0).all()


def test_labels_map_to_the_networks_classes(clip):
    sample = sample_window(np.random.default_rng(3), clip, SETTINGS)
    semantic, depth = sample.truth.semantic.numpy(), sample.truth.depth_m.numpy()
    assert set(np.unique(semantic)) == {0, SemanticClass.SKY, SemanticClass.ROAD, SemanticClass.MOVABLE}
    assert ((semantic == SemanticClass.SKY) == (depth == 0)).all()


def test_a_sample_has_the_shapes_of_the_profile_and_is_repeatable(tmp_path):
    cameras = [training_clips.camera(f"c{k}", yaw) for k, yaw in enumerate((0, 50, -50))]
    clip = CachedClip(training_clips.write_clip(tmp_path / "three", cameras))
    profile = dataclasses.replace(PROFILES["tiny"], width_px=56, height_px=42)
    settings = WindowSettings(profile, cameras={3: 1.0}, frames={4: 1.0}, most_images=6)
    sample, again = (sample_window(np.random.default_rng(5), clip, settings) for _ in range(2))
    assert sample.inputs.rgb.shape == (1, 6, 42, 56, 3) and sample.inputs.rays.shape == (1, 6, 42, 56, 6)
    assert sample.inputs.camera_idxs.tolist() == [[0, 0, 1, 1, 2, 2]] and len(sample.targets) == 4
    assert torch.equal(sample.inputs.rgb, again.inputs.rgb) and sample.id == again.id
    assert torch.equal(sample.truth.motion_m, again.truth.motion_m)
    for target, other in zip(sample.targets, again.targets, strict=True):
        assert torch.equal(target.rgb, other.rgb) and target.rgb.shape == (42, 56, 3) and target.time >= 0
    tensors = [*vars(sample.inputs).values(), *vars(sample.truth).values()]
    assert all(torch.isfinite(value).all() for value in tensors)


def test_targets_are_held_out_frames_of_the_sampled_cameras(tmp_path):
    clip = CachedClip(training_clips.write_clip(tmp_path / "one"))
    for seed in range(5):
        sample = sample_window(np.random.default_rng(seed), clip, SETTINGS)
        context = sample.inputs.time[0].tolist()
        gap = context[1] - context[0]
        for target in sample.targets:
            assert 0 < target.time < context[-1] + gap and min(abs(target.time - t) for t in context) > 1e-3


@pytest.mark.parametrize(
    "change",
    [
        {"zoom": 0.5},
        {"targets": -1},
        {"cameras": {}},
        {"frames": {0: 1.0}},
        {"most_images": 2},
        {"spacing_s": (0.3, 0.1)},
    ],
)
def test_settings_out_of_range_are_refused(change):
    with pytest.raises(ValueError):
        dataclasses.replace(SETTINGS, **change)


@pytest.mark.parametrize("damage", ["cut", "missing", "shape", "meta", "format", "type"])
def test_a_damaged_clip_is_refused(tmp_path, damage):
    folder = training_clips.write_clip(tmp_path / "clip", frames=2)
    depth = folder / "0_depth.npy"
    if damage == "cut":
        depth.write_bytes(depth.read_bytes()[:-100])
    elif damage == "missing":
        depth.unlink()
    elif damage == "shape":
        np.save(depth, np.zeros((2, 3, 4), np.float16))
    elif damage == "meta":
        (folder / "meta.json").write_text("{")
    elif damage == "format":
        (folder / "meta.json").write_text('{"format": 99}')
    else:
        np.save(depth, np.array([{"a": 1}]), allow_pickle=True)
    with pytest.raises(ClipError):
        CachedClip(folder)


def test_writing_leaves_a_clip_that_is_there_alone(tmp_path):
    folder = training_clips.write_clip(tmp_path / "clip", frames=2)
    before = (folder / "meta.json").stat().st_mtime_ns
    training_clips.write_clip(folder, frames=2)
    assert (folder / "meta.json").stat().st_mtime_ns == before
    assert [path.name for path in tmp_path.iterdir()] == ["clip"]
