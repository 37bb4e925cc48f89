"""Objects in the frame of a camera, and how much of each an image shows.

The frame is that of the camera: x right, y down, z along the optical axis. A heading is the angle of an object's
forward axis from z towards x, so that 0 drives away from the camera and pi/2 to the right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import shapely
from jaxtyping import Bool, Float64, Int32, Int64

from nurec_sim import geometry, sensors
from nurec_sim.types import CameraModel, Matrix4, Track

KINDS = ("vehicle", "person")
KIND_OF_LABEL = {
    "automobile": 0, "heavy_truck": 0, "bus": 0, "trailer": 0, "other_vehicle": 0, "person": 1, "rider": 1,
}  # fmt: skip
"""Kind of an object by its label; other labels are no objects of the detector. Cyclists are people."""
FOCAL_PX = 343.0
"""Focal length of the images at which the detector looks: others are resized."""
SHARE, PIXELS = np.array([0.25, 0.12]), 16.0
"""An object is visible if at least this share of its box's outline, by kind, and this many pixels of such an image show
it. A vehicle that nothing hides fills 0.6 to 0.8 of its outline, a person 0.2 to 0.5."""
NEAREST_M = 0.3


@dataclass(frozen=True, eq=False)
class Objects:
    """Boxes in the frame of a camera.

    Attributes:
        kind: index into ``KINDS``.
        centre_m: centres of the boxes.
        size_m: length, width, height.
        heading_rad: angle of the forward axis from z towards x.
    """

    kind: Int64[np.ndarray, " n"]
    centre_m: Float64[np.ndarray, "n 3"]
    size_m: Float64[np.ndarray, "n 3"]
    heading_rad: Float64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.kind)

    @property
    def ground_m(self) -> Float64[np.ndarray, "n 2"]:
        """Places of the centres in the plane of x and z."""
        return self.centre_m[:, [0, 2]]


@dataclass(frozen=True, eq=False)
class Labelled(Objects):
    """True objects before a camera.

    Attributes:
        outline_px: area of the part of the box's outline that is in the image, NaN if the box reaches behind the camera
            and has none.
        shown_px: pixels that show the object.
        inside: whether the box's centre is in front of the camera and in its image.
        focal_px: of the image.
    """

    outline_px: Float64[np.ndarray, " n"]
    shown_px: Float64[np.ndarray, " n"]
    inside: Bool[np.ndarray, " n"]
    focal_px: float

    @property
    def visible(self) -> Bool[np.ndarray, " n"]:
        """Which ones a detector should find.

        The centre is in the image, and at least ``SHARE`` of the outline and ``PIXELS`` pixels show the object. All
        others, hidden, cut off, or too small, are neither to be found nor wrong if they are.
        """
        scaled = self.shown_px * (FOCAL_PX / self.focal_px) ** 2
        with np.errstate(invalid="ignore"):
            enough = self.shown_px >= SHARE[self.kind] * np.maximum(self.outline_px, 1.0)
        return self.inside & enough & (scaled >= PIXELS)


def labelled_objects(
    tracks: Sequence[Track],
    t_us: int,
    camera: CameraModel,
    world_from_camera: Matrix4,
    instance: Int32[np.ndarray, "h w"] | None = None,
) -> Labelled:
    """The objects of a log before a camera at an instant.

    Args:
        tracks: all tracks of the log.
        t_us: the instant, microseconds.
        camera: pinhole or any other lens; what is not in its valid field is not in the image.
        world_from_camera: its pose then.
        instance: of every pixel, i + 1 for ``tracks[i]``. If None, as in real logs, boxes are drawn from the farthest
            to the nearest, so that only other boxes hide an object.
    """
    camera_from_world = geometry.inverse(world_from_camera)
    known = [
        (i, track) for i, track in enumerate(tracks) if track.label in KIND_OF_LABEL and track.path.covers(t_us)
    ]  # fmt: skip
    poses = [camera_from_world @ track.path.at(t_us) for _, track in known]
    rows = [(i, track, pose) for (i, track), pose in zip(known, poses, strict=True) if pose[2, 3] > 0]
    hulls = [_outline(camera, pose, track.size_m) for _, track, pose in rows]
    if instance is None:
        instance = _drawn(camera, hulls, [(i, float(np.linalg.norm(pose[:3, 3]))) for i, _, pose in rows])
    shown = np.bincount(instance.ravel().clip(0), minlength=len(tracks) + 1)
    image = shapely.box(0, 0, camera.width_px, camera.height_px)
    place = np.array([pose[:3, 3] for _, _, pose in rows]).reshape(-1, 3)
    forward = np.array([pose[:3, 0] for _, _, pose in rows]).reshape(-1, 3)
    uv, valid = sensors.project(camera, place) if len(place) else (np.zeros((0, 2)), np.zeros(0, bool))
    inside = valid & sensors.in_image(camera, uv) if len(place) else valid
    return Labelled(
        np.array([KIND_OF_LABEL[track.label] for _, track, _ in rows], np.int64),
        place,
        np.array([track.size_m for _, track, _ in rows], np.float64).reshape(-1, 3),
        np.arctan2(forward[:, 0], forward[:, 2]),
        np.array([np.nan if hull is None else _area(hull, image) for hull in hulls], np.float64),
        np.array([shown[i + 1] for i, _, _ in rows], np.float64),
        np.asarray(inside, bool),
        focal_px(camera),
    )


def focal_px(camera: CameraModel) -> float:
    """Pixels per radian at the middle of an image."""
    lens = camera.ideal_pinhole
    if lens is not None:
        return float(lens.fy_px)
    middle = np.array(
        [[camera.width_px / 2, camera.height_px / 2 - 1], [camera.width_px / 2, camera.height_px / 2 + 1]]
    )
    rays, _ = sensors.unproject(camera, middle)
    return 2.0 / float(np.arccos(np.clip(rays[0] @ rays[1], -1, 1)))


def outlines(camera: CameraModel, objects: Objects) -> list[Float64[np.ndarray, "8 2"] | None]:
    """Corners of boxes in pixels; None of those that reach behind the camera or out of the lens's valid field."""
    found = []
    for centre, size, heading in zip(objects.centre_m, objects.size_m, objects.heading_rad, strict=True):
        # Columns: forward, left and up of an upright box in the camera's axes.
        forward = np.array([np.sin(heading), 0.0, np.cos(heading)])
        up = np.array([0.0, -1.0, 0.0])
        pose = geometry.pose(np.stack([forward, np.cross(up, forward), up], axis=1), centre)
        corners = geometry.transform_points(pose, geometry.BOX_CORNERS * size)
        uv, valid = sensors.project(camera, corners)
        found.append(uv if valid.all() and corners[:, 2].min() >= NEAREST_M else None)
    return found


