"""What cameras see of the ego vehicle: found in the frames of a log, so that it is not rebuilt as part of the street.

The bonnet or the boot stays at its place in the image while the car drives; the street moves as its depth predicts.
Textured pixels that match better at their own place than along their epipolar line are evidence for the vehicle, those
that match along the line are evidence for the street (``evidence.py``). The vehicle fills the image from its lower edge
up to a boundary of one row per column: the one that contradicts the least evidence and lies on edges that stay
(``boundary.py``). What is dark and hangs into the image from above, down to an edge that stays, belongs to it as well.

A car ahead that keeps its distance stays at its place too. What stands beyond the ego vehicle by LiDAR returns or boxes
of the log is evidence for the street, unless the lower body of the car may hide it (``surroundings.py``).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from nurec_sim import geometry, sensors
from nurec_sim.compute.cores import in_order
from nurec_sim.reconstruct.ego_vehicle.boundary import vehicle_above, vehicle_below
from nurec_sim.reconstruct.ego_vehicle.evidence import compare, flow_of, static_gradient
from nurec_sim.reconstruct.ego_vehicle.surroundings import shows_others
from nurec_sim.types import Box, CameraModel, Clip

EGO_HEIGHT_M = 0.75
"""Bonnet and boot of a car lie at about this height: what is lower within its outline is the car itself."""
WIDTH_PX = 400
"""Width at which frames are compared, about."""
PAIRS = 6
"""Pairs of frames that are compared, at most."""
BASELINE_M = 1.0
"""How far the camera moves between the frames of a pair, at least."""
GROUND_RANGE_M = 30.0
"""Ground further away moves too little."""
FULL_EDGE = 12.0
"""Change of the grey level per pixel, of 255, at an edge that counts fully."""
DARK = 48.0
"""Grey level of what hangs into the image from above, at most: it is out of focus and in the shade."""
PICTURES = 16
"""Frames whose median is the image of the vehicle, at most."""
FEATHER_PX = 1.5


def find_ego_images(
    clip: Clip,
    cameras: Sequence[str],
    progress: Callable[[float], None] = lambda fraction: None,
    hold_out: Collection[int] = (),
) -> dict[str, UInt8[np.ndarray, "h w 4"]]:
    """Images of the ego vehicle as each camera sees it, RGBA of the camera's size; none of cameras that do not see it.

    Sweeps of ``hold_out`` are not read. The log's own masks (``Clip.ego_mask``) come first. Without two frames at least
    ``BASELINE_M`` apart, or without evidence in it, the vehicle is taken to be where its outline is, below
    ``EGO_HEIGHT_M``.
    """
    images = {}
    for number, camera in enumerate(cameras):
        progress(number / len(cameras))
        mask = clip.ego_mask(camera)
        if mask is None:
            mask = _find_mask(clip, camera, hold_out)
        if mask is not None and mask.any():
            images[camera] = _picture(clip, camera, mask)
    return images


def shows_ego(rays: Float64[np.ndarray, "h w 3"], camera: CameraModel, body: Box) -> Bool[np.ndarray, "h w"]:
    """Which of a camera's rays, of any length, pass through the lower body of the car; none if it is within."""
    centre, size = np.asarray(body.center_m), np.asarray(body.size_m)
    low, high = centre - size / 2, centre + size / 2
    high[2] = min(high[2], low[2] + EGO_HEIGHT_M)
    origin = camera.rig_from_camera[:3, 3]
    if np.all((origin >= low) & (origin <= high)):
        return np.zeros(rays.shape[:2], bool)
    rays = rays @ camera.rig_from_camera[:3, :3].T
    enter, leave = geometry.box_crossings(origin, rays, low, high)
    return (enter < leave) & (leave > 0)


