"""The demo log in the layouts of public data sets, as their publishers write them."""

import hashlib
import json
from pathlib import Path

import cv2
import numpy as np

from nurec_sim import geometry, logs

DEMO = Path(__file__).parents[2] / "scenarios" / "demo_clip.zip"
INDICES = (4, 5, 6, 12, 18)
"""Frames of the demo log that are written."""
EPOCH_US = 1_317_042_164_000_000
"""2011-09-26 13:02:44, added to the times of the demo log."""
LIDAR, CAMERAS = "lidar_top", ("camera_front", "camera_front_left")


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


# -------------------------------------------------------------------------------------------------------- Argoverse 2

LOG = "7fab2350-7eaf-3b7e-a39d-6937a4c1beef"
RIG_FROM_EGO = geometry.pose(np.eye(3), np.array([0, 0, 0.33]))
CITY_M = np.array([5172.0, 2419.0, 66.0])
EPOCH_NS = 315_966_253_000_000_000
DOWN = geometry.pose(
    cv2.Rodrigues(np.array([np.pi, 0, 0]))[0] @ geometry.rotation_from_yaw(0.4), np.array([1.1, 0, 1.7])
)
"""Pose in the rig of the lower LiDAR, which hangs upside down."""


def pose_columns(poses: np.ndarray) -> dict[str, np.ndarray]:
    quaternions = geometry.quat_from_matrix(poses[:, :3, :3])
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    return dict(zip(names, np.concatenate([quaternions, poses[:, :3, 3]], axis=1).T, strict=True))


def feather(path: Path, columns: dict, **types) -> None:
    import polars

    path.parent.mkdir(parents=True, exist_ok=True)
    table = polars.DataFrame({name: polars.Series(name, list(values)) for name, values in columns.items()})
    table.cast(types).write_ipc(path, compression="zstd")


def argoverse2(root: Path, clip: logs.Clip, invert: bool = False) -> Path:
    """A log of Argoverse 2 with two cameras of the demo; every second point is one of the lower LiDAR.

    ``invert``: the poses of the cameras are the inverse of what they should be.
    """
    import polars

    folder, city = root / "val" / LOG, geometry.pose(np.eye(3), CITY_M)
    sensors = {
        **{name: clip.rig.cameras[name].rig_from_camera for name in CAMERAS},
        "up_lidar": clip.rig.lidars[LIDAR].rig_from_lidar, "down_lidar": DOWN,
    }  # fmt: skip
    ego_from_sensor = geometry.inverse(RIG_FROM_EGO) @ np.array(list(sensors.values()))
    if invert:
        ego_from_sensor[: len(CAMERAS)] = geometry.inverse(ego_from_sensor[: len(CAMERAS)])
    feather(
        folder / "calibration/egovehicle_SE3_sensor.feather",
        {"sensor_name": list(sensors), **pose_columns(ego_from_sensor)},
    )
    cameras = [clip.rig.cameras[name] for name in CAMERAS]
    lenses = [camera.lens for camera in cameras]
    feather(
        folder / "calibration/intrinsics.feather",
        {
            "sensor_name": [*(camera.id for camera in cameras), "ring_rear_left"],
            **{name: [*(getattr(lens, name) for lens in lenses), 1684.0] for name in ("fx_px", "fy_px")},
            **{name: [*(getattr(lens, name) - 0.5 for lens in lenses), 800.0] for name in ("cx_px", "cy_px")},
            **{name: [-0.28, 0.1, 0.1] for name in ("k1", "k2", "k3")},
            "height_px": [*(camera.height_px for camera in cameras), 1550],
            "width_px": [*(camera.width_px for camera in cameras), 2048],
        },
        height_px=polars.UInt16,
        width_px=polars.UInt16,
    )
    ego = city @ clip.ego.world_from_body @ RIG_FROM_EGO
    feather(
        folder / "city_SE3_egovehicle.feather",
        {"timestamp_ns": EPOCH_NS + clip.ego.t_us * 1000, **pose_columns(ego)},
    )
    boxes = []
    for index in INDICES:
        for camera in CAMERAS:
            t_us = clip.image_records(camera)[index].start_us
            put(folder / f"sensors/cameras/{camera}/{EPOCH_NS + t_us * 1000}.jpg", jpeg(clip.image(camera, index)))
        sweep = clip.sweep(LIDAR, index)
        ego_from_world = geometry.inverse(clip.ego.at(sweep.t_us) @ RIG_FROM_EGO)
        points = geometry.transform_points(ego_from_world, sweep.xyz_world_m)
        rows = np.arange(len(points))
        feather(
            folder / f"sensors/lidar/{EPOCH_NS + sweep.t_us * 1000}.feather",
            {
                **dict(zip("xyz", points.T, strict=True)),
                "intensity": np.rint(sweep.intensity * 255).astype(int),
                "laser_number": rows % 2 * 32 + rows % 31,
                "offset_ns": (sweep.point_t_us - sweep.start_us) * 1000,
            },
            **dict.fromkeys("xyz", polars.Float16), intensity=polars.UInt8, laser_number=polars.UInt8,
            offset_ns=polars.Int32,
        )  # fmt: skip
        for track in clip.tracks:
            boxes.append((index, track, ego_from_world @ track.path.at(sweep.t_us)))
    feather(
        folder / "annotations.feather",
        {
            "timestamp_ns": [EPOCH_NS + clip.sweep_records(LIDAR)[index].t_us * 1000 for index, _, _ in boxes],
            "track_uuid": [track.id for _, track, _ in boxes],
            "category": [{"automobile": "REGULAR_VEHICLE", "person": "PEDESTRIAN"}[t.label] for _, t, _ in boxes],
            **{
                name: [track.size_m[axis] for _, track, _ in boxes]
                for axis, name in enumerate(("length_m", "width_m", "height_m"))
            },
            **pose_columns(np.array([pose for _, _, pose in boxes])),
            "num_interior_pts": [1] * len(boxes),
        },
    )
    put(folder / f"map/log_map_archive_{LOG}____PIT_city_1.json", argoverse_map())
    return folder


