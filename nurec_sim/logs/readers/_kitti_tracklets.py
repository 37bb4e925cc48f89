"""The labelled boxes of a KITTI raw drive: ``tracklet_labels.xml``, a Boost archive in the frame of the LiDAR."""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree import ElementTree

import numpy as np

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.files.decoding import TooMuchError, check_xml
from nurec_sim.logs.labels import IGNORED, is_movable, our_label
from nurec_sim.logs.storage import Storage
from nurec_sim.types import Matrix4, Track, Trajectory


def read_tracklets(
    storage: Storage, file: str, t_us: Mapping[int, int], world_from_lidar: Mapping[int, Matrix4]
) -> list[Track]:
    """Tracks of the boxes at frames that have a sweep.

    Args:
        storage: where the file is.
        file: its name.
        t_us: time of each sweep by the number of its frame.
        world_from_lidar: pose of the LiDAR at that time.

    Raises:
        ClipError: it is not such a file, or a value is wrong.
    """
    data = storage.read(file)
    try:
        check_xml(data)
        root = ElementTree.fromstring(data)
    except (TooMuchError, ElementTree.ParseError) as error:
        raise ClipError(f"{file}: is not a readable XML file: {error}") from None
    tracks = []
    for number, item in enumerate(root.iterfind("./tracklets/item")):
        where = f"{file}: tracklet {number}"
        label = our_label(item.findtext("objectType") or "")
        if label in IGNORED:
            continue
        height, width, length = (_number(where, item, name) for name in ("h", "w", "l"))
        if min(height, width, length) <= 0:
            raise ClipError(f"{where}: h, w, l must be positive, got {height}, {width}, {length}")
        first = int(_number(where, item, "first_frame"))
        times, poses = [], []
        for frame, pose in enumerate(item.iterfind("./poses/item"), start=first):
            if frame in t_us:
                times.append(t_us[frame])
                poses.append(world_from_lidar[frame] @ _lidar_from_box(where, pose, height))
        if times:
            path = Trajectory(np.array(times, np.int64), np.array(poses))
            tracks.append(Track(str(number), label, (length, width, height), path, controllable=is_movable(label)))
    return tracks


def _lidar_from_box(where: str, item: ElementTree.Element, height: float) -> Matrix4:
    # The origin of a tracklet is the middle of its bottom.
    x, y, z, yaw = (_number(where, item, name) for name in ("tx", "ty", "tz", "rz"))
    return geometry.pose(geometry.rotation_from_yaw(yaw), np.array([x, y, z + height / 2]))


def _number(where: str, item: ElementTree.Element, name: str) -> float:
    text = item.findtext(name)
    try:
        value = float(text) if text is not None else np.nan
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ClipError(f"{where}: <{name}> must be a finite number, got {text!r}")
    return value
