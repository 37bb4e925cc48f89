import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nurec_sim import geometry
from nurec_sim.reconstruct.lift.actors import emit, tracks_of, windows_of
from nurec_sim.reconstruct.lift.points import actors_of
from nurec_sim.reconstruct.lift.settings import LiftSettings, PointSettings
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


def opacity(window_t, t):
    t1, t2, t3 = window_t
    x = (t - t2) / (t3 - t2) if t > t2 else (t2 - t) / (t2 - t1)
    return np.exp(-(x**10))


@settings(max_examples=40, deadline=None)
@given(st.floats(1, 15), st.floats(-2, 2), st.floats(-0.6, 0.6))
def test_windows_cover_all_times_and_follow_the_path(speed, accel, yaw_rate):
    path = drive(max(speed, 2 * abs(accel) * 4), accel, yaw_rate)
    options = LiftSettings()
    windows = windows_of(actor(path), SPAN_US, options)
    for t in np.linspace(path.start_us, path.end_us, 60):
        strength = [opacity(w.t_us, t) for w in windows]
        assert 1 - np.prod(1 - 0.95 * np.array(strength)) > 0.75
        window = windows[int(np.argmax(strength))]
        position = [np.interp(t, window.t_us, window.position_m[:, axis]) for axis in range(3)]
        assert np.linalg.norm(position - path.at(int(t))[:3, 3]) <= options.window_position_m + 0.01
        turn = window.world_from_box[:3, :3].T @ path.at(int(t))[:3, :3]
        angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
        assert angle <= options.window_rotation_deg + 0.3


def test_straight_driving_needs_one_window():
    assert len(windows_of(actor(drive()), SPAN_US, LiftSettings())) == 1
    assert len(windows_of(actor(drive(yaw_rate=0.4)), SPAN_US, LiftSettings())) > 5


def test_standing_actors_stay_over_the_whole_clip():
    jitter = np.random.default_rng(0).normal(0, 0.03, (10, 2))
    poses = np.stack([geometry.pose_from_xyyaw(5 + x, 2 + y, 0.1, 0.8) for x, y in jitter])
    standing = actor(Trajectory(2_000_000 + 100_000 * np.arange(10), poses))
    assert standing.standing
    (window,) = windows_of(standing, SPAN_US, LiftSettings())
    assert all(opacity(window.t_us, t) > 0.8 for t in (*SPAN_US, 3_500_000))
    assert np.ptp(window.position_m, axis=0) == pytest.approx([0, 0, 0])


def test_a_far_label_that_jitters_stands_but_a_starting_car_does_not():
    poses = np.stack([geometry.pose_from_xyyaw(x, 0, 0) for x in (0, 0.5, -0.1, 0.1, 0, -0.4, 0.1, 0, 0.05)])
    assert actor(Trajectory(1_000_000 + 100_000 * np.arange(9), poses)).standing
    poses = np.stack([geometry.pose_from_xyyaw(x, 0, 0) for x in (0, 0, 0, 0, 0, 0.2, 0.5, 0.9, 1.4)])
    assert not actor(Trajectory(1_000_000 + 100_000 * np.arange(9), poses)).standing


def test_things_that_cannot_move_are_no_actors():
    assert actor(drive(), label="traffic_sign") is None


def test_emitted_gaussians_move_with_their_box():
    mover = actor(drive(yaw_rate=0.3))
    box = Gaussians.empty(3)
    box.mean_m[:] = [[2, 0, 0], [0, 1, 0], [0, 0, 0.7]]
    box.normal[:] = [0, 1, 0]
    windows = windows_of(mover, SPAN_US, LiftSettings())
    layer = emit(mover, box, windows)
    assert len(layer) == 3 * len(windows)
    assert (layer.track == mover.index).all()
    assert (np.diff(layer.knot_t_us, axis=1) > 0).all()
    for k in range(len(layer)):
        pose = mover.path.at(int(layer.knot_t_us[k, 1]))
        assert layer.gaussians.mean_m[k] == pytest.approx(pose[:3, :3] @ box.mean_m[k % 3] + pose[:3, 3], abs=1e-3)
        assert layer.gaussians.normal[k] == pytest.approx(pose[:3, :3] @ [0, 1, 0], abs=1e-3)
        assert np.array_equal(layer.knot_m[k, 1], layer.gaussians.mean_m[k])


def test_a_standing_actor_stays_to_be_hit_after_its_labels_end():
    clip = Log(Track("car", "automobile", (4.0, 1.8, 1.5), drive(speed=0.0, seconds=1.0)))
    (shown,) = tracks_of(clip, actors_of(clip, PointSettings()))
    assert (shown.path.start_us, shown.path.end_us) == SPAN_US
    assert np.array_equal(shown.path.at(SPAN_US[1]), clip.tracks[0].path.world_from_body[0])


def test_a_moving_actor_keeps_its_recorded_path():
    clip = Log(Track("car", "automobile", (4.0, 1.8, 1.5), drive()))
    assert tracks_of(clip, actors_of(clip, PointSettings())) == clip.tracks