def argoverse_map() -> str:
    """A square, and a bus lane and a bicycle lane along x in it."""

    def line(*points) -> list[dict]:
        return [dict(zip("xyz", (CITY_M + point).tolist(), strict=True)) for point in points]

    lane = {
        "is_intersection": False, "left_lane_mark_type": "NONE", "right_lane_mark_type": "NONE", "successors": [],
        "predecessors": [], "right_neighbor_id": None, "left_neighbor_id": None,
        "left_lane_boundary": line([0, 4, 0], [8, 4, 0]),
        "right_lane_boundary": line([0, 0, 0], [4, 0, 0], [8, 0, 2]),
    }  # fmt: skip
    return json.dumps(
        {
            "pedestrian_crossings": {},
            "lane_segments": {
                "1": {**lane, "id": 1, "lane_type": "BUS"},
                "2": {**lane, "id": 2, "lane_type": "BIKE"},
            },
            "drivable_areas": {
                "3": {"area_boundary": line([0, 0, 0], [9, 0, 0], [9, 9, 0], [0, 9, 0]), "id": 3},
            },
        }
    )


# ----------------------------------------------------------------------------------------------------------- nuScenes

MAP_M = np.array([411.0, 1180.0, 0.0])
EPOCH_NUSCENES_US = 1_532_402_927_000_000
FILE_FROM_LIDAR = geometry.pose(geometry.rotation_from_yaw(np.pi / 2), np.zeros(3))
KEYFRAMES = INDICES[::2]
"""Frames with boxes; the others are sweeps between them."""


def token(*parts) -> str:
    return hashlib.md5(repr(parts).encode()).hexdigest()


def as_table(pose: np.ndarray) -> dict[str, list[float]]:
    return {"translation": pose[:3, 3].tolist(), "rotation": geometry.quat_from_matrix(pose[:3, :3]).tolist()}


