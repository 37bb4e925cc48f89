"""Which points belong to the boxes of a log, and how they move with them."""

import dataclasses

import numpy as np
import pytest

from nurec_sim import geometry, logs
from nurec_sim.reconstruct.feedforward.tracks import labelled as module
from nurec_sim.reconstruct.feedforward.tracks.labelled import (
    knots_along,
    owners_of_points,
    owners_of_rays,
    scene_actors,
)
from nurec_sim.reconstruct.lift.actors import tracks_of
from nurec_sim.types import Track, Trajectory

START_US = 1_000_000
EPOCH_US = 1_550_000_000_000_000
CAR_M = (4.0, 2.0, 1.5)


class Log:
    def __init__(self, *tracks, span_us=(START_US, START_US + 10_000_000)):
        self.tracks, self.span_us = tracks, span_us


def car(
    name="car", start=(10.0, 0.0), speed=8.0, yaw=0.3, start_us=START_US, size=CAR_M, seconds=4.0, label="automobile"
):
    """Drives straight ahead, labelled every 0.1 s from 1 s on."""
    t_us = start_us + 1_000_000 + 100_000 * np.arange(int(seconds * 10) + 1)
    along = speed * (t_us - t_us[0]) / 1e6
    poses = [geometry.pose_from_xyyaw(start[0] + s * np.cos(yaw), start[1] + s * np.sin(yaw), yaw, 0.75) for s in along]
    return Track(name, label, size, Trajectory(t_us, np.stack(poses)))


def points_in(track, t_us, n=400, scale=0.98, seed=0):
    """Points spread over a track's box at their own times."""
    box = np.random.default_rng(seed).uniform(-0.5, 0.5, (n, 3)) * np.array(track.size_m) * scale
    poses = track.path.at(t_us)
    return np.einsum("nij,nj->ni", poses[:, :3, :3], box) + poses[:, :3, 3], box


def lines(start_us, n=400, lines=20, exposure_us=30_000):
    """Times of points of a rolling shutter."""
    return start_us + np.rint(np.arange(n) % lines / (lines - 1) * exposure_us).astype(np.int64)


def yes(n):
    return np.ones(n, bool)


@pytest.mark.parametrize("start_us", [START_US, EPOCH_US])
def test_defect_2_points_associate_on_any_clock(start_us):
    track = car(start_us=start_us, speed=20.0)
    t_us = lines(start_us + 2_345_678)
    xyz, _ = points_in(track, t_us)
    log = Log(track, span_us=(start_us, start_us + 10_000_000))
    assert (owners_of_points(scene_actors(log), xyz, t_us, ~yes(400)) == 0).all()


def test_points_are_taken_at_their_own_time():
    """The box moves by more than itself between two exposures, and by 0.6 m within one."""
    track = car(speed=20.0)
    actors = scene_actors(Log(track))
    t_us = lines(START_US + 2_000_000)
    xyz, _ = points_in(track, t_us, scale=0.999)
    assert (owners_of_points(actors, xyz, t_us, ~yes(400)) == 0).all()
    assert (owners_of_points(actors, xyz, t_us + 300_000, yes(400)) == -1).all()
    one_time = np.full(400, t_us[0])
    assert (owners_of_points(actors, xyz, one_time, ~yes(400)) == -1).any()


def test_padding_is_for_movable_points_only():
    track = car(speed=0.0, yaw=0.0)
    middle = track.path.position_m[0]
    beside = middle + np.array([[0.0, 1.2, 0.0], [2.3, 0, 0], [0, 0, 1.1], [0, 1.51, 0], [0, 1.5, 0], [0.5, 0.9, 0.5]])
    t_us = np.full(6, START_US + 2_000_000)
    actors = scene_actors(Log(track))
    assert owners_of_points(actors, beside, t_us, yes(6)).tolist() == [0, 0, 0, -1, -1, 0]
    assert owners_of_points(actors, beside, t_us, ~yes(6)).tolist() == [-1, -1, -1, -1, -1, 0]


def test_of_several_boxes_the_one_wins_in_which_a_point_lies_deepest():
    vehicle = car(speed=0.0, yaw=0.0)
    person = car("person", (10.0, 1.4), 0.0, 0.0, size=(0.6, 0.6, 1.7), label="person")
    spots = np.array([[10.0, 1.4, 0.8], [10.0, 0.3, 0.8], [11.5, 1.3, 0.8]])
    t_us = np.full(3, START_US + 2_000_000)
    for order, expected in ((vehicle, person), [1, 0, 0]), ((person, vehicle), [0, 1, 1]):
        assert owners_of_points(scene_actors(Log(*order)), spots, t_us, yes(3)).tolist() == expected


