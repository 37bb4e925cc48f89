"""One sweep as a file: its pose and time, range noise, points as NPZ and PLY, the picture."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pytest
from render_scenes import START_US, gaussians, scene

from nurec_sim import geometry, sensors
from nurec_sim.errors import RequestError
from nurec_sim.render import CpuRenderer
from nurec_sim.render.images import sweep
from nurec_sim.render.images.sweep import SweepPlace, choose_lidar, sweep_request, with_range_noise
from nurec_sim.types import Rig, Trajectory

SPEED_MPS = 12.0


@pytest.fixture(scope="module")
def drive():
    """A wall 20 m ahead and a post 8 m to the left; the car drives ahead; a VLP-16 1.8 m above it."""
    wall = gaussians([[20.0, 0, 0]], scale=(0.001, 50.0, 50.0), opacity=0.99)
    post = gaussians([[0.6, 8.0, z] for z in np.arange(0, 4, 0.1)], scale=0.05, opacity=0.99)
    lidar = sensors.lidar_model("VLP-16", geometry.pose_from_xyyaw(0.0, 0.0, 0.0, 1.8), id="roof", columns=720)
    poses = np.stack([geometry.pose_from_xyyaw(0.0, 0.0, 0.0), geometry.pose_from_xyyaw(SPEED_MPS, 0.0, 0.0)])
    return dataclasses.replace(
        scene(type(wall).concatenate([wall, post, wall])),
        rig=Rig({}, {"roof": lidar}),
        ego=Trajectory(START_US + np.array([0, 1_000_000]), poses),
        span_us=(START_US, START_US + 1_000_000),
    )


@pytest.fixture(scope="module")
def standing(drive):
    """A sweep of the drive from one pose, and its request."""
    request = sweep_request(drive, choose_lidar(drive), SweepPlace(standing=True))
    return CpuRenderer(drive).render_lidar(request), request


def test_a_sweep_starts_where_and_when_it_is_told(drive):
    lidar = choose_lidar(drive)
    request = sweep_request(drive, lidar, SweepPlace(time_s=0.5, left_m=3.5, ahead_m=1.0, yaw_deg=90.0))
    assert (request.start_us, request.end_us) == (START_US + 500_000, START_US + 600_000)
    np.testing.assert_allclose(request.world_from_sensor[:, :3, 3], [[7.0, 3.5, 1.8], [8.2, 3.5, 1.8]], atol=1e-9)
    np.testing.assert_allclose(request.world_from_sensor[0, :3, 0], [0, 1, 0], atol=1e-9)
    first, last = sweep_request(drive, lidar, SweepPlace(standing=True)).world_from_sensor
    assert np.array_equal(first, last)


def test_a_device_takes_the_place_of_the_rigs_lidar(drive):
    device = choose_lidar(drive, model="PANDAR128", columns=90)
    assert (len(device.elevation_rad), len(device.azimuth_rad)) == (128, 90)
    assert np.array_equal(device.rig_from_lidar, drive.rig.lidars["roof"].rig_from_lidar)
    without = dataclasses.replace(drive, rig=Rig({}, {}))
    assert choose_lidar(without, model="HDL-32").rig_from_lidar[2, 3] == sweep.ROOF_M


@pytest.mark.parametrize(
    ("asked", "text"),
    [
        ({"lidar_id": "side"}, "scene 'test' has no LiDAR 'side'; have ['roof']"),
        ({"model": "HDL-65"}, "no LiDAR table 'HDL-65'; have ['AT128', 'HDL-32', 'HDL-64'"),
        ({"columns": 100}, "--columns changes a device from the tables; name one by --model"),
        ({"model": "VLP-16", "columns": 0}, "needs at least 1 column, got 0"),
    ],
)
def test_unknown_devices_are_refused(drive, asked, text):
    with pytest.raises(RequestError) as error:
        choose_lidar(drive, **asked)
    assert text in str(error.value)


def test_a_scene_without_lidars_needs_a_device(drive):
    with pytest.raises(RequestError, match=r"scene 'test' has no LiDARs; name a device by --model: PANDAR128, AT128"):
        choose_lidar(dataclasses.replace(drive, rig=Rig({}, {})))


@pytest.mark.parametrize("time_s", [-0.1, 0.91, np.nan])
def test_a_sweep_lies_within_the_recording(drive, time_s):
    with pytest.raises(RequestError, match=r"a sweep of 0.1 s can start 0 to 0.9 s after the first recorded pose, got"):
        sweep_request(drive, choose_lidar(drive), SweepPlace(time_s))


def test_range_noise_lies_along_the_beams(standing):
    frame, request = standing
    noisy = with_range_noise(frame, request, 0.05, seed=3)
    error = noisy.range_m - frame.range_m
    assert abs(error.mean()) < 0.005 and error.std() == pytest.approx(0.05, rel=0.1)
    # The sensor stands: points keep their directions, and their distance is the range.
    np.testing.assert_allclose(np.linalg.norm(noisy.xyz_m, axis=1), noisy.range_m, atol=1e-4)
    np.testing.assert_allclose(noisy.xyz_m / noisy.range_m[:, None], frame.xyz_m / frame.range_m[:, None], atol=1e-5)
    assert np.array_equal(with_range_noise(frame, request, 0.05, seed=3).range_m, noisy.range_m)
    assert not np.array_equal(with_range_noise(frame, request, 0.05, seed=4).range_m, noisy.range_m)
    assert with_range_noise(frame, request, 0.0, seed=3) is frame


def test_the_noise_of_a_beam_does_not_depend_on_others(standing):
    frame, request = standing
    half = dataclasses.replace(frame, **{name: getattr(frame, name)[::2] for name in ("xyz_m", "range_m", "intensity",
                                                                                      "beam")})  # fmt: skip
    whole = with_range_noise(frame, request, 0.05, seed=1)
    assert np.array_equal(with_range_noise(half, request, 0.05, seed=1).range_m, whole.range_m[::2])


def test_noise_does_not_leave_the_devices_range(standing):
    frame, request = standing
    near = dataclasses.replace(frame, range_m=np.full_like(frame.range_m, frame.lidar.range_m[0] + 0.01))
    noisy = with_range_noise(near, request, 0.05, seed=1)
    assert 0.4 < len(noisy.beam) / len(frame.beam) < 0.7
    assert noisy.range_m.min() >= frame.lidar.range_m[0]


def test_npz_and_ply_hold_every_return(drive):
    request = sweep_request(drive, choose_lidar(drive), SweepPlace())
    frame = CpuRenderer(drive).render_lidar(request)
    row, column = np.divmod(frame.beam, 720)
    # The first column fires at the start of the sweep, the last one at its end.
    fired = START_US + np.rint(column / 719 * 100_000).astype(np.int64)
    with np.load(io.BytesIO(sweep.npz_bytes(frame, request))) as kept:
        for name in ("xyz_m", "range_m", "intensity", "beam"):
            assert np.array_equal(kept[name], getattr(frame, name))
        assert np.array_equal(kept["t_us"], fired) and kept["world_from_sensor"].shape == (2, 4, 4)
        assert len(kept["elevation_rad"]) == 16 and len(kept["azimuth_rad"]) == 720
    head, body = sweep.ply_bytes(frame, request).split(b"end_header\n")
    assert f"element vertex {len(frame.beam)}\n".encode() in head
    names = [line.split()[1:] for line in head.decode().splitlines() if line.startswith("property")]
    vertex = np.frombuffer(body, [(name, {"float": "<f4", "int": "<i4"}[kind]) for kind, name in names])
    assert np.array_equal(np.stack([vertex[axis] for axis in "xyz"], axis=1), frame.xyz_m)
    assert np.array_equal(vertex["row"], row) and np.array_equal(vertex["column"], column)
    assert np.array_equal(vertex["after_start_us"], fired - START_US)


def test_the_picture_has_ahead_on_top_and_left_on_the_left(standing):
    frame, _ = standing
    image = sweep.sweep_picture(frame)
    assert image.shape[1] == sweep.SIDE_PX and image.dtype == np.uint8
    shown = image[: sweep.SIDE_PX].any(axis=-1) & (image[: sweep.SIDE_PX].max(-1) != image[: sweep.SIDE_PX].min(-1))
    scale, middle = sweep.SIDE_PX / (2 * sweep.REACH_M), sweep.SIDE_PX // 2
    wall_row, post_column = round(middle - 20 * scale), round(middle - 8 * scale)
    assert shown[wall_row - 2 : wall_row + 3, 200:700].sum() > 100  # the wall, 20 m ahead
    assert shown[middle - 12 : middle + 3, post_column - 3 : post_column + 4].any()  # the post, 8 m to the left
    assert not shown[middle + 12 :, :].any()  # nothing behind
    ranges = image[sweep.SIDE_PX + 6 :]
    # A device's first column looks back; shown are beams from the left over ahead to the right.
    assert ranges[:, 440:460].any() and not ranges[:, :20].any()
    assert ranges[:, 205:235].max() > 0
