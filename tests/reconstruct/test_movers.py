"""Actors of logs without boxes: what moves in the sweeps becomes tracks, and nothing else does."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from reconstruct_street import Street

from nurec_sim import geometry
from nurec_sim.errors import ReconstructError
from nurec_sim.reconstruct import load_method, reconstruct
from nurec_sim.reconstruct.movers import find_actors, with_actors
from nurec_sim.reconstruct.movers.contradicted import Seen, off_ground
from nurec_sim.reconstruct.movers.find import _lasting, _moves, _track, _whole
from nurec_sim.reconstruct.movers.following import follow
from nurec_sim.reconstruct.movers.objects import Blob, blobs_of
from nurec_sim.types import DynamicGaussians, Gaussians, GaussianScene, Rig, Track, Trajectory

FRAMES = 16
SECONDS = 0.2 * np.arange(FRAMES)


def driven(x_m, y_m, x_mps, y_mps=0.0):
    return np.column_stack([x_m + x_mps * SECONDS, y_m + y_mps * SECONDS])


MOVERS = {
    "oncoming": ((4.4, 1.8, 1.5), driven(38.0, 2.2, -8.0)),
    "lead": ((4.6, 1.8, 1.5), driven(14.0, -1.5, 6.0)),
    "person": ((0.6, 0.6, 1.75), driven(26.0, -3.5, 0.0, 1.4)),
}
PARKED = {f"parked {k}": ((4.4, 1.8, 1.5), np.array([8.0 + 9.0 * k, 3.9])) for k in range(4)}


class Log(Street):
    """A street without labels that notes which sweeps are read."""

    def __post_init__(self):
        super().__post_init__()
        self.read, self.kept = [], {}

    def sweep(self, lidar_id, index):
        self.read.append(index)
        if index not in self.kept:
            self.kept[index] = super().sweep(lidar_id, index)
        return self.kept[index]


@pytest.fixture(scope="module")
def log():
    return Log(frames=FRAMES, boxes=MOVERS | PARKED, labelled=False)


@pytest.fixture(scope="module")
def tracks(log):
    return find_actors(log)


def nearest(tracks, log, name):
    """The track nearest to a thing in the middle of the track's own life, and the largest distance between the two."""
    size, _ = log.boxes[name]
    true = Trajectory(log.t_us, log._box_poses(name))

    def apart(track):
        times = track.path.t_us[1:-1]
        return np.linalg.norm((track.path.at(times) - true.at(times))[:, :2, 3], axis=1).max()

    best = min(tracks, key=apart)
    return best, apart(best)


def test_each_mover_becomes_one_track_and_what_is_parked_none(log, tracks):
    assert [track.id for track in tracks] == ["found-1", "found-2", "found-3"]
    assert all(not track.labelled and track.actor and track.controllable for track in tracks)
    assert len({nearest(tracks, log, name)[0].id for name in MOVERS}) == 3


@pytest.mark.parametrize(("name", "label"), [("oncoming", "automobile"), ("lead", "automobile"), ("person", "person")])
def test_a_track_is_where_its_mover_is_and_as_fast(log, tracks, name, label):
    track, apart = nearest(tracks, log, name)
    assert track.label == label and apart < 0.8
    seconds = (track.path.end_us - track.path.start_us) / 1e6
    assert seconds > 1.0
    velocity = np.diff(track.path.position_m[[0, -1], :2], axis=0)[0] / seconds
    true = np.diff(MOVERS[name][1][[0, 1]], axis=0)[0] / 0.2
    assert np.linalg.norm(velocity - true) < 0.4
    turned = geometry.yaw_of(track.path.world_from_body) - np.arctan2(true[1], true[0])
    assert np.abs(geometry.wrap_angle(turned)).max() < np.radians(15)


def test_boxes_reach_from_the_ground_to_the_roof(log, tracks):
    for name, (size, _) in MOVERS.items():
        track, _ = nearest(tracks, log, name)
        bottom = track.path.position_m[:, 2] - track.size_m[2] / 2
        assert np.abs(bottom).max() < 0.15 and abs(track.size_m[2] - size[2]) < 0.4


def test_returns_are_moving_where_others_saw_free_space(log):
    seen = list(off_ground(log, "top", range(FRAMES)))
    assert [set(each.fired_us.tolist()) for each in seen] == [{t} for t in log.t_us.tolist()]
    shares = {name: [] for name in log.boxes}
    for index, each in enumerate(seen):
        assert each.height_m.min() > 0.3 and each.height_m.max() < 4.5
        for name, (size, _) in log.boxes.items():
            box_from_world = geometry.inverse(log._box_poses(name)[index])
            inside = geometry.points_in_box(geometry.transform_points(box_from_world, each.xyz_m), size, 0.1)
            shares[name] += each.moving[inside].tolist()
    assert min(np.mean(shares[name]) for name in MOVERS) > 0.8
    assert max(np.mean(shares[name]) for name in PARKED) < 0.25  # beams pass close to edges


