"""One image or sweep in one call: pose, size and outputs as asked for; a PNG of it."""

import dataclasses

import cv2
import numpy as np
import pytest
from render_scenes import START_US, camera, gaussians, scene

from nurec_sim import render
from nurec_sim.errors import RequestError
from nurec_sim.render.images.still import render_still, view_request
from nurec_sim.types import Rig, Trajectory

FORWARD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])


@pytest.fixture(scope="module")
def drive():
    """A red post 10 m ahead; the car stands at the origin; a camera of 72 x 48 pixels and a focal length of its own."""
    post = gaussians([[10.0, 0.0, z] for z in np.arange(0, 3, 0.1)], scale=0.1, opacity=0.99, rgb=(1, 0, 0))
    front = dataclasses.replace(camera(), rig_from_camera=FORWARD)
    return dataclasses.replace(
        scene(post, sky=0.0),
        rig=Rig({"front": front}, {}),
        ego=Trajectory(START_US + np.array([0, 1_000_000]), np.stack([np.eye(4)] * 2)),
        camera_times_us={"front": np.array([[START_US, START_US], [START_US + 500_000, START_US + 520_000]])},
    )


def middle_of_post(frame):
    """Column of the image, 0 to 1, where the post is."""
    red = frame.rgb[..., 0].astype(float).sum(axis=0)
    return float((red * (np.arange(len(red)) + 0.5)).sum() / red.sum() / len(red))


def test_a_car_moved_to_its_left_sees_things_farther_right(drive):
    lens = drive.rig.cameras["front"].lens
    ahead, left = (middle_of_post(render.render_view(drive, left_m=left_m)) for left_m in (0.0, 1.0))
    assert ahead == pytest.approx(lens.cx_px / 72, abs=0.005)
    # 1 m beside, 10 m ahead: a tenth of the focal length.
    assert left - ahead == pytest.approx(0.1 * lens.fx_px / 72, abs=0.01)


def test_a_car_turned_to_its_left_sees_things_farther_right(drive):
    lens = drive.rig.cameras["front"].lens
    turned = middle_of_post(render.render_view(drive, yaw_deg=5.0)) - lens.cx_px / 72
    assert turned == pytest.approx(np.tan(np.radians(5.0)) * lens.fx_px / 72, abs=0.01)


def test_a_renderer_gives_what_its_scene_gives(drive):
    renderer = render.make_renderer(drive, "cpu")
    assert np.array_equal(render.render_view(renderer, "front", 1).rgb, render.render_view(drive, "front", 1).rgb)


def test_time_size_and_outputs_are_those_asked_for(drive):
    frame = render.render_view(drive, frame=1, width_px=36, outputs=("rgb", "depth"))
    assert (frame.start_us, frame.end_us) == (START_US + 500_000, START_US + 520_000)
    assert frame.rgb.shape == (24, 36, 3) and frame.depth_m.shape == (24, 36) and frame.normal is None
    # A log that knows one time only: the shortest exposure.
    assert view_request(drive).end_us == START_US + 1


@pytest.mark.parametrize(
    ("asked", "text"),
    [
        ({"camera": "rear"}, "scene 'test' has no camera 'rear'; have ['front']"),
        ({"frame": 2}, "camera 'front' has frames 0 to 1, got 2"),
        ({"left_m": float("nan")}, "left_m and yaw_deg must be finite, got nan and 0.0"),
    ],
)
def test_what_is_not_there_is_refused(drive, asked, text):
    drive = dataclasses.replace(drive, id="test")
    with pytest.raises(RequestError) as refused:
        render.render_view(drive, **asked)
    assert str(refused.value) == text


def test_a_still_is_the_view_as_png(drive, tmp_path):
    render_still(render.make_renderer(drive, "cpu"), tmp_path / "a.png", left_m=0.5)
    shown = cv2.imread(str(tmp_path / "a.png"))[..., ::-1]
    assert np.array_equal(shown, render.render_view(drive, left_m=0.5).rgb)


def test_a_sweep_beside_the_path_sees_the_post_beside(drive):
    drive = dataclasses.replace(drive, span_us=(START_US, START_US + 1_000_000))
    sweep = render.render_sweep(drive, model="VLP-16", columns=1800, left_m=2.0)
    # The device is 1.8 m above the rig's origin; the post 10 m ahead and 2 m to its right.
    assert np.median(sweep.xyz_m[:, 0]) == pytest.approx(10, abs=0.3)
    assert np.median(sweep.xyz_m[:, 1]) == pytest.approx(-2, abs=0.1)
