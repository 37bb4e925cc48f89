"""Mountings of cameras corrected by what two of them show: a part of the demo log, with one camera turned."""

import types

import numpy as np
import pytest
from misaligned import street, turned
from scipy.spatial.transform import Rotation

from nurec_sim import geometry, logs
from nurec_sim.errors import ClipError
from nurec_sim.logs.alignment import CAMERA_FACT, aligned_as, shared, with_aligned_sensors
from nurec_sim.logs.alignment.cameras import disagreement_px, moves_of, with_aligned_cameras
from nurec_sim.logs.alignment.shared import SharedFeatures, shared_features
from nurec_sim.logs.alignment.stored import with_mountings
from nurec_sim.scene.describe import _camera_alignment
from nurec_sim.types import Rig

FRONT, LEFT = "camera_front", "camera_front_left"
OFF_DEG = np.array([0.25, -0.3, 0.2])
SWEEPS = 3


@pytest.fixture(scope="module")
def exact() -> logs.Clip:
    return street(SWEEPS, FRONT, LEFT)


def with_turned_camera(clip: logs.Clip) -> logs.Clip:
    """The log whose calibration has the left camera, and its images, turned."""
    mounting = clip.rig.cameras[LEFT].rig_from_camera @ turned(OFF_DEG)
    wrong = with_mountings(clip, {LEFT: mounting}, {})
    del wrong.facts[CAMERA_FACT]
    return wrong


def between(clip: logs.Clip) -> np.ndarray:
    """The rotation from the left camera to the front one."""
    front, left = (clip.rig.cameras[name].rig_from_camera for name in (FRONT, LEFT))
    return (geometry.inverse(front) @ left)[:3, :3]


def apart_deg(clip: logs.Clip, other: logs.Clip) -> float:
    return float(np.degrees(Rotation.from_matrix(between(clip).T @ between(other)).magnitude()))


def test_a_camera_that_is_off_agrees_with_the_other_again(exact):
    wrong = with_turned_camera(exact)
    assert apart_deg(wrong, exact) == pytest.approx(np.linalg.norm(OFF_DEG), abs=1e-6)
    right = with_aligned_cameras(wrong)
    # In the narrow overlap a pitch of one camera moves features nearly as a roll does, and a shift as a yaw: what is
    # left is between them.
    assert apart_deg(right, exact) < 0.2
    before, after = right.facts[CAMERA_FACT]["apart_px"]
    assert before > 3 and after < 1.0 and CAMERA_FACT not in wrong.facts
    # Both cameras turn, by half each: which of them is off nobody can tell.
    turns = right.facts[CAMERA_FACT]["turn_deg"]
    assert set(turns) == {FRONT, LEFT} and np.linalg.norm(turns[FRONT]) == pytest.approx(
        0.5 * np.linalg.norm(OFF_DEG), rel=0.25
    )
    # Images move with their camera.
    for name in (FRONT, LEFT):
        mountings = [clip.rig.cameras[name].rig_from_camera for clip in (wrong, right)]
        poses = [clip.world_from_camera(name, 1)[0] for clip in (wrong, right)]
        assert geometry.inverse(poses[0]) @ poses[1] == pytest.approx(
            geometry.inverse(mountings[0]) @ mountings[1], abs=1e-9
        )
        moved = geometry.inverse(mountings[0]) @ mountings[1]
        assert moved[:3, 3] == pytest.approx(right.facts[CAMERA_FACT]["shift_m"][name], abs=1e-5)
        assert 1e-4 < np.linalg.norm(moved[:3, 3]) < 0.02, "nothing was shifted"
    assert with_aligned_cameras(right) is right


def test_logs_that_show_nothing_wrong_stay(exact):
    assert with_aligned_cameras(exact) is exact
    wrong = with_turned_camera(exact)
    assert with_aligned_cameras(wrong, cameras=[LEFT]) is wrong, "one camera"
    assert with_aligned_cameras(wrong, hold_out=range(SWEEPS)) is wrong, "no sweep"
    blind = wrong.replaced(rig=Rig(wrong.rig.cameras, {}), sweeps={})
    assert with_aligned_cameras(blind) is blind
    wrong.facts[CAMERA_FACT] = {}
    assert with_aligned_cameras(wrong) is wrong, "aligned already"


