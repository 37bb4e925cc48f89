"""Sweeps aligned by the planes they share: a part of the demo log with known errors of beams, mounting and poses."""

import json
import types

import numpy as np
import pytest
from misaligned import ELEVATION_RAD, LIDAR, miscalibrated, shaken, street
from scipy.spatial.transform import Rotation

from nurec_sim import geometry, logs
from nurec_sim.errors import ClipError
from nurec_sim.logs.alignment import FACT, aligned_as, with_aligned_sweeps
from nurec_sim.logs.alignment.fit import errors_of
from nurec_sim.logs.alignment.followed import FollowedPoints
from nurec_sim.logs.alignment.planes import PlanePoints, plane_points
from nurec_sim.logs.alignment.stored import errors_from, plain
from nurec_sim.logs.beam_errors import BeamErrors
from nurec_sim.types import Rig, Trajectory

SWEEPS = 24


@pytest.fixture(scope="module")
def exact() -> logs.Clip:
    """26 m of the way to the middle of a turn."""
    return street(SWEEPS)


def step_m(clip: logs.Clip) -> float:
    """How far the road is higher or lower where it is seen from more than 15 m than where it is seen from nearer."""
    near, far = {}, {}
    for index in range(0, SWEEPS, 2):
        sweep = clip.sweep(LIDAR, index)
        car = geometry.inverse(clip.ego.at(sweep.t_us))
        local = geometry.transform_points(car, sweep.xyz_world_m)
        away = np.hypot(local[:, 0], local[:, 1])
        for seen, rows in ((near, away < 10), (far, (away > 15) & (away < 40))):
            for x, y, z in sweep.xyz_world_m[rows & (np.abs(local[:, 2]) < 0.15)]:
                seen.setdefault((int(x // 0.5), int(y // 0.5)), []).append(z)
    return float(np.median([abs(np.median(far[cell]) - np.median(near[cell])) for cell in near if cell in far]))


def test_errors_of_beams_move_points_along_the_meridian():
    errors = BeamErrors(np.radians([-20.0, 0.0]), np.radians([1.0, 0.0]))
    point = 10 * np.array([np.cos(np.radians(10)) * 0.6, np.cos(np.radians(10)) * 0.8, -np.sin(np.radians(10))])
    true = np.radians(10.5)
    assert errors.removed(point[None])[0] == pytest.approx(
        [10 * np.cos(true) * 0.6, 10 * np.cos(true) * 0.8, -10 * np.sin(true)]
    )
    assert errors.removed(np.array([[0.0, 0.0, 2.0]]))[0] == pytest.approx([0, 0, 2])


def test_beams_that_are_off_are_found_by_ground_seen_from_far_and_near(exact):
    wrong = miscalibrated(exact, 0.05)
    right = with_aligned_sweeps(wrong)
    assert step_m(exact) < 0.001 and step_m(wrong) > 0.02 and step_m(right) < 0.2 * step_m(wrong)
    # Neighbouring beams differ by what they were given; what all have in common may be the poses as well.
    at = np.radians(np.arange(-20, -3, 0.5))
    given = -wrong.source.given.error_rad
    found = right.sweep_records(LIDAR)[0].beam_errors
    steps = np.diff(np.interp(at, ELEVATION_RAD, given)), np.diff(np.interp(at, found.elevation_rad, found.error_rad))
    assert np.corrcoef(*steps)[0, 1] > 0.8
    before, after = right.facts[FACT]["apart_m"]
    assert after < 0.5 * before and FACT not in wrong.facts
    # Ranges are what the scanner measured, whatever its beams.
    ours, theirs = (np.linalg.norm(clip.sweep(LIDAR, 4).xyz_m, axis=1) for clip in (right, wrong))
    assert np.abs(ours - theirs).max() < 0.02


def test_poses_that_roll_and_pitch_are_levelled_with_all_that_was_seen_from_them(exact):
    wrong = shaken(exact)
    right = with_aligned_sweeps(wrong)
    times = np.array([record.t_us for record in exact.sweep_records(LIDAR)])
    tilt = []
    for clip in (wrong, right):
        off = geometry.inverse(exact.ego.at(times)) @ clip.ego.at(times)
        tilt.append(np.linalg.norm(Rotation.from_matrix(off[:, :3, :3]).as_rotvec()[:, :2], axis=1))
    assert np.median(tilt[1]) < 0.3 * np.median(tilt[0])
    # Boxes are where they were seen from the car.
    track = next(track for track in wrong.tracks if track.path.covers(int(times[8])))
    other = next(each for each in right.tracks if each.id == track.id)
    seen, moved, left = (
        geometry.inverse(clip.ego.at(int(times[8]))) @ each.path.at(int(times[8]))
        for clip, each in ((wrong, track), (right, other), (right, track))
    )
    assert np.abs(seen - moved).max() < 0.5 * np.abs(seen - left).max()


def test_what_is_held_out_is_not_read_and_moves_with_the_rest(exact):
    held = {3, 4, 5, 11}

    class Guarded:
        def sweep(self, lidar_id, index):
            assert index not in held, f"sweep {index} was read"
            return source.sweep(lidar_id, index)

    wrong = miscalibrated(exact)
    source, wrong.source = wrong.source, Guarded()
    right = with_aligned_sweeps(wrong, held)
    assert right.sweep_records(LIDAR)[4].beam_errors is right.sweep_records(LIDAR)[6].beam_errors is not None
    points = plane_points(wrong, held)
    assert not set(points.t_us[points.sweep]) & {exact.sweep_records(LIDAR)[index].t_us for index in held}


def test_what_is_exact_or_shows_nothing_stays_as_it_is(exact):
    assert with_aligned_sweeps(exact) is exact
    no_lidar = logs.Clip("dark", Rig({}, {}), exact.ego, {}, {}, exact.source)
    assert with_aligned_sweeps(no_lidar) is no_lidar
    alone = exact.replaced(sweeps={LIDAR: exact.sweep_records(LIDAR)[:1]})
    assert with_aligned_sweeps(alone) is alone
    assert with_aligned_sweeps(exact, range(1, SWEEPS)) is exact and with_aligned_sweeps(exact, range(SWEEPS)) is exact
    right = with_aligned_sweeps(miscalibrated(exact))
    assert with_aligned_sweeps(right) is right


def test_a_scene_says_how_its_log_was_aligned(exact):
    wrong = shaken(miscalibrated(exact, 0.05))
    right = with_aligned_sweeps(wrong)
    scene = types.SimpleNamespace(
        id="street", ego=right.ego, rig=right.rig, provenance={FACT: json.loads(json.dumps(right.facts[FACT]))}
    )
    again = aligned_as(wrong, scene)
    for index in (0, 7, SWEEPS - 1):
        ours, theirs = again.sweep(LIDAR, index), right.sweep(LIDAR, index)
        assert np.abs(ours.xyz_world_m - theirs.xyz_world_m).max() < 1e-3
    assert aligned_as(right, scene) is right
    assert aligned_as(wrong, types.SimpleNamespace(provenance={})) is wrong


@pytest.mark.parametrize(
    ("damaged", "says"),
    [
        ([], "of LiDARs that clip 'street' does not have"),
        ({"beams": {"other": {}}}, "of LiDARs that clip 'street' does not have"),
        ({"beams": {LIDAR: {"elevation_deg": [0, 1]}}}, "two lists of degrees"),
        ({"beams": {LIDAR: {"elevation_deg": [1, 0], "error_deg": [0, 0]}}}, "elevation_deg ascending"),
        ({"beams": {LIDAR: {"elevation_deg": [0, 1], "error_deg": [0, float("nan")]}}}, "finite degrees"),
    ],
)
def test_a_damaged_record_of_an_alignment_is_refused(exact, damaged, says):
    scene = types.SimpleNamespace(id="street", ego=exact.ego, rig=exact.rig, provenance={FACT: damaged})
    with pytest.raises(ClipError, match=says):
        aligned_as(exact, scene)


def test_errors_of_beams_survive_storage():
    error = np.zeros(len(ELEVATION_RAD))
    error[10:20] = np.radians(0.05)
    stored = plain(BeamErrors(ELEVATION_RAD, error))
    assert len(stored["error_deg"]) == 12
    again = errors_from(stored)
    assert np.interp(ELEVATION_RAD, again.elevation_rad, again.error_rad) == pytest.approx(error, abs=1e-7)


def test_alignment_of_a_real_drive_makes_its_sweeps_agree(realdata):
    clip = logs.open_clip(realdata / "kitti_raw_0002")
    before, after = with_aligned_sweeps(clip).facts[FACT]["apart_m"]
    assert after < 0.7 * before
    # The beams of sweeps that are not compensated are those at firing.
    points, record = plane_points(clip, set(range(1, clip.sweep_count("lidar")))), clip.sweep_records("lidar")[0]
    assert len(points) == 0 and not record.compensated
    points = plane_points(clip)
    fired, _ = logs.as_fired(clip, "lidar", clip.sweep("lidar", 0))
    place = {tuple(xyz): index for index, xyz in enumerate(clip.sweep("lidar", 0).xyz_world_m.tolist())}
    mine = np.flatnonzero(points.sweep == 0)[::50]
    assert np.ptp(points.at_us[mine]) > 80_000 and abs(np.median(points.at_us[mine]) - record.t_us) < 20_000
    theirs = fired[[place[tuple(xyz)] for xyz in points.xyz_m[mine].tolist()]]
    elevation = [np.degrees(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1]))) for p in (points.beam_m[mine], theirs)]
    assert np.median(np.abs(elevation[0] - elevation[1])) < 0.03


