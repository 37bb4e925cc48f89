"""One image of a scene, or a PNG of it: recorded time, recorded or shifted pose, any layer."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32, UInt8

from nurec_sim import geometry, sensors
from nurec_sim.errors import RequestError
from nurec_sim.files.new_files import write_file
from nurec_sim.render.device import Renderer, make_renderer
from nurec_sim.render.images.encode import encode_image
from nurec_sim.render.support import Support, small_camera
from nurec_sim.types import CameraFrame, CameraModel, GaussianScene, Label, SensorRequest

Layer = Literal["rgb", "depth", "alpha", "label", "normal", "support"]
FAR_M = 80.0
SUPPORT_PX = 480
"""Largest width at which support is shown: it is computed for every pixel and every recorded view."""
INVENTED_RGB = (255, 0, 60)
LABEL_RGB = {
    Label.OTHER: (120, 120, 120),
    Label.ROAD: (128, 64, 128),
    Label.MOVABLE: (30, 60, 200),
    Label.SKY: (135, 190, 235),
    Label.EGO: (0, 0, 0),
}


def render_view(
    scene: GaussianScene | Renderer,
    camera: str | None = None,
    frame: int = 0,
    *,
    left_m: float = 0.0,
    yaw_deg: float = 0.0,
    width_px: int | None = None,
    outputs: Sequence[str] = ("rgb",),
) -> CameraFrame:
    """What a camera of the car sees at a recorded time, with the car at its recorded pose or beside it.

    Args:
        scene: a scene, or its renderer (``make_renderer``), which need not be prepared again for every image.
        camera: a camera of the scene's rig; the first if None.
        frame: index of the camera's recorded time; the ego pose is that of the recording.
        left_m: the car moved to its left.
        yaw_deg: the car turned to its left.
        width_px: image width, height follows; the camera's own size if None.
        outputs: ``rgb``, ``depth``, ``alpha``, ``label``, ``normal``: what the frame holds.

    Raises:
        RequestError: no such camera, frame or output, or an offset that is not finite.
    """
    renderer = make_renderer(scene) if isinstance(scene, GaussianScene) else scene
    request = view_request(renderer.scene, camera, frame, left_m=left_m, yaw_deg=yaw_deg, width_px=width_px)
    return renderer.render_camera(request, tuple(outputs))


def view_request(
    scene: GaussianScene,
    camera_id: str | None = None,
    frame: int = 0,
    *,
    left_m: float = 0.0,
    yaw_deg: float = 0.0,
    width_px: int | None = None,
) -> SensorRequest:
    """The request behind ``render_view``; arguments and errors are the same."""
    if not scene.rig.cameras:
        raise RequestError(f"scene {scene.id!r} has no cameras")
    if not np.isfinite([left_m, yaw_deg]).all():
        raise RequestError(f"left_m and yaw_deg must be finite, got {left_m} and {yaw_deg}")
    camera_id = camera_id or next(iter(scene.rig.cameras))
    if camera_id not in scene.rig.cameras:
        raise RequestError(f"scene {scene.id!r} has no camera {camera_id!r}; have {list(scene.rig.cameras)}")
    camera = scene.rig.cameras[camera_id]
    times = scene.camera_times_us.get(camera_id, scene.ego.t_us[:, None].repeat(2, axis=1))
    if not -len(times) <= frame < len(times):
        raise RequestError(f"camera {camera_id!r} has frames 0 to {len(times) - 1}, got {frame}")
    if width_px is not None:
        camera = sensors.scaled_camera(camera, width_px, max(1, round(width_px * camera.height_px / camera.width_px)))
    start_us, end_us = int(times[frame, 0]), int(times[frame, 1])
    moved = geometry.pose_from_xyyaw(0.0, left_m, np.radians(yaw_deg))
    poses = scene.ego.at(np.array([start_us, end_us])) @ moved @ camera.rig_from_camera
    # An exposure must end after it starts; an instant becomes a microsecond.
    return SensorRequest(scene.id, camera, start_us, max(end_us, start_us + 1), poses, show_ego=True)


def render_still(
    renderer: Renderer,
    path: Path,
    camera_id: str | None = None,
    frame: int = 0,
    *,
    left_m: float = 0.0,
    yaw_deg: float = 0.0,
    layer: Layer = "rgb",
    width_px: int | None = None,
) -> None:
    """Write one image; the other arguments are those of ``render_view``.

    Args:
        renderer: of the world.
        path: the PNG to write.
        camera_id: a camera of the scene's rig; the first if None.
        frame: index of the camera's recorded time.
        left_m: the car moved to its left.
        yaw_deg: the car turned to its left.
        layer: what to show; depth is grey from near to ``FAR_M``, normals are coloured by x, y and z in the world;
            ``support`` is the image, the redder the less it rests on recorded views (``render.support``).
        width_px: image width, height follows; the camera's own size if None.

    Raises:
        RequestError: see ``render_view``.
        WriteError: the file cannot be written; one that was there is as it was.
    """
    if layer == "support":
        request = view_request(renderer.scene, camera_id, frame, left_m=left_m, yaw_deg=yaw_deg, width_px=width_px)
        write_file(path, encode_image(support_picture(renderer, request)))
        return
    shown = render_view(
        renderer, camera_id, frame, left_m=left_m, yaw_deg=yaw_deg, width_px=width_px, outputs=("rgb", layer)
    )
    write_file(path, encode_image(picture(shown, layer)))


def support_picture(renderer: Renderer, request: SensorRequest) -> UInt8[np.ndarray, "h w 3"]:
    """An image of a camera, ``SUPPORT_PX`` wide at most, the redder the less it rests on recorded views.

    Raises:
        RequestError: see ``render.support.Support``.
    """
    assert isinstance(request.sensor, CameraModel)
    width_px = min(request.sensor.width_px, SUPPORT_PX)
    small = small_camera(request.sensor, width_px)
    rgb = renderer.render_camera(dataclasses.replace(request, sensor=small)).rgb
    return tinted(rgb, Support(renderer).map(request, width_px))


def tinted(rgb: UInt8[np.ndarray, "h w 3"], support: Float32[np.ndarray, "rows columns"]) -> UInt8[np.ndarray, "h w 3"]:
    """An image, the redder the less it rests on recorded views.

    Args:
        rgb: the image.
        support: its support, 0..1, of any size.
    """
    import cv2

    if support.shape != rgb.shape[:2]:
        support = np.asarray(cv2.resize(support, rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR), np.float32)
    weight = support[..., None]
    return np.rint(rgb * weight + np.array(INVENTED_RGB) * (1 - weight)).astype(np.uint8)


def picture(frame: CameraFrame, layer: Layer) -> UInt8[np.ndarray, "h w 3"]:
    """One layer of a frame as a viewable RGB image."""
    if layer == "rgb":
        return frame.rgb
    plane = getattr(frame, {"depth": "depth_m"}.get(layer, layer))
    if layer == "label":
        table = np.zeros((256, 3), np.uint8)
        for label, colour in LABEL_RGB.items():
            table[label] = colour
        return table[plane]
    if layer == "normal":
        known = np.any(plane != 0, axis=-1, keepdims=True)
        return np.where(known, (plane + 1) * 127.5 + 0.5, 0).astype(np.uint8)
    # The square root spreads near depths, where most of an image lies.
    shade = np.clip(plane / FAR_M, 0, 1) ** 0.5 if layer == "depth" else np.clip(plane, 0, 1)
    return np.repeat((255 * shade + 0.5).astype(np.uint8)[..., None], 3, axis=2)
