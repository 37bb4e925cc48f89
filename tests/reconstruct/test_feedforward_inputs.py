import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from feedforward_clip import FORWARD, START_US, MadeClip, clip_of, frame_times, looking, pinhole
from tiny_clip import rig as tiny_rig

from nurec_sim import geometry, logs, sensors
from nurec_sim.errors import ReconstructError
from nurec_sim.network.profiles import PROFILES
from nurec_sim.reconstruct.feedforward.inputs import window as inputs
from nurec_sim.reconstruct.feedforward.inputs.crop import crop_camera, crop_exposure, crop_image, input_size, plan_crop
from nurec_sim.reconstruct.feedforward.inputs.frames import choose_cameras, chunk_windows
from nurec_sim.reconstruct.feedforward.inputs.rays import camera_rays, pinhole_field_rad, scene_rays
from nurec_sim.reconstruct.feedforward.inputs.window import chunk_inputs
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings
from nurec_sim.types import CameraModel, Fisheye, FTheta, FThetaReference, Pinhole, Shutter

FRONT, MULTIVIEW, TINY = PROFILES["pa-front"], PROFILES["pa-multiview"], PROFILES["tiny"]
SMALL = dataclasses.replace(MULTIVIEW, width_px=84, height_px=42)
GLASS = tiny_rig().cameras["wide"].windshield
LENSES = {
    "pinhole": Pinhole(90.0, 93.0, 100.0, 59.0, (-0.1, 0.01, 0, 0, 0, 0), (0.001, 0.002), (0.001, 0, 0, 0)),
    "fisheye": Fisheye(80.0, 78.0, 97.0, 56.0, (0.01, -0.002, 0, 0), 1.4),
    "ftheta": FTheta(95.0, 61.0, FThetaReference.PIXELDIST_TO_ANGLE, (0, 0.012, 2e-6), (), 1.4, (1.01, 0.004, 0.003)),
    "ftheta-forward": FTheta(97.0, 58.0, FThetaReference.ANGLE_TO_PIXELDIST, (), (0.0, 82.0, 1.5), 1.5),
}  # fmt: skip
SIZES = {"cut above and below": (192, 116), "cut left and right": (260, 116)}


def camera_with(lens: str, shutter: Shutter, size: str, glass: bool = False) -> CameraModel:
    width, height = SIZES[size]
    return CameraModel("cam", width, height, LENSES[lens], looking(5), shutter, GLASS if glass else None)


def made_chunk(clip: MadeClip, profile=SMALL, **changes):
    settings = FeedForwardSettings(**changes)
    (window,) = chunk_windows(clip, list(clip.cameras), profile, settings)
    return chunk_inputs(clip, profile, window, settings, {})


# ------------------------------------------------------------------------------------------------ resizing, cropping


@pytest.mark.parametrize(
    ("profile", "resized", "offset", "size"),
    [(FRONT, (796, 448), (6, 0), (784, 448)), (MULTIVIEW, (504, 284), (0, 2), (504, 280))],
)
def test_crop_of_full_hd_as_the_release(profile, resized, offset, size):
    camera = pinhole("a", width=1920, height=1080)
    crop = plan_crop(profile, camera, input_size(profile, camera))
    assert (crop.resized, crop.offset, crop.size, crop.align_corners) == (resized, offset, size, True)


@pytest.mark.parametrize("width, height", [(1242, 375), (1936, 1216), (1600, 900), (448, 256), (100, 1000), (4000, 90)])
def test_sizes_that_keep_the_aspect(width, height):
    camera = pinhole("a", width=width, height=height)
    size = input_size(TINY, camera)
    assert size[0] % 14 == 0 and size[1] % 14 == 0 and min(size) >= 28
    if 0.3 < width / height < 4:
        assert abs(size[0] * size[1] / (TINY.width_px * TINY.height_px) - 1) < 0.1
        assert abs(size[0] / size[1] / (width / height) - 1) < 0.1
    crop = plan_crop(TINY, camera, size)
    assert crop.resized[0] >= size[0] and crop.resized[1] >= size[1] and min(crop.offset) >= 0
    assert crop.resized[0] == size[0] or crop.resized[1] == size[1]