@pytest.fixture(scope="module")
def slow():
    """A car creeps ahead of one as slow: beams end at its rear, and where they pass later was hidden before."""
    creeps = (4.4, 1.8, 1.5), np.column_stack([8.0 + 0.8 * SECONDS[:11], np.zeros(11)])
    return Log(frames=11, speed_mps=0.8, boxes={"creeps": creeps} | PARKED, labelled=False)


def test_a_slow_car_ahead_is_found_though_few_sweeps_see_past_it(slow):
    (track,) = find_actors(slow)
    assert track.label == "automobile" and track.path.end_us - track.path.start_us > 1_000_000
    seconds = (track.path.end_us - track.path.start_us) / 1e6
    assert np.abs(np.diff(track.path.position_m[[0, -1], :2], axis=0)[0] / seconds - [0.8, 0]).max() < 0.15
    middle = track.path.position_m[0]
    rear_m = middle[0] - track.size_m[0] / 2
    assert abs(rear_m - (5.8 + 0.8 * (track.path.start_us - slow.t_us[0]) / 1e6)) < 0.3 and abs(middle[1]) < 0.3


@pytest.mark.parametrize("late, until", [(0, "the end"), (1, "the end"), (2, "half a sweep later")])
def test_an_object_that_is_lost_near_the_end_of_the_log_is_there_until_then(late, until):
    """Sweeps every 100 ms over a second; the last sighting is at 850 ms, or one or two sweeps earlier."""
    clip = SimpleNamespace(span_us=(0, 1_000_000))
    seen_us = np.array([450_000, 850_000 - 100_000 * late])
    poses = np.stack([geometry.pose(np.eye(3), np.array([t / 1e5, 0.0, 0.0])) for t in seen_us])
    lasting = _lasting(Track("", "automobile", (4.0, 2.0, 1.5), Trajectory(seen_us, poses)), clip, 100_000)
    assert lasting.path.start_us == 400_000
    assert lasting.path.end_us == {"the end": 999_999, "half a sweep later": 700_000}[until]
    assert lasting.path.position_m[-1, 0] == pytest.approx(lasting.path.end_us / 1e5)
    mirrored = Track("", "automobile", (4.0, 2.0, 1.5), Trajectory(1_000_000 - seen_us[::-1], poses))
    assert _lasting(mirrored, clip, 100_000).path.start_us == {"the end": 0, "half a sweep later": 300_000}[until]


def test_beams_cross_a_slow_car_within_their_noise_before_they_pass_it_by_the_margin(slow):
    shares = {"moving": [], "crossed": [], "parked": []}
    for index, each in enumerate(off_ground(slow, "top", range(11))):
        for name, (size, _) in slow.boxes.items():
            box_from_world = geometry.inverse(slow._box_poses(name)[index])
            inside = geometry.points_in_box(geometry.transform_points(box_from_world, each.xyz_m), size, 0.1)
            if name == "creeps":
                shares["moving"] += each.moving[inside].tolist()
                shares["crossed"] += each.crossed[inside].tolist()
            else:
                shares["parked"] += each.crossed[inside].tolist()
    assert np.mean(shares["crossed"]) > np.mean(shares["moving"]) + 0.15
    assert np.mean(shares["parked"]) < 0.25  # beams pass close to edges


def test_sweeps_that_are_held_out_are_not_read(log):
    log.read.clear()
    assert len(find_actors(log, hold_out=range(1, FRAMES, 4))) == 3
    assert set(log.read) == set(range(FRAMES)) - set(range(1, FRAMES, 4))


def test_one_sweep_tells_of_no_motion():
    assert find_actors(Log(frames=1, boxes=PARKED, labelled=False)) == ()


# --------------------------------------------------------------------------------------------------------- choice


BOX = Track("a", "automobile", (4.0, 1.8, 1.5), Trajectory(np.array([1_000_000]), np.eye(4)[None]))


