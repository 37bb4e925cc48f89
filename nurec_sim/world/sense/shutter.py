"""Rolling shutters and spinning LiDARs as patches of rays that share one instant.

A rolling shutter is divided into bands of lines, a LiDAR turn into sectors of columns; each is rendered with the poses
of its own middle instant.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from nurec_sim import geometry, sensors
from nurec_sim.types import CameraModel, Lens, LidarModel, Pinhole, Shutter, Windshield
from nurec_sim.world.sense.faces import Face, pinhole_face, plan_faces

MOTION_PX = 0.5
"""Bands are narrow enough for less image motion than this within one, if ``MOST_BANDS`` suffice."""
MOST_BANDS = 16
FEWEST_LINES = 4
FINENESS = 1.5
"""Pixels of a rendered face per camera pixel or beam; more give sharper edges and take longer."""
SECTORS = 12
SECTOR_PIXEL_RAD = np.deg2rad(0.1)
"""Maximum pixel size of a LiDAR's faces, however sparse its beams."""
KEPT_PIXELS = 1 << 21
"""Patches of images up to this size are cached for the next frame; about 50 bytes per pixel."""
IMAGE_DOWN, LIDAR_DOWN = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True, eq=False)
class RayPatch:
    """Rays of a sensor at one instant: ``fraction`` of the exposure or turn, 0 at its start.

    ``rays`` belong to the sensor's pixels or beams in ``rows`` and ``columns``; ``flat`` is the lens of these pixels
    if it is a pinhole without distortion. ``down`` and ``fineness`` as in ``faces.plan_faces``.
    """

    rows: slice
    columns: slice
    fraction: float
    rays: Float64[np.ndarray, "h w 3"]
    valid: Bool[np.ndarray, "h w"]
    down: Float64[np.ndarray, " 3"]
    fineness: float
    flat: Pinhole | None = None

    @functools.cached_property
    def faces(self) -> tuple[Face, ...]:
        """Pinhole images that together cover all rays."""
        if self.flat is not None:
            return (pinhole_face(self.flat, self.rays),)
        return plan_faces(self.rays, self.valid, self.down, self.fineness)


def camera_patches(camera: CameraModel, bands: int) -> tuple[RayPatch, ...]:
    """A camera as ``bands`` bands of its lines, one after the other; a global shutter is one band."""
    usual = camera.width_px * camera.height_px <= KEPT_PIXELS
    make = _kept_camera_patches if usual else _camera_patches
    bands = 1 if camera.shutter is Shutter.GLOBAL else bands
    return make(camera.lens, camera.windshield, camera.width_px, camera.height_px, camera.shutter, bands)


def _camera_patches(
    lens: Lens, glass: Windshield | None, width: int, height: int, shutter: Shutter, bands: int
) -> tuple[RayPatch, ...]:
    camera = CameraModel("", width, height, lens, np.eye(4), shutter, glass)
    rays, valid = sensors.pixel_rays(camera)
    by_column = shutter in (Shutter.LEFT_TO_RIGHT, Shutter.RIGHT_TO_LEFT)
    edges = np.rint(np.linspace(0, width if by_column else height, bands + 1)).astype(int)
    patches = []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        band, whole = slice(int(low), int(high)), slice(0, height if by_column else width)
        rows, columns = (whole, band) if by_column else (band, whole)
        # The mean time of the first and the last line of the band.
        lines = np.array([low, high - 1]) + 0.5
        fraction = float(sensors.shutter_fraction(camera, np.stack([lines, lines], axis=1)).mean())
        part, seen = rays[rows, columns], valid[rows, columns]
        # A band of an undistorted pinhole is itself a pinhole, with a shifted principal point: no resampling.
        flat = None if camera.ideal_pinhole is None else camera.ideal_pinhole.cropped(columns.start, rows.start)
        patches.append(RayPatch(rows, columns, fraction, part, seen, IMAGE_DOWN, FINENESS, flat))
    return tuple(patches)


_kept_camera_patches = functools.lru_cache(maxsize=8)(_camera_patches)