def _find_mask(clip: Clip, camera: str, hold_out: Collection[int]) -> Bool[np.ndarray, "h w"] | None:
    """Where the camera sees the vehicle, at the size of the camera; None if nowhere."""
    model = clip.rig.cameras[camera]
    reduction = max(1, round(model.width_px / WIDTH_PX))
    small = sensors.scaled_camera(model, model.width_px // reduction, model.height_px // reduction)
    poses = [
        geometry.interpolate_pose_pair(np.asarray(clip.world_from_camera(camera, frame), np.float64), np.array(0.5))
        for frame in range(len(clip.camera_times_us(camera)))
    ]
    pairs, outline = _pairs(poses), shows_ego(sensors.pixel_rays(model)[0], model, clip.rig.body)
    if not pairs:
        return outline
    rays, depth_m = ground_before(small, clip)
    near = np.isfinite(depth_m)
    if not near.any():
        return None
    size = small.width_px, small.height_px
    frames = sorted({i for pair in pairs for i in pair})
    small_images = list(in_order(lambda i: _reduced(clip.image(camera, i), size), frames))
    grey = {i: cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for i, image in zip(frames, small_images, strict=True)}
    hidden, points = shows_ego(rays, small, clip.rig.body), np.where(near, depth_m, 1.0)[..., None] * rays
    gradient = static_gradient(small_images)
    strength = np.hypot(*gradient)

    def compared(pair: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        first, second = pair
        others = shows_others(clip, small, first, hold_out) & ~hidden
        second_from_first = geometry.inverse(poses[second]) @ poses[first]
        here, there = compare(small, grey[first], grey[second], points, second_from_first)
        flow = flow_of(small, points, second_from_first)
        along = np.abs((gradient * flow).sum(axis=0)) / np.maximum(np.hypot(*flow), 1e-6)
        return here & near & ~others, (there | others) & near, along

    ego, street, along = np.mean(list(in_order(compared, pairs)), axis=0)
    edges = np.minimum(strength / FULL_EDGE, 1.0)
    # A line along the motion, as those of the road are, stays at its place too: it counts half.
    across = along / np.maximum(strength, 1e-6)
    mask = vehicle_below(ego, street, edges * np.minimum(0.5 + across, 1.0), near)
    bright = np.max(list(grey.values()), axis=0) > DARK
    mask |= vehicle_above(bright, np.copysign(edges, gradient[1]), near)
    if not mask.any():
        # Neither plain paint nor plain asphalt tells anything.
        street_seen = street[hidden & near].sum() > ego[hidden & near].sum()
        return None if street_seen else outline
    full = cv2.resize(mask.astype(np.float32), (model.width_px, model.height_px), interpolation=cv2.INTER_LINEAR)
    return full > 0.25


def _pairs(poses: Sequence[Float64[np.ndarray, "4 4"]]) -> list[tuple[int, int]]:
    """Pairs of frames, in both orders, with the baseline between them; spread evenly over the drive."""
    places = np.array([pose[:3, 3] for pose in poses])
    pairs = []
    for first in range(len(places)):
        away = np.nonzero(np.linalg.norm(places[first + 1 :] - places[first], axis=1) >= BASELINE_M)[0]
        if len(away):
            pairs.append((first, first + 1 + int(away[0])))
    pairs += [(second, first) for first, second in pairs]
    chosen = np.linspace(0, len(pairs) - 1, min(PAIRS, len(pairs))).astype(int)
    return [pairs[k] for k in chosen]


def ground_before(camera: CameraModel, clip: Clip) -> tuple[Float64[np.ndarray, "h w 3"], Float64[np.ndarray, "h w"]]:
    """Rays of the pixels in the camera frame, and the distance at which each meets the ground, or nan."""
    rays, seen = sensors.pixel_rays(camera)
    body = clip.rig.body
    ground_z = body.center_m[2] - body.size_m[2] / 2
    down = (rays @ camera.rig_from_camera[:3, :3].T)[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        length = (ground_z - camera.rig_from_camera[2, 3]) / down
    return rays, np.where(seen & (length > 0) & (length < GROUND_RANGE_M), length, np.nan)


def _reduced(rgb: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> Float32[np.ndarray, "h w 3"]:
    return cv2.resize(rgb, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def _picture(clip: Clip, camera: str, mask: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 4"]:
    """Median of frames where the mask is set, with a soft edge."""
    count = len(clip.camera_times_us(camera))
    frames = sorted(set(np.linspace(0, count - 1, min(PICTURES, count)).astype(int).tolist()))
    top = int(mask.any(axis=1).argmax())
    cover = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), FEATHER_PX)
    stack = np.stack([clip.image(camera, frame)[top:] for frame in frames])
    picture = np.zeros((*mask.shape, 4), np.uint8)
    picture[top:, :, :3] = np.median(stack, axis=0) * (cover[top:, :, None] > 0)
    picture[..., 3] = np.rint(255 * cover)
    return picture