def test_recorded_boxes_win_unless_others_are_asked_for(log):
    labelled = Log(frames=FRAMES, boxes=MOVERS | PARKED)
    assert with_actors(labelled, "auto") == (labelled, None) == with_actors(labelled, "recorded")
    assert not labelled.read
    bare, note = with_actors(labelled, "none")
    assert (
        bare.tracks == ()
        and bare.id == labelled.id
        and note == "no boxes: the 7 recorded tracks were left out as asked"
    )
    other, note = with_actors(labelled, "found")
    assert [track.id for track in other.tracks] == ["found-1", "found-2", "found-3"]
    assert note.startswith("no boxes: 3 actors were found by their motion in the sweeps; what stands throughout")
    assert len(labelled.tracks) == 7


def test_a_log_without_boxes_gets_what_moves(log, tracks):
    again = with_actors(log, "auto")[0].tracks
    assert [(track.id, track.size_m) for track in again] == [(track.id, track.size_m) for track in tracks]
    poses = [[track.path.world_from_body for track in each] for each in (again, tracks)]
    assert all(np.array_equal(*pair) for pair in zip(*poses, strict=True))
    assert with_actors(log, "recorded") == (log, None) == with_actors(log, "none")


def test_a_log_in_which_nothing_moves_stays_as_it_is():
    still = Log(frames=6, boxes=PARKED, labelled=False)
    assert with_actors(still, "auto") == (still, None)


def test_actors_cannot_be_found_without_sweeps(log):
    blind = Log(frames=2, labelled=False)
    blind.rig = Rig(blind.rig.cameras, {})
    assert with_actors(blind, "auto") == (blind, None)
    with pytest.raises(ReconstructError, match="clip 'street': actors are found in two LiDAR sweeps or more"):
        with_actors(blind, "found")


def test_an_unknown_choice_is_refused(log):
    with pytest.raises(
        ReconstructError, match=r"actors must be one of \['auto', 'recorded', 'found', 'none'\], got 'all'"
    ):
        with_actors(log, "all")


class _Nothing:
    """A method whose scenes hold nothing but the tracks of the log that it gets."""

    name, settings = "nothing", load_method("lift").settings

    def files(self, settings):
        return ()

    def reconstruct(self, clip, settings, *, cameras, hold_out_sweeps, progress):
        progress("all", 0.0)
        progress("all", 1.0)
        return GaussianScene(
            id=clip.id, static=Gaussians.empty(0), dynamic=DynamicGaussians.empty(), sky=np.zeros((6, 2, 2, 3), "f4"),
            isp={}, rig=clip.rig, ego=clip.ego, tracks=tuple(clip.tracks), road_map=None, span_us=clip.span_us,
            camera_times_us={}, provenance={"unknown": ["no boxes: movers are scenery", "no map: no road"]},
        )  # fmt: skip


def test_methods_get_the_found_actors_and_scenes_tell_of_them(log):
    method, steps = _Nothing(), []
    scene = reconstruct(log, method, progress=lambda stage, done: steps.append(done))
    assert [track.id for track in scene.tracks] == ["found-1", "found-2", "found-3"]
    assert [text.partition(":")[0] for text in scene.provenance["unknown"]] == ["no boxes", "no map"]
    assert "3 actors were found" in scene.provenance["unknown"][0]
    assert steps == sorted(steps) and steps[-1] == 1.0
    assert reconstruct(log, method, actors="none").tracks == ()
    steps.clear()
    still = Log(frames=6, boxes=PARKED, labelled=False)
    assert reconstruct(still, method, progress=lambda stage, done: steps.append(done)).tracks == ()
    assert steps == sorted(steps) and steps[-1] == 1.0 and len(steps) > 2


# ------------------------------------------------------------------------------------------------------ following


def blob(t_s, x_m, y_m):
    xyz = np.array([[x_m, y_m, 0.5]])
    return Blob(round(t_s * 1e6), xyz, xyz, xyz[0, :2])


def test_objects_that_meet_go_on_as_they_came():
    times = np.arange(0, 3, 0.1)
    sweeps = [[blob(t, 10 * t, 1.2), blob(t, 30 - 10 * t, -1.2)] for t in times]
    paths = follow(sweeps)
    assert len(paths) == 2
    for path in paths:
        assert np.abs(np.diff([each.middle_m[1] for each in path.blobs])).max() == 0
        assert np.allclose(np.abs(path.smoothed()[:, 2]), 10, atol=0.3)


def test_an_object_that_was_hidden_for_a_second_is_the_same_one():
    times = [t for t in np.arange(0, 4, 0.1) if not 1.5 < t < 2.4]
    (path,) = follow([[blob(t, 8 * t, 0.0)] for t in times])
    assert len(path.blobs) == len(times)


