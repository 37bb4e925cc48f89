import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from nurec_sim import geometry, logs, sensors
from nurec_sim.errors import ClipError
from nurec_sim.logs.stored import encode_points

PACKS = {
    "kitti_raw_0009": (2, 51, 20),
    "kitti_raw_0002": (2, 10, 0),
    "ddad_6cam": (6, 2, 13),
    "ddad_3cam_static": (3, 3, 97),
    "nuscenes_6cam_1frame": (6, 1, 69),
}
HEIGHT_M = 0.9
EGO_FROM_CAMERA = geometry.pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([1.0, 0.1, 0.6]))
EGO_FROM_LIDAR = geometry.pose(geometry.rotation_from_yaw(-np.pi / 2 + 0.01), np.array([0.8, -0.3, 0.8]))


def tilted(x: float) -> np.ndarray:
    """A pose that no axis swap or sign error leaves alone."""
    c, s = np.cos(0.05), np.sin(0.05)
    return geometry.pose_from_xyyaw(x, 0.2 * x, 0.1 + 0.01 * x, z=1.0) @ geometry.pose(
        np.array([[1, 0, 0], [0, c, -s], [0, s, c]]), np.zeros(3)
    )


@pytest.fixture
def pack(tmp_path) -> Path:
    """A pack of two frames whose ego frame lies above the road and whose LiDAR looks along its y axis."""
    (tmp_path / "images").mkdir()
    (tmp_path / "lidar").mkdir()
    frames = []
    for index in range(2):
        cv2.imwrite(str(tmp_path / f"images/{index}.jpg"), np.full((40, 60, 3), 90, np.uint8))
        xyz = np.array([[0.0, 12, -1], [1, 15, 0], [-9, 0, 0], [3, 30, 1]])
        arrays = {"dxyz_mm": encode_points(xyz), "intensity": np.array([0, 50, 100, 100], np.uint8)}
        np.savez(tmp_path / f"lidar/{index}.npz", **arrays)
        ego, t = tilted(2.0 * index), 1.6e9 + 0.1 * index
        box = {"size_lwh": [4, 2, 1.5], "yaw_ego": 0.3, "center_ego": [10 - index, 2, 0], "track_id": 5, "type": "Van"}
        loose = {**box, "track_id": None, "type": "Pedestrian", "R_ego_box": tilted(3)[:3, :3].tolist()}
        frames.append(
            {
                "timestamp_s": t,
                "T_world_ego": ego.tolist(),
                "lidar": {
                    "file": f"lidar/{index}.npz",
                    "timestamp_s": t,
                    "motion_compensated": True,
                    "T_world_lidar": (ego @ EGO_FROM_LIDAR).tolist(),
                },
                "cameras": {
                    "cam": {
                        "file": f"images/{index}.jpg",
                        "timestamp_s": t + 0.01,
                        "T_world_cam": (ego @ EGO_FROM_CAMERA).tolist(),
                    }
                },
                "boxes": [box, loose] if index == 0 else [box, {**box, "track_id": 9, "type": "DontCare"}],
            }
        )
    calib = {
        "ground_z_in_ego_m": -HEIGHT_M,
        "lidar": {"model": "Velodyne VLP-16", "T_ego_lidar": EGO_FROM_LIDAR.tolist(), "intensity_scale": 100},
        "cameras": {
            "cam": {
                "width": 60,
                "height": 40,
                "K": [[50, 0, 29.5], [0, 51, 19.5], [0, 0, 1]],
                "T_ego_cam": EGO_FROM_CAMERA.tolist(),
            }
        },
    }
    meta = {"schema": "realdata-pack-1", "name": "made", "rate_hz": 10.0}
    for name, value in (("meta", meta), ("calib", calib), ("frames", {"frames": frames})):
        (tmp_path / f"{name}.json").write_text(json.dumps(value))
    return tmp_path


def test_the_rig_lies_on_the_ground_and_every_chain_agrees(pack):
    clip = logs.open_clip(pack)
    for index in range(2):
        ego = tilted(2.0 * index)
        t_us = int(clip.ego.t_us[index])
        assert t_us == 1_600_000_000_000_000 + 100_000 * index
        assert np.allclose(clip.ego.at(t_us), ego @ geometry.pose(np.eye(3), np.array([0, 0, -HEIGHT_M])))
        recorded = clip.world_from_camera("cam", index)
        assert np.allclose(recorded, ego @ EGO_FROM_CAMERA)
        assert np.allclose(clip.ego.at(t_us) @ clip.rig.cameras["cam"].rig_from_camera, recorded[0])
        sweep = clip.sweep("lidar", index)
        assert np.allclose(clip.ego.at(t_us) @ clip.rig.lidars["lidar"].rig_from_lidar, sweep.world_from_lidar)
        xyz = np.array([[0.0, 12, -1], [1, 15, 0], [-9, 0, 0], [3, 30, 1]])
        assert np.allclose(sweep.xyz_world_m, geometry.transform_points(ego @ EGO_FROM_LIDAR, xyz))
        assert np.allclose(clip.tracks[0].path.at(t_us)[:3, 3], ego @ [10 - index, 2, 0, 1] @ np.eye(4)[:, :3])