def nuscenes(root: Path, clip: logs.Clip, invert: bool = False) -> Path:
    """A folder of nuScenes with the scene ``scene-0007`` from the demo, and ``scene-0008`` without sensors.

    ``invert``: the poses of the cameras are the inverse of what they should be.
    """
    moved = geometry.pose(np.eye(3), MAP_M)
    names = {"CAM_FRONT": "camera_front", "CAM_FRONT_LEFT": "camera_front_left", "LIDAR_TOP": LIDAR}
    tables: dict[str, list[dict]] = {name: [] for name in (
        "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample",
        "sample_annotation", "sample_data", "scene", "sensor", "visibility",
    )}  # fmt: skip
    for name in ("vehicle.car", "human.pedestrian.adult"):
        tables["category"].append({"token": token(name), "name": name, "description": "", "index": 1})
    tables["log"] = [
        {"token": token("log"), "logfile": "n015", "vehicle": "n015", "date_captured": "2018", "location": "x"}
    ]
    tables["map"] = [{"token": token("map"), "log_tokens": [token("log")], "category": "x", "filename": "maps/x.png"}]
    put(root / "maps" / "x.png", png(np.full((8, 8, 3), 255, np.uint8)))
    for number, scene in ((7, "scene-0007"), (8, "scene-0008")):
        count = len(KEYFRAMES) if number == 7 else 1
        ends = (token("sample", number, 0), token("sample", number, count - 1))
        tables["scene"].append(
            {"token": token(scene), "log_token": token("log"), "nbr_samples": count, "name": scene,
             "first_sample_token": ends[0], "last_sample_token": ends[1], "description": "a {street}"}
        )  # fmt: skip
        for k in range(count):
            near = [token("sample", number, j) if 0 <= j < count else "" for j in (k - 1, k + 1)]
            t_us = EPOCH_NUSCENES_US + clip.sweep_records(LIDAR)[KEYFRAMES[k]].t_us
            tables["sample"].append(
                {"token": token("sample", number, k), "timestamp": t_us, "prev": near[0], "next": near[1],
                 "scene_token": token(scene)}
            )  # fmt: skip
    for channel, name in names.items():
        is_lidar = name == LIDAR
        rig_from_sensor = clip.rig.lidars[name].rig_from_lidar if is_lidar else clip.rig.cameras[name].rig_from_camera
        pose = rig_from_sensor @ geometry.inverse(FILE_FROM_LIDAR) if is_lidar else rig_from_sensor
        if invert and not is_lidar:
            pose = geometry.inverse(pose)
        lens = None if is_lidar else clip.rig.cameras[name].lens
        k = [] if lens is None else [[lens.fx_px, 0, lens.cx_px - 0.5], [0, lens.fy_px, lens.cy_px - 0.5], [0, 0, 1]]
        modality = "lidar" if is_lidar else "camera"
        tables["sensor"].append({"token": token(channel), "channel": channel, "modality": modality})
        tables["calibrated_sensor"].append(
            {
                "token": token("mounted", channel),
                "sensor_token": token(channel),
                **as_table(pose),
                "camera_intrinsic": k,
            }
        )
        for number, index in enumerate(INDICES):
            t_us = clip.sweep_records(LIDAR)[index].t_us if is_lidar else clip.image_records(name)[index].start_us
            key = index in KEYFRAMES
            file = f"{'samples' if key else 'sweeps'}/{channel}/n015__{channel}__{EPOCH_NUSCENES_US + t_us}"
            file += ".pcd.bin" if is_lidar else ".jpg"
            near = [token(channel, n) if 0 <= n < len(INDICES) else "" for n in (number - 1, number + 1)]
            size = (0, 0) if is_lidar else (clip.rig.cameras[name].width_px, clip.rig.cameras[name].height_px)
            sample = min(range(len(KEYFRAMES)), key=lambda j: (KEYFRAMES[j] < index, abs(KEYFRAMES[j] - index)))
            tables["sample_data"].append(
                {"token": token(channel, number), "sample_token": token("sample", 7, sample), "is_key_frame": key,
                 "ego_pose_token": token(channel, number), "calibrated_sensor_token": token("mounted", channel),
                 "timestamp": EPOCH_NUSCENES_US + t_us, "fileformat": "pcd" if is_lidar else "jpg",
                 "height": size[1], "width": size[0], "filename": file, "prev": near[0], "next": near[1]}
            )  # fmt: skip
            tables["ego_pose"].append(
                {"token": token(channel, number), "timestamp": EPOCH_NUSCENES_US + t_us,
                 **as_table(moved @ clip.ego.at(t_us))}
            )  # fmt: skip
            if is_lidar:
                sweep = clip.sweep(LIDAR, index)
                points = geometry.transform_points(FILE_FROM_LIDAR, sweep.xyz_m)
                data = np.column_stack([points, sweep.intensity * 255, np.zeros(len(points))])
                put(root / file, data.astype("<f4").tobytes())
            else:
                put(root / file, jpeg(clip.image(name, index)))
    for track in clip.tracks:
        kind = {"automobile": "vehicle.car", "person": "human.pedestrian.adult"}[track.label]
        boxes = [token("box", track.id, k) for k in range(len(KEYFRAMES))]
        tables["instance"].append(
            {"token": token(track.id), "category_token": token(kind), "nbr_annotations": len(boxes),
             "first_annotation_token": boxes[0], "last_annotation_token": boxes[-1]}
        )  # fmt: skip
        length, width, height = track.size_m
        for k, index in enumerate(KEYFRAMES):
            pose = moved @ track.path.at(clip.sweep_records(LIDAR)[index].t_us)
            near = [boxes[j] if 0 <= j < len(boxes) else "" for j in (k - 1, k + 1)]
            tables["sample_annotation"].append(
                {"token": boxes[k], "sample_token": token("sample", 7, k), "instance_token": token(track.id),
                 "visibility_token": "4", "attribute_tokens": [], **as_table(pose), "size": [width, length, height],
                 "prev": near[0], "next": near[1], "num_lidar_pts": 1, "num_radar_pts": 0}
            )  # fmt: skip
    for name, rows in tables.items():
        put(root / "v1.0-mini" / f"{name}.json", json.dumps(rows, indent=0))
    return root