def test_smoothed_velocities_follow_a_turn():
    times, rate = np.arange(0, 5, 0.1), 0.25
    radius = 8 / rate
    (path,) = follow([[blob(t, radius * np.sin(rate * t), radius * (1 - np.cos(rate * t)))] for t in times])
    true = 8 * np.column_stack([np.cos(rate * times), np.sin(rate * times)])
    error = np.linalg.norm(path.smoothed()[:, 2:] - true, axis=1)
    assert np.median(error) < 0.1 and error.max() < 1.2


def test_boxes_of_other_ids_stay_when_tracks_are_replaced(log):
    from nurec_sim.logs.selection import with_tracks

    other = with_tracks(log, [BOX])
    assert other.tracks == (BOX,) and other.ego is log.ego
    assert dataclasses.asdict(other.rig.body) == dataclasses.asdict(log.rig.body)


# ---------------------------------------------------------------------------------------------- objects and their check


EGO = SimpleNamespace(ego=Trajectory(np.array([0, 10_000_000]), np.tile(np.eye(4), (2, 1, 1))))


def seen_path(blobs_m):
    """The path of an object of which these points are seen every 0.1 s."""
    blobs = []
    for number, xyz in enumerate(blobs_m):
        low, high = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
        blobs.append(Blob(100_000 * number, xyz, xyz * [1, 1, 0], (low + high) / 2))
    (path,) = follow([[each] for each in blobs])
    return path


def test_a_hedge_of_which_each_sweep_sees_another_part_does_not_move():
    hedge = np.random.default_rng(1).uniform([0, 8, 0.3], [30, 9, 1.8], (1500, 3))
    parts = [hedge[np.abs(hedge[:, 0] - 5 - 0.5 * k) < 2] for k in range(20)]
    path = seen_path(parts)
    assert not _moves(path, _track(path, EGO), 0.3)
    body = parts[0]
    path = seen_path([body + [0.5 * k, 0, 0] for k in range(20)])
    assert _moves(path, _track(path, EGO), 0.3)


def test_what_is_flat_or_hardly_moves_is_no_actor():
    body = np.random.default_rng(1).uniform([8, 3, 0.3], [12, 5, 1.5], (200, 3))
    flat = body * [1, 1, 0.2]
    for points, step_m in ((flat, 0.5), (body, 0.04)):
        path = seen_path([points + [step_m * k, 0, 0] for k in range(20)])
        assert not _moves(path, _track(path, EGO), 0.3)


def test_an_object_moves_as_a_whole():
    xyz = np.random.default_rng(2).uniform([0, 0, 0.3], [2, 1, 1.5], (100, 3))
    for count, number in ((100, 1), (60, 1), (30, 0)):
        moving = np.arange(100) < count
        seen = Seen(xyz, np.zeros(100, int), xyz[:, 2], moving, ~moving)
        assert len(blobs_of(seen, seen.moving)) == number


def test_objects_apart_are_two_and_what_floats_or_is_low_is_none():
    xyz = np.random.default_rng(3).uniform([0, 0, 0.3], [2, 1, 1.5], (60, 3))
    both = np.concatenate([xyz, xyz + [3.5, 0, 0]])
    yes, zero = np.ones(len(both), bool), np.zeros(len(both), int)
    for height_m, number in ((both[:, 2], 2), (both[:, 2] + 1.5, 0), (0.3 * both[:, 2], 0)):
        assert len(blobs_of(Seen(both, zero, height_m, yes, yes), yes)) == number


def test_a_track_inside_of_a_longer_one_is_a_part_of_it():
    def along(x_m, count):
        poses = np.stack([geometry.pose_from_xyyaw(x_m + k, 0, 0) for k in range(count)])
        return Track("a", "automobile", (4.0, 1.8, 1.5), Trajectory(100_000 * np.arange(count), poses))

    whole, part, behind = along(0, 20), along(1.5, 8), along(-6, 8)
    assert _whole([whole, part, behind]) == [whole, behind]
    assert _whole([whole, whole]) == [whole, whole]


def test_an_object_at_the_seam_of_two_sweeps_is_taken_once():
    """It is measured at the end of one sweep and, at the same time, at the start of the next one."""
    sweeps = [[blob(t, 8 * t, 0.0)] for t in (0.0, 0.1, 0.2)] + [[blob(0.2, 1.6, 0.0)], [blob(0.3, 2.4, 0.0)]]
    first, *others = follow(sweeps)
    assert [each.t_us for each in first.blobs] == [0, 100_000, 200_000, 300_000]
    assert [len(other.blobs) for other in others] == [1]