def test_the_lidars_x_axis_is_turned_forward(pack):
    clip = logs.open_clip(pack)
    assert clip.rig.lidars["lidar"].rig_from_lidar[0, 0] > 0.999
    assert np.allclose(clip.sweep("lidar", 0).xyz_m[0], [12, 0, -1])
    assert clip.sweep("lidar", 0).intensity.tolist() == [0, 0.5, 1, 1]
    assert len(clip.rig.lidars["lidar"].elevation_rad) == 16


def test_principal_points_move_to_corner_origin(pack):
    lens = logs.open_clip(pack).rig.cameras["cam"].lens
    assert (lens.cx_px, lens.cy_px, lens.fx_px, lens.fy_px) == (30, 20, 50, 51)


def test_boxes_become_tracks(pack):
    clip = logs.open_clip(pack)
    van, person = clip.tracks
    assert (van.id, van.label, van.size_m, van.controllable) == ("5", "automobile", (4, 2, 1.5), True)
    assert len(van.path.t_us) == 2
    assert np.allclose(van.path.world_from_body[0], tilted(0) @ geometry.pose_from_xyyaw(10, 2, 0.3))
    assert (person.label, len(person.path.t_us)) == ("person", 1)
    assert np.allclose(person.path.world_from_body[0, :3, :3], tilted(0)[:3, :3] @ tilted(3)[:3, :3])


def test_a_pack_that_starts_at_zero_opens(pack):
    file = pack / "frames.json"
    file.write_text(file.read_text().replace("1600000000.", "0."))
    clip = logs.open_clip(pack)
    assert clip.time_offset_us == 1_000_000
    assert clip.ego.t_us.tolist() == [1_000_000, 1_100_000]
    assert clip.camera_times_us("cam")[:, 0].tolist() == [1_010_000, 1_110_000]
    assert [record.t_us for record in clip.sweep_records("lidar")] == [1_000_000, 1_100_000]
    assert logs.check_clip(clip) == []


def test_exposures_of_zero_length_and_no_faults(pack):
    clip = logs.open_clip(pack)
    times = clip.camera_times_us("cam")
    assert np.array_equal(times[:, 0], times[:, 1]) and times[0, 0] == 1_600_000_000_010_000
    assert clip.span_us == (1_600_000_000_000_000, 1_600_000_000_110_001)
    assert logs.check_clip(clip) == []


@pytest.mark.parametrize(
    "name, old, new, text",
    [
        (
            "frames",
            '"track_id": null',
            '"track_id": 5',
            "frame 0: box 1: track '5' appears twice at 1600000000000000 us",
        ),
        ("frames", '"timestamp_s": 1600000000.1,', '"timestamp_s": 1600000000.0,', "frame 1: time goes back or stands"),
        ("frames", '"yaw_ego": 0.3', '"yaw_ego": "east"', "frame 0: box 0: 'yaw_ego' must be a finite number"),
        ("frames", '"motion_compensated"', '"compensated"', "frame 0: lidar: 'motion_compensated' is missing"),
        ("frames", '"T_world_cam"', '"pose"', "frame 0: camera 'cam': 'T_world_cam' is missing"),
        ("calib", "[0, 51, 19.5]", "[0, 51, -1e999]", "'K' must be finite"),
        (
            "calib",
            '"width"',
            '"model": "fisheye", "width"',
            "model 'fisheye' is unknown; packs have 'pinhole_rectified'",
        ),
        ("calib", '"width"', '"distortion": [0.1], "width"', r"a rectified camera has no distortion, got \[0.1\]"),
        ("meta", '"rate_hz": 10.0', '"rate_hz": "fast"', "'rate_hz' must be a finite number, got 'fast'"),
    ],
)
def test_wrong_fields_of_packs_are_named(pack, name, old, new, text):
    file = pack / f"{name}.json"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(ClipError, match=text):
        logs.open_clip(pack)


