"""Poses refined by the LiDAR: the demo log with poses that drift, and a real drive whose GPS does."""

import json
from pathlib import Path

import numpy as np
import pytest
import tiny_clip

from nurec_sim import cli, geometry, logs
from nurec_sim.errors import ClipError
from nurec_sim.logs.moved import corrected
from nurec_sim.logs.odometry import agreement_m, refine_poses
from nurec_sim.logs.odometry.refine import _smoothed, _tridiagonal
from nurec_sim.logs.odometry.static_points import moving_tracks, static_points
from nurec_sim.types import Rig, Trajectory

LIDAR = "lidar_top"
SWEEPS = 24


@pytest.fixture(scope="module")
def exact() -> logs.Clip:
    """The first sweeps of the demo log, 26 m of the way to the middle of its turn, with its exact poses."""
    demo = logs.open_clip(Path(__file__).parents[2] / "scenarios" / "demo_clip.zip")
    sweeps = {LIDAR: demo.sweep_records(LIDAR)[:SWEEPS]}
    return logs.Clip("street", Rig({}, demo.rig.lidars), demo.ego, {}, sweeps, demo.source, tracks=demo.tracks)


def drifting(clip: logs.Clip, metres: float) -> logs.Clip:
    """The log with poses that drift to the left, and turn by 1 degree, until its last sweep."""
    times = np.linspace(clip.span_us[0], clip.sweep_records(LIDAR)[-1].t_us, 20).astype(np.int64)
    start = clip.ego.at(times[0])
    local = [geometry.pose_from_xyyaw(0, metres * share, np.radians(1) * share) for share in np.linspace(0, 1, 20)]
    return corrected(clip, Trajectory(times, start @ np.array(local) @ geometry.inverse(start)))


@pytest.mark.slow
def test_drift_is_undone_and_reported(exact):
    clip = drifting(exact, 0.5)
    times = np.array([record.t_us for record in exact.sweep_records(LIDAR)])
    refined, report = refine_poses(clip)
    # From the first pose on: where the whole path lies is a matter of the recorded poses.
    way, *ways = (geometry.inverse(each.ego.at(times)[0]) @ each.ego.at(times) for each in (exact, clip, refined))
    error = [np.linalg.norm((each - way)[:, :3, 3], axis=1) for each in ways]
    assert error[0][-1] > 0.5 and error[1].max() < 0.12
    assert np.linalg.norm((refined.ego.at(times) - clip.ego.at(times))[:, :3, 3], axis=1).max() < 0.6
    assert report.lost == 0 and report.sweeps == SWEEPS and report.residual_m < 0.05
    before, after = report.agreement_m
    assert after < 0.75 * before and after < agreement_m(exact, LIDAR) + 0.03
    assert [text for _, text in report.rows][0] == "24 of 24 of 'lidar_top'"
    assert refined.facts["poses"] == "refined by LiDAR odometry; recorded: as in the log" and "poses" not in clip.facts


def test_points_of_what_moves_and_of_the_car_are_left_out(exact):
    moving = moving_tracks(exact)
    names = {track.id for track in moving}
    assert {"lead", "vehicle_6", "pedestrian_0"} <= names and not any(name.startswith("parked") for name in names)
    sweep = exact.sweep(LIDAR, 3)
    lead = next(track for track in exact.tracks if track.id == "lead")
    everything, still = static_points(exact, LIDAR, 3, ()), static_points(exact, LIDAR, 3, moving)
    box_from_rig = geometry.inverse(lead.path.at(sweep.t_us)) @ exact.ego.at(sweep.t_us)

    def inside(points) -> int:
        return int(geometry.points_in_box(geometry.transform_points(box_from_rig, points), lead.size_m).sum())

    assert inside(everything) > 20 and inside(still) == 0 and len(still) < len(everything)
    taken = np.zeros(len(everything), bool)
    for track in moving:
        if track.path.covers(sweep.t_us):
            box_from_rig = geometry.inverse(track.path.at(sweep.t_us)) @ exact.ego.at(sweep.t_us)
            local = geometry.transform_points(box_from_rig, everything)
            taken |= geometry.points_in_box(local, track.size_m, 0.3)  # boxes grow by 0.3 m
    assert np.array_equal(still, everything[~taken])
    body = exact.rig.body
    assert not geometry.points_in_box(still - np.array(body.center_m), body.size_m).any()


def test_a_correction_moves_everything_that_was_seen(tmp_path):
    clip = logs.open_clip(tiny_clip.write(tmp_path / "tiny.zip"))
    turn = geometry.pose_from_xyyaw(3.0, -1.0, 0.2, z=0.5)
    moved = corrected(clip, Trajectory(np.array([clip.span_us[0]]), turn[None]))
    assert np.allclose(moved.ego.world_from_body, turn @ clip.ego.world_from_body)
    for name in clip.rig.cameras:
        assert np.allclose(moved.world_from_camera(name, 1), turn @ clip.world_from_camera(name, 1))
    ours, theirs = moved.sweep("top", 1), clip.sweep("top", 1)
    assert np.allclose(ours.world_from_lidar, turn @ theirs.world_from_lidar) and np.allclose(ours.xyz_m, theirs.xyz_m)
    for track, given in zip(moved.tracks, clip.tracks, strict=True):
        assert np.allclose(track.path.world_from_body, turn @ given.path.world_from_body)
    # One that begins in the middle: nothing before it changes from pose to pose, half of it half way.
    start, end = clip.ego.start_us, clip.ego.end_us
    ramp = corrected(clip, Trajectory(np.array([start, end]), np.stack([np.eye(4), geometry.pose_from_xyyaw(0, 2, 0)])))
    middle = (start + end) // 2
    assert np.allclose(ramp.ego.at(middle)[:3, 3] - clip.ego.at(middle)[:3, 3], [0, 1, 0], atol=1e-3)
    assert ramp.span_us == clip.span_us and ramp.path == clip.path


