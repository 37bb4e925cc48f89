"""Support in a world of planes, whose depth is known in closed form.

A wall 20 m ahead fills everything below 4 m, above it is sky; a board 10 m ahead reaches 1 m to both sides of the x
axis.
"""

import dataclasses

import numpy as np
import pytest
from render_scenes import START_US, camera, gaussians, request, scene

from nurec_sim import geometry
from nurec_sim.errors import RequestError
from nurec_sim.render import make_renderer
from nurec_sim.render.rays import ray_grid
from nurec_sim.render.support import ANGLE_RAD, CLOSER, DOUBT, VIEW_PX, Support, recorded_frames
from nurec_sim.types import CameraFrame, Rig, Track, Trajectory

WALL_M, BOARD_M, TOP_M = 20.0, 10.0, 4.0
ONE = 1 / (1 + DOUBT)
"""Support by one view from the same place."""


def drive(places, tracks=(), cameras=None):
    """A scene recorded from these places [x, y], one frame each, 0.1 s apart."""
    times = START_US + 100_000 * np.arange(max(len(places), 2))
    stands = [places[min(n, len(places) - 1)] for n in range(len(times))]
    frames = np.repeat(times[: len(places), None], 2, axis=1)
    return dataclasses.replace(
        scene(tracks=tracks),
        rig=Rig({"front": cameras or camera(240, 160)}, {}),
        ego=Trajectory(times, np.stack([geometry.pose_from_xyyaw(x, y, 0.0) for x, y in stands])),
        camera_times_us={"front": frames},
    )


class Planes:
    """Renders the depth of the wall, and of the board where it is at a time."""

    def __init__(self, scene, board=lambda t_us: 0.0, wall=lambda t_us: True):
        self.scene, self._board, self._wall = scene, board, wall

    def render_camera(self, request, outputs):
        pose = request.world_from_sensor[0]
        rays = geometry.rotate_vectors(pose[:3, :3], ray_grid(request.sensor).direction)
        eye, depth = pose[:3, 3], np.zeros(rays.shape[:2])
        board = self._board(request.start_us)
        for x, left, right, top in ((WALL_M, -1e3, 1e3, TOP_M), (BOARD_M, board - 1, board + 1, TOP_M)):
            t = (x - eye[0]) / rays[..., 0]
            y, z = eye[1] + t * rays[..., 1], eye[2] + t * rays[..., 2]
            shown = (left <= y) & (y <= right) & (z <= top) & (x < WALL_M or self._wall(request.start_us))
            depth = np.where(shown, x - eye[0], depth)
        rgb = np.zeros((*depth.shape, 3), np.uint8)
        return CameraFrame(request.sensor, request.start_us, request.end_us, rgb, depth.astype(np.float32))


def look(x=0.0, y=0.0, at_us=START_US, **more):
    """A request for the camera of 240 x 160 pixels, focal length 156."""
    pose = geometry.pose_from_xyyaw(x, y, 0.0)
    return request(camera(240, 160), pose, start_us=at_us, end_us=at_us + 1, **more)


def pixel(support, y_over_x, z_over_x=0.0):
    """The support of the ray to (1, y_over_x, z_over_x)."""
    return float(support[int(80 - 156 * z_over_x), int(120 - 156 * y_over_x)])


def test_a_recorded_view_supports_itself():
    support = Support(Planes(drive([[0, 0]]))).map(look(), 240)
    assert support.shape == (160, 240) and support.dtype == np.float32
    assert support == pytest.approx(ONE)  # wall, board, sky and edges


def test_what_the_board_hid_is_unsupported():
    """From (0, 0) it hides the wall from y = -2 to 2; from (0, 2) one sees the wall from y = 0 on."""
    support = Support(Planes(drive([[0, 0]]))).map(look(y=2), 240)
    for y in (0.3, 1.0, 1.7):
        assert pixel(support, (y - 2) / WALL_M) == 0
    for y in (2.5, 4.0, 6.0):
        angle = abs(np.arctan2(y, WALL_M) - np.arctan2(y - 2, WALL_M))
        assert pixel(support, (y - 2) / WALL_M) == pytest.approx(ONE * np.exp(-angle / ANGLE_RAD), abs=0.01)
    # The sky is seen at the same angle from everywhere.
    assert pixel(support, 0.2, 0.35) == pytest.approx(ONE)


def test_nearer_than_the_recording_counts_less_and_farther_does_not():
    support = Support(Planes(drive([[0, 0]])))
    near, far = support.map(look(x=5), 240), support.map(look(x=-5), 240)
    # The board straight ahead: 10 m away in the recording, then 5 m and 15 m.
    assert pixel(near, 0) == pytest.approx(ONE * 0.5**CLOSER, abs=0.01)
    assert pixel(far, 0) == pytest.approx(ONE, abs=0.01)


def test_outside_of_the_recorded_images_nothing_is_supported():
    """The image ends at y = 0.77 x; from 10 m behind the wall is seen beyond that where y > 0.51 x."""
    planes = Planes(drive([[0, 0]]))
    behind = Support(planes).map(look(x=-10), 240)
    assert pixel(behind, 0.53) == 0 and pixel(behind, 0.49) > 0.5
    pose = geometry.pose_from_xyyaw(0, 0, 2.0)
    assert Support(planes).map(request(camera(240, 160), pose, end_us=START_US + 1), 240).max() == 0