@pytest.mark.realdata
@pytest.mark.parametrize("name", list(PACKS))
def test_real_packs_open_and_are_sound(realdata, name):
    clip = logs.open_clip(realdata / name)
    cameras, frames, tracks = PACKS[name]
    assert (len(clip.rig.cameras), len(clip.tracks)) == (cameras, tracks)
    assert all(clip.frame_count(camera) == frames for camera in clip.rig.cameras)
    assert clip.sweep_count("lidar") == frames and clip.span_us[0] > 1_000_000
    sweep = clip.sweep("lidar", 0)
    assert 0 < np.median(sweep.intensity) < 1 and len(sweep.xyz_m) > 30_000
    assert clip.image(next(iter(clip.rig.cameras)), 0).std() > 20
    if frames <= 3:
        assert logs.check_clip(clip) == []


@pytest.mark.realdata
@pytest.mark.parametrize(
    "name, allowed_m", [("kitti_raw_0009", 0.05), ("nuscenes_6cam_1frame", 0.05), ("ddad_6cam", 0.2)]
)
def test_the_road_ahead_of_real_cars_is_at_height_zero(realdata, name, allowed_m):
    clip = logs.open_clip(realdata / name)
    sweep = clip.sweep("lidar", 0)
    rig = geometry.transform_points(geometry.inverse(clip.ego.at(sweep.t_us)), sweep.xyz_world_m)
    road = (np.abs(rig[:, 1]) < 2) & (rig[:, 0] > 4) & (rig[:, 0] < 15) & (rig[:, 2] < 0.5)
    assert road.sum() > 200 and abs(np.median(rig[road, 2])) < allowed_m


@pytest.mark.realdata
def test_compensating_kittis_turns_makes_sweeps_agree(realdata):
    """The same walls seen ten frames apart lie closer together than in the raw points."""
    from scipy.spatial import cKDTree

    clip = logs.open_clip(realdata / "kitti_raw_0009")
    first, later = clip.sweep("lidar", 10), clip.sweep("lidar", 20)
    records = clip.sweep_records("lidar")

    def raw(index: int) -> np.ndarray:
        arrays = clip.source.storage.read_arrays(records[index].file)
        xyz = np.cumsum(arrays["dxyz_mm"], axis=1, dtype=np.int64).T / 1000
        return geometry.transform_points(records[index].world_from_lidar, xyz)

    near = (np.linalg.norm(first.xyz_m, axis=1) < 25) & (first.xyz_m[:, 2] > -1) & (np.abs(first.xyz_m[:, 0]) > 5)

    def agreement(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.mean(cKDTree(b).query(a[near][::5])[0] < 0.1))

    assert agreement(first.xyz_world_m, later.xyz_world_m) > agreement(raw(10), raw(20)) + 0.02
    moved_m = np.linalg.norm(first.xyz_world_m - raw(10), axis=1)
    assert 0.4 < moved_m.max() < 0.7  # half a turn at 11 m/s


@pytest.mark.realdata
def test_lidar_points_fall_on_what_the_camera_sees(realdata):
    """Depth edges of the sweep lie on edges of the image: shifting the projection makes it worse."""
    clip = logs.open_clip(realdata / "kitti_raw_0009")
    camera = clip.rig.cameras["cam_left"]
    grey = cv2.cvtColor(clip.image("cam_left", 20), cv2.COLOR_RGB2GRAY).astype(np.float32)
    edges = cv2.GaussianBlur(np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0)), (0, 0), 1)
    points = geometry.transform_points(
        geometry.inverse(clip.world_from_camera("cam_left", 20)[0]), clip.sweep("lidar", 20).xyz_world_m
    )
    uv, valid = sensors.project(camera, points)
    range_m = np.linalg.norm(points, axis=1)
    # Neighbours in the file are neighbours in a row of the sweep: a jump in range is the border of something near.
    jump = np.zeros(len(points), bool)
    jump[1:] = range_m[1:] - range_m[:-1] > 2
    border = np.flatnonzero(jump) - 1

    def on_edges(shift_px: int) -> float:
        place = uv[border] + (shift_px, 0)
        seen = valid[border] & sensors.in_image(camera, place)
        columns, rows = np.floor(place[seen]).astype(int).T
        return float(edges[rows, columns].mean())

    best = max(range(-30, 31, 2), key=on_edges)
    assert abs(best) <= 4


@pytest.mark.realdata
@pytest.mark.parametrize("index", [0, 4, 9])
def test_points_as_fired_are_those_of_the_file_also_at_the_ends_of_the_log(realdata, index):
    """The first and the last sweep reach beyond the recorded poses; both ways extrapolate them alike."""
    clip = logs.open_clip(realdata / "kitti_raw_0002")
    with np.load(realdata / f"kitti_raw_0002/lidar/{index:04d}.npz") as stored:
        raw = np.cumsum(stored["dxyz_mm"], axis=1, dtype=np.int64).T / 1000
    fired, _ = logs.as_fired(clip, "lidar", clip.sweep("lidar", index))
    assert np.abs(fired - raw).max() < 0.002
