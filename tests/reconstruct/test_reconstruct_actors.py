import numpy as np
import pytest

from nurec_sim import geometry
from nurec_sim.reconstruct.lift import lifting
from nurec_sim.reconstruct.lift.actors import in_box, standing_knots_us, tracks_of
from nurec_sim.reconstruct.lift.bake import body_pixels
from nurec_sim.reconstruct.lift.bodies import Surfels
from nurec_sim.reconstruct.lift.cloud import Cloud
from nurec_sim.reconstruct.lift.pictures import DepthPicture
from nurec_sim.reconstruct.lift.points import actors_of
from nurec_sim.reconstruct.lift.settings import LiftSettings, PointSettings
from nurec_sim.reconstruct.lift.views import Tile, WorkingView
from nurec_sim.types import Gaussians, Track, Trajectory

SPAN_US = (1_000_000, 6_000_000)


class Log:
    span_us = SPAN_US

    def __init__(self, *tracks):
        self.tracks = tracks


def actor(path, label="automobile"):
    found = actors_of(Log(Track("a", label, (4.0, 2.0, 1.5), path)), PointSettings())
    return found[0] if found else None


def drive(speed=8.0, accel=0.0, yaw_rate=0.0, seconds=4.0, step_s=0.1):
    t = np.arange(0, seconds + 1e-9, step_s)
    heading = yaw_rate * t
    along = np.cumsum((speed + accel * t) * step_s)
    x = np.cumsum(np.cos(heading) * np.diff(along, prepend=0))
    y = np.cumsum(np.sin(heading) * np.diff(along, prepend=0))
    poses = np.stack([geometry.pose_from_xyyaw(*row, 0.8) for row in zip(x, y, heading, strict=True)])
    return Trajectory(1_200_000 + np.round(t * 1e6).astype(np.int64), poses)


def test_what_stands_hardly_fades_within_the_clip():
    jitter = np.random.default_rng(0).normal(0, 0.03, (10, 2))
    poses = np.stack([geometry.pose_from_xyyaw(5 + x, 2 + y, 0.1, 0.8) for x, y in jitter])
    assert actor(Trajectory(2_000_000 + 100_000 * np.arange(10), poses)).standing
    early, middle, late = standing_knots_us(SPAN_US)
    assert middle == 3_500_000 and early == middle - 3_000_001 and late == middle + 3_000_001
    for t_us in (*SPAN_US, 3_500_000):
        assert np.exp(-((abs(t_us - middle) / (late - middle)) ** 10)) > 0.8


def test_a_far_label_that_jitters_stands_but_a_starting_car_does_not():
    poses = np.stack([geometry.pose_from_xyyaw(x, 0, 0) for x in (0, 0.5, -0.1, 0.1, 0, -0.4, 0.1, 0, 0.05)])
    assert actor(Trajectory(1_000_000 + 100_000 * np.arange(9), poses)).standing
    poses = np.stack([geometry.pose_from_xyyaw(x, 0, 0) for x in (0, 0, 0, 0, 0, 0.2, 0.5, 0.9, 1.4)])
    assert not actor(Trajectory(1_000_000 + 100_000 * np.arange(9), poses)).standing


@pytest.mark.parametrize("turn", [1, -1])
def test_a_car_that_creeps_to_a_stop_moves_but_labels_that_go_to_and_fro_do_not(turn):
    """The first third has gone 0.35 m, too little for the medians of thirds; 0.45 m in all, or back by half of it."""
    stops = [0.0, 0.12, 0.22, 0.30, 0.36, 0.40, 0.42, 0.44, *[0.45] * 16][::turn]
    poses = np.stack([geometry.pose_from_xyyaw(3 + 0.6 * x, 4 + 0.8 * x, 0.9) for x in stops])
    assert not actor(Trajectory(1_000_000 + 100_000 * np.arange(24), poses)).standing
    jitters = [0.0, 0.12, 0.22, 0.30, 0.06, 0.40, 0.42, 0.44, *[0.45] * 8, 0.2, *[0.45] * 7][::turn]
    poses = np.stack([geometry.pose_from_xyyaw(3 + 0.6 * x, 4 + 0.8 * x, 0.9) for x in jitters])
    assert actor(Trajectory(1_000_000 + 100_000 * np.arange(24), poses)).standing


