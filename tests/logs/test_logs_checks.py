import dataclasses
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny_clip

from nurec_sim import cli, geometry, logs
from nurec_sim.logs.checks import borders, ground, turned
from nurec_sim.logs.checks.boxes import check_boxes
from nurec_sim.logs.checks.calibration import check_calibration
from nurec_sim.logs.checks.camera_pairs import check_camera_pairs
from nurec_sim.logs.checks.ground import check_ground
from nurec_sim.logs.checks.sampling import sample_sweeps
from nurec_sim.types import Box, Rig, Track, Trajectory

REPO = Path(__file__).parents[2]
BODY = Box((1.4, 0.0, 0.75), (4.9, 1.9, 1.5))


@pytest.fixture(scope="module")
def spoil():
    """The benchmark's ways to spoil a log."""
    sys.path.insert(0, str(REPO / "benchmarks"))
    try:
        import inspect_faults

        yield inspect_faults
    finally:
        sys.path.remove(str(REPO / "benchmarks"))


@pytest.fixture(scope="module")
def demo() -> logs.Clip:
    return logs.open_clip(REPO / "scenarios" / "demo_clip.zip")


@pytest.fixture(scope="module")
def sweeps(demo):
    return sample_sweeps(demo)


@pytest.fixture(scope="module")
def two(sweeps):
    """Enough to judge a camera of this log by."""
    return sweeps[1:3]


def test_a_sound_log_fits_together(demo):
    measures = logs.measure_clip(demo)
    assert [fault for each in measures for fault in each.faults] == []
    found = {each.what: each.found for each in measures}
    assert list(found) == [
        "ground below the rear axle, LiDAR 'lidar_top'",
        "beams of LiDAR 'lidar_top'",
        *(f"LiDAR in camera {name!r}" for name in demo.rig.cameras),
        "cameras 'camera_front' and 'camera_front_left'",
        "cameras 'camera_front' and 'camera_front_right'",
        "boxes that hold LiDAR points",
    ]
    height = float(found["ground below the rear axle, LiDAR 'lidar_top'"].split("z = ")[1].split()[0])
    assert abs(height) < 0.05
    assert found["beams of LiDAR 'lidar_top'"].startswith("48 x 600, 100.0 % of the points have one of their own")
    for name in demo.rig.cameras:
        words = found[f"LiDAR in camera {name!r}"].split()
        # "fits at 18.8 standard errors, turned or inverted at most 2.7"
        assert float(words[2]) > 8 and float(words[2]) > 2 * float(words[-1])
    assert int(found["boxes that hold LiDAR points"].split("%")[0]) > 90


@pytest.mark.parametrize(
    "way, camera_id, said",
    [
        ("pose inverted", "camera_front", "if its pose is inverted (T_ego_cam takes points of the camera to the ego"),
        ("turned by 90 about its y", "camera_front_left", "if its pose is turned by 270 degrees about "),
        ("turned by 180 about its z", "camera_front_right", "if its pose is turned by 180 degrees about its z axis"),
        ("axes of the car (x forward, z up)", "camera_front", "if its pose is with its axes x, y, z taken for "),
        ("turned by 3 about its y", "camera_front", "if its pose is turned by -3 degrees about its y axis"),
    ],
)
def test_a_wrong_pose_of_a_camera_is_found_and_named(demo, two, spoil, way, camera_id, said):
    pose = spoil.CAMERAS[way](demo, demo.rig.cameras[camera_id].rig_from_camera)
    (row,) = check_calibration(spoil.with_camera(demo, camera_id, pose), two)
    (fault,) = row.faults
    assert fault.startswith(f"camera {camera_id!r}: borders in the LiDAR meet borders in the image clearly better")
    assert said in fault


def test_a_pose_inverted_in_the_logs_own_ego_frame_is_found(demo, two, spoil):
    """The log's ego frame lies 0.93 m above the road: inverting the pose in the rig frame would not undo it."""
    lifted = spoil.remade(demo, rig_from_log=geometry.pose(np.eye(3), np.array([0.0, 0.0, 0.93])))
    pose = spoil.CAMERAS["pose inverted"](lifted, demo.rig.cameras["camera_front"].rig_from_camera)
    (row,) = check_calibration(spoil.with_camera(lifted, "camera_front", pose), two)
    assert "if its pose is inverted" in row.faults[0]
    better = float(row.faults[0].split(": ")[2].split()[0])
    assert better > 10  # as good as the pose before it was inverted


