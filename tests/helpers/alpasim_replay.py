"""Messages that AlpaSim's runtime (commit 3032e0c) really sent, and a client that sends them once more.

``tests/data/alpasim_messages`` holds those of a generated street and what they need of its log (``STREET_LOG``); those
of a KITTI log are not ours to ship. A line is one message: ``kind`` (the entry in AlpaSim's log), ``type`` and
``message`` (protobuf JSON). Images are left out.
"""

import gzip
import json
from pathlib import Path

import cv2
import numpy as np
from google.protobuf import json_format, message_factory

from nurec_sim.serving.wire.messages import pool
from nurec_sim.types import Clip, DynamicGaussians, Gaussians, GaussianScene, Label

OURS = Path(__file__).parents[1] / "data" / "alpasim_messages"
STREET_LOG = OURS / "street_log.zip"
"""The log that shipped with version 0.1.0: its rig, path, tracks and map, and the first frame of each sensor."""
SUBMITTED = {
    "driver_session_request": "start_session",
    "driver_camera_image": "submit_image_observation",
    "driver_ego_trajectory": "submit_egomotion_observation",
    "route_request": "submit_route",
    "ground_truth_request": "submit_recording_ground_truth",
    "driver_request": "drive",
}
"""Procedure of the driver by kind of message."""
RENDERED = {
    "available_cameras_request": "get_available_cameras",
    "available_ego_masks_request": "get_available_ego_masks",
    "render_request": "render_rgb",
    "batch_render_request": "batch_render_rgb",
}
"""Procedure of the sensor server by kind of message."""


def read_messages(path: Path):
    """(kind, message) in the order in which they were sent."""
    text = gzip.decompress(path.read_bytes()).decode() if path.suffix == ".gz" else path.read_text()
    for line in text.splitlines():
        entry = json.loads(line)
        kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(entry["type"]))
        yield entry["kind"], json_format.ParseDict(entry["message"], kind())


def scene_of(clip: Clip) -> GaussianScene:
    """A scene with a log's id, sensors, path, tracks and times, but only a coloured plain to look at: made at once."""
    x, y, z = clip.ego.world_from_body[:, :3, 3].T
    grid = np.arange(-60.0, 61.0, 4.0)
    east, north = (
        around.ravel() + middle for around, middle in zip(np.meshgrid(grid, grid), (x[0], y[0]), strict=True)
    )
    blank = Gaussians.empty(len(east))
    plain = Gaussians(
        np.column_stack([east, north, np.full_like(east, z.mean())]).astype(np.float32),
        blank.quat_wxyz,
        np.full((len(east), 3), (1.5, 1.5, 0.05), np.float32),
        np.full(len(east), 0.95, np.float32),
        np.random.default_rng(0).uniform(0.2, 0.8, (len(east), 3)).astype(np.float32),
        blank.normal,
        np.full(len(east), Label.ROAD, np.uint8),
        blank.intensity,
    )
    sky = np.full((6, 4, 4, 3), 0.6, np.float32)
    return GaussianScene(
        clip.id, plain, DynamicGaussians.empty(), sky, {}, clip.rig, clip.ego, tuple(clip.tracks), clip.road_map,
        clip.span_us,
    )  # fmt: skip


def decoded(data: bytes):
    """The image [h, w, 3] of a reply."""
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