def test_a_ray_belongs_to_the_only_box_that_it_meets():
    near, far = car("near", (10.0, 0.0), 0.0, 0.0), car("far", (20.0, 0.0), 0.0, 0.0)
    side = car("side", (20.0, 8.0), 0.0, 0.0)
    origin = np.tile([0.0, 0.0, 0.75], (6, 1))
    target = np.array([[10.0, 0, 0.75], [20, 8, 0.75], [20, 8, 2.6], [20, 1.2, 0.75], [-10, 0, 0.75], [20, -1.4, 0.75]])
    direction = (target - origin) / np.linalg.norm(target - origin, axis=1, keepdims=True)
    t_us = np.full(6, START_US + 2_000_000)
    owner = owners_of_rays(scene_actors(Log(near, far, side)), origin, direction, t_us)
    assert owner.tolist() == [-1, 2, -1, -1, -1, -1]  # the first meets two boxes
    assert owners_of_rays(scene_actors(Log(near, side)), origin, direction, t_us).tolist() == [0, 1, -1, 0, -1, 0]
    inside = owners_of_rays(scene_actors(Log(near)), origin + [10, 0, 0], direction, t_us)
    assert (inside == -1).all()


def test_rays_along_the_faces_of_a_box_are_no_numbers_problem():
    actors = scene_actors(Log(car(speed=0.0, yaw=0.0)))
    origin = np.array([[0.0, 1.5, 0.75], [0.0, 0.0, 2.0], [0.0, 0.0, 0.75]])
    direction = np.tile([1.0, 0.0, 0.0], (3, 1))
    owner = owners_of_rays(actors, origin, direction, np.full(3, START_US + 2_000_000))
    assert owner[2] == 0


def test_rays_agree_with_points_along_them():
    """Independent of the slabs: a ray meets a box where one of many points along it lies inside."""
    rng = np.random.default_rng(3)
    track = car(yaw=0.7, speed=5.0)
    actors = scene_actors(Log(track))
    n = 500
    t_us = lines(START_US + 2_500_000, n)
    origin = rng.normal(0, 0.2, (n, 3)) + [0, 0, 1]
    aim = track.path.at(int(t_us[0]))[:3, 3] + rng.normal(0, [2, 2, 1], (n, 3))
    direction = (aim - origin) / np.linalg.norm(aim - origin, axis=1, keepdims=True)
    owner = owners_of_rays(actors, origin, direction, t_us)
    distance = np.linspace(0.1, 40, 4000)
    inside = np.zeros(n, bool)
    for start in range(0, 4000, 200):
        along = origin[:, None] + direction[:, None] * distance[None, start : start + 200, None]
        repeated = np.repeat(t_us, along.shape[1])
        inside |= (
            (owners_of_points(actors, along.reshape(-1, 3), repeated, yes(len(repeated))) == 0).reshape(n, -1).any(1)
        )
    assert 100 < inside.sum() < 400
    assert np.mean(inside == (owner == 0)) > 0.99  # corners can slip between two samples


def test_defect_6_one_call_per_track_and_no_loop_over_rays(monkeypatch):
    """20 000 rays and 10 boxes: the release takes 0.9 s in a Python loop over hits."""
    tracks = [car(f"car-{k}", (20.0 + 6 * k, 3.0 * (k % 3)), 4.0, 0.1 * k) for k in range(10)]
    actors = scene_actors(Log(*tracks))
    rng = np.random.default_rng(0)
    n = 20_000
    direction = rng.normal(0, [0.0, 0.15, 0.03], (n, 3)) + [1, 0, 0]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin, t_us = np.tile([0.0, 0.0, 1.0], (n, 1)), lines(START_US + 2_000_000, n, 448)
    calls = []
    poses_at = module.poses_at
    monkeypatch.setattr(module, "poses_at", lambda path, t: calls.append(len(t)) or poses_at(path, t))
    owner = owners_of_rays(actors, origin, direction, t_us)
    assert len(calls) <= len(actors) and max(calls) > 500 and (owner >= 0).sum() > 1000
    calls.clear()
    owners_of_points(actors, origin + 30 * direction, t_us, yes(n))
    assert len(calls) <= len(actors)


def test_knots_follow_the_path_and_end_with_it():
    track = car(yaw=0.0, speed=10.0)
    (actor,) = scene_actors(Log(track))
    t_us = lines(START_US + 3_000_000)
    xyz, box = points_in(track, t_us)
    target = (START_US + 2_500_000, START_US + 3_500_000)
    times, knots = knots_along(actor, xyz, t_us, target, (START_US, START_US + 10_000_000))
    assert (times[:, 0] == target[0]).all() and (times[:, 1] == t_us).all() and (times[:, 2] == target[1]).all()
    for k in range(3):
        pose = track.path.at(times[:, k])
        assert np.allclose(knots[:, k], np.einsum("nij,nj->ni", pose[:, :3, :3], box) + pose[:, :3, 3])
    late = np.full(400, actor.path.end_us - 50_000)
    times, knots = knots_along(actor, xyz, late, (late[0] - 500_000, late[0] + 500_000), (START_US, START_US + 10**7))
    assert (times[:, 2] == actor.path.end_us).all()
    assert np.allclose((knots[:, 2] - knots[:, 1]) / 0.05, [10.0, 0, 0], atol=1e-6)  # no slower towards the end
    assert (np.diff(times, axis=1) > 0).all()


