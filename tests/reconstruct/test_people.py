"""People are built anew for every few images; what they are made of moves with their track in between."""

import dataclasses

import numpy as np
import pytest
from reconstruct_street import FRAME_US, Street

from nurec_sim import geometry
from nurec_sim.reconstruct import LiftSettings, PointSettings, ViewSettings, reconstruct
from nurec_sim.reconstruct.lift.people import _ends_us, _straight_parts, in_windows, moving
from nurec_sim.reconstruct.lift.points import Actor, actors_of, gather
from nurec_sim.types import Gaussians, Track, Trajectory

FRAMES = 6
START_US = 1_000_000
SECONDS = 0.2 * np.arange(FRAMES)
BOXES = {
    "walker": ((0.6, 0.6, 1.7), np.column_stack([9.0 + 1.4 * SECONDS, np.full(FRAMES, 1.0)])),
    "waiting": ((0.6, 0.6, 1.7), np.array([12.0, 5.0])),
    "car": ((4.4, 1.8, 1.5), np.column_stack([12.0 + 6.0 * SECONDS, np.full(FRAMES, -2.0)])),
}


@pytest.fixture(scope="module")
def street():
    made = Street(frames=FRAMES, boxes=BOXES)
    for number in (0, 1):
        made.tracks[number] = dataclasses.replace(made.tracks[number], label="person")
    return made


def windows_of(street, frames, name="walker"):
    actors = in_windows(actors_of(street, PointSettings()), street, [("front", frame) for frame in frames])
    return [actor.window_us for actor in actors if actor.track.id == name]


def test_only_people_that_move_have_windows(street):
    assert windows_of(street, range(FRAMES), "waiting") == windows_of(street, range(FRAMES), "car") == [None]
    assert None not in windows_of(street, range(FRAMES))


