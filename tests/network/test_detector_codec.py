"""Objects to maps and back, what is visible, and cameras that are not the detector's, by hand."""

import dataclasses

import numpy as np
import pytest

from nurec_sim import geometry
from nurec_sim.lenses import Fisheye
from nurec_sim.network.detector.codec import NUMBERS, decode, encode, look
from nurec_sim.network.detector.objects import FOCAL_PX, Labelled, focal_px, labelled_objects, outlines
from nurec_sim.types import CameraModel, Pinhole, Track, Trajectory

LENS = Pinhole(400.0, 400.0, 160.0, 96.0)
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def car(x, y, z, heading=0.0, kind=0, shown=1e4, size=(4.7, 1.86, 1.62)):
    one = np.ones(1)
    return Labelled(np.array([kind]), np.array([[x, y, z]], float), np.array([size]), heading * one, 1e4 * one,
                    shown * one, one.astype(bool), 400.0)  # fmt: skip


def test_a_cell_of_the_maps_is_a_box():
    heat, numbers = np.zeros((2, 48, 80), np.float32), np.zeros((NUMBERS, 48, 80), np.float32)
    heat[0, 30, 50] = 0.8
    # Cell (30, 50) has its middle at pixel (202, 122); half a cell to the right and a quarter up is (204, 121).
    numbers[:, 30, 50] = [0.5, -0.25, np.log(1.5), np.log(0.05), np.log(2), 0, 0, np.sin(0.3), np.cos(0.3)]
    found = decode(heat, numbers, LENS)
    assert len(found) == 1 and found.kind[0] == 0
    # Depth 20 * 1.5 = 30; x = 30 * (204 - 160) / 400 = 3.3, y = 30 * (121 - 96) / 400 = 1.875.
    np.testing.assert_allclose(found.centre_m[0], [3.3, 1.875, 30.0], rtol=1e-6)
    np.testing.assert_allclose(found.size_m[0], [9.4, 1.86, 1.62], rtol=1e-6)
    np.testing.assert_allclose(found.heading_rad[0], 0.3 + np.arctan(0.11), rtol=1e-6)
    # The depth's error is 5 % of 30 m: within 2 m with the probability 1 - exp(-2 / 1.5).
    np.testing.assert_allclose(found.score[0], 0.8 * (1 - np.exp(-2 / 1.5)), rtol=1e-6)


def test_of_two_detections_at_one_place_the_surer_one_stays():
    heat, numbers = np.zeros((2, 48, 80), np.float32), np.zeros((NUMBERS, 48, 80), np.float32)
    numbers[3] = -3
    heat[0, 30, 50], heat[0, 30, 54], heat[0, 30, 70], heat[1, 30, 50] = 0.9, 0.8, 0.7, 0.6
    found = decode(heat, numbers, LENS)
    # At 20 m four cells of four pixels are 0.8 m, 20 cells are 4 m; people do not suppress vehicles.
    assert found.kind.tolist() == [0, 0, 1] and np.all(np.diff(found.score) < 0)
    np.testing.assert_allclose(found.centre_m[1, 0] - found.centre_m[0, 0], 4.0, rtol=1e-5)
    assert len(found.above(np.array([found.score[0], 1.0]))) == 1


def test_what_is_encoded_is_decoded():
    objects = car(-4.0, 1.2, 25.0, heading=2.0)
    targets = encode(objects, LENS, 320, 192)
    found = decode(targets.heat * (targets.heat >= 1), targets.numbers, LENS)
    assert targets.heat.max() == 1 and targets.known.sum() > 1 and targets.weight.all()
    for name in ("kind", "centre_m", "size_m", "heading_rad"):
        np.testing.assert_allclose(getattr(found, name), getattr(objects, name), rtol=1e-5)


def test_what_is_not_visible_is_neither_an_object_nor_background():
    targets = encode(car(-4.0, 1.2, 25.0, shown=10.0), LENS, 320, 192)
    # u = 160 - 64 = 96, v = 96 + 19.2: cell (28, 24).
    assert targets.heat.max() == 0 and not targets.known.any()
    assert targets.weight[0, 28, 24] == 0 and targets.weight[0, 10, 70] == 1 and targets.weight[1].all()