def test_a_car_that_heaves_within_a_sweep_is_levelled_at_each_time():
    """Squares of level ground on all sides, each seen in every sweep at the time when the LiDAR looks there."""
    random, sweeps, squares = np.random.default_rng(4), 12, 40
    bearing = np.linspace(-np.pi, np.pi, squares, endpoint=False)
    centre = np.column_stack([12 * np.cos(bearing), 12 * np.sin(bearing), np.zeros(squares)])
    sweep, plane = (each.ravel().repeat(20) for each in np.meshgrid(range(sweeps), range(squares), indexing="ij"))
    t_us = 100_000 * np.arange(1, sweeps + 1)
    at_us = t_us[sweep] + np.rint(50_000 * bearing[plane] / np.pi).astype(np.int64)

    def heave_m(times):
        return 0.02 * np.sin(2 * np.pi * times / 200_000)

    xyz = centre[plane] + np.column_stack([random.uniform(-0.2, 0.2, (len(plane), 2)), heave_m(at_us)])
    up, turns = np.tile([0.0, 0.0, 1.0], (len(plane), 1)), np.tile(np.eye(3), (sweeps, 1, 1))
    points = PlanePoints(np.zeros(sweeps, np.int64), t_us, turns, sweep, at_us, xyz, xyz, up, plane)
    ego = Trajectory(np.array([0, 2_000_000]), np.tile(np.eye(4), (2, 1, 1)))
    knots = np.arange(50_000, 1_250_001, 25_000)
    found = errors_of(points, FollowedPoints.concatenate([]), 1, knots, ego).shift_m[2:-2, 2]
    assert np.corrcoef(found, heave_m(knots)[2:-2])[0, 1] > 0.95
    assert 0.01 < np.abs(found).max() < 0.02  # the prior takes a part