def test_own_profiles_stretch_a_little_rather_than_cut_away():
    camera = pinhole("a", width=480, height=320)
    crop = plan_crop(TINY, camera, (308, 210))
    assert (crop.resized, crop.offset, crop.size) == ((308, 210), (0, 0), (308, 210))
    cropped = crop_camera(camera, crop)
    corners = np.array([[0.0, 0.0], [308.0, 210.0]])
    whole = np.array([[0.0, 0.0], [480.0, 320.0]])
    assert np.allclose(sensors.unproject(cropped, corners)[0], sensors.unproject(camera, whole)[0], atol=1e-9)
    # A camera of quite another aspect is cut.
    wide = plan_crop(TINY, pinhole("b", width=640, height=320), (308, 210))
    assert wide.resized == (420, 210) and wide.offset == (56, 0) and wide.size == (308, 210)


def given_fields(tensors):
    """Fields that are there: matches are found later, by the network."""
    return [field for field in dataclasses.fields(tensors) if getattr(tensors, field.name) is not None]


def test_images_may_be_smaller_or_larger_where_the_profile_keeps_the_aspect():
    camera = pinhole("a", width=480, height=320)
    for pixels in (5_000, 16_464, 200_000):
        size = input_size(TINY, camera, pixels)
        assert abs(size[0] * size[1] / pixels - 1) < 0.2 and abs(size[0] / size[1] / 1.5 - 1) < 0.2
    with pytest.raises(ReconstructError, match="'pa-front' always have 784 x 448 px; image_pixels must not be given"):
        input_size(FRONT, camera, 16_464)
    with pytest.raises(ReconstructError, match=r"image_pixels must lie in 784\.\.4e\+06, got 10"):
        FeedForwardSettings(image_pixels=10)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("glass", [False, True])
def test_cropped_camera_maps_pixels_by_scale_and_offset(lens, glass):
    camera = camera_with(lens, Shutter.GLOBAL, "cut left and right", glass)
    crop = plan_crop(SMALL, camera, (84, 42))
    rng = np.random.default_rng(1)
    points = rng.uniform((-0.8, -0.5, 1), (0.8, 0.5, 1), (500, 3))
    before, seen = sensors.project(camera, points)
    after, still_seen = sensors.project(crop_camera(camera, crop), points)
    np.testing.assert_array_equal(seen, still_seen)
    assert seen.sum() > 400
    scale = np.array(crop.resized) / (camera.width_px, camera.height_px)
    np.testing.assert_allclose(after[seen], before[seen] * scale - crop.offset, atol=1e-9)


@pytest.mark.parametrize("profile", [TINY, MULTIVIEW], ids=["ours", "release"])
def test_where_pixels_of_the_resized_image_come_from(profile):
    """Ours samples where the intrinsics say, the release's pair of flags up to 0.6 pixels to the side."""
    camera = pinhole("a", width=1920, height=1080)
    crop = plan_crop(profile, camera, input_size(profile, camera))
    ramp = np.zeros((1080, 1920, 3), np.uint8)
    ramp[..., 0] = np.arange(1920) // 8
    ramp[..., 1] = np.arange(1080)[:, None] // 8
    pixels = crop_image(ramp, crop).numpy() * 255 * 8 + 4  # the corner-origin pixel of the original
    inner = slice(20, -20)
    u = (np.arange(crop.size[0]) + 0.5 + crop.offset[0]) * 1920 / crop.resized[0]
    off = (pixels[100, inner, 0] - u[inner]) * crop.resized[0] / 1920
    if profile is TINY:
        assert abs(off.mean()) < 0.02 and abs(off[-100:].mean()) < 0.05
    else:
        expected = u[inner] * (1 / (1920 / 1919 * (1 - 1 / crop.resized[0])) - 1) * crop.resized[0] / 1920
        np.testing.assert_allclose(off, expected, atol=0.3)
        assert abs((off - expected).mean()) < 0.02 and 0.5 < expected[-1] < 1