def test_held_out_images_are_not_read(exact, monkeypatch):
    wrong = with_turned_camera(exact)
    read = []
    monkeypatch.setattr(
        wrong, "image", lambda camera, index: read.append((camera, index)) or exact.image(camera, index)
    )
    shared_features(wrong, [FRONT, LEFT], (), {LEFT: [0, 2]})
    assert {index for camera, index in read if camera == LEFT} <= {1, 3} and any(camera == FRONT for camera, _ in read)


def test_images_of_other_times_are_not_compared(exact):
    """Of the left camera only the third image may be read, a quarter of a second or more after the first sweep."""
    assert exact.frame_count(LEFT) == 3
    assert len(shared_features(exact, [FRONT, LEFT], [1, 2], {LEFT: [2]})) > 0
    assert len(shared_features(exact, [FRONT, LEFT], [1, 2], {LEFT: [0, 1]})) == 0


def test_features_without_returns_beside_them_do_not_count(exact, monkeypatch):
    features = len(shared_features(exact, [FRONT, LEFT], (), {}))
    monkeypatch.setattr(shared, "SURFACE_PX", 6.0)
    assert 0 < len(shared_features(exact, [FRONT, LEFT], (), {})) < 0.5 * features


def test_pixels_of_features_count_from_the_corner_of_the_image():
    """A round spot in the middle of the pixel of column 60 and row 40."""
    rows, columns = np.indices((96, 128))
    spot = 200 * np.exp(-((columns - 60) ** 2 + (rows - 40) ** 2) / 18)
    ends = np.array([[30.0, 30.0], [100.0, 80.0]])
    view = shared._View(None, "", 0, np.eye(4), ends, np.ones(2, bool), spot.astype(np.uint8))
    points, _ = view.features(np.ones(2, bool))
    assert points[0] == pytest.approx([60.5, 40.5], abs=0.1)


def test_a_scene_says_how_its_log_was_aligned(exact):
    wrong = with_turned_camera(exact)
    right = with_aligned_sensors(wrong)
    scene = types.SimpleNamespace(id="street", ego=right.ego, rig=right.rig, provenance=dict(right.facts))
    again = aligned_as(wrong, scene)
    for name in (FRONT, LEFT):
        assert again.world_from_camera(name, 1) == pytest.approx(right.world_from_camera(name, 1), abs=1e-12)
    assert again.facts[CAMERA_FACT] == right.facts[CAMERA_FACT] and aligned_as(again, scene) is again
    for damaged in ("turned", {"turn_deg": 3}, {"turn_deg": {"other": [0, 0, 0]}}):
        scene = types.SimpleNamespace(id="street", ego=right.ego, rig=right.rig, provenance={CAMERA_FACT: damaged})
        with pytest.raises(ClipError, match="says camera_alignment of cameras that clip 'street' does not have"):
            aligned_as(wrong, scene)


def given_features(off_px: np.ndarray, by_depth: np.ndarray, group: np.ndarray | None = None) -> SharedFeatures:
    """Features of camera 0 in camera 1; turns about y and x move them along x and y, those of both cameras opposite."""
    n = len(off_px)
    by_mounting = np.zeros((n, 2, 2, 6))
    by_mounting[:, 0, :, 1], by_mounting[:, 1, :, 0] = [1000.0, -1000.0], [-1000.0, 1000.0]
    cameras = np.tile([0, 1], (n, 1))
    return SharedFeatures(np.zeros(n, int) if group is None else group, cameras, off_px, by_mounting, by_depth)


def relative(turns: np.ndarray) -> np.ndarray:
    """How far camera 1 turned against camera 0, milliradian; both turn alike far."""
    assert turns[0] == pytest.approx(-turns[1])
    return 1000 * (turns[1] - turns[0])[:3]


def test_what_is_near_tells_a_shift_from_a_turn():
    """Camera 1 is 6 cm too far left, and shows features 4 m away 15 px off, by 1000 px of focal length, 30 m away 2."""
    depth_m = np.repeat([4.0, 30.0], 60)
    off = np.column_stack([1000 * 0.06 / depth_m, np.zeros(120)])
    given = given_features(off, np.zeros((120, 2)), np.repeat([0, 1], 60))
    given.by_mounting[:, 0, :, 3] = np.outer(1000 / depth_m, [-1, 1])
    moves = moves_of(given, 2)
    assert moves[1, 3] == pytest.approx(0.03, rel=0.1) and moves[0, 3] == pytest.approx(-0.03, rel=0.1)
    assert np.abs(np.delete(moves, 3, axis=1)).max() < 1e-4 and disagreement_px(given, moves) < 0.5


