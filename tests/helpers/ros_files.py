"""Writes a clip as a ROS 2 bag, with the writer of ``mcap-ros2-support``."""

import sqlite3
from pathlib import Path
from types import SimpleNamespace as Message

import cv2
import numpy as np
from ncore_files import measured

from nurec_sim import geometry, logs
from nurec_sim.logs.readers import _ros_messages as messages
from nurec_sim.types import Fisheye

STATIC, MOVING = "/tf_static", "/tf"
MSG = "sensor_msgs/msg/"


def write_bag(path: Path, clip: logs.Clip, times: str = "t", raw: bool = False, pose_of=np.asarray) -> Path:
    """Write an .mcap file, a folder of rosbag2 with one (no suffix), or a .db3 file; returns ``path``.

    Args:
        path: where to.
        clip: what to write; sweeps are stored as they were measured, without motion compensation.
        times: the field for the times of points: "t" (nanoseconds after the message), "time" (seconds before it, as
            float32), "timestamp" (seconds since the epoch), "offset_time" (microseconds) or "" (none, compensated).
        raw: whether images are raw, in bgr8.
        pose_of: applied to the mounting pose of every camera (the inverse is wrong on purpose).
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    file = path
    if not path.suffix:
        path.mkdir()
        file = path / "part_0.mcap"
        head = "rosbag2_bagfile_information:\n  storage_identifier: mcap\n  relative_file_paths: [part_0.mcap]\n"
        (path / "metadata.yaml").write_text(head)
    rows = sorted(bag_messages(clip, times, raw, pose_of), key=lambda row: row[3])
    (write_db3 if file.suffix == ".db3" else write_mcap)(file, rows)
    return path


def write_mcap(file: Path, rows) -> None:
    from mcap_ros2.writer import Writer

    with file.open("wb") as stream:
        writer = Writer(stream)
        kinds = {kind: writer.register_msgdef(kind, messages.definition(kind)) for _, kind, _, _ in rows}
        for topic, kind, message, t_ns in rows:
            writer.write_message(topic, kinds[kind], message, log_time=t_ns)
        writer.finish()


def write_db3(file: Path, rows) -> None:
    """The tables of rosbag2_storage_sqlite3 before it kept definitions."""
    from mcap_ros2._dynamic import serialize_dynamic

    connection = sqlite3.connect(file)
    connection.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
    connection.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data BLOB)")
    encoders, ids = {}, {}
    for topic, kind, message, t_ns in rows:
        if topic not in ids:
            ids[topic] = len(ids) + 1
            connection.execute("INSERT INTO topics VALUES(?, ?, ?, 'cdr')", (ids[topic], topic, kind))
        if kind not in encoders:
            encoders[kind] = serialize_dynamic(kind, messages.definition(kind))[kind]
        data = encoders[kind](message)
        connection.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", (ids[topic], t_ns, data))
    connection.commit()
    connection.close()


def bag_messages(clip: logs.Clip, times: str, raw: bool, pose_of):
    """Topic, type, message and log time (5 ms after the header's) of everything."""
    mounted = {name: pose_of(camera.rig_from_camera) for name, camera in clip.rig.cameras.items()}
    mounted |= {name: lidar.rig_from_lidar for name, lidar in clip.rig.lidars.items()}
    start_us = clip.span_us[0]
    fixed = [transform("base_link", f"{name}_frame", pose, start_us) for name, pose in mounted.items()]
    yield STATIC, messages.TRANSFORMS, Message(transforms=fixed), start_us * 1000
    for t_us, pose in zip(clip.ego.t_us.tolist(), clip.ego.world_from_body, strict=True):
        # map -> odom stands still, odom -> base_link moves; the drift between them is a turn and a shift.
        edges = [transform("map", "odom", DRIFT, t_us)]
        edges.append(transform("odom", "base_link", geometry.inverse(DRIFT) @ pose, t_us))
        yield MOVING, messages.TRANSFORMS, Message(transforms=edges), t_us * 1000
    for name, camera in clip.rig.cameras.items():
        kind = messages.IMAGES[int(raw)]
        for index, (t_us, _) in enumerate(clip.camera_times_us(name).tolist()):
            top, late = header(t_us, f"{name}_frame"), t_us * 1000 + 5_000_000
            yield f"/{name}/camera_info", messages.CAMERA_INFO, camera_info(camera, top), late
            image = np.ascontiguousarray(clip.image(name, index)[:, :, ::-1])
            if raw:
                message = raw_image(top, image)
            else:
                message = Message(header=top, format="png", data=cv2.imencode(".png", image)[1].tobytes())
            yield f"/{name}/image_raw" + ("" if raw else "/compressed"), kind, message, late
    for name in clip.rig.lidars:
        for index in range(clip.sweep_count(name)):
            t_us, message = points(clip, name, index, times)
            yield f"/{name}/points", messages.POINTS, message, t_us * 1000 + 5_000_000


def odometry(clip: logs.Clip):
    """The path of the car as messages of /odometry."""
    zero = Message(x=0.0, y=0.0, z=0.0)
    twist = Message(twist=Message(linear=zero, angular=zero), covariance=[0.0] * 36)
    for t_us, pose in zip(clip.ego.t_us.tolist(), clip.ego.world_from_body, strict=True):
        given = transform("odom", "base_link", pose, t_us)
        place = Message(position=given.transform.translation, orientation=given.transform.rotation)
        pose = Message(pose=place, covariance=[0.0] * 36)
        message = Message(header=given.header, child_frame_id="base_link", pose=pose, twist=twist)
        yield "/odometry", messages.ODOMETRY, message, t_us * 1000


DRIFT = geometry.pose_from_xyyaw(3.0, -4.0, 0.7, z=0.5)


def header(t_us: int, frame: str) -> Message:
    return Message(stamp=Message(sec=t_us // 1_000_000, nanosec=t_us % 1_000_000 * 1000), frame_id=frame)


def transform(parent: str, child: str, pose: np.ndarray, t_us: int) -> Message:
    w, x, y, z = geometry.quat_from_matrix(np.asarray(pose)[:3, :3]).tolist()
    place = dict(zip("xyz", np.asarray(pose)[:3, 3].tolist(), strict=True))
    value = Message(translation=Message(**place), rotation=Message(x=x, y=y, z=z, w=w))
    return Message(header=header(t_us, parent), child_frame_id=child, transform=value)


def camera_info(camera, top: Message) -> Message:
    lens, roi = camera.lens, Message(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    if isinstance(lens, Fisheye):
        model, d = "equidistant", [*lens.radial]
    else:
        k1, k2, k3, k4, k5, k6 = lens.radial
        model, d = "rational_polynomial", [k1, k2, *lens.tangential, k3, k4, k5, k6, *lens.thin_prism]
    k = [lens.fx_px, 0.0, lens.cx_px - 0.5, 0.0, lens.fy_px, lens.cy_px - 0.5, 0.0, 0.0, 1.0]
    p = [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]
    size = {"height": camera.height_px, "width": camera.width_px}
    r = np.eye(3).ravel().tolist()
    return Message(header=top, **size, distortion_model=model, d=d, k=k, r=r, p=p, binning_x=0, binning_y=0, roi=roi)


def raw_image(top: Message, bgr: np.ndarray) -> Message:
    """Rows are padded by three bytes, as some drivers do."""
    height, width = bgr.shape[:2]
    data = np.pad(bgr.reshape(height, -1), ((0, 0), (0, 3))).tobytes()
    return Message(
        header=top, height=height, width=width, encoding="bgr8", is_bigendian=0, step=width * 3 + 3, data=data
    )


FIELDS = {"": None, "t": ("<u4", 6), "time": ("<f4", 7), "timestamp": ("<f8", 8), "offset_time": ("<u4", 6)}


def points(clip: logs.Clip, name: str, index: int, times: str) -> tuple[int, Message]:
    """Time and message of a sweep, with a beam without a return in the middle."""
    sweep = clip.sweep(name, index)
    stamp_us = sweep.end_us if times in ("", "time") else sweep.start_us
    xyz = sweep.xyz_m if not times else measured(clip, name, index)
    layout = [("x", "<f4", 7), ("y", "<f4", 7), ("z", "<f4", 7), ("intensity", "<u1", 2)]
    if times:
        layout.append((times, *FIELDS[times]))
    record = np.dtype({"names": [n for n, _, _ in layout], "formats": [f for _, f, _ in layout]}, align=True)
    cloud = np.zeros(len(xyz) + 1, record)
    real = np.arange(len(cloud)) != 1
    for axis, values in zip("xyz", xyz.T, strict=True):
        cloud[axis][real] = values
        cloud[axis][~real] = np.nan
    cloud["intensity"][real] = np.rint(sweep.intensity * 255)
    after_us = sweep.point_t_us - stamp_us
    if times:
        values = {
            "t": after_us * 1000,
            "time": after_us * 1e-6,
            "timestamp": sweep.point_t_us * 1e-6,
            "offset_time": after_us,
        }[times]
        cloud[times][real] = values
    fields = [Message(name=n, offset=record.fields[n][1], datatype=number, count=1) for n, _, number in layout]
    return stamp_us, Message(
        header=header(stamp_us, f"{name}_frame"),
        height=1,
        width=len(cloud),
        fields=fields,
        is_bigendian=False,
        point_step=record.itemsize,
        row_step=record.itemsize * len(cloud),
        data=cloud.tobytes(),
        is_dense=False,
    )
