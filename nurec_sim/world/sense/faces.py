"""Any sensor from pinhole images: which images to render for a grid of rays, and how to resample them along the rays.

Ids and surfaces come from the nearest pixel, but depth is the intersection of the ray with the plane seen by that
pixel: otherwise a surface at a grazing angle would be off by half a pixel. Colours are interpolated, and supersampled
where the sensor is coarser than the image. The axes of a face are those of a camera: x right, y down, z forward.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt8

from nurec_sim.types import Pinhole
from nurec_sim.world.sense.truth import plane_normals, slopes

WIDEST_TANGENT = 1.3
"""Largest tangent of one image (105 degrees across); wider fields of view need several."""
SECTOR_RAD = np.deg2rad(80.0)
COARSE_STEP = 1.3
"""Colours are sampled twice as densely where neighbouring rays are this many pixels of the face apart."""
RIM_PX = 2
MAX_SIDE_PX = 4096

Rays = Float64[np.ndarray, "h w 3"]
Mask = Bool[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class FaceImage:
    """A pinhole image: colours (None if not requested), geom ids (-1 sky) and 1 / z (0 sky)."""

    rgb: UInt8[np.ndarray, "h w 3"] | None
    geom: Int32[np.ndarray, "h w"]
    nearness: Float32[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class Seen:
    """Ray hits of a grid: colours, geom ids (-1 no hit), distance along the ray (0 no hit) and normals (0 unknown).

    Normals are unit vectors in the sensor's frame, pointing towards it.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    geom: Int32[np.ndarray, "h w"]
    range_m: Float32[np.ndarray, "h w"]
    normal: Float32[np.ndarray, "h w 3"]

    @staticmethod
    def nothing(height: int, width: int) -> Seen:
        """Black and without hits, to be filled."""
        return Seen(np.zeros((height, width, 3), np.uint8), np.full((height, width), -1, np.int32),
                    np.zeros((height, width), np.float32), np.zeros((height, width, 3), np.float32))  # fmt: skip

    def part(self, rows: slice, columns: slice) -> Seen:
        """A view of a window, sharing memory."""
        return Seen(*(image[rows, columns] for image in (self.rgb, self.geom, self.range_m, self.normal)))


