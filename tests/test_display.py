"""What objects show of themselves in notebooks: images by pixel, tables and drawings by what they say."""

import base64
import dataclasses
import re

import cv2
import numpy as np
import pytest
import tiny_clip
from metrics_worlds import full_rollout, scene
from render_scenes import camera, gaussians

from nurec_sim import display, logs
from nurec_sim.evaluate.comparison import Comparison
from nurec_sim.types import CameraFrame, Event, LidarFrame, Reduce, Series, Trajectory


def decoded(data):
    """RGB of an encoded image."""
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def images_in(html):
    return [decoded(base64.b64decode(code)) for code in re.findall(r"base64,([\w+/=]+)", html)]


def test_a_camera_frame_shows_its_colours():
    rgb = np.zeros((32, 48, 3), np.uint8)
    rgb[:, :24], rgb[:, 24:] = (200, 40, 30), (20, 60, 180)
    shown = decoded(CameraFrame(camera(48, 32), 0, 1, rgb)._repr_jpeg_()).astype(int)
    assert np.abs(shown[:, :16] - rgb[:, :16]).max() < 12 and np.abs(shown[:, -16:] - rgb[:, -16:]).max() < 12


def test_points_from_above_lie_where_they_are_and_high_ones_hide_low_ones():
    # 10 m by 5 m in 420 by 210 pixels: 42 pixels per metre, y up.
    points = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 2.0], [9.0, 4.0, 0.0], [11.0, 1.0, 0.0]])
    rgb = np.array([[1, 1, 1], [255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    picture = display.from_above(points, rgb, [0, 0], [10, 5])
    assert picture.shape == (210, 420, 3)
    assert picture[168, 42].tolist() == [255, 0, 0] and picture[42, 378].tolist() == [0, 255, 0]
    assert (picture != display.BACKGROUND_RGB).any(axis=2).sum() == 2


def test_a_sweep_shows_its_points_forwards_to_the_right():
    # 80 m in 420 pixels: 20 m ahead is 105 pixels right of the middle, 10 m left is 52.5 above it.
    xyz = np.array([[20.0, 10.0, 2.0]], np.float32)
    one = np.ones(1, np.float32)
    frame = LidarFrame(tiny_clip.rig().lidars["top"], 0, 1, xyz, one, one, np.zeros(1, np.int32))
    shown = decoded(frame._repr_png_())
    (row,), (column,) = np.nonzero((shown != display.BACKGROUND_RGB).any(axis=2))
    assert (row, column) == (157, 315)
    red, green, blue = shown[row, column]
    assert red > 100 > blue and green < 50
    assert tiny_clip.sweep(0)._repr_png_()[:4] == b"\x89PNG"


def test_a_scene_shows_the_street_without_what_hangs_over_it():
    ego = Trajectory(np.array([0, 1_000_000]), np.stack([np.eye(4)] * 2))
    # 40 m in 420 pixels: 20 x 20 points cover a square metre of green, and as much red 8 m above it.
    square = np.stack([*np.meshgrid(np.arange(1, 2, 0.05), np.arange(1, 2, 0.05)), np.zeros((20, 20))], -1).reshape(
        -1, 3
    )
    both = np.concatenate([square, square + [0, 0, 8.0]])
    static = gaussians(both, rgb=np.repeat([[0, 1, 0], [1, 0, 0]], 400, axis=0), opacity=0.9)
    html = scene(static, ego)._repr_html_()
    (shown,) = images_in(html)
    green, red = (shown[..., k].astype(int) - shown[..., 1 - k] for k in (1, 0))
    assert green.max() > 150 and red.max() < 60
    assert "800 static" in html


def test_a_clip_shows_its_sensors_and_an_image_of_each_camera(tmp_path):
    clip = logs.open_clip(tiny_clip.write(tmp_path / "tiny"))
    html = clip._repr_html_()
    assert all(f">{name}<" in html for name in ("front", "left", "wide", "top"))
    assert [image.shape for image in images_in(html)] == [(48, 64, 3)] * 3


def test_a_clip_shows_why_an_image_cannot_be_read(tmp_path):
    folder = tiny_clip.write(tmp_path / "tiny")
    clip = logs.open_clip(folder)
    (folder / clip.image_records("left")[0].file).unlink()
    html = clip._repr_html_()
    assert len(images_in(html)) == 2 and clip.image_records("left")[0].file in html


def test_a_rollout_shows_result_events_and_paths():
    rollout = dataclasses.replace(
        full_rollout(), policy="<mine>", events=(Event(full_rollout().states[0].t_us + 1_500_000, "clipped", "a & b"),)
    )
    html = rollout._repr_html_()
    assert "1.5 s: clipped" in html and "a &amp; b" in html and "<mine>" not in html
    assert html.count("<polyline") == 2


def test_a_rollout_that_never_started_shows_its_error():
    html = dataclasses.replace(full_rollout(), states=(), status="failed", error="no camera")._repr_html_()
    assert "failed: no camera" in html


def test_a_series_shows_its_value_and_only_valid_values():
    values, valid = np.array([4.0, 9e9, 6.0, 5.0]), np.array([True, False, True, True])
    series = Series("gap", "m", np.arange(4), values, valid, Reduce.MEAN)
    html = series._repr_html_()
    assert "<td" in html and ">5<" in html and "3 of 4 values valid" in html
    points = re.findall(r'points="([^"]+)"', html)[0].split()
    assert points == ["2.0,38.0", "159.3,2.0", "238.0,20.0"]


def test_nothing_to_draw_is_drawn_as_nothing():
    assert display.paths({"none": (np.zeros((0, 2)), "red")}) == ""
    assert display.spark(np.zeros(0), np.zeros(0)) == ""


@pytest.mark.parametrize(("width", "shown"), [(480, (120, 240)), (100, (50, 100))])
def test_thumbnails_are_small_and_never_larger_than_the_image(width, shown):
    assert display.thumbnail(np.zeros((width // 2, width, 3), np.uint8)).shape[:2] == shown


def test_a_comparison_shows_figures_and_worst_frames():
    figures = {
        name: {
            "image": {}, "lidar": None, "free_space": None, "road": None, "seconds": {},
            "counts": {"static": count, "dynamic": 0},
        }
        for name, count in (("a", 12345), ("b", 54321))
    }  # fmt: skip
    picture = np.zeros((4, 8, 3), np.uint8)
    html = Comparison("log", figures, [("front, frame 3", picture)], b"")._repr_html_()
    assert ">12345<" in html and ">54321<" in html and "front, frame 3" in html and len(images_in(html)) == 1


def test_what_is_printed_is_short():
    """Notebooks keep the printed form beside the picture."""
    rig = tiny_clip.rig()
    frame = CameraFrame(rig.cameras["front"], 5, 9, np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), np.float32))
    assert repr(frame) == "CameraFrame('front', 64x48, 5 to 9 us: rgb, depth_m)"
    one = np.ones(1200, np.float32)
    sweep = LidarFrame(
        rig.lidars["top"], 5, 9, np.ones((1200, 3), np.float32), one, one, np.arange(1200, dtype=np.int32)
    )
    assert repr(sweep) == "LidarFrame('top', 5 to 9 us: 1,200 returns)"
    assert repr(tiny_clip.sweep(0)) == "Sweep(2000000 to 2100000 us, moved to 2100000 us: 1,440 points)"
    series = Series("gap", "m", np.arange(2), np.array([4.0, np.nan]), np.array([True, False]), Reduce.MEAN)
    assert repr(series) == "Series('gap', mean 4 m, 1 of 2 valid)"
    figures = {"a": {}, "b": {}}
    assert repr(Comparison("log", figures, [], b"x" * 200_000)) == "Comparison(a, b on 'log', video of 0.2 MB)"
