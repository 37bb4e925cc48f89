"""Tracks that are off are corrected by the returns of all sweeps on their object; others stay as they are."""

import dataclasses

import numpy as np
import pytest
from reconstruct_street import Street

from nurec_sim import geometry
from nurec_sim.logs.selection import with_tracks
from nurec_sim.reconstruct import LiftSettings, PointSettings, ViewSettings, reconstruct
from nurec_sim.reconstruct.lift.points import actors_of
from nurec_sim.reconstruct.movers import registration, with_aligned_actors
from nurec_sim.reconstruct.movers.alignment import _corrected, _parts
from nurec_sim.reconstruct.movers.registration import Returns, corrections, disagreement, moved
from nurec_sim.types import Track, Trajectory

FRAMES = 12
SIGMA = np.array([0.15, 0.15, 0.05, np.radians(2.0)])
OFF = np.array([0.12, 0.12, 0.03, np.radians(1.5)])
SECONDS = 0.2 * np.arange(FRAMES)
SIZE = (4.4, 1.8, 1.5)
BOXES = {
    "lead": (SIZE, np.column_stack([12.0 + 6.0 * SECONDS, np.full(FRAMES, -2.8)])),
    "parked": (SIZE, np.array([14.0, 5.5])),
}


class Log(Street):
    """A street that notes which sweeps are read."""

    def __post_init__(self):
        super().__post_init__()
        self.read = []

    def sweep(self, lidar_id, index):
        self.read.append(index)
        return super().sweep(lidar_id, index)


def change(x, y, z, yaw):
    return geometry.pose_from_xyyaw(x, y, yaw, z)


def off_by(track, values):
    """The track with its poses moved by [t,4] in the frame of the box."""
    poses = track.path.world_from_body @ np.array([change(*row) for row in values])
    return dataclasses.replace(track, path=Trajectory(track.path.t_us, poses))


def errors(track, true):
    """Root mean square of a track's shift and turn from the true one, but for what is the same at all times."""
    apart = geometry.inverse(true.path.at(track.path.t_us)) @ track.path.world_from_body
    shift, turn = apart[:, :3, 3], np.arctan2(apart[:, 1, 0], apart[:, 0, 0])
    return np.sqrt(((shift - shift.mean(axis=0)) ** 2).sum(axis=1).mean()), np.std(turn)


@pytest.fixture(scope="module")
def street():
    return Log(frames=FRAMES, boxes=BOXES)


@pytest.fixture(scope="module")
def wrong(street):
    values = np.random.default_rng(3).normal(size=(FRAMES, 4)) * OFF
    return with_tracks(street, [off_by(street.tracks[0], values), street.tracks[1]])


def test_labels_that_are_off_are_corrected(street, wrong):
    log, changed = with_aligned_actors(wrong)
    shift, turn = errors(wrong.tracks[0], street.tracks[0])
    assert shift > 0.1 and turn > np.radians(0.9)
    better_shift, better_turn = errors(log.tracks[0], street.tracks[0])
    assert changed == 1 and better_shift < 0.2 * shift and better_turn < 0.2 * turn
    assert log.tracks[0].size_m == SIZE
    assert np.array_equal(log.tracks[0].path.t_us, street.t_us)


def test_returns_come_with_the_rays_that_found_them(street):
    """Of the car ahead the rear is seen, from the roof of the car behind it."""
    actors = [actor for actor in actors_of(street, PointSettings()) if actor.track.id == "lead"]
    _, seen = _parts(street, actors, "top", 3)[actors[0].index]
    xyz, ray = np.split(seen, 2, axis=1)
    assert len(xyz) > 20 and np.linalg.norm(ray, axis=1) == pytest.approx(1)
    eye = street.sweep("top", 3).world_from_lidar[:3, 3]
    eye = geometry.transform_points(geometry.inverse(actors[0].path.at(int(street.t_us[3]))), eye[None])
    expected = (xyz - eye) / np.linalg.norm(xyz - eye, axis=1, keepdims=True)
    assert np.abs(ray - expected).max() < 0.02 and ray[:, 0].min() > 0.9


def test_exact_labels_and_what_stands_stay(street):
    log, changed = with_aligned_actors(street)
    assert changed == 0 and log is street


def test_the_mean_of_all_labels_stays(street, wrong):
    log, _ = with_aligned_actors(wrong)
    given = geometry.inverse(street.tracks[0].path.world_from_body) @ wrong.tracks[0].path.world_from_body
    found = geometry.inverse(street.tracks[0].path.world_from_body) @ log.tracks[0].path.world_from_body
    assert np.abs((found - given)[:, :3, 3].mean(axis=0)).max() < 0.03