def test_visible_by_centre_share_and_pixels():
    assert car(0, 1, 20, shown=2500.0).visible[0] and not car(0, 1, 20, shown=2499.0).visible[0]
    assert car(0, 1, 20, kind=1, shown=1200.0).visible[0]  # a person fills less of its box
    outside = dataclasses.replace(car(0, 1, 20), inside=np.zeros(1, bool))
    behind = dataclasses.replace(car(0, 1, 20), outline_px=np.full(1, np.nan))
    small = dataclasses.replace(car(0, 1, 20, shown=16.0), outline_px=np.full(1, 20.0))  # 16 pixels of focal length 400
    assert not outside.visible[0] and not behind.visible[0] and not small.visible[0]


def track(name, x, y, z, size):
    pose = geometry.pose(np.eye(3), np.array([x, y, z], float))
    return Track(name, "automobile", size, Trajectory(np.array([0, 10]), np.stack([pose, pose])))


def test_boxes_seen_by_a_camera_that_is_turned():
    """A camera turned left by 90 degrees: what is to the left of the car is straight ahead of it."""
    turn = geometry.rotation_from_yaw(np.pi / 2) @ FORWARD
    camera = CameraModel("c", 320, 192, LENS, geometry.pose(turn, np.array([0.0, 0, 1.5])))
    # 20 m to the left and 1 m ahead of the car, 0.8 m high: 1 m to the right, 0.7 m down; it drives to the right.
    tracks = [track("a", 1, 20, 0.8, (4.0, 2.0, 1.6)), track("hidden", 1, 40, 0.8, (4.0, 2.0, 1.6)),
              track("behind", 1, -20, 0.8, (4.0, 2.0, 1.6))]  # fmt: skip
    found = labelled_objects(tracks, 5, camera, camera.rig_from_camera)
    np.testing.assert_allclose(found.centre_m, [[1, 0.7, 20], [1, 0.7, 40]], atol=1e-9)
    np.testing.assert_allclose(found.heading_rad, np.pi / 2, atol=1e-9)
    # The near side of the box, 19 m away, spans u from 160 + 400 * (-1) / 19 to 160 + 400 * 3 / 19 and so on.
    near = outlines(camera, found)[0]
    assert near[:, 0].min() == pytest.approx(160 - 400 / 19) and near[:, 0].max() == pytest.approx(160 + 1200 / 19)
    assert near[:, 1].max() == pytest.approx(96 + 400 * 1.5 / 19)
    # Sides of 4 m by 1.6 m: the farther box is hidden but for what its own half height leaves above the near one.
    assert found.visible.tolist() == [True, False]
    assert found.shown_px[0] == pytest.approx(found.outline_px[0], rel=0.06)


def test_images_are_looked_at_with_one_focal_length():
    rgb = np.zeros((300, 900, 3), np.uint8)
    rgb[140:160, 440:460] = 255
    camera = CameraModel("c", 900, 300, Pinhole(2 * FOCAL_PX, 2 * FOCAL_PX, 450.0, 150.0), np.eye(4))
    seen = look(rgb, camera)
    assert seen.inner_px == (450, 150) and seen.rgb.shape == (160, 480, 3)
    np.testing.assert_allclose([seen.lens.fx_px, seen.lens.fy_px, seen.lens.cx_px, seen.lens.cy_px],
                               [FOCAL_PX, FOCAL_PX, 225, 75])  # fmt: skip
    assert seen.rgb[75, 225].min() == 255 and seen.rgb[64, 225].max() == 0
    tangent = seen.coordinates[:, 75, 225]
    np.testing.assert_allclose(tangent, [0.5 / FOCAL_PX, 0.5 / FOCAL_PX], rtol=1e-4)


def test_a_fisheye_is_looked_at_through_a_pinhole():
    camera = CameraModel("c", 400, 300, Fisheye(200.0, 200.0, 200.0, 150.0), np.eye(4))
    assert focal_px(camera) == pytest.approx(200, rel=1e-4)
    rgb = np.zeros((300, 400, 3), np.uint8)
    # An equidistant lens shows a point 0.3 rad to the right 60 pixels from the middle.
    rgb[147:153, 257:263] = 255
    seen = look(rgb, camera)
    rows, columns = np.nonzero(seen.rgb[..., 0] > 127)
    tangents = seen.coordinates[:, rows, columns].mean(axis=1)
    np.testing.assert_allclose(tangents, [np.tan(0.3), 0], atol=0.005)