def test_a_calibration_that_its_frames_contradict_is_found(demo, two, spoil):
    camera = demo.rig.cameras["camera_front"]
    moved = spoil.with_camera(demo, "camera_front", camera.rig_from_camera @ spoil.turn(1, 20))
    both = spoil.remade(moved, images={"camera_front": demo.image_records("camera_front")})
    (row,) = check_calibration(both, two)
    assert row.faults == (
        "camera 'camera_front': its frames' own poses lie 0.00 m and 20 degrees off those of the ego and the "
        "calibration; T_ego_cam in calib.json may be inverted",
    )


def test_dark_images_tell_nothing(demo, two, spoil, monkeypatch):
    dark = spoil.with_camera(demo, "camera_front", demo.rig.cameras["camera_front"].rig_from_camera)
    monkeypatch.setattr(dark, "image", lambda name, index: np.zeros((256, 448, 3), np.uint8))
    (row,) = check_calibration(dark, two)
    assert row.faults == () and row.found.startswith("cannot tell: fits at 0.0")


def test_a_log_without_lidar_has_nothing_to_compare(demo, spoil):
    blind = spoil.remade(demo, rig=Rig(demo.rig.cameras, {}), sweeps={})
    measures = logs.measure_clip(blind)
    assert [each.found for each in measures] == ["cannot tell: no sweep about the time of an image"] * 3


def apart_px(found: str) -> tuple[float, float]:
    """``the same points lie +0.41 px across and +0.08 px down apart ...``"""
    across, down = re.findall(r"([+-][0-9.]+) px", found)
    return float(across), float(down)


def test_cameras_with_exact_calibrations_agree_to_a_tenth_of_a_pixel(demo, sweeps):
    rows = check_camera_pairs(demo, sweeps)
    assert len(rows) == 2
    np.testing.assert_allclose([apart_px(row.found) for row in rows], 0.0, atol=0.1)
    assert not any(row.found.startswith("cannot tell") for row in rows)


def test_cameras_that_show_the_same_two_pixels_apart_are_found(demo, two, spoil, monkeypatch):
    """One camera twice; the second image is the first one moved by 2 pixels to the right and 1 down."""
    front, records = demo.rig.cameras["camera_front"], demo.image_records("camera_front")
    cameras = {"front": dataclasses.replace(front, id="front"), "again": dataclasses.replace(front, id="again")}
    same = spoil.remade(demo, rig=Rig(cameras, demo.rig.lidars), images=dict.fromkeys(cameras, records))
    moved = {"front": (0, 0), "again": (1, 2)}
    monkeypatch.setattr(same, "image", lambda name, k: np.roll(demo.image("camera_front", k), moved[name], (0, 1)))
    (row,) = check_camera_pairs(same, two)
    assert row.what == "cameras 'front' and 'again'" and row.faults == ()
    np.testing.assert_allclose(apart_px(row.found), (2.0, 1.0), atol=0.05)
    assert row.found.startswith("cannot tell why the same points lie +2.0")


def test_a_forgotten_ground_height_is_found(demo, spoil):
    high = spoil.with_ground(demo, 0.93)
    (row,) = check_ground(high, sample_sweeps(high))
    (fault,) = row.faults
    assert fault.startswith("LiDAR 'lidar_top': the ground below the rear axle lies at z = -0.9")
    assert "ground_z_in_ego_m in calib.json may be off by as much" in fault


