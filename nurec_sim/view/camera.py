"""Cameras: the browser's as one of ours, and those of the rig at a view's time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry, sensors
from nurec_sim.types import CameraModel, Matrix4, Pinhole, SensorRequest
from nurec_sim.view.state import Stage, View

MOST_PX = 1920
"""Longest side of a picture of the free camera."""
BEHIND_M, ABOVE_M, AHEAD_M = 9.0, 4.5, 8.0
"""Where the free camera starts: behind and above the car, looking at the road ahead."""


def pose_of(position: Sequence[float], wxyz: Sequence[float]) -> Matrix4:
    """A pose from viser's position and quaternion.

    viser's cameras are OpenCV's, as ours: x right, y down, z forward.
    """
    return geometry.pose(geometry.matrix_from_quat(np.asarray(wxyz, np.float64)), np.asarray(position, np.float64))


def parts_of(pose: Matrix4) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 4"]]:
    """Position and quaternion of a pose, for viser."""
    return pose[:3, 3].copy(), geometry.quat_from_matrix(pose[:3, :3])


def eye_camera(view: View, scale: float, like: str) -> CameraModel:
    """The free camera: an ideal pinhole with the browser's field of view.

    Args:
        view: size and field of view.
        scale: fraction of the canvas' pixels to each side.
        like: the camera of the rig whose colour correction it gets.
    """
    width, height = view.size_px
    scale *= min(1.0, MOST_PX / max(width, height))
    width, height = max(16, round(width * scale)), max(16, round(height * scale))
    focal = height / 2 / math.tan(view.fov_rad / 2)
    return CameraModel(like, width, height, Pinhole(focal, focal, width / 2, height / 2), np.eye(4))


def request_of(stage: Stage, view: View, scale: float) -> SensorRequest:
    """What to render for a view.

    A camera of the rig keeps its lens and its shutter; the exposure is as long as its recorded ones. The free camera
    sees one instant.

    Args:
        stage: where everything is.
        view: what is looked at.
        scale: fraction of the full number of pixels to each side.
    """
    world = stage.world(view)
    start_us, end_us = exposure_of(stage, view)
    if view.camera is None:
        camera = eye_camera(view, scale, next(iter(world.rig.cameras), "eye"))
        eye = stage.world_from_browser(view) @ view.browser_from_eye
        poses = np.stack([eye, eye])
    else:
        camera = world.rig.cameras[view.camera]
        if scale != 1:
            size = (max(16, round(side * scale)) for side in (camera.width_px, camera.height_px))
            camera = sensors.scaled_camera(camera, *size)
        poses = stage.ego(view, np.array([start_us, end_us])) @ camera.rig_from_camera
    actors = stage.overrides(view, start_us, end_us)
    # The free camera borrows the id of a camera of the car for its colours, but is not mounted on it.
    show_ego = view.camera is not None and world.scene is not None
    return SensorRequest(world.id, camera, start_us, end_us, poses, actors, apply_isp=view.apply_isp, show_ego=show_ego)


def exposure_of(stage: Stage, view: View) -> tuple[int, int]:
    """Start and end of the exposure.

    Beside a recorded image it is that image's; else it starts at the view's time and lasts as long as recorded ones.
    """
    world = stage.world(view)
    start_us, end_us = view.t_us, view.t_us + 1
    if view.camera is not None:
        if (index := recorded_index(stage, view)) is not None and stage.opened.clip is not None:
            start_us, end_us = stage.opened.clip.camera_times_us(view.camera)[index].tolist()
        elif (times := world.camera_times_us.get(view.camera)) is not None and len(times):
            end_us += int(np.median(times[:, 1] - times[:, 0]))
    first, last = world.times_us
    end_us = min(max(end_us, start_us + 1), last + 1)
    return max(min(start_us, end_us - 1), first), end_us


def recorded_index(stage: Stage, view: View) -> int | None:
    """Index of the recorded image that is shown; None if none is."""
    clip = stage.opened.clip
    if view.recorded == "off" or clip is None or view.camera is None or view.camera not in clip.rig.cameras:
        return None
    times = clip.camera_times_us(view.camera)
    return int(np.argmin(np.abs(times.mean(axis=1) - view.t_us))) if len(times) else None


def start_pose() -> tuple[Matrix4, Float64[np.ndarray, " 3"]]:
    """Pose of the free camera in the car's frame at the start, and the point that it looks at."""
    eye, target = np.array([-BEHIND_M, 0.0, ABOVE_M]), np.array([AHEAD_M, 0.0, 0.0])
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return geometry.pose(np.stack([right, np.cross(forward, right), forward], axis=1), eye), target


def ray_hits_box(
    origin_m: Float64[np.ndarray, " 3"], direction: Float64[np.ndarray, " 3"], size_m: Sequence[float]
) -> float:
    """Distance along a ray at which it enters a box about the origin, in the box's axes; infinite if it misses it."""
    half = np.asarray(size_m, np.float64) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        one, two = (-half - origin_m) / direction, (half - origin_m) / direction
    near, far = np.nanmax(np.minimum(one, two)), np.nanmin(np.maximum(one, two))
    return max(float(near), 0.0) if near <= far and far >= 0 else math.inf