def test_smoothing_follows_the_lidar_for_metres_and_gps_for_kilometres():
    """GPS that jumps to the side is not followed; odometry that drifts by 1 % to the side is brought back."""
    t_us = np.arange(2001) * 100_000
    straight = np.tile(np.eye(4), (2001, 1, 1))
    straight[:, 0, 3] = np.arange(2001) * 1.0
    jumping = straight.copy()
    jumping[1000:1005, 1, 3] += 1.0
    # Half a second of a metre, out of the 50 m or more that count together.
    assert np.abs(_smoothed(t_us, jumping, straight)[:, 1, 3]).max() < 0.1
    leaving = straight.copy()
    leaving[:, 1, 3] = 0.01 * straight[:, 0, 3]  # 20 m after 2 km
    error = np.abs(_smoothed(t_us, straight, leaving)[:, 1, 3])
    assert error.max() < 4.0 and error[600:1400].max() < 1.0
    same = _smoothed(t_us, straight, straight)
    assert np.allclose(same, straight, atol=1e-9)


def test_roll_and_pitch_follow_the_imu():
    """Odometry that pitches by 0.5 degrees more and more, as wrong beam angles make it, climbs less."""
    t_us = np.arange(501) * 100_000
    recorded = np.tile(np.eye(4), (501, 1, 1))
    recorded[:, 0, 3] = np.arange(501)
    pitch = np.radians(0.5) * np.linspace(0, 1, 501)
    climbing = recorded.copy()
    climbing[:, 0, 0] = climbing[:, 2, 2] = np.cos(pitch)
    climbing[:, 0, 2], climbing[:, 2, 0] = -np.sin(pitch), np.sin(pitch)
    climbing[1:, 2, 3] = np.cumsum(np.sin(pitch))[:-1]
    smooth = _smoothed(t_us, recorded, climbing)
    assert climbing[-1, 2, 3] > 2 and np.abs(smooth[:, 2, 3]).max() < 0.3
    assert np.degrees(np.abs(smooth[:, 2, 0])).max() < 0.1


def test_the_smallest_sum_of_squares():
    random = np.random.default_rng(3)
    stiff, wanted = random.uniform(1, 5, 6), random.normal(size=(7, 2))
    steps = np.sqrt(stiff)[:, None] * np.diff(np.eye(7), axis=0)
    rows = np.concatenate([steps, np.sqrt(0.7) * np.eye(7)])
    target = np.concatenate([np.zeros((6, 2)), np.sqrt(0.7) * wanted])
    assert np.allclose(_tridiagonal(stiff, 0.7, wanted), np.linalg.lstsq(rows, target, rcond=None)[0])


def test_a_log_without_sweeps_cannot_be_refined(exact):
    bare = logs.Clip("bare", Rig({}, {}), exact.ego, {}, {}, exact.source)
    with pytest.raises(ClipError, match="poses cannot be refined: 'bare' has no LiDAR with two sweeps or more"):
        refine_poses(bare)


def test_the_command_says_how_well_it_went(tmp_path, capsys):
    path = tiny_clip.write(tmp_path / "tiny.zip")
    cli.main(["import-log", str(path), "--out", str(tmp_path / "out.zip"), "--poses", "refined"])
    said = capsys.readouterr().out
    assert "sweeps registered" in said and "not known, less than 22 m driven" in said
    assert logs.open_clip(tmp_path / "out.zip").facts["poses"].startswith("refined by LiDAR odometry")


@pytest.mark.realdata
@pytest.mark.slow
def test_surfaces_of_a_real_drive_agree_as_well_as_with_published_odometry(realdata):
    """The pack's poses are those of KISS-ICP; it keeps the recorded ones, 0.5 m off after 22 m."""
    path = realdata / "kitti_raw_0009"
    pack = logs.open_clip(path)
    frames = json.loads((path / "frames.json").read_text())["frames"]
    recorded, odometry = (np.array([f[key] for f in frames]) for key in ("T_world_ego_oxts", "T_world_ego"))
    clip = corrected(pack, Trajectory(pack.ego.t_us, recorded @ geometry.inverse(odometry)))
    refined, report = refine_poses(clip)
    assert report.lost == 0 and report.agreement_m[0] > 0.4
    assert report.agreement_m[1] < agreement_m(pack, "lidar") + 0.005
    paths = [geometry.inverse(each.ego.at(pack.ego.t_us)[0]) @ each.ego.at(pack.ego.t_us) for each in (refined, pack)]
    assert np.linalg.norm((paths[0] - paths[1])[:, :3, 3], axis=1).max() < 0.25