def test_one_colour_stays_that_colour():
    image = np.full((90, 130, 3), (255, 51, 0), np.uint8)
    crop = plan_crop(SMALL, pinhole("a", width=130, height=90), (84, 42))
    result = crop_image(image, crop)
    assert result.shape == (42, 84, 3) and result.max() <= 1
    torch.testing.assert_close(result, torch.tensor([1.0, 0.2, 0.0]).expand(42, 84, 3))


# -------------------------------------------------------------------------------------------------------------- rays


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("shutter", Shutter)
@pytest.mark.parametrize("size", SIZES)
def test_points_on_the_rays_project_back_to_pixel_centres(lens, shutter, size):
    camera = camera_with(lens, shutter, size, glass=lens == "ftheta")
    chunk = made_chunk(clip_of(camera, times=frame_times(2, 400_000, exposure_us=40_000)))
    distance = np.linspace(3, 60, 42 * 84).reshape(42, 84, 1)
    centres = np.stack(np.meshgrid(np.arange(84) + 0.5, np.arange(42) + 0.5), axis=-1)
    for image, rays, ego in zip(chunk.images, chunk.tensors.rays[0].double().numpy(), chunk.ego, strict=True):
        points = geometry.transform_points(chunk.world_from_scene, rays[..., :3] + distance * rays[..., 3:])
        shown = ~ego
        uv, valid, _ = sensors.project_rolling(image.camera, image.world_from_camera, points[shown])
        assert valid.all() and shown.mean() > 0.8
        np.testing.assert_allclose(uv, centres[shown], atol=2e-4)


@pytest.mark.parametrize("shutter", [s for s in Shutter if s is not Shutter.GLOBAL])
@pytest.mark.parametrize("size", SIZES)
def test_a_crop_keeps_the_instant_of_every_line(shutter, size):
    """Lines of the cropped image have the times and poses that they had in the whole resized image."""
    camera = camera_with("pinhole", shutter, size)
    clip = clip_of(camera, times=frame_times(3, 100_000, exposure_us=50_000))
    crop = plan_crop(SMALL, camera, (84, 42))
    assert crop.offset != (0, 0)
    whole_t, whole_poses = tuple(int(t) for t in clip.times["cam"][1]), clip.world_from_camera("cam", 1)
    t_us, poses = crop_exposure(camera, crop, whole_t, whole_poses)
    cropped, whole = crop_camera(camera, crop), sensors.scaled_camera(camera, *crop.resized)
    pixels = np.stack(np.meshgrid(np.arange(84) + 0.5, np.arange(42) + 0.5), axis=-1).reshape(-1, 2)
    part, full = sensors.shutter_fraction(cropped, pixels), sensors.shutter_fraction(whole, pixels + crop.offset)
    np.testing.assert_allclose(t_us[0] + part * (t_us[1] - t_us[0]) - whole_t[0], full * 50_000, atol=1)
    expected = geometry.interpolate_pose_pair(whole_poses, full)
    np.testing.assert_allclose(geometry.interpolate_pose_pair(poses, part), expected, atol=1e-8)


def test_rays_and_field_of_view_are_those_of_the_reference_case():
    """Numbers of an input of the reference network: 84 x 56 pixels, 100 degrees."""
    focal = 42 / np.tan(np.radians(50))
    camera = CameraModel("a", 84, 56, Pinhole(focal, focal, 42, 28), FORWARD, Shutter.TOP_TO_BOTTOM)
    rays, usable = camera_rays(camera)
    result = scene_rays(camera, rays, np.stack([np.eye(4)] * 2))
    assert usable.all()
    np.testing.assert_allclose(result[0, 0], (0, 0, 0, -0.68037254, -0.45084926, 0.57777864), atol=1e-7)
    np.testing.assert_allclose(result[28, 83, 3:], (0.7622045, 0.00918319, 0.64727116), atol=1e-7)
    np.testing.assert_allclose(pinhole_field_rad(camera), (1.7453292608, 1.3427594900), atol=1e-6)