def test_a_shifted_camera_is_as_derivatives_say(exact):
    """Moving both mountings by a little changes what is expected as ``by_mounting`` says."""
    before = shared_features(exact, [FRONT, LEFT], (), {})
    moves = np.array([[0, 5e-4, 0, 0.02, -0.01, 0.04], [5e-4, 0, 5e-4, -0.02, 0.02, -0.04]])
    moved = with_mountings(exact, {
        name: exact.rig.cameras[name].rig_from_camera @ geometry.pose(shared.rotation(move[:3]), move[3:])
        for name, move in zip((FRONT, LEFT), moves, strict=True)
    }, {})  # fmt: skip
    after = shared_features(moved, [FRONT, LEFT], (), {})
    assert len(after) == pytest.approx(len(before), rel=0.1)
    expected = before.off_px - np.einsum("nkci,nci->nk", before.by_mounting, moves[before.cameras])
    # Features are not in the same order; how far they are off, over all of them, is alike.
    for pair in ((0, 1), (1, 0)):
        old, new = ((each.cameras == pair).all(axis=1) for each in (before, after))
        changed = np.median(after.off_px[new], axis=0) - np.median(before.off_px[old], axis=0)
        assert changed == pytest.approx(
            np.median(expected[old], axis=0) - np.median(before.off_px[old], axis=0), abs=0.1
        )
        assert np.linalg.norm(changed) > 1


def test_a_few_wrong_matches_do_not_matter():
    """All others say 4 and 2 px, by 1000 px per radian."""
    off = np.tile([-4.0, 2.0], (60, 1))
    off[::5] = [25.0, -30.0]
    given = given_features(off, np.zeros((60, 2)))
    turns = moves_of(given, 2)
    assert relative(turns) == pytest.approx([2, 4, 0], rel=0.05)
    assert disagreement_px(given, turns) < 0.3


def test_what_a_wrong_depth_explains_tells_little():
    """Off by 20 px along the line on which a depth that is wrong by 10 % moves them."""
    off, along = np.tile([-20.0, 2.0], (60, 1)), np.tile([200.0, 0.0], (60, 1))
    # By exact depths the turn would be 20 mrad. Now 20 of 60 count, each with a noise of 20 px, beside the prior of
    # 5.2 mrad for each camera, 7.4 mrad or px for both: 20^2 / 20 of variance against 7.4^2, with Cauchy weights less.
    assert relative(moves_of(given_features(off, np.zeros((60, 2))), 2))[:2] == pytest.approx([2, 20], rel=0.05)
    turns = relative(moves_of(given_features(off, along), 2))
    assert turns[0] == pytest.approx(2, rel=0.05) and 7 < turns[1] < 17


def test_many_features_of_one_pair_of_images_count_as_few():
    """300 features of one pair say 1 px, 20 of another say 0: both count alike."""
    off = np.concatenate([np.tile([0.0, 1.0], (300, 1)), np.zeros((20, 2))])
    group = np.repeat([0, 1], [300, 20])
    assert relative(moves_of(given_features(off, np.zeros((320, 2)), group), 2))[0] == pytest.approx(0.5, rel=0.1)


def test_that_all_cameras_look_up_is_hardly_believed():
    """Only camera 1 is seen to be off: the other one turns, against it, by as much."""
    given = given_features(np.tile([0.0, 2.0], (60, 1)), np.zeros((60, 2)))
    given.by_mounting[:, :, 0] = 0
    turns = 1000 * moves_of(given, 2)
    assert turns[1, 0] == pytest.approx(2, rel=0.05) and turns[0, 0] == pytest.approx(-2, rel=0.15)
    given.by_mounting[:, 1, 1, 4], given.by_mounting[:, :, 1, :3] = 100.0, 0.0
    shifts = 100 * moves_of(given, 2)
    assert shifts[1, 4] == pytest.approx(2, rel=0.1) and shifts[0, 4] == pytest.approx(-2, rel=0.2)


def test_a_summary_of_a_scene_tells_it():
    assert _camera_alignment({"apart_px": [13.47, 1.66], "turn_deg": {}}) == [
        ("cameras aligned", "features that two share were 13.5 px off, and are 1.7 px")
    ]
    assert _camera_alignment(None) == _camera_alignment({"apart_px": [1.0]}) == []
