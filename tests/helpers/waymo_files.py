"""Writes a clip in the layout of Waymo's Perception data set v2."""

from pathlib import Path

import cv2
import numpy as np
import polars
from ncore_files import measured
from scipy.spatial.transform import Rotation

from nurec_sim import geometry, logs, sensors
from nurec_sim.types import LidarModel, Shutter

CAMERAS, TOP = {"front": 1, "front_left": 2, "front_right": 3}, 1
KINDS = {"automobile": 1, "person": 2, "rider": 4}
HALF_US, TURN_US, SHUTTER_S = 50_000, 100_000, 0.002
DIRECTIONS = [None, *list(Shutter)[1:]]
# Takes x forward, y left, z up to x right, y down, z forward.
CAMERA_FROM_THEIRS = np.array([[0, -1.0, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def write_waymo(folder: Path, clip: logs.Clip, pose_of=np.asarray, ranges=None) -> Path:
    """Write a segment of the clip's name; returns ``folder``.

    Args:
        folder: where to.
        clip: what to write; its cameras are called as theirs or in the same order, and its LiDAR becomes the top one.
        pose_of: applied to the mounting pose of every camera (the inverse is wrong on purpose).
        ranges: of each sweep, a range image [rows, columns]; by default the returns of the sweep.
    """
    (lidar_id, lidar), starts = (
        *clip.rig.lidars.items(),
        clip.sweep_times_us(next(iter(clip.rig.lidars)))[:, 0].tolist(),
    )
    poses = {start: clip.ego.at(start + HALF_US) for start in starts}
    images = ranges or [returns(clip, lidar_id, index) for index in range(len(starts))]
    save(folder, clip.id, "vehicle_pose", "VehiclePose", {"key.frame_timestamp_micros": starts},
         {"world_from_vehicle.transform": matrices(poses.values())})  # fmt: skip
    number_of = {name: CAMERAS.get(name, index + 1) for index, name in enumerate(clip.rig.cameras)}
    write_cameras(folder, clip, number_of, starts, pose_of)
    save(folder, clip.id, "lidar_calibration", "LiDARCalibration", {"key.laser_name": [TOP]}, {
        "extrinsic.transform": matrices([lidar.rig_from_lidar]),
        "beam_inclination.min": [float(lidar.elevation_rad[-1])],
        "beam_inclination.max": [float(lidar.elevation_rad[0])],
        "beam_inclination.values": [lidar.elevation_rad[::-1].tolist()],
    })  # fmt: skip
    keys = {"key.frame_timestamp_micros": starts, "key.laser_name": [TOP] * len(starts)}
    shapes = [list(image.shape) for image in images]
    save(folder, clip.id, "lidar", "LiDAR", keys, {
        "range_image_return1.values": floats(images), "range_image_return1.shape": [[*s[:2], 4] for s in shapes],
    })  # fmt: skip
    beams = [beam_poses(clip, lidar, start) for start in starts]
    save(folder, clip.id, "lidar_pose", "LiDARPose", keys, {
        "range_image_return1.values": floats(beams), "range_image_return1.shape": [[*s[:2], 6] for s in shapes],
    })  # fmt: skip
    write_boxes(folder, clip, poses)
    return folder


def save(folder: Path, segment: str, component: str, tag: str, keys: dict, columns: dict) -> None:
    (folder / component).mkdir(parents=True, exist_ok=True)
    named = {f"[{tag}Component].{name}": values for name, values in columns.items()}
    frame = polars.DataFrame({**keys, **named}, strict=False)
    frame.write_parquet(folder / component / f"{segment}.parquet", row_group_size=2)


def matrices(poses) -> polars.Series:
    return polars.Series([np.asarray(pose).ravel().tolist() for pose in poses], dtype=polars.Array(polars.Float64, 16))


def floats(images) -> polars.Series:
    return polars.Series([image.ravel().tolist() for image in images], dtype=polars.List(polars.Float64))


def write_cameras(folder: Path, clip: logs.Clip, number_of: dict, starts: list, pose_of) -> None:
    rows = list(clip.rig.cameras.items())
    lens = {"f_u": "fx_px", "f_v": "fy_px", "c_u": "cx_px", "c_v": "cy_px"}
    distortion = {"k1": ("radial", 0), "k2": ("radial", 1), "p1": ("tangential", 0), "p2": ("tangential", 1)}
    distortion["k3"] = ("radial", 2)
    save(folder, clip.id, "camera_calibration", "CameraCalibration",
         {"key.camera_name": [number_of[name] for name, _ in rows]}, {
        **{f"intrinsic.{key}": [getattr(c.lens, name) for _, c in rows] for key, name in lens.items()},
        **{f"intrinsic.{key}": [getattr(c.lens, name)[i] for _, c in rows] for key, (name, i) in distortion.items()},
        "extrinsic.transform": matrices(pose_of(c.rig_from_camera) @ CAMERA_FROM_THEIRS for _, c in rows),
        "width": [c.width_px for _, c in rows],
        "height": [c.height_px for _, c in rows],
        "rolling_shutter_direction": [5 if c.shutter is Shutter.GLOBAL else DIRECTIONS.index(c.shutter)
                                      for _, c in rows],
    })  # fmt: skip
    frames = [
        (start, number_of[name], clip.image(name, index), clip.camera_times_us(name)[index])
        for index, start in enumerate(starts)
        for name in clip.rig.cameras
    ]
    middles = [int(span.mean()) for *_, span in frames]
    save(folder, clip.id, "camera_image", "CameraImage",
         {"key.frame_timestamp_micros": [f[0] for f in frames], "key.camera_name": [f[1] for f in frames]}, {
        "image": [cv2.imencode(".png", f[2][:, :, ::-1])[1].tobytes() for f in frames],
        "pose.transform": matrices(clip.ego.at(t) for t in middles),
        "pose_timestamp": [t * 1e-6 for t in middles],
        "rolling_shutter_params.camera_trigger_time": [f[3][0] * 1e-6 - SHUTTER_S / 2 for f in frames],
        "rolling_shutter_params.camera_readout_done_time": [f[3][1] * 1e-6 + SHUTTER_S / 2 for f in frames],
        "rolling_shutter_params.shutter": [SHUTTER_S] * len(frames),
    })  # fmt: skip


def column_times_us(columns: int, start_us: int) -> np.ndarray:
    return start_us + np.rint((np.arange(columns) + 0.5) / columns * TURN_US).astype(np.int64)


def beam_poses(clip: logs.Clip, lidar: LidarModel, start_us: int) -> np.ndarray:
    """Roll, pitch, yaw, x, y, z of the car at the time of each beam."""
    rows, columns = len(lidar.elevation_rad), len(lidar.azimuth_rad)
    poses = clip.ego.at(column_times_us(columns, start_us))
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("xyz")
    return np.tile(np.concatenate([angles, poses[:, :3, 3]], axis=1), (rows, 1, 1))


def returns(clip: logs.Clip, name: str, index: int) -> np.ndarray:
    """Range image of a sweep: each return in the beam next to it, which turns it by half a column at most."""
    lidar, sweep = clip.rig.lidars[name], clip.sweep(name, index)
    rows, columns = len(lidar.elevation_rad), len(lidar.azimuth_rad)
    xyz = measured(clip, name, index)
    row, _, valid = sensors.beam_coordinates(lidar, xyz)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0]) + geometry.yaw_of(lidar.rig_from_lidar)
    column = np.floor((np.pi - azimuth) / (2 * np.pi) * columns).astype(int) % columns
    image = np.zeros((rows, columns, 4))
    image[:, :, 0] = -1.0
    place = np.rint(row[valid]).astype(int), column[valid]
    image[(*place, 0)] = np.linalg.norm(xyz[valid], axis=1)
    image[(*place, 1)] = sweep.intensity[valid]
    return image


def write_boxes(folder: Path, clip: logs.Clip, poses: dict) -> None:
    rows = []
    for track in clip.tracks:
        for start, pose in poses.items():
            if track.path.covers(start + HALF_US):
                local = np.linalg.inv(pose) @ track.path.at(start + HALF_US)
                yaw = float(np.arctan2(local[1, 0], local[0, 0]))
                rows.append((start, track.id, *local[:3, 3], *track.size_m, yaw, KINDS.get(track.label, 3)))
    times, ids, *values = zip(*rows, strict=True) if rows else [()] * 10
    names = [f"box.{what}.{axis}" for what in ("center", "size") for axis in "xyz"]
    keys = {"key.frame_timestamp_micros": list(times), "key.laser_object_id": list(ids)}
    columns = dict(zip([*names, "box.heading", "type"], map(list, values), strict=True))
    save(folder, clip.id, "lidar_box", "LiDARBox", keys, columns)