def test_field_of_a_decentred_camera_and_of_one_wider_than_a_pinhole():
    camera = CameraModel("a", 100, 60, Pinhole(50, 50, 40, 30), FORWARD)
    half = np.arctan(40 / 50)
    expected = (2 * half, 2 * np.arctan(30 / (50 / np.tan(half))))
    np.testing.assert_allclose(pinhole_field_rad(camera), expected)
    wide = CameraModel("b", 100, 60, Fisheye(28, 28, 50, 30, max_angle_rad=1.7), FORWARD)
    field = pinhole_field_rad(wide)
    assert np.radians(150) < field[0] < np.pi and field[1] < field[0]


def test_pixels_that_the_lens_does_not_reach_are_finite_and_marked():
    cameras = [
        CameraModel("round", 200, 120, Fisheye(60, 60, 100, 60, max_angle_rad=0.9), FORWARD),
        CameraModel("over", 200, 120, Fisheye(50, 50, 100, 60, max_angle_rad=2.2), looking(70)),
        CameraModel("glass", 200, 120, LENSES["ftheta"], looking(-70), windshield=GLASS),
    ]
    chunk = made_chunk(clip_of(*cameras, times=frame_times(2, 400_000)))
    for field in given_fields(chunk.tensors):
        assert torch.isfinite(getattr(chunk.tensors, field.name)).all(), field.name
    directions = chunk.tensors.rays[0, ..., 3:]
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(6, 42, 84))
    assert chunk.tensors.distance_to_depth_scale.min() >= 0.05
    rows, columns = np.indices((42, 84))
    radius = np.hypot((columns + 0.5 - 42) / (60 * 84 / 200), (rows + 0.5 - 21) / (60 * 50 / 120))
    np.testing.assert_array_equal(chunk.ego[0], radius > 0.9)
    assert chunk.ego[2].any() and not chunk.ego[2].all()


def test_a_lens_that_looks_nowhere_is_refused():
    camera = CameraModel("up", 96, 54, Fisheye(60, 60, -400, 27, max_angle_rad=0.5), FORWARD)
    with pytest.raises(ReconstructError, match="'up': its lens sees nothing"):
        made_chunk(clip_of(camera, times=frame_times(1, 1)))


# ------------------------------------------------------------------------------------------------------------ chunks


def surround(times) -> MadeClip:
    cameras = [pinhole("f"), pinhole("l", looking(60), 108, 60), pinhole("r", looking(-60), 120, 54)]
    rolling = dataclasses.replace(cameras[0], shutter=Shutter.TOP_TO_BOTTOM)
    return clip_of(rolling, *cameras[1:], times=times)


def test_images_are_camera_major_in_the_scene_of_the_first():
    clip = surround(frame_times(5, 400_000, exposure_us=30_000))
    chunk = made_chunk(clip)
    tensors = chunk.tensors
    assert chunk.camera_ids == ("f", "l", "r")
    assert [(i.camera.id, i.frame) for i in chunk.images] == [(c, f) for c in "flr" for f in range(5)]
    assert tensors.camera_idxs.tolist() == [[0] * 5 + [1] * 5 + [2] * 5]
    assert tensors.rgb.shape == (1, 15, 42, 84, 3) and chunk.ego.shape == (15, 42, 84) and not chunk.ego.any()
    np.testing.assert_array_equal(chunk.world_from_scene, clip.world_from_camera("f", 0)[1])
    torch.testing.assert_close(tensors.c2w[0, 0], torch.eye(4))
    end = geometry.inverse(chunk.world_from_scene) @ clip.world_from_camera("l", 3)[1]
    np.testing.assert_allclose(tensors.c2w[0, 8, :3, 3], 0.15 * end[:3, 3], atol=1e-6)
    np.testing.assert_allclose(tensors.c2w[0, 8, :3, :3], end[:3, :3], atol=1e-6)
    for number, image in enumerate(chunk.images):
        crop = plan_crop(SMALL, clip.cameras[image.camera.id], (84, 42))
        torch.testing.assert_close(tensors.rgb[0, number], crop_image(clip.image(image.camera.id, image.frame), crop))
        axis = sensors.pixel_rays(image.camera)[0]
        np.testing.assert_allclose(tensors.distance_to_depth_scale[0, number, ..., 0], axis[..., 2], atol=1e-6)