def _outline(camera: CameraModel, camera_from_box: Matrix4, size_m: Sequence[float]) -> np.ndarray | None:
    """The box's outline in pixels; None if it reaches behind the camera or out of the lens's valid field."""
    corners = geometry.transform_points(camera_from_box, geometry.BOX_CORNERS * np.asarray(size_m))
    if corners[:, 2].min() < NEAREST_M:
        return None
    uv, valid = sensors.project(camera, corners)
    return cv2.convexHull(uv.astype(np.float32))[:, 0] if valid.all() else None


def _area(hull: np.ndarray, image: shapely.Polygon) -> float:
    return float(shapely.intersection(shapely.Polygon(hull), image).area) if len(hull) > 2 else 0.0


def _drawn(
    camera: CameraModel, hulls: Sequence[np.ndarray | None], places: Sequence[tuple[int, float]]
) -> Int32[np.ndarray, "h w"]:
    """Instances of boxes that are drawn from the farthest to the nearest."""
    image = np.zeros((camera.height_px, camera.width_px), np.int32)
    for k in sorted(range(len(hulls)), key=lambda k: -places[k][1]):
        hull = hulls[k]
        if hull is not None:
            cv2.fillConvexPoly(image, np.rint(hull).astype(np.int32), places[k][0] + 1)
    return image
