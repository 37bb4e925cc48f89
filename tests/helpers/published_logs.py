"""The demo log in the layouts of public data sets, as their publishers write them."""

from pathlib import Path

import cv2
import numpy as np

from nurec_sim import geometry, logs

DEMO = Path(__file__).parents[2] / "scenarios" / "demo_clip.zip"
INDICES = (4, 5, 6, 12, 18)
"""Frames of the demo log that are written."""
EPOCH_US = 1_317_042_164_000_000
"""2011-09-26 13:02:44, added to the times of the demo log."""
LIDAR = "lidar_top"


def demo() -> logs.Clip:
    return logs.open_clip(DEMO)


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", np.ascontiguousarray(image[:, :, ::-1]), [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def jpeg(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", np.ascontiguousarray(image[:, :, ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()


def put(path: Path, data: bytes | str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data if isinstance(data, bytes) else data.encode())


def as_measured(clip: logs.Clip, index: int) -> np.ndarray:
    """Points of a sweep in the frame of the LiDAR at the time of each, undoing its motion compensation."""
    sweep = clip.sweep(LIDAR, index)
    times, place = np.unique(sweep.point_t_us, return_inverse=True)
    then = geometry.inverse(clip.ego.at(times) @ clip.rig.lidars[LIDAR].rig_from_lidar)[place]
    world = sweep.xyz_world_m
    return np.einsum("nij,nj->ni", then[:, :3, :3], world) + then[:, :3, 3]


# -------------------------------------------------------------------------------------------------------------- KITTI

DAY, DRIVE = "2011_09_26", "2011_09_26_drive_0042_sync"
RIG_FROM_IMU = geometry.pose(np.eye(3), np.array([-0.05, 0.32, 0.93]))
BASELINE_M = 0.06
RECTIFYING = geometry.pose(cv2.Rodrigues(np.array([0.01, -0.02, 0.015]))[0], np.zeros(3))
LATITUDE, LONGITUDE = 49.0, 8.4


def stamp(t_us: int) -> str:
    day, clock = str(np.datetime64(EPOCH_US + t_us, "us")).split("T")
    return f"{day} {clock}000"


def numbers(values) -> str:
    return " ".join(f"{value:.12e}" for value in np.asarray(values, np.float64).reshape(-1))


def rectified_pose(clip: logs.Clip) -> np.ndarray:
    """Pose in the rig of the rectified frame of camera 0, left of which the demo's camera is by the baseline."""
    return clip.rig.cameras["camera_front"].rig_from_camera @ geometry.pose(np.eye(3), np.array([BASELINE_M, 0, 0]))


def projection(clip: logs.Clip) -> np.ndarray:
    lens = clip.rig.cameras["camera_front"].lens
    k = np.array([[lens.fx_px, 0, lens.cx_px - 0.5], [0, lens.fy_px, lens.cy_px - 0.5], [0, 0, 1]])
    return k @ np.array([[1, 0, 0, BASELINE_M], [0, 1, 0, 0], [0, 0, 1, 0]])


def kitti_raw(root: Path, clip: logs.Clip, invert: bool = False) -> Path:
    """A drive of KITTI raw with the demo's front camera as ``image_02``; the second of its frames has no sweep.

    ``invert``: the calibration of the LiDAR and the cameras is the inverse of what it should be.
    """
    folder, camera = root / DAY / DRIVE, clip.rig.cameras["camera_front"]
    rig_from_velo = clip.rig.lidars[LIDAR].rig_from_lidar
    velo_from_imu = geometry.inverse(rig_from_velo) @ RIG_FROM_IMU
    camera0_from_velo = geometry.inverse(rectified_pose(clip) @ RECTIFYING) @ rig_from_velo
    if invert:
        camera0_from_velo = geometry.inverse(camera0_from_velo)
    for name, pose in (("imu_to_velo", velo_from_imu), ("velo_to_cam", camera0_from_velo)):
        text = f"calib_time: 25-May-2012 16:47:16\nR: {numbers(pose[:3, :3])}\nT: {numbers(pose[:3, 3])}\n"
        put(folder.parent / f"calib_{name}.txt", text)
    lines = [
        "calib_time: 09-Jan-2012 13:57:47",
        f"R_rect_00: {numbers(RECTIFYING[:3, :3])}",
        f"S_rect_02: {numbers([camera.width_px, camera.height_px])}",
        f"P_rect_02: {numbers(projection(clip))}",
    ]
    put(folder.parent / "calib_cam_to_cam.txt", "\n".join(lines) + "\n")
    stamps: dict[str, list[str]] = {name: [] for name in ("image", "start", "middle", "end", "oxts")}
    for number, index in enumerate(INDICES):
        record, frame = clip.sweep_records(LIDAR)[index], clip.image_records("camera_front")[index]
        put(folder / f"image_02/data/{number:010d}.png", png(clip.image("camera_front", index)))
        points = np.column_stack([as_measured(clip, index), clip.sweep(LIDAR, index).intensity])
        if number != 1:
            put(folder / f"velodyne_points/data/{number:010d}.bin", points.astype("<f4").tobytes())
        times = {"image": frame.start_us, "start": record.start_us, "middle": record.t_us, "end": record.end_us}
        for name, t_us in {**times, "oxts": record.t_us + 7_000}.items():
            stamps[name].append(stamp(t_us))
        pose = clip.ego.at(record.t_us + 7_000) @ RIG_FROM_IMU
        # Small distances around the first place: metres east and north as degrees.
        scale = np.cos(np.radians(LATITUDE)) * 6378137.0
        north = scale * np.log(np.tan(np.pi / 4 + np.radians(LATITUDE) / 2)) + pose[1, 3]
        latitude = np.degrees(2 * np.arctan(np.exp(north / scale)) - np.pi / 2)
        longitude = LONGITUDE + np.degrees(pose[0, 3] / scale)
        values = [f"{value:.13f}" for value in (latitude, longitude, 116 + pose[2, 3], 0, 0, geometry.yaw_of(pose))]
        put(folder / f"oxts/data/{number:010d}.txt", " ".join([*values, *["0"] * 24]) + "\n")
    places = {
        "image": "image_02/timestamps", "start": "velodyne_points/timestamps_start",
        "middle": "velodyne_points/timestamps", "end": "velodyne_points/timestamps_end", "oxts": "oxts/timestamps",
    }  # fmt: skip
    for name, place in places.items():
        put(folder / f"{place}.txt", "\n".join(stamps[name]) + "\n")
    put(folder / "tracklet_labels.xml", tracklets(clip))
    return folder


def tracklets(clip: logs.Clip) -> str:
    """All tracks from the second frame on, as a Boost archive."""
    items = []
    for track in clip.tracks:
        poses = []
        for index in INDICES[1:]:
            t_us = clip.sweep_records(LIDAR)[index].t_us
            pose = geometry.inverse(clip.ego.at(t_us) @ clip.rig.lidars[LIDAR].rig_from_lidar) @ track.path.at(t_us)
            x, y, z = pose[:3, 3] - [0, 0, track.size_m[2] / 2]
            place = f"<tx>{x:.9f}</tx><ty>{y:.9f}</ty><tz>{z:.9f}</tz>"
            poses.append(
                f"<item>{place}<rx>0</rx><ry>0</ry><rz>{geometry.yaw_of(pose):.9f}</rz><state>2</state></item>"
            )
        length, width, height = track.size_m
        kind = {"automobile": "Car", "person": "Pedestrian"}[track.label]
        size = f"<h>{height}</h><w>{width}</w><l>{length}</l><first_frame>1</first_frame>"
        count = f"<count>{len(poses)}</count><item_version>2</item_version>"
        items.append(f"<item><objectType>{kind}</objectType>{size}<poses>{count}{''.join(poses)}</poses></item>")
    return (
        '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n<!DOCTYPE boost_serialization>\n'
        '<boost_serialization signature="serialization::archive" version="9"><tracklets class_id="0">'
        f"<count>{len(items)}</count><item_version>1</item_version>{''.join(items)}</tracklets></boost_serialization>"
    )


def kitti_odometry(root: Path, clip: logs.Clip) -> Path:
    """A sequence of KITTI odometry with the demo's front camera as ``image_2``."""
    folder, rectified = root / "sequences" / "07", rectified_pose(clip)
    transform = geometry.inverse(rectified) @ clip.rig.lidars[LIDAR].rig_from_lidar
    put(folder / "calib.txt", f"P2: {numbers(projection(clip))}\nTr: {numbers(transform[:3])}\n")
    times, poses = [], []
    world_from_rectified = [clip.ego.at(clip.sweep_records(LIDAR)[index].t_us) @ rectified for index in INDICES]
    for number, index in enumerate(INDICES):
        put(folder / f"image_2/{number:06d}.png", png(clip.image("camera_front", index)))
        sweep = clip.sweep(LIDAR, index)
        put(
            folder / f"velodyne/{number:06d}.bin",
            np.column_stack([sweep.xyz_m, sweep.intensity]).astype("<f4").tobytes(),
        )
        times.append(f"{(sweep.t_us - clip.sweep_records(LIDAR)[INDICES[0]].t_us) / 1e6:e}")
        poses.append(numbers((geometry.inverse(world_from_rectified[0]) @ world_from_rectified[number])[:3]))
    put(folder / "times.txt", "\n".join(times) + "\n")
    put(root / "poses" / "07.txt", "\n".join(poses) + "\n")
    return folder