def test_times_are_those_of_the_reference_case():
    """Three frames 0.5 s apart, exposed for 30 ms over 56 rows: source 15 272 us into a span of 1.03 s."""
    camera = dataclasses.replace(pinhole("a", width=84, height=56), shutter=Shutter.TOP_TO_BOTTOM)
    profile = dataclasses.replace(FRONT, width_px=84, height_px=56)
    chunk = made_chunk(clip_of(camera, times=frame_times(3, 500_000, exposure_us=30_000)), profile)
    source = 15_272 + 500_000 * np.arange(3)
    assert chunk.span_us == (START_US, START_US + 1_030_000)
    assert [image.centre_t_us - START_US for image in chunk.images] == source.tolist()
    targets = [(t - 500_000 + START_US, t + 500_000 + START_US) for t in source.tolist()]
    assert [image.target_t_us for image in chunk.images] == targets
    np.testing.assert_allclose(chunk.tensors.time[0], source / 1.03e6, rtol=1e-6)
    np.testing.assert_allclose(chunk.tensors.time_before[0], (source - 5e5) / 1.03e6, atol=1e-7)
    np.testing.assert_allclose(chunk.tensors.time_after[0], (source + 5e5) / 1.03e6, rtol=1e-6)


def test_targets_at_the_ends_of_a_chunk_and_of_a_lone_frame():
    times = np.array([[0, 0], [400_000, 400_000], [900_000, 900_000]]) + START_US
    chunk = made_chunk(clip_of(pinhole("a"), times=times))
    gaps = [(i.target_t_us[0] - i.centre_t_us, i.target_t_us[1] - i.centre_t_us) for i in chunk.images]
    assert gaps == [(-400_000, 400_000), (-400_000, 500_000), (-500_000, 500_000)]
    lone = made_chunk(clip_of(pinhole("a"), times=frame_times(1, 1)))
    assert lone.images[0].target_t_us == (START_US - 500_000, START_US + 500_000)
    values = (lone.tensors.time.item(), lone.tensors.time_before.item(), lone.tensors.time_after.item())
    assert values == (0.0, -1.0, 1.0)


def test_epoch_times_give_the_same_bits():
    early, late = (
        made_chunk(surround(frame_times(6, 333_333, first_us=first, exposure_us=31_111)))
        for first in (1_000_000, START_US + 7)
    )
    for field in given_fields(early.tensors):
        assert torch.equal(getattr(early.tensors, field.name), getattr(late.tensors, field.name)), field.name
    shift = START_US + 7 - 1_000_000
    for a, b in zip(early.images, late.images, strict=True):
        assert (b.t_us[0] - a.t_us[0], b.target_t_us[0] - a.target_t_us[0]) == (shift, shift)


def test_any_number_of_threads_gives_the_same_bits(monkeypatch):
    many = made_chunk(surround(frame_times(6, 300_000)))
    monkeypatch.setattr(inputs, "READING_THREADS", 1)
    one = made_chunk(surround(frame_times(6, 300_000)))
    assert torch.equal(one.tensors.rgb, many.tensors.rgb) and torch.equal(one.tensors.rays, many.tensors.rays)


def test_the_demo_log_becomes_two_chunks():
    clip = logs.open_clip(Path(__file__).parents[2] / "scenarios" / "demo_clip.zip")
    cameras = choose_cameras(clip, TINY)
    assert cameras == ("camera_front", "camera_front_left", "camera_front_right")
    first, last = chunk_windows(clip, cameras, TINY, FeedForwardSettings())
    assert len(set(first.frames["camera_front"]) & set(last.frames["camera_front"])) == 4
    few = dataclasses.replace(last, frames={camera: frames[-2:] for camera, frames in last.frames.items()})
    chunk = chunk_inputs(clip, TINY, few, FeedForwardSettings(), {})
    # 28 x 17 patches of 14 pixels in the aspect of the cameras, 640 x 400: sqrt(476 * 1.6) = 27.6 across, 17.2 down.
    assert chunk.tensors.rgb.shape == (1, 6, 17 * 14, 28 * 14, 3) and chunk.index == 1
    # The car drives ahead, a quarter of a second at 5.8 m/s: the second frame lies along z of the first, 0.15 a metre.
    ahead = chunk.tensors.c2w[0, 1, :3, 3]
    assert float(ahead[2]) == pytest.approx(0.15 * 5.8 / 4, abs=0.005) and ahead[:2].abs().max() < 0.2 * ahead[2]