def street(height_m: float, slope: tuple[float, float]) -> np.ndarray:
    """A plane with a wall on each side and a car's roof on it."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-10.0, 12.0, 0.25), np.arange(-5.0, 5.25, 0.25)))
    road = np.column_stack([x, y, height_m + slope[0] * x + slope[1] * y])
    wall = np.column_stack([x, np.where(y > 0, 5.5, -5.5), np.abs(y) / 2])
    roof = np.column_stack([x[::7] / 5 + 8, y[::7] / 5 + 3, np.full(len(x[::7]), 1.4)])
    return np.concatenate([road, wall, roof])


@pytest.mark.parametrize("height_m, slope", [(0.0, (0.0, 0.0)), (-0.93, (0.03, -0.02)), (0.4, (0.0, 0.12))])
def test_the_ground_is_measured(height_m, slope):
    found = ground.find_ground(street(height_m, slope), BODY)
    assert found is not None
    assert found.height_m == pytest.approx(height_m, abs=0.01)
    assert found.slope == pytest.approx(slope, abs=0.003)
    assert found.tilt_deg == pytest.approx(np.degrees(np.arctan(np.hypot(*slope))), abs=0.2)


def test_walls_and_ceilings_are_no_ground():
    points = street(0.0, (0.0, 0.0))
    assert ground.find_ground(points[points[:, 1] == 5.5], BODY) is None
    # A ceiling is larger, but the street lies below it.
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-10.0, 13.0, 0.25), np.arange(-5.9, 5.9, 0.25)))
    ceiling = np.column_stack([x, y, np.full(len(x), 2.5)])
    found = ground.find_ground(np.concatenate([points, ceiling]), BODY)
    assert found is not None and abs(found.height_m) < 0.01


def test_a_tilted_lidar_is_found(demo, spoil):
    tilted = geometry.pose(spoil.turn(0, 8)[:3, :3], np.zeros(3))
    lidars = {
        name: [spoil.dataclasses.replace(row, world_from_lidar=row.world_from_lidar @ tilted)
               for row in demo.sweep_records(name)]
        for name in demo.rig.lidars
    }  # fmt: skip
    clip = spoil.remade(demo, sweeps=lidars)
    (row,) = check_ground(clip, sample_sweeps(clip))
    (fault,) = row.faults
    degrees = float(fault.split("is tilted by ")[1].split()[0])
    assert 7 < degrees < 9 and "allowed are 6" in fault


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda pose, size, ego: (pose @ up(-size[2] / 2), size), "read half a height higher"),
        (lambda pose, size, ego: (pose @ up(size[2] / 2), size), "read half a height lower"),
        (lambda pose, size, ego: (pose, (size[1], size[0], size[2])), "read with length and width exchanged"),
        (lambda pose, size, ego: (geometry.inverse(ego) @ pose, size), "read as poses in the ego frame"),
        (lambda pose, size, ego: (ego @ pose, size), "read as poses in the world, to which the ego's"),
        (lambda pose, size, ego: (pose @ up(6.0), size), "in sight within 70 m hold no LiDAR points; their frame"),
    ],
)
def test_boxes_read_wrongly_are_found_and_named(demo, sweeps, spoil, change, said):
    tracks = []
    for track in demo.tracks:
        changed = [change(pose, track.size_m, demo.ego.at(int(t)))
                   for pose, t in zip(track.path.world_from_body, track.path.t_us, strict=True)]  # fmt: skip
        path = Trajectory(track.path.t_us, np.array([pose for pose, _ in changed]))
        tracks.append(Track(track.id, track.label, changed[0][1], path))
    (row,) = check_boxes(spoil.remade(demo, tracks=tracks), sweeps)
    (fault,) = row.faults
    assert said in fault


def up(metres: float) -> np.ndarray:
    return geometry.pose(np.eye(3), np.array([0.0, 0.0, metres]))


def test_few_boxes_tell_nothing(demo, sweeps, spoil):
    (row,) = check_boxes(spoil.remade(demo, tracks=demo.tracks[:0]), sweeps) or [None]
    assert row is None
    clip = logs.Clip(**{**vars_of(demo), "tracks": [parked(demo)]})
    (row,) = check_boxes(clip, sweeps[:1])
    assert row.faults == () and row.found == "cannot tell: 1 boxes in sight within 70 m"


def parked(demo: logs.Clip) -> Track:
    """A box over the road ahead where nothing stands: rays cross it."""
    pose = demo.ego.at(demo.ego.start_us) @ geometry.pose_from_xyyaw(10, 0, 0, z=1.0)
    return Track("ghost", "automobile", (4.0, 1.8, 2.0), Trajectory(demo.ego.t_us[:1], pose[None]))


def vars_of(clip: logs.Clip) -> dict:
    return {
        "id": clip.id, "rig": clip.rig, "ego": clip.ego, "road_map": None, "images": {}, "sweeps": {},
        "source": clip.source, "facts": {},
    }  # fmt: skip


def test_turns_that_leave_an_upright_camera_upright():
    names = [name for name, _ in turned.wrong_readings(tiny_clip.FORWARD, np.eye(4))]
    assert sorted(name for name in names if "its y" in name) == [
        f"turned by {angle} degrees about its y axis" for angle in (180, 270, 90)
    ]
    assert sum("car's z axis" in name for name in names) == 3 and len(names) == 6
    readings = dict(turned.wrong_readings(tiny_clip.FORWARD, np.eye(4)))
    # A camera that looks ahead, turned by 90 degrees about its y axis (down), looks to the right.
    assert np.allclose(readings["turned by 90 degrees about its y axis"][:3, 2], [0, -1, 0])
    assert not turned.is_upright(geometry.inverse(tiny_clip.FORWARD))
    assert len(list(turned._quarter_turns())) == 23


def test_pairs_of_points_with_and_without_a_border():
    """A wall at 20 m with a board at 10 m before its left half, seen from the origin, one row of beams."""
    azimuth = np.radians(np.arange(-10, 10, 0.5))
    distance = np.where(azimuth > 0, 10.0, 20.0)
    points = np.column_stack([distance * np.cos(azimuth), distance * np.sin(azimuth), 0.05 * distance])
    pairs = borders.find_pairs(points, None, np.zeros(3))
    ahead = np.flatnonzero(pairs.border)
    sides = azimuth[np.stack([pairs.first[ahead], pairs.second[ahead]])]
    assert len(ahead) > 0 and (sides.min(axis=0) <= 0).all() and (sides.max(axis=0) > 0).all()
    same = np.flatnonzero(~pairs.border)
    assert len(same) > 60 and (distance[pairs.first[same]] == distance[pairs.second[same]]).all()
    # Flat ground at a grazing angle has jumps too, which are no borders.
    level = points * (1, 1, 0)
    assert not borders.find_pairs(level, None, np.zeros(3)).border.any()
    # Paint: same range, other intensity.
    paint = np.where(azimuth < np.radians(-5), 0.9, 0.1)
    wall = azimuth <= 0
    painted = borders.find_pairs(points[wall], paint[wall], np.zeros(3))
    sides = azimuth[wall][np.stack([painted.first[painted.border], painted.second[painted.border]])]
    assert painted.border.any() and (sides.min(axis=0) < np.radians(-5)).all()


def test_inspect_says_what_fits_and_fails_on_what_does_not(tmp_path, capsys):
    path = tiny_clip.write(tmp_path / "clip")
    cli.main(["inspect", str(path)])
    text = capsys.readouterr().out
    assert "consistency" in text and "cannot tell" in text and text.endswith("no faults\n")


@pytest.mark.slow
@pytest.mark.realdata
@pytest.mark.parametrize("name", ["kitti_raw_0002", "ddad_6cam", "nuscenes_6cam_1frame"])
def test_real_packs_fit_together_until_they_are_spoilt(realdata, spoil, name):
    clip = logs.open_clip(realdata / name)
    sampled = sample_sweeps(clip)
    assert [fault for each in logs.measure_clip(clip) for fault in each.faults] == []
    camera_id, camera = list(clip.rig.cameras.items())[-1]
    pose = spoil.CAMERAS["pose inverted"](clip, camera.rig_from_camera)
    assert check_calibration(spoil.with_camera(clip, camera_id, pose), sampled)[0].faults
    high = spoil.with_ground(clip, 0.93)
    assert check_ground(high, sample_sweeps(high))[0].faults
    if clip.tracks:
        assert "half a height higher" in check_boxes(spoil.with_boxes(clip, -0.5), sampled)[0].faults[0]
