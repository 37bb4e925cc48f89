"""Where images show something else than the ego vehicle, by what LiDAR returns and labelled boxes say is there.

A LiDAR on the roof sees road that the bonnet hides from a camera. So returns from the road say nothing; those from
what stands on it do, because it stands at the same place of the image in many frames only if it keeps its distance.
"""

from __future__ import annotations

from collections.abc import Collection

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from nurec_sim import geometry, sensors
from nurec_sim.types import CameraModel, Clip

NEAREST_M = 2.0
"""Returns nearer to the camera, or within the outline of the car and ``MARGIN_M``, may lie on the car itself."""
MARGIN_M = 0.3
STANDING_M, STANDING_SLOPE = 0.3, 0.03
"""Returns so much above the plane of the road, and above a slope, do not lie on the road."""
LATE_US = 150_000
"""A sweep whose middle is further away in time from the image says nothing about it."""
SPACING_PX = 9
"""A return speaks for a square of so many pixels, at a width of about 400: the rows of a 32-beam LiDAR lie 8 apart, and
windows of this size in which images are compared reach beyond what stands there."""
DOWN = 9
"""Places from a return down to the road that are marked."""


def shows_others(
    clip: Clip, camera: CameraModel, frame: int, hold_out: Collection[int] = ()
) -> Bool[np.ndarray, "h w"]:
    """Pixels with something that stands beyond the ego vehicle: LiDAR returns and what is below them, boxes.

    Args:
        clip: the driving log.
        camera: the camera, at the size of the result.
        frame: index among its images.
        hold_out: sweeps that must not be read, of every LiDAR.
    """
    shown = np.zeros((camera.height_px, camera.width_px), np.uint8)
    pair = np.asarray(clip.world_from_camera(camera.id, frame), np.float64)
    t_us = int(np.sum(clip.camera_times_us(camera.id)[frame])) // 2
    for lidar in clip.rig.lidars:
        middles = clip.sweep_times_us(lidar).sum(axis=1) // 2
        near = [(abs(int(middle) - t_us), index) for index, middle in enumerate(middles) if index not in hold_out]
        if near and min(near)[0] <= LATE_US:
            _mark_returns(clip, camera, pair, lidar, min(near)[1], shown)
    for track in clip.tracks:
        if track.path.covers(t_us):
            corners = geometry.transform_points(track.path.at(t_us), geometry.BOX_CORNERS * track.size_m)
            uv, seen, _ = sensors.project_rolling(camera, pair, corners)
            # A box that reaches behind the image plane has no hull in the image.
            if seen.all() and np.abs(uv).max() < 1e5:
                cv2.fillConvexPoly(shown, cv2.convexHull(np.floor(uv).astype(np.int32)), 1)
    return cv2.dilate(shown, np.ones((SPACING_PX, SPACING_PX), np.uint8)) > 0


def _mark_returns(
    clip: Clip, camera: CameraModel, pair: np.ndarray, lidar: str, index: int, shown: UInt8[np.ndarray, "h w"]
) -> None:
    """Set the pixels of returns that are neither on the ego vehicle nor on the road, and those below them."""
    sweep, body = clip.sweep(lidar, index), clip.rig.body
    xyz = sweep.xyz_world_m[np.isfinite(sweep.xyz_m).all(axis=1)]
    world_from_rig = clip.ego.at(sweep.t_us)
    in_rig = geometry.transform_points(geometry.inverse(world_from_rig), xyz)
    own = geometry.points_in_box(in_rig - np.asarray(body.center_m), body.size_m, MARGIN_M)
    away, up = np.linalg.norm(xyz - pair[0, :3, 3], axis=1), in_rig[:, 2] - body.center_m[2] + body.size_m[2] / 2
    chosen = ~own & (away > NEAREST_M) & (up > STANDING_M + STANDING_SLOPE * away)
    for share in np.linspace(0, 1, DOWN):
        foot = in_rig[chosen] - np.array([0.0, 0.0, 1.0]) * share * up[chosen, None]
        uv, seen, _ = sensors.project_rolling(camera, pair, geometry.transform_points(world_from_rig, foot))
        seen &= sensors.in_image(camera, uv)
        column, row = np.floor(uv[seen]).astype(int).T
        shown[row, column] = 1