# --------------------------------------------------------------------------------------------------------- ego masks


@pytest.mark.parametrize("kind", ["grey", "colour", "alpha", "16 bit"])
def test_defect_8_masks_of_the_log_are_used(tmp_path, kind):
    """Whatever their size, they end up where the car is in the resized and cropped image."""
    mask = np.zeros((60, 96), np.uint16 if kind == "16 bit" else np.uint8)
    mask[45:, :48] = 200
    if kind == "colour":
        mask = np.stack([0 * mask, 0 * mask, mask], axis=-1)
    elif kind == "alpha":
        mask = np.stack([np.full_like(mask, 90)] * 3 + [mask], axis=-1)
    assert cv2.imwrite(str(tmp_path / "r.png"), mask)
    clip = surround(frame_times(2, 400_000))  # camera r: 120 x 54 to 93 x 42, then 4 columns cut off
    ego = made_chunk(clip, ego_masks=tmp_path).ego
    assert not ego[:4].any()
    expected = np.zeros((42, 84), bool)
    expected[31:, : 47 - 4] = True  # row 31 and column 46 of the resized image are covered in part
    for image in ego[4:]:
        np.testing.assert_array_equal(image, expected)


def test_errors_of_ego_masks(tmp_path):
    clip = surround(frame_times(1, 1))
    with pytest.raises(ReconstructError, match=r"the folder of ego masks .*nowhere does not exist"):
        made_chunk(clip, ego_masks=tmp_path / "nowhere")
    (tmp_path / "x.png").write_bytes(b"")
    with pytest.raises(ReconstructError, match=r"need <camera>.png of \['f', 'l', 'r'\], have \['x'\]"):
        made_chunk(clip, ego_masks=tmp_path)
    (tmp_path / "f.png").write_bytes(b"not a picture")
    with pytest.raises(ReconstructError, match=r"f\.png is not a readable PNG"):
        made_chunk(clip, ego_masks=tmp_path)


# --------------------------------------------------------------------------------------------------------- real logs


@pytest.mark.realdata
@pytest.mark.parametrize("profile", [TINY, FRONT, MULTIVIEW], ids=lambda p: p.name)
@pytest.mark.parametrize(
    "pack, views, frames, count",
    [("kitti_raw_0009", 1, 3, 3), ("kitti_raw_0002", 1, None, 4), ("ddad_6cam", 5, None, 2),
     ("ddad_3cam_static", 3, None, 3), ("nuscenes_6cam_1frame", 5, None, 1)],
)  # fmt: skip
def test_real_logs_become_inputs(realdata, pack, views, frames, count, profile):
    clip = logs.open_clip(realdata / pack)
    cameras = choose_cameras(clip, profile)
    assert len(cameras) == (1 if profile is FRONT else views)
    settings = FeedForwardSettings(frames=frames)
    windows = chunk_windows(clip, cameras, profile, settings)
    chunk = chunk_inputs(clip, profile, windows[-1], settings, {})
    alone = profile is TINY and len(cameras) == 1 and frames is None  # 0.9 s, eight times a second
    assert len(chunk.images) == len(cameras) * (2 * count if alone else count)
    for field in given_fields(chunk.tensors):
        assert torch.isfinite(getattr(chunk.tensors, field.name)).all(), field.name
    assert 0.1 < chunk.tensors.rgb.mean() < 0.9 and chunk.tensors.rgb.std() > 0.1