def test_sweeps_that_are_held_out_are_not_read_and_labels_between_follow(street, wrong):
    street.read.clear()
    log, changed = with_aligned_actors(wrong, hold_out=range(1, FRAMES, 4))
    assert changed == 1 and set(street.read) == set(range(FRAMES)) - set(range(1, FRAMES, 4))
    assert np.array_equal(log.tracks[0].path.t_us, street.t_us)
    shift, _ = errors(log.tracks[0], street.tracks[0])
    assert shift < 0.3 * errors(wrong.tracks[0], street.tracks[0])[0]


def test_labels_far_from_all_sweeps_that_show_the_object_stay(street, wrong):
    log, changed = with_aligned_actors(wrong, hold_out=range(4, FRAMES))
    before, after = wrong.tracks[0].path.world_from_body, log.tracks[0].path.world_from_body
    assert changed == 1 and np.array_equal(log.tracks[0].path.t_us, street.t_us)
    apart = np.abs(after - before).max(axis=(1, 2))
    # The last sweep that is read is the fourth, five frames are one second.
    assert apart[:8].min() > 1e-3 and apart[8:].max() < 1e-12


def test_a_found_box_holds_all_returns_on_its_object(street):
    """The box is too short, and lies farther ahead in the first half of the sweeps than in the second one."""
    half = np.zeros((FRAMES, 4))
    half[:, 0] = np.where(np.arange(FRAMES) < FRAMES // 2, 0.12, -0.12)
    track = dataclasses.replace(off_by(street.tracks[0], half), labelled=False, size_m=(4.1, 1.8, 1.5))
    log, changed = with_aligned_actors(with_tracks(street, [track]))
    (found,) = log.tracks
    assert changed == 1 and errors(found, street.tracks[0])[0] < 0.06
    true = street.tracks[0].path.world_from_body
    rear = np.array([[-2.2, y, z] for y in (-0.9, 0.9) for z in (-0.3, 0.74)])  # what the car behind it sees throughout
    for pose, box in zip(true, found.path.world_from_body, strict=True):
        assert geometry.points_in_box(transformed(box, pose, rear), found.size_m, 0.04).all()
    assert not geometry.points_in_box(
        transformed(track.path.world_from_body[0], true[0], rear), track.size_m, 0.04
    ).any()


def test_a_found_box_of_a_person_keeps_its_size(street):
    """What swings about a person is no part of a larger box, in which nothing is free space."""
    half = np.zeros((FRAMES, 4))
    half[:, 0] = np.where(np.arange(FRAMES) < FRAMES // 2, 0.12, -0.12)
    track = dataclasses.replace(off_by(street.tracks[0], half), label="person", labelled=False, size_m=(4.1, 1.8, 1.5))
    log, changed = with_aligned_actors(with_tracks(street, [track]))
    assert changed == 1 and log.tracks[0].size_m == track.size_m


def transformed(box, pose, points):
    """Points of the frame of ``pose`` in that of the box."""
    return geometry.transform_points(geometry.inverse(box) @ pose, points)


def walls(values):
    """Returns on two walls at right angles, another part of them in each sweep, as seen along labels that are off."""
    rng = np.random.default_rng(5)
    xyz, sweep = [], []
    for k, row in enumerate(values):
        u, z = rng.uniform(-1, 1, 60), rng.uniform(-0.5, 0.5, 60)
        points = np.concatenate([np.column_stack([u, 0 * u + 1, z]), np.column_stack([0 * u + 1, u, z])])
        # A label that is off by E shows the point x of the object at E^-1 x.
        xyz.append(geometry.transform_points(geometry.inverse(change(*row)), points))
        sweep.append(np.full(len(points), k))
    return seen_from((-10, -10, 0), 100_000 * np.arange(len(values)), np.concatenate(xyz), np.concatenate(sweep))


def seen_from(eye, t_us, xyz, sweep):
    ray = xyz - np.array(eye)
    return Returns(t_us, xyz, sweep, ray / np.linalg.norm(ray, axis=1, keepdims=True))


def test_corrections_undo_shifts_and_turns():
    values = np.array([[0.1, -0.05, 0, 0.02], [-0.1, 0.02, 0, -0.03], [0.05, 0.08, 0, 0.0], [-0.05, -0.05, 0, 0.01]])
    returns, poses = walls(values), np.array([change(*row) for row in values])
    found = corrections(returns, poses, SIGMA)
    together = poses @ geometry.inverse(np.array([change(*row) for row in found]))
    assert np.abs(together - together.mean(axis=0)).max() < 0.02
    assert disagreement(returns, found) < 0.1 * disagreement(returns, np.zeros((4, 4)))
    xyz = moved(returns, found).reshape(4, 2, 60, 3)
    assert np.ptp(xyz[:, 0, :, 1].mean(axis=1)) < 0.01 and np.ptp(xyz[:, 1, :, 0].mean(axis=1)) < 0.01


def test_labels_that_are_sure_stay():
    values = np.array([[0.1, -0.05, 0, 0.02], [-0.1, 0.02, 0, -0.03], [0.05, 0.08, 0, 0.0], [-0.05, -0.05, 0, 0.01]])
    poses = np.array([change(*row) for row in values])
    assert np.abs(corrections(walls(values), poses, 1e-4 * SIGMA)).max() < 0.01


def test_gradients_of_pairs_are_derivatives_of_half_their_squares():
    """By shift and turn of each of two sweeps; the planes turn with neither, and no pair is an outlier."""
    rng = np.random.default_rng(4)
    xyz, normal, flat = rng.normal(size=(6, 3)), rng.normal(size=(6, 3)), rng.uniform(0.2, 1, 6)
    sweep, near = np.array([0, 0, 0, 1, 1, 1]), np.array([[3, 1], [4, -1], [5, 4], [0, 2], [1, -1], [2, 4]])

    def cost(values):
        at = moved(Returns(np.arange(2), xyz, sweep, 0 * xyz), values.reshape(2, 4))
        pairs = [(i, j) for i, row in enumerate(near) for j in row if j >= 0 and sweep[i] != sweep[j]]
        return sum(flat[j] * (normal[j] @ (at[i] - at[j])) ** 2 / 2 for i, j in pairs)

    information, gradient = np.zeros((8, 8)), np.zeros(8)
    registration._add_pairs(near, xyz, np.zeros((6, 3)), normal, flat, sweep, 1e6, information, gradient)
    steps = 1e-5 * np.eye(8)
    assert gradient == pytest.approx([(cost(d) - cost(-d)) / 2e-5 for d in steps], abs=1e-6)
    # Second derivatives by shifts are exact: residuals are linear in them.
    shifts = [0, 1, 2, 4, 5, 6]
    steps = 1e-3 * np.eye(8)[shifts]
    second = [[(cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / 4e-6 for b in steps] for a in steps]
    assert information[np.ix_(shifts, shifts)] == pytest.approx(np.array(second), abs=1e-5)


def test_rows_of_few_beams_are_not_pulled_onto_each_other():
    """The bent rear of a car 10 m ahead, by two beams that meet it 0.1 m higher in every other sweep."""
    xyz, sweep, y = [], [], np.linspace(-0.8, 0.8, 40)
    for k in range(8):
        for down_deg in (3.0, 5.0):
            x = 10.0 + 0.3 * y**2
            z = 1.8 - x * np.tan(np.radians(down_deg)) + 0.1 * (k % 2)
            xyz.append(np.column_stack([x, y, z]))
            sweep.append(np.full(len(y), k))
    returns = seen_from((0, 0, 1.8), 100_000 * np.arange(8), np.concatenate(xyz), np.concatenate(sweep))
    found = corrections(returns, np.tile(np.eye(4), (8, 1, 1)), SIGMA)
    assert np.abs(found[:, 2]).max() < 0.005


@pytest.mark.parametrize(("labelled", "changed"), [(True, False), (False, True)])
def test_labels_that_are_exact_but_for_centimetres_stay(labelled, changed):
    off = np.tile([0.02, -0.02, 0, np.radians(0.3)], (12, 1)) * np.array([1.0, -1.0] * 6)[:, None]
    seen = walls(off)
    parts = [(int(t), np.concatenate([seen.xyz_m, seen.ray], axis=1)[seen.sweep == k]) for k, t in enumerate(seen.t_us)]
    path = Trajectory(seen.t_us, np.array([change(*row) for row in off]))
    track = Track("1", "automobile", SIZE, path, labelled=labelled)
    assert (_corrected(track, parts) is not None) == changed
    twice = walls(2.5 * off)
    parts = [(t, np.concatenate([twice.xyz_m, twice.ray], axis=1)[twice.sweep == k]) for k, (t, _) in enumerate(parts)]
    path = Trajectory(seen.t_us, np.array([change(*row) for row in 2.5 * off]))
    assert _corrected(dataclasses.replace(track, path=path), parts) is not None


@pytest.mark.parametrize(("up_m", "stays"), [(0.045, True), (0.06, False)])
def test_labels_of_exact_place_keep_their_height(up_m, stays):
    """Corrections of 45 mm of height are not believed where nothing else is off."""
    off = np.zeros((12, 4))
    off[:, 2] = up_m * (-1.0) ** np.arange(12)
    seen = walls(off)
    track = Track(
        "1", "automobile", SIZE, Trajectory(seen.t_us, np.array([change(*row) for row in off])), labelled=True
    )
    parts = [(int(t), np.concatenate([seen.xyz_m, seen.ray], axis=1)[seen.sweep == k]) for k, t in enumerate(seen.t_us)]
    assert (_corrected(track, parts) is None) == stays


def test_where_surfaces_do_not_tell_the_motion_is_steady():
    """Along one wall nothing tells the shift but that speed does not jump: labels zigzag by 0.2 m at 10 Hz, 80 m/s2."""
    zigzag = np.zeros((9, 4))
    zigzag[:, 0] = 0.1 * (-1.0) ** np.arange(9)
    returns = walls(zigzag)
    wall = returns.xyz_m[:, 1] > 0.99
    returns = Returns(returns.t_us, returns.xyz_m[wall], returns.sweep[wall], returns.ray[wall])
    poses = np.array([change(*row) for row in zigzag])
    found = poses @ geometry.inverse(np.array([change(*row) for row in corrections(returns, poses, SIGMA)]))
    assert np.abs(np.diff(found[:, 0, 3], 2)).max() < 0.05


def test_long_tracks_are_corrected_in_parts(monkeypatch):
    values = np.random.default_rng(2).normal(size=(7, 4)) * OFF * (1, 1, 0, 1)
    poses, whole = np.tile(np.eye(4), (7, 1, 1)), walls(values)
    monkeypatch.setattr(registration, "MOST_TIMES", 4)
    found = corrections(whole, poses, SIGMA)
    first = whole.sweep < 4
    part = Returns(whole.t_us[:4], whole.xyz_m[first], whole.sweep[first], whole.ray[first])
    alone = corrections(part, poses[:4], SIGMA)
    rest = Returns(whole.t_us[4:], whole.xyz_m[~first], whole.sweep[~first] - 4, whole.ray[~first])
    assert np.array_equal(found, np.concatenate([alone, corrections(rest, poses[4:], SIGMA)]))


def test_a_part_without_returns_stays(monkeypatch):
    """Labels at a high rate go on for a second after the last sweep."""
    seen = walls(np.random.default_rng(2).normal(size=(4, 4)) * OFF * (1, 1, 0, 1))
    times = np.append(seen.t_us, seen.t_us[-1] + 5_000 * np.arange(1, 5))
    monkeypatch.setattr(registration, "MOST_TIMES", 4)
    found = corrections(Returns(times, seen.xyz_m, seen.sweep, seen.ray), np.tile(np.eye(4), (8, 1, 1)), SIGMA)
    assert np.abs(found[:4]).max() > 0.01 and not found[4:].any()


def test_a_reconstruction_has_the_corrected_tracks_unless_told_otherwise(street, wrong):
    small = LiftSettings(views=ViewSettings(width_px=96, levels=8, max_views=3), sky_px=32)
    scene = reconstruct(wrong, "lift", settings=small)
    assert scene.provenance["aligned_tracks"] == 1
    assert errors(scene.tracks[0], street.tracks[0])[0] < 0.03
    scene = reconstruct(wrong, "lift", settings=small, align_actors=False)
    assert "aligned_tracks" not in scene.provenance
    assert np.array_equal(scene.tracks[0].path.world_from_body, wrong.tracks[0].path.world_from_body)


def test_a_track_lasts_as_long_as_it_was_labelled(street, wrong):
    """Labels 40 ms before the sweeps, and one after the last of them."""
    path = wrong.tracks[0].path
    times = np.append(path.t_us - 40_000, path.end_us + 40_000)
    steps = -6.0 * 0.04 * np.append(np.ones(FRAMES), -1.0)
    poses = path.at(np.append(path.t_us, path.end_us))
    poses[:, 0, 3] += steps
    log, changed = with_aligned_actors(
        with_tracks(street, [dataclasses.replace(wrong.tracks[0], path=Trajectory(times, poses))])
    )
    assert changed == 1
    expected = np.concatenate([times[:1], path.t_us, times[-1:]])  # the sweeps, and both ends
    assert np.array_equal(log.tracks[0].path.t_us, expected)


def test_a_track_stays_if_no_two_sweeps_show_the_same_part(wrong):
    rng = np.random.default_rng(1)
    # As seen from behind.
    rear, front = (
        np.column_stack([np.full(40, x), *rng.uniform(-0.7, 0.7, (2, 40)), np.tile([1.0, 0, 0], (40, 1))])
        for x in (-2.0, 2.0)
    )
    track = wrong.tracks[0]
    times = track.path.t_us.tolist()
    assert _corrected(track, [(times[2], rear), (times[3], rear + (0.1, 0, 0, 0, 0, 0))]) is not None
    assert _corrected(track, [(times[2], rear), (times[3], front)]) is None