def test_things_that_cannot_move_are_no_actors():
    assert actor(drive(), label="traffic_sign") is None


def test_gaussians_of_an_actor_are_stored_once_in_its_box():
    mover = actor(drive(yaw_rate=0.3))
    box = Gaussians.empty(3)
    box.mean_m[:] = [[2, 0, 0], [0, 1, 0], [0, 0, 0.7]]
    layer = in_box(mover, box)
    assert len(layer) == 3 and layer.in_box.all() and (layer.track == mover.index).all()
    assert np.array_equal(layer.gaussians.mean_m, box.mean_m)
    alive, where, fade = layer.at(mover.path.end_us)
    assert len(alive) == 3 and np.array_equal(where, box.mean_m) and (fade == 1).all()


def test_a_track_that_is_labelled_once_is_there_for_a_tenth_of_a_second():
    clip = Log(Track("car", "automobile", (4.0, 1.8, 1.5), Trajectory(np.array([2_000_000]), np.eye(4)[None])))
    (found,) = actors_of(clip, PointSettings())
    (shown,) = tracks_of(clip, [found])
    assert shown.path.t_us.tolist() == [1_950_000, 2_050_000]
    # An image 35 ms before the sweep shows the car, not a wall where the car is.
    times = np.array([1_949_999, 1_950_000, 1_965_000, 2_050_000, 2_050_001])
    assert found.present(times).tolist() == [False, True, True, True, False]


def test_a_standing_actor_stays_to_be_hit_after_its_labels_end():
    clip = Log(Track("car", "automobile", (4.0, 1.8, 1.5), drive(speed=0.0, seconds=1.0)))
    (shown,) = tracks_of(clip, actors_of(clip, PointSettings()))
    assert (shown.path.start_us, shown.path.end_us) == SPAN_US
    assert np.array_equal(shown.path.at(SPAN_US[1]), clip.tracks[0].path.world_from_body[0])


def test_a_moving_actor_keeps_its_recorded_path():
    clip = Log(Track("car", "automobile", (4.0, 1.8, 1.5), drive()))
    assert tracks_of(clip, actors_of(clip, PointSettings())) == clip.tracks


def test_pixels_go_to_the_frame_of_their_body_and_normals_are_computed_once_per_view(monkeypatch):
    """A chequered wall 10 m ahead of a camera that looks along x; the left half of the picture shows an actor."""
    shape, calls = (4, 8), []
    normals_of = lifting.normals_of
    monkeypatch.setattr(lifting, "normals_of", lambda *given: calls.append(1) or normals_of(*given))
    mover = actor(drive(speed=8.0))
    nothing = np.zeros((0, 3), np.float32), *np.zeros((2, 0), np.float32), np.zeros(0, np.uint8)
    bodies = [Surfels(each, Cloud.empty(), *nothing) for each in (None, mover)]
    turn = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    tile = Tile(8, 4, 8.0, (4.0, 2.0), np.eye(3), 1, None, np.ones(shape, bool), np.zeros(3))
    rgb = np.tile((np.indices(shape).sum(axis=0) % 2 * 99).astype(np.uint8)[..., None], 3)
    t_us = (1_200_000, 2_200_000)
    views = [WorkingView("front", 0, t, True, tile, geometry.pose(turn, np.zeros(3)), np.zeros(3), rgb) for t in t_us]
    body = np.repeat(np.arange(8) < 4, 4).reshape(8, 4).T.astype(np.int32)
    picture = DepthPicture(
        np.full(shape, 0.1, np.float32), body, np.full(shape, -1, np.int32), *np.zeros((2, *shape), bool)
    )
    world, box = body_pixels(bodies, views, [picture] * 2, [rgb] * 2, LiftSettings())
    assert len(calls) == 2 and len(world) == len(box) == 32
    assert np.allclose(world.xyz_m[:, 0], 10) and (world.xyz_m[:, 1] < 0).all() and np.allclose(world.depth_m, 10)
    for k, t in enumerate(t_us):
        mine = box.view == k
        expected = 10 - mover.path.at(t)[0, 3]
        assert mine.sum() == 16 and np.allclose(box.xyz_m[mine, 0], expected) and (box.xyz_m[mine, 1] > 0).all()