def test_the_best_of_several_views_counts():
    one = Support(Planes(drive([[0, 0]]))).map(look(y=2), 240)
    two = Support(Planes(drive([[0, 0], [0, 2]]))).map(look(y=2), 240)
    assert pixel(one, -0.05) == 0 and pixel(two, -0.05) == pytest.approx(ONE)
    # What both saw is surer than what one saw.
    assert pixel(two, 0.3) == pytest.approx(2 / (2 + DOUBT)) and pixel(one, 0.3) < ONE


def test_views_that_look_through_a_point_speak_against_it():
    """In the first frame the wall is not there: of two views one saw it, and one looked through it to the sky."""
    planes = Planes(drive([[0, 0], [0, 0]]), wall=lambda t_us: t_us > START_US)
    support = Support(planes).map(look(at_us=START_US + 100_000), 240)
    assert pixel(support, 0.2) == pytest.approx(1 / (2 + DOUBT), abs=0.01)
    assert pixel(support, 0.0) == pytest.approx(2 / (2 + DOUBT), abs=0.01)  # the board is in both


def test_a_hole_is_unsupported_where_a_surface_was_recorded():
    planes = Planes(drive([[0, 0]]), wall=lambda t_us: t_us == START_US)
    support = Support(planes).map(look(at_us=START_US + 100_000), 240)
    assert pixel(support, 0.2) == 0 and pixel(support, 0.2, 0.35) == pytest.approx(ONE)


@pytest.fixture
def moving():
    """The board is a car that goes 2 m to the left within 0.1 s."""
    poses = np.stack([geometry.pose_from_xyyaw(BOARD_M, y, 0.0) for y in (0.0, 2.0)])
    path = Trajectory(START_US + np.array([0, 100_000]), poses)
    car = Track("car", "automobile", (1.0, 2.0, 9.0), path)
    return Planes(drive([[0, 0]], [car]), board=lambda t_us: 2.0 * (t_us - START_US) / 100_000)


def test_points_on_an_actor_are_followed(moving):
    """0.1 s later the car is seen 11.3 degrees farther left, where the recording saw the wall."""
    support = Support(moving).map(look(at_us=START_US + 100_000), 240)
    angle = np.arctan2(2, BOARD_M)
    assert pixel(support, 0.2) == pytest.approx(ONE * np.exp(-angle / ANGLE_RAD), abs=0.01)
    # Where it was there is wall now, which nobody saw.
    assert pixel(support, 0.0) == 0


def test_an_actor_that_a_request_moves_is_followed_as_well(moving):
    pose = geometry.pose_from_xyyaw(BOARD_M, 2.0, 0.0)
    moving._board = lambda t_us: 0.0 if t_us == START_US and not asked else 2.0
    asked = False
    support = Support(moving)
    asked = True
    moved = support.map(look(actors={"car": np.stack([pose, pose])}), 240)
    assert pixel(moved, 0.2) > 0.5
    assert pixel(support.map(look(), 240), 0.2) == 0  # its recorded box does not hold what is shown there


def test_only_cameras_that_the_scene_was_made_from_count():
    made = drive([[0, 0], [0, 2]])
    assert [t for _, t in recorded_frames(made)] == [START_US, START_US + 100_000]
    other = dataclasses.replace(made, provenance={"cameras": ["side"]})
    with pytest.raises(RequestError, match="'test' has no times of recorded frames: its support is unknown"):
        Support(Planes(other))


def test_long_logs_are_thinned_evenly():
    made = drive([[0, 0]])
    times = START_US + 1000 * np.arange(1000)
    frames = recorded_frames(dataclasses.replace(made, camera_times_us={"front": np.stack([times, times], axis=1)}))
    found = np.array([t for _, t in frames])
    assert len(found) == 48 and found[0] == times[0] and found[-1] == times[-1]
    assert np.diff(found).max() - np.diff(found).min() <= 1000


def test_recorded_views_are_shown_small_and_maps_have_the_asked_size():
    planes = Planes(drive([[0, 0]], cameras=camera(720, 480)))
    support = Support(planes)
    assert support._views[0].inverse_m.shape == (VIEW_PX * 2 // 3, VIEW_PX)
    assert support.map(look()).shape == (64, 96)


def test_the_renderer_of_a_scene_of_gaussians_is_enough():
    """A disc 10 m ahead, seen again from the recorded place and from 1 m beside."""
    disc = gaussians([[10.0, 0, 0]], scale=(0.001, 30.0, 30.0), opacity=0.99)
    renderer = make_renderer(dataclasses.replace(drive([[0, 0]]), static=disc), "cpu", threads=1)
    support = Support(renderer)
    assert support.map(look(), 60) == pytest.approx(ONE, abs=0.01)
    angle = np.arctan2(1, BOARD_M)
    assert support.map(look(y=1), 61)[20, 30] == pytest.approx(ONE * np.exp(-angle / ANGLE_RAD), abs=0.01)


@pytest.mark.parametrize("most, views", [(48, 30), (12, 12), (2, 8)])
def test_fewer_recorded_views_may_do_but_some_of_each_camera(most, views):
    recorded = drive([(0.5 * k, 0.0) for k in range(30)])
    assert len(recorded_frames(recorded, most)) == views
    asked = []

    class Counted(Planes):
        def render_camera(self, request, outputs):
            asked.append(request)
            return super().render_camera(request, outputs)

    Support(Counted(recorded), most=most)
    assert len(asked) == views