def test_knots_stay_in_order_at_the_very_ends_of_a_path():
    track = car()
    (actor,) = scene_actors(Log(track))
    for t in (actor.path.start_us, actor.path.end_us):
        t_us = np.full(3, t)
        times, knots = knots_along(actor, np.zeros((3, 3)), t_us, (t - 500_000, t + 500_000), (0, 1))
        assert (np.diff(times, axis=1) > 0).all() and np.isfinite(knots).all()


def test_a_track_that_stands_lives_over_the_whole_clip():
    track = car(speed=0.0, seconds=0.5)
    log = Log(track)
    (actor,) = scene_actors(log)
    t_us = np.full(5, START_US + 9_000_000)  # seen again long after its last label
    xyz, _ = points_in(track, t_us, 5)
    assert (owners_of_points([actor], xyz, t_us, yes(5)) == 0).all()
    times, knots = knots_along(actor, xyz, t_us, (START_US + 8_500_000, START_US + 9_500_000), log.span_us)
    assert (times[:, 0] < log.span_us[0]).all() and (times[:, 2] > log.span_us[1]).all()
    assert np.array_equal(knots, np.repeat(xyz[:, None], 3, axis=1))
    (shown,) = tracks_of(log, [actor])
    assert (shown.path.start_us, shown.path.end_us) == log.span_us


def test_moving_tracks_go_on_for_one_label_step_within_the_clip():
    track = car(speed=10.0, yaw=0.0)
    log = Log(track, span_us=(track.path.start_us - 30_000, START_US + 10_000_000))
    (actor,) = scene_actors(log)
    assert actor.path.start_us == log.span_us[0] and actor.path.end_us == track.path.end_us + 100_000
    assert actor.path.position_m[0, 0] == pytest.approx(10.0 - 0.3)
    assert actor.path.position_m[-1, 0] == pytest.approx(10.0 + 40 + 1)
    assert tracks_of(log, [actor]) == (track,), "what is measured against is where the labels say"
    outside = np.full(2, track.path.end_us + 150_000)
    assert (owners_of_points([actor], actor.path.position_m[-1:].repeat(2, 0), outside, yes(2)) == -1).all()


def test_things_that_do_not_move_by_themselves_are_no_actors():
    cone = car("cone", label="traffic_cone", speed=0.0)
    log = Log(cone, car("car"))
    actors = scene_actors(log)
    assert [actor.index for actor in actors] == [1]
    assert tracks_of(log, actors)[0] is cone


def test_a_single_label_holds_for_a_moment():
    track = car()
    once = dataclasses.replace(track, path=Trajectory(track.path.t_us[:1], track.path.world_from_body[:1]))
    actors = scene_actors(Log(once))
    here = once.path.position_m.repeat(3, axis=0)
    t_us = once.path.t_us[0] + np.array([-40_000, 40_000, 90_000])
    assert owners_of_points(actors, here, t_us, yes(3)).tolist() == [0, 0, -1]


def test_no_points_and_no_actors():
    actors = scene_actors(Log(car()))
    none, times = np.zeros((0, 3)), np.zeros(0, np.int64)
    assert owners_of_points(actors, none, times, yes(0)).shape == (0,)
    assert owners_of_rays(actors, none, none, times).shape == (0,)
    assert owners_of_points([], np.zeros((4, 3)), np.zeros(4, np.int64), yes(4)).tolist() == [-1] * 4


@pytest.mark.realdata
@pytest.mark.parametrize("name, least", [("kitti_raw_0009", 500), ("ddad_6cam", 500), ("nuscenes_6cam_1frame", 500)])
def test_real_sweeps_associate_with_real_boxes(realdata, name, least):
    """Clocks of these logs count microseconds since 1970; sweeps give points, their own times and rays."""
    clip = logs.open_clip(realdata / name)
    actors = scene_actors(clip)
    sweep = clip.sweep("lidar", 0)
    xyz, t_us = sweep.xyz_world_m, sweep.point_t_us
    padded = owners_of_points(actors, xyz, t_us, yes(len(xyz)))
    plain = owners_of_points(actors, xyz, t_us, ~yes(len(xyz)))
    assert least < (plain >= 0).sum() < (padded >= 0).sum() < 0.5 * len(xyz)
    assert np.array_equal(plain[plain >= 0] >= 0, padded[plain >= 0] >= 0)
    rows = np.flatnonzero((plain >= 0) & (np.linalg.norm(sweep.xyz_m, axis=1) > 3))
    origin = np.broadcast_to(sweep.world_from_lidar[:3, 3], (len(rows), 3))
    direction = (xyz[rows] - origin) / np.linalg.norm(xyz[rows] - origin, axis=1, keepdims=True)
    by_ray = owners_of_rays(actors, origin, direction, t_us[rows])
    assert np.mean(by_ray >= 0) > 0.3 and np.array_equal(by_ray[by_ray >= 0], plain[rows][by_ray >= 0])