def test_windows_end_half_way_between_images(street):
    t = street.t_us.tolist()
    # Half of the first gap is shorter than 0.2 s, and half of the last one is as short as the last window may be.
    half = [time + FRAME_US // 2 for time in t[1:-1]]
    assert windows_of(street, range(FRAMES)) == list(zip([t[0], *half], [*half, t[-1] + 1], strict=True))
    assert windows_of(street, [0, 4]) == [(t[0], t[2]), (t[2], t[-1] + 1)]
    assert windows_of(street, []) == [(t[0], t[-1] + 1)]


def test_windows_without_a_sweep_last_until_the_next_one(street):
    """Sweeps lie around the images."""
    labelled, frames = actors_of(street, PointSettings()), [("front", k) for k in range(FRAMES)]
    t = street.t_us.tolist()

    def windows(hold_out):
        actors = in_windows(labelled, street, frames, hold_out)
        return [actor.window_us for actor in actors if actor.track.id == "walker"]

    half = [time + FRAME_US // 2 for time in t[:-1]]
    assert windows(()) == windows_of(street, range(FRAMES))
    assert windows({2}) == list(zip([t[0], *half[1::2], half[4]], [half[1], *half[3:], t[-1] + 1], strict=True))
    assert windows({4, 5}) == [(t[0], half[1]), (half[1], half[2]), (half[2], t[-1] + 1)]
    assert windows(set(range(FRAMES))) == [(t[0], t[-1] + 1)]


def test_riders_have_windows_as_walkers_do(street):
    rides = Street(frames=FRAMES, boxes=BOXES)
    rides.tracks[0] = dataclasses.replace(street.tracks[0], label="rider")
    assert windows_of(rides, range(FRAMES)) == windows_of(street, range(FRAMES))


@pytest.mark.parametrize(("frame_us", "images"), [(100_000, [3, 2, 2, 2, 3]), (70_000, [4, 3, 3, 2])])
def test_windows_are_no_shorter_than_200_ms_but_the_last_one(frame_us, images):
    """Of twelve images, the first and the last ones at the times of the first and the last label."""
    path = Trajectory(frame_us * np.arange(12), np.tile(np.eye(4), (12, 1, 1)))
    ends = np.array(_ends_us(path, path.t_us, path.t_us))
    assert np.histogram(path.t_us, ends)[0].tolist() == images and ends[-1] == path.end_us + 1
    assert (np.diff(ends)[:-1] >= 200_000).all() and ends[-1] - ends[-2] >= 100_000


def test_an_image_that_does_not_show_a_person_begins_no_window():
    behind = Street(frames=FRAMES, boxes={"walker": ((0.6, 0.6, 1.7), BOXES["walker"][1] - (20.0, 0.0))})
    behind.tracks[0] = dataclasses.replace(behind.tracks[0], label="person")
    assert len(windows_of(behind, range(FRAMES))) == 1


def test_a_window_holds_the_returns_of_its_time(street):
    actors = in_windows(actors_of(street, PointSettings()), street, [("front", frame) for frame in range(FRAMES)])
    whole = gather(street, actors_of(street, PointSettings()), set(), PointSettings())
    parts = gather(street, actors, set(), PointSettings())
    for number, actor in enumerate(actors):
        if actor.track.id != "walker":
            continue
        frames = [k for k, t_us in enumerate(street.t_us) if actor.present(np.array(t_us))]
        alone = gather(street, [actor], set(range(FRAMES)) - set(frames), PointSettings())
        assert len(alone.actors[0]) and np.array_equal(parts.actors[number].xyz_m, alone.actors[0].xyz_m)
    assert len(parts.static) == len(whole.static)


def test_each_instant_is_in_one_window(street):
    actors = in_windows(actors_of(street, PointSettings()), street, [("front", frame) for frame in range(FRAMES)])
    walkers = [actor for actor in actors if actor.track.id == "walker"]
    times = np.arange(street.t_us[0], street.t_us[-1] + 1, 20_000)
    assert len(walkers) == 5 and (sum(actor.present(times).astype(int) for actor in walkers) == 1).all()
    assert not any(actor.present(street.t_us[[0, -1]] + [-1, 1]).any() for actor in walkers)


def one_at(xyz):
    return dataclasses.replace(Gaussians.empty(1), mean_m=np.float32([xyz]), scale_m=np.full((1, 3), 0.1, np.float32))


def actor_along(poses, window_us):
    path = Trajectory(START_US + 100_000 * np.arange(len(poses)), np.array(poses))
    return Actor(3, Track("a", "person", (0.6, 0.6, 1.7), path), False, path, window_us)


def test_gaussians_move_along_the_track_and_last_as_long_as_the_window():
    poses = [geometry.pose_from_xyyaw(2.0 + 0.14 * k, 1.0, 0.5, 0.9) for k in range(11)]
    shown = moving(actor_along(poses, (START_US + 200_000, START_US + 600_000)), one_at([0.1, 0.2, 0.3]))
    assert shown.track.tolist() == [3] and not shown.in_box.any()
    for t_us in (START_US + 200_000, START_US + 310_000, START_US + 599_999):
        rows, mean_m, fade = shown.at(t_us)
        expected = geometry.transform_points(
            geometry.pose_from_xyyaw(2.0 + 1.4 * (t_us - START_US) / 1e6, 1.0, 0.5, 0.9), np.array([[0.1, 0.2, 0.3]])
        )
        assert rows.tolist() == [0] and np.abs(mean_m - expected).max() < 1e-4
        assert fade[0] > 0.67
    assert len(shown.at(START_US + 150_000)[0]) == len(shown.at(START_US + 650_000)[0]) == 0
    assert np.allclose(
        geometry.matrix_from_quat(shown.gaussians.quat_wxyz.astype(float))[0], poses[0][:3, :3], atol=1e-6
    )


def test_long_windows_of_a_turn_are_cut_where_it_bends():
    straight = [geometry.pose_from_xyyaw(0.14 * k, 0.0, 0.0) for k in range(41)]
    path = actor_along(straight, None).path
    assert _straight_parts(path, path.start_us, path.end_us) == [(path.start_us, path.end_us)]
    turn = [geometry.pose_from_xyyaw(2 * np.sin(k / 14), 2 - 2 * np.cos(k / 14), k / 14) for k in range(41)]
    path = actor_along(turn, None).path
    parts = _straight_parts(path, path.start_us, path.end_us)
    assert len(parts) > 4 and parts[0][0] == path.start_us and parts[-1][1] == path.end_us
    assert all(one[1] == other[0] for one, other in zip(parts[:-1], parts[1:], strict=True))
    for first, last in parts:
        yaw = geometry.yaw_of(path.at(np.array([first, (first + last) // 2, last])))
        assert np.ptp(yaw) < np.radians(41)


def test_a_scene_shows_a_person_at_all_times_and_cars_as_rigid_parts(street):
    small = LiftSettings(views=ViewSettings(width_px=96, levels=8), sky_px=32)
    scene = reconstruct(street, "lift", settings=small, align_actors=False)
    dynamic = scene.dynamic
    assert dynamic.in_box[dynamic.track == 2].all() and dynamic.in_box[dynamic.track == 1].all()
    assert not dynamic.in_box[dynamic.track == 0].any()
    size = np.array(BOXES["walker"][0])
    for t_us in (street.t_us[:-1] + 70_000).tolist():
        rows, mean_m, fade = dynamic.at(t_us)
        mine = dynamic.track[rows] == 0
        in_box = geometry.transform_points(geometry.inverse(scene.tracks[0].path.at(t_us)), mean_m[mine])
        assert mine.sum() > 10 and fade[mine].max() > 0.6
        assert geometry.points_in_box(in_box, size, 0.1).mean() > 0.95