@functools.lru_cache(maxsize=4)
def lidar_patches(lidar: LidarModel) -> tuple[RayPatch, ...]:
    """A turning LiDAR as up to ``SECTORS`` sectors of its columns."""
    beams, fraction = sensors.beam_directions(lidar), sensors.column_fraction(lidar)
    rows, columns = beams.shape[:2]
    angles = (lidar.elevation_rad, lidar.azimuth_rad)
    # Sparse beams get more face pixels each, so that edges are located to the same angle.
    closest = min((float(np.quantile(np.abs(np.diff(k)), 0.2)) for k in angles if len(k) > 1), default=0.0)
    fineness = max(FINENESS, closest / SECTOR_PIXEL_RAD)
    edges = np.unique(np.rint(np.linspace(0, columns, SECTORS + 1)).astype(int)).tolist()
    patches = []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        part, valid = beams[:, low:high], np.ones((rows, high - low), bool)
        middle = float(fraction[low:high].mean())
        patches.append(RayPatch(slice(0, rows), slice(low, high), middle, part, valid, LIDAR_DOWN, fineness))
    return tuple(patches)


def bands_for(camera: CameraModel, motion_px: float) -> int:
    """Number of bands for an image motion of ``motion_px`` during the whole readout: 1, 2, 4, 8 or 16."""
    lines = camera.width_px if camera.shutter in (Shutter.LEFT_TO_RIGHT, Shutter.RIGHT_TO_LEFT) else camera.height_px
    most = max(min(MOST_BANDS, lines // FEWEST_LINES), 1)
    bands = 1
    # Powers of two: a slowly changing speed keeps hitting the same cached patches.
    while bands * 2 <= most and motion_px / bands > MOTION_PX:
        bands *= 2
    return bands


def turned_patch(patch: RayPatch, turns: Float64[np.ndarray, "*lines 3 3"]) -> RayPatch:
    """The patch with the rays of every line rotated (``turns`` broadcasts over its rays), for fast rotating cameras."""
    rays = (turns @ np.where(patch.valid[..., None], patch.rays, 0.0)[..., None])[..., 0]
    return RayPatch(patch.rows, patch.columns, patch.fraction, rays, patch.valid, patch.down, patch.fineness)


def line_turns(
    camera: CameraModel, patch: RayPatch, world_from_camera: Float64[np.ndarray, "2 4 4"]
) -> Float64[np.ndarray, "*lines 3 3"]:
    """Rotations band_from_line of a rolling shutter: [h,1,3,3] for bands of rows, [1,w,3,3] for bands of columns."""
    by_column = camera.shutter in (Shutter.LEFT_TO_RIGHT, Shutter.RIGHT_TO_LEFT)
    band = patch.columns if by_column else patch.rows
    lines = np.arange(band.start, band.stop) + 0.5
    fractions = sensors.shutter_fraction(camera, np.stack([lines, lines], axis=1))
    poses = geometry.interpolate_pose_pair(world_from_camera, np.append(fractions, patch.fraction))[:, :3, :3]
    # band_from_line = (world_from_band)^T world_from_line; the last pose is the band's.
    turns = poses[-1].T @ poses[:-1]
    return turns[None] if by_column else turns[:, None]


def motion_px(
    camera: CameraModel,
    world_from_camera: Float64[np.ndarray, "2 4 4"],
    start_m: Float64[np.ndarray, "n 3"],
    end_m: Float64[np.ndarray, "n 3"],
) -> float:
    """Image motion (95th percentile, in pixels) of world points during an exposure.

    Args:
        camera: the camera.
        world_from_camera: its poses at the start and at the end.
        start_m: points in the world at the start.
        end_m: the same points at the end.
    """
    (first, seen), (last, still_seen) = (
        sensors.project(camera, geometry.transform_points(geometry.inverse(pose), points))
        for pose, points in zip(world_from_camera, (start_m, end_m), strict=True)
    )
    moved = np.linalg.norm(last - first, axis=1)[seen & still_seen]
    return float(np.quantile(moved, 0.95)) if len(moved) else 0.0
