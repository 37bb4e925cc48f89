"""Geometry from exact depth and exact boxes: slopes within a pixel, normals, and scene flow.

``nearness`` is 1 / z along the optical axis, 0 for the sky. In a pinhole image the nearness of a plane is linear in the
pixel coordinates, so that differences of neighbours are exact on planes, at any distance and angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, UInt8

from nurec_sim import geometry, sensors
from nurec_sim.types import CameraModel, Matrix4, Pinhole

_NO_NEIGHBOUR = np.float32(1e9)

Plane = Float32[np.ndarray, "h w"]


@dataclass(frozen=True)
class TrueView:
    """An image with its ground truth. Pixels outside the lens are black sky, with all other values zero.

    Args:
        rgb: colours, after the camera's ``CameraResponse``.
        depth_m: distance of the surface along the optical axis, 0 for the sky and for points behind the camera
            (lenses of more than 180 degrees).
        surface: ``SurfaceClass``.
        instance: 0 for static surfaces, i + 1 for actor i of the plan.
        normal: unit normal of the surface in the camera frame, towards the camera; zero where unknown.
        range_m: distance of the surface from the camera, 0 for the sky.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    depth_m: Float32[np.ndarray, "h w"]
    surface: UInt8[np.ndarray, "h w"]
    instance: Int32[np.ndarray, "h w"]
    normal: Float32[np.ndarray, "h w 3"]
    range_m: Float32[np.ndarray, "h w"]


def slopes(nearness: Plane, geom: Int32[np.ndarray, "h w"]) -> tuple[Plane, Plane, Bool[np.ndarray, "h w"]]:
    """Gradient of nearness per pixel, rightwards and downwards, and where both are known (elsewhere they may be 0).

    Differences never cross from one geom to another. Of the two one-sided differences along a line, the one beyond
    which the surface continues most evenly is used, so that folds and edges inside a geom are not smeared (the idea of
    ENO schemes).
    """
    right, right_known = _slope(nearness, geom)
    down, down_known = _slope(nearness.T, geom.T)
    return right, np.ascontiguousarray(down.T), right_known & down_known.T & (geom >= 0)


def _slope(nearness: Plane, geom: Int32[np.ndarray, "h w"]) -> tuple[Plane, Bool[np.ndarray, "h w"]]:
    """Slope along the last axis."""
    height, width = nearness.shape
    # Step j leads from pixel j - 1 to pixel j, so pixel j lies between the steps j and j + 1.
    step = np.full((height, width + 1), _NO_NEIGHBOUR, np.float32)
    np.subtract(nearness[:, 1:], nearness[:, :-1], out=step[:, 1:-1], where=geom[:, 1:] == geom[:, :-1])
    bend = np.full((height, width + 2), _NO_NEIGHBOUR, np.float32)
    np.abs(np.diff(step, axis=1), out=bend[:, 1:-1])
    size = np.abs(step)
    unknown = size >= _NO_NEIGHBOUR / 2
    # How much the slope changes one step further out; if that step leaves the geom, the size of the step itself.
    after, before = np.minimum(bend[:, 2:], size[:, 1:]), np.minimum(bend[:, :-2], size[:, :-1])
    # A step into another geom is never chosen over a known one.
    after[unknown[:, 1:]] = before[unknown[:, :-1]] = 2 * _NO_NEIGHBOUR
    slope = np.where(after < before, step[:, 1:], step[:, :-1])
    known = slope < _NO_NEIGHBOUR / 2
    slope[~known] = 0.0
    return slope, known


def plane_normals(
    lens: Pinhole, nearness: Plane, right: Plane, down: Plane, known: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    """Unit normals of the planes with these slopes, in the camera frame and towards the camera.

    Args:
        lens: pinhole without distortion that took the image.
        nearness: 1 / z of every pixel (1/m).
        right: slope of nearness per pixel to the right.
        down: slope of nearness per pixel downwards.
        known: where the slopes are valid; normals are zero elsewhere.
    """
    height, width = nearness.shape
    u = np.arange(width, dtype=np.float32) + np.float32(0.5 - lens.cx_px)
    v = np.arange(height, dtype=np.float32)[:, None] + np.float32(0.5 - lens.cy_px)
    # Points of a plane obey n . (x, y, z) = 1, hence nearness = n . (x/z, y/z, 1); this n points away from the camera.
    normal = np.empty((height, width, 3), np.float32)
    normal[..., 0], normal[..., 1] = right * np.float32(lens.fx_px), down * np.float32(lens.fy_px)
    normal[..., 2] = nearness - right * u - down * v
    length = np.sqrt(np.einsum("hwc,hwc->hw", normal, normal))
    normal *= np.where(known, -1 / np.maximum(length, np.float32(1e-12)), np.float32(0))[..., None]
    return normal


def scene_flow(
    view: TrueView,
    camera: CameraModel,
    world_from_camera: Matrix4,
    boxes_now: Float64[np.ndarray, "actors 4 4"],
    boxes_then: Float64[np.ndarray, "actors 4 4"],
) -> Float32[np.ndarray, "h w 3"]:
    """Motion of every pixel's point from now to then, in metres along the world's axes; zero on static surfaces.

    Points of an actor move rigidly with its box: swinging limbs and turning wheels are not followed.

    Args:
        view: image with ground truth, taken now.
        camera: the camera.
        world_from_camera: its pose now.
        boxes_now: ``world_from_box`` of all actors of the plan in its order (``TrueWorld.boxes``).
        boxes_then: the same at another time.
    """
    flow = np.zeros((*view.instance.shape, 3), np.float32)
    rays, _ = sensors.pixel_rays(camera)
    for instance in np.unique(view.instance[view.instance > 0]):
        moved = boxes_then[instance - 1] @ geometry.inverse(boxes_now[instance - 1])
        on_it = view.instance == instance
        points = geometry.transform_points(world_from_camera, rays[on_it] * view.range_m[on_it, None])
        flow[on_it] = geometry.transform_points(moved, points) - points
    return flow


def follow(
    view: TrueView,
    camera: CameraModel,
    world_from_camera: Matrix4,
    flow_m: Float32[np.ndarray, "h w 3"],
    world_from_camera_then: Matrix4,
) -> tuple[Float64[np.ndarray, "h w 2"], Float64[np.ndarray, "h w"]]:
    """Projection of each pixel's point at another time, ignoring occlusion.

    Args:
        view: image with ground truth, taken now.
        camera: the camera.
        world_from_camera: its pose now.
        flow_m: motion of every pixel's point until then (``scene_flow``).
        world_from_camera_then: pose of the camera at the other time.

    Returns:
        Pixel coordinates then, NaN for the sky and for points outside the lens; and the distance (m) then.
    """
    rays, _ = sensors.pixel_rays(camera)
    met = view.range_m > 0
    points = geometry.transform_points(world_from_camera, rays[met] * view.range_m[met, None]) + flow_m[met]
    points = geometry.transform_points(geometry.inverse(world_from_camera_then), points)
    uv, range_m = np.full((*met.shape, 2), np.nan), np.zeros(met.shape)
    uv[met], _ = sensors.project(camera, points)
    range_m[met] = np.linalg.norm(points, axis=1)
    return uv, range_m