@dataclass(frozen=True, eq=False)
class Face:
    """One pinhole image and the rays that are resampled from it.

    ``rows`` and ``columns`` bound the window of the grid with such rays, and ``owned`` marks them in it. ``nearest`` is
    the flat index of each ray's pixel, ``offset_px`` the ray's offset from the pixel centre to the right and down,
    ``cosine`` the z of the unit ray in the face. ``colour_maps`` are sampling positions whose colours are averaged. If
    the pixels of the face are the grid itself, ``nearest``, ``offset_px`` and ``colour_maps`` are unset.
    """

    lens: Pinhole
    width_px: int
    height_px: int
    sensor_from_face: Float64[np.ndarray, "3 3"]
    rows: slice
    columns: slice
    cosine: Float32[np.ndarray, "h w"]
    owned: Mask | None = None
    nearest: Int64[np.ndarray, "h w"] | None = None
    offset_px: Float32[np.ndarray, "2 h w"] | None = None
    colour_maps: tuple[Float32[np.ndarray, "h w 2"], ...] = ()

    def read(self, image: FaceImage, seen: Seen) -> None:
        """Fills this face's part of what the sensor sees."""
        right, down, known = slopes(image.nearness, image.geom)
        normal = plane_normals(self.lens, image.nearness, right, down, known)
        geom, nearness, rgb = image.geom, image.nearness, image.rgb
        if self.nearest is not None:
            assert self.offset_px is not None
            geom, nearness = geom.ravel()[self.nearest], nearness.ravel()[self.nearest]
            # 1 / z is linear in pixel coordinates on a plane, so extrapolation by the slopes is exact.
            on_plane = nearness + self.offset_px[0] * right.ravel()[self.nearest]
            on_plane += self.offset_px[1] * down.ravel()[self.nearest]
            # Where the surface curves within half a pixel, the plane is no valid extrapolation.
            nearness = np.where(np.abs(on_plane - nearness) < 0.5 * nearness, on_plane, nearness)
            normal = normal.reshape(-1, 3)[self.nearest] @ self.sensor_from_face.T.astype(np.float32)
            rgb = None if rgb is None else self._colours(rgb)
        range_m = np.zeros_like(nearness)
        # z = range * cosine.
        np.divide(1, nearness * self.cosine, out=range_m, where=geom >= 0)
        owned = np.ones((1, 1), bool) if self.owned is None else self.owned
        part = seen.part(self.rows, self.columns)
        np.copyto(part.geom, geom, where=owned)
        np.copyto(part.range_m, range_m, where=owned)
        np.copyto(part.normal, normal, where=owned[..., None])
        if rgb is not None:
            np.copyto(part.rgb, rgb, where=owned[..., None])

    def _colours(self, rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Colours along the rays, bilinear between pixel centres, averaged over all maps."""
        images = [
            np.asarray(cv2.remap(rgb, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
            for at in self.colour_maps
        ]
        if len(images) == 1:
            return images[0]
        total: np.ndarray = images[0].astype(np.uint16)
        for image in images[1:]:
            total = total + image
        return ((total + len(images) // 2) // len(images)).astype(np.uint8)


def pinhole_face(lens: Pinhole, rays: Rays) -> Face:
    """The only face of a pinhole camera without distortion: its pixels are the camera's."""
    height, width = rays.shape[:2]
    return Face(lens, width, height, np.eye(3), slice(0, height), slice(0, width), rays[..., 2].astype(np.float32))


def plan_faces(rays: Rays, valid: Mask, down: Float64[np.ndarray, " 3"], fineness: float) -> tuple[Face, ...]:
    """Faces that together cover all valid rays of a grid.

    Args:
        rays: unit rays in the sensor's frame.
        valid: which rays exist.
        down: a direction in the sensor's frame that points down in the faces.
        fineness: pixels of a face between the closest neighbouring rays.
    """
    if not valid.any():
        return ()
    frame = _frame(rays[valid].mean(axis=0), down)
    local = rays @ frame
    # Missing rays become the optical axis, which fits into any face.
    x, y, z = np.moveaxis(np.where(valid[..., None], local, (0.0, 0.0, 1.0)), -1, 0)
    # A normal field of view fits into a single image.
    if (z > 0.1).all() and max(np.abs(x / z).max(), np.abs(y / z).max()) <= WIDEST_TANGENT:
        return (_face(rays, valid, frame, fineness),)
    azimuth = np.arctan2(x, z)
    # A panorama that is wide but not high, as of a LiDAR, is divided into sectors of azimuth. At the edge of a sector z
    # is smaller by the cosine of half its width, hence the bound on the elevation.
    steep = np.abs(y) / np.maximum(np.hypot(x, z), 1e-9)
    first, last = azimuth[valid].min(), azimuth[valid].max()
    sectors = max(int(np.ceil((last - first) / SECTOR_RAD)), 1)
    width = (last - first) / sectors
    if steep[valid].max() <= WIDEST_TANGENT * np.cos(width / 2):
        owner = np.clip(np.floor((azimuth - first) / max(width, 1e-9)), 0, sectors - 1)
        turns = [_turn(first + (i + 0.5) * width) for i in range(sectors)]
    else:
        # The faces of a cube: forward, right, back, left, down, up.
        order = np.stack([z, x, -z, -x, y, -y], axis=-1)
        owner = np.argmax(order, axis=-1)
        tilts = [np.array([[1.0, 0, 0], [0, 0, s], [0, -s, 0]]) for s in (1, -1)]
        turns = [_turn(angle) for angle in (0, np.pi / 2, np.pi, -np.pi / 2)] + tilts
    owned = [valid & (owner == i) for i in range(len(turns))]
    return tuple(_face(rays, mask, frame @ turn, fineness) for mask, turn in zip(owned, turns, strict=True)
                 if mask.any())  # fmt: skip


def _frame(forward: Float64[np.ndarray, " 3"], down: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """Rotation sensor_from_face that looks ``forward`` with ``down`` pointing as much down as this allows."""
    length = np.linalg.norm(forward)
    # Rays in all directions have no mean direction; any one perpendicular to `down` serves.
    z = forward / length if length > 1e-6 else np.roll(down, 1)
    x = np.cross(down, z)
    if np.linalg.norm(x) < 1e-3:
        x = np.cross(np.roll(down, 1), z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _turn(angle: float) -> Float64[np.ndarray, "3 3"]:
    """Rotation about y that takes z towards x."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _face(rays: Rays, owned: Mask, sensor_from_face: Float64[np.ndarray, "3 3"], fineness: float) -> Face:
    rows, columns = (slice(int(i.min()), int(i.max()) + 1) for i in np.nonzero(owned))
    owned = np.ascontiguousarray(owned[rows, columns])
    local = rays[rows, columns] @ sensor_from_face
    forward = np.where(owned, local[..., 2], 1.0)
    # Rays of other faces are NaN, which the nan-functions below ignore.
    tangent = np.where(owned[..., None], local[..., :2] / forward[..., None], np.nan)
    steps = [_step(tangent, axis) for axis in (0, 1)]
    closest = np.nanpercentile(np.fmin(*steps), 20) if owned.sum() > 1 else 1e-3
    low, high = np.nanmin(tangent, axis=(0, 1)), np.nanmax(tangent, axis=(0, 1))
    # The closest fifth of the rays may share pixels: at the rim of some lenses their distance tends to zero.
    focal = min(fineness / max(closest, 1e-6), (MAX_SIDE_PX - 2 * RIM_PX - 2) / max((high - low).max(), 1e-9))
    centre = RIM_PX - low * focal
    width, height = (int(n) for n in np.ceil((high - low) * focal) + 2 * RIM_PX)
    lens = Pinhole(focal, focal, float(centre[0]), float(centre[1]))
    # Pixel centres lie at half-integer image coordinates, hence at integer places.
    places = tangent * focal + centre - 0.5
    place = np.where(owned[..., None], places, 0.0)
    index = np.rint(place).astype(np.int64)
    nearest = index[..., 1] * width + index[..., 0]
    offset = np.moveaxis(place - index, -1, 0).astype(np.float32)
    coarse = np.nanpercentile(np.fmax(*steps), 75) * focal > COARSE_STEP if owned.sum() > 1 else False
    return Face(lens, width, height, sensor_from_face, rows, columns, forward.astype(np.float32), owned, nearest,
                np.ascontiguousarray(offset), _colour_maps(places.astype(np.float32), bool(coarse)))  # fmt: skip


def _step(tangent: Float64[np.ndarray, "h w 2"], axis: int) -> Float64[np.ndarray, "h w"]:
    """Distance to the next ray along an axis of the grid; NaN where there is none."""
    step = np.full(tangent.shape[:2], np.nan)
    along = np.moveaxis(step, axis, 0)
    along[:-1] = np.linalg.norm(np.diff(np.moveaxis(tangent, axis, 0), axis=0), axis=-1)
    return step


def _colour_maps(places: Float32[np.ndarray, "h w 2"], coarse: bool) -> tuple[Float32[np.ndarray, "h w 2"], ...]:
    """Sampling positions of colours: the rays, or four positions within each ray's footprint in the image."""
    place = np.nan_to_num(places)
    if not coarse or min(place.shape[:2]) < 2:
        return (place,)
    by_row, by_column = (np.nan_to_num(part) for part in np.gradient(places, axis=(0, 1)))
    quarters = (-0.25, 0.25)
    return tuple(place + np.float32(a) * by_row + np.float32(b) * by_column for a in quarters for b in quarters)
