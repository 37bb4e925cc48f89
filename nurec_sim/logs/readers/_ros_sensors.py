"""Lenses, images and points of ROS 2 messages.

Their conventions: pixel centres at whole numbers; fields of points at byte offsets; times of points in fields of many
names, units and origins.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8

from nurec_sim.errors import ClipError
from nurec_sim.files.decoding import LIMITS
from nurec_sim.logs.storage import decode_image
from nurec_sim.types import Fisheye, Lens, Pinhole, SweepPoints

TIME_FIELDS = ("t", "time", "timestamp", "offset_time", "time_stamp", "timeStamp", "time_offset", "dt")
INTENSITY_FIELDS = ("intensity", "reflectivity", "i")
UNITS_PER_S = {"s": 1, "ms": 1_000, "us": 1_000_000, "ns": 1_000_000_000}
LONGEST_SWEEP_S, FURTHEST_S = 1.5, 10.0
FULL_BYTE = 255.0
# sensor_msgs/PointField: INT8 = 1 to FLOAT64 = 8.
_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_PLAIN = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2), "bgra8": (2, 1, 0), "8UC3": (2, 1, 0)}
# OpenCV names a pattern by the second row, from the second pixel on.
_CONVERTED = {
    "bayer_rggb8": "COLOR_BayerBG2RGB",
    "bayer_bggr8": "COLOR_BayerRG2RGB",
    "bayer_gbrg8": "COLOR_BayerGR2RGB",
    "bayer_grbg8": "COLOR_BayerGB2RGB",
    "yuv422": "COLOR_YUV2RGB_UYVY",
    "uyvy": "COLOR_YUV2RGB_UYVY",
    "yuv422_yuy2": "COLOR_YUV2RGB_YUY2",
    "yuyv": "COLOR_YUV2RGB_YUY2",
    "mono8": "COLOR_GRAY2RGB",
    "8UC1": "COLOR_GRAY2RGB",
}


def lens_of(where: str, info: Any, rectified: bool) -> tuple[Lens, int, int]:
    """The lens of a CameraInfo, and the width and height of the images that it describes.

    Args:
        where: its topic, for messages.
        info: the message.
        rectified: whether its images are; P holds then, else K and the distortion.

    Raises:
        ClipError: it is not calibrated, or its distortion is of an unknown kind.
    """
    matrix = np.array(info.p if rectified else info.k, np.float64).reshape(3, -1)
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5
    if not (np.isfinite(matrix).all() and fx > 0 and fy > 0):
        raise ClipError(
            f"{where}: its CameraInfo has focal lengths of {fx} and {fy}, it is not calibrated; give a lens in the "
            "YAML file, or list the other cameras there"
        )
    lens = Pinhole(fx, fy, cx, cy) if rectified else _distorted(where, info, fx, fy, cx, cy)
    # K describes the full sensor; images may show a part of it, at a lower resolution.
    roi, step_x, step_y = info.roi, max(1, info.binning_x), max(1, info.binning_y)
    width, height = roi.width or info.width, roi.height or info.height
    lens = dataclasses.replace(lens, cx_px=lens.cx_px - roi.x_offset, cy_px=lens.cy_px - roi.y_offset)
    return lens.scaled(1 / step_x, 1 / step_y), width // step_x, height // step_y


def _distorted(where: str, info: Any, fx: float, fy: float, cx: float, cy: float) -> Pinhole | Fisheye:
    given = tuple(float(value) for value in info.d)
    if info.distortion_model in ("equidistant", "fisheye"):
        k1, k2, k3, k4 = (*given, *(0.0,) * 4)[:4]
        return Fisheye(fx, fy, cx, cy, (k1, k2, k3, k4), max_angle_rad=np.pi)
    if info.distortion_model not in ("plumb_bob", "rational_polynomial", ""):
        known = "plumb_bob, rational_polynomial, equidistant, fisheye"
        raise ClipError(f"{where}: distortion model {info.distortion_model!r} is unknown; known are {known}")
    if any(given[12:]):
        raise ClipError(f"{where}: a tilted sensor (distortion coefficients 13 and 14) is not supported")
    # OpenCV: k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4.
    k1, k2, p1, p2, k3, k4, k5, k6, *prism = (*given, *(0.0,) * 12)[:12]
    return Pinhole(fx, fy, cx, cy, (k1, k2, k3, k4, k5, k6), (p1, p2), tuple(prism))


def picture(message: Any) -> UInt8[np.ndarray, "h w 3"]:
    """An Image or a CompressedImage as RGB.

    Raises:
        ClipError: its encoding is unknown, or its size does not fit its data.
    """
    if not hasattr(message, "encoding"):
        return decode_image(bytes(message.data))
    encoding, height, width, step = message.encoding, message.height, message.width, message.step
    channels = 1 if encoding.startswith(("bayer", "mono", "8UC1")) else 4 if encoding.endswith("a8") else 3
    channels = 2 if "yu" in encoding else channels
    if encoding not in _PLAIN | _CONVERTED:
        raise ClipError(f"encoding {encoding!r} is unknown; known are {sorted(_PLAIN | _CONVERTED)}")
    if not 0 < height * width <= LIMITS.image_pixels or step < width * channels or len(message.data) < step * height:
        size = f"{width} x {height} pixels in rows of {step} bytes"
        raise ClipError(f"an image of encoding {encoding!r} and {size} does not fit its {len(message.data)} bytes")
    rows = np.frombuffer(message.data, np.uint8, step * height).reshape(height, step)[:, : width * channels]
    pixels = rows.reshape(height, width, channels)
    if encoding in _PLAIN:
        return np.ascontiguousarray(pixels[:, :, _PLAIN[encoding]])
    import cv2

    converted = cv2.cvtColor(np.ascontiguousarray(pixels), getattr(cv2, _CONVERTED[encoding]))
    return np.asarray(converted, np.uint8)


def cloud(message: Any) -> np.ndarray:
    """The points of a PointCloud2 as a structured array with its fields; those without a return are left out.

    Raises:
        ClipError: it lacks x, y or z, a field is of an unknown type, or its size does not fit its data.
    """
    order = ">" if message.is_bigendian else "<"
    step, count = message.point_step, message.height * message.width
    known = [each for each in message.fields if each.datatype in _DATATYPES and each.count <= 1 and each.name]
    names = [each.name for each in known]
    if not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        raise ClipError(f"a point cloud needs the fields x, y and z once, got {names}")
    if count > LIMITS.sweep_points:
        raise ClipError(f"{count:,} points; a sweep may have {LIMITS.sweep_points:,}")
    layout = {
        "names": names,
        "formats": [order + _DATATYPES[each.datatype] for each in known],
        "offsets": [each.offset for each in known],
        "itemsize": step,
    }
    try:
        record = np.dtype(layout)  # type: ignore[call-overload]
        row_bytes = message.row_step if message.height > 1 else step * message.width
        rows = np.frombuffer(message.data, np.uint8, row_bytes * message.height).reshape(message.height, row_bytes)
        points = np.ascontiguousarray(rows[:, : step * message.width]).view(record).reshape(-1)
    except ValueError as error:
        raise ClipError(f"{count:,} points of {step} bytes do not fit {len(message.data):,} bytes: {error}") from None
    xyz = np.stack([points[axis] for axis in "xyz"])
    # Organised clouds fill in beams without a return with NaN or zero.
    return points[np.isfinite(xyz).all(axis=0) & (xyz != 0).any(axis=0)]


@dataclass(frozen=True)
class PointTimes:
    """How the points of a LiDAR say when they were measured.

    Attributes:
        field: the field that says so.
        per_s: its units in a second.
        absolute: whether it counts from the epoch of the clock, rather than from the message's time.
    """

    field: str
    per_s: int
    absolute: bool

    def after_us(self, points: np.ndarray, stamp_ns: int) -> np.ndarray:
        """Whole microseconds from the time of the message to each point's."""
        values = points[self.field]
        if self.absolute and values.dtype.kind in "iu":
            # In float64, nanoseconds since 1970 are exact to 256 only.
            values = values.astype(np.int64) - stamp_ns * self.per_s // 1_000_000_000
        elif self.absolute:
            values = values.astype(np.float64) - stamp_ns / 1_000_000_000 * self.per_s
        return np.rint(values.astype(np.float64) * (1e6 / self.per_s)).astype(np.int64)


def point_times(
    where: str, points: np.ndarray, stamp_ns: int, field: str | None, unit: str | None
) -> PointTimes | None:
    """What the times of a LiDAR's points mean, told from one of its clouds; None if they have no times.

    Args:
        where: topic, for messages.
        points: the cloud.
        stamp_ns: time of its message.
        field: name of the field; None looks for a usual one.
        unit: its unit; None takes the largest one by which a sweep lasts a second and a half at most.

    Raises:
        ClipError: the field does not exist, or its values cannot be the times of a sweep.
    """
    names = points.dtype.names or ()
    if field is None:
        field = next((name for name in TIME_FIELDS if name in names), None)
        if field is None:
            return None
    if field not in names:
        raise ClipError(f"{where}: points have no field {field!r}; have {list(names)}")
    values = points[field].astype(np.float64)
    if len(values) == 0 or not np.isfinite(values).all():
        raise ClipError(f"{where}: field {field!r} of the first cloud holds no times")
    span = float(values.max() - values.min())
    for name in UNITS_PER_S if unit is None else (unit,):
        per_s = UNITS_PER_S[name]
        if span > LONGEST_SWEEP_S * per_s:
            continue
        # Small times count from the message, those near its own from the epoch.
        middle = float(np.median(values)) / per_s
        apart = abs(middle - stamp_ns / 1e9)
        if min(abs(middle), apart) <= FURTHEST_S:
            return PointTimes(field, per_s, absolute=apart < abs(middle))
    raise ClipError(
        f"{where}: field {field!r} runs from {values.min():g} to {values.max():g}, "
        f"which are no times of a sweep in {unit or 's, ms, us or ns'}; name its field and unit under 'time'"
    )


def intensity_scale(points: np.ndarray) -> float:
    """The divisor that maps intensities to 0..1, told from one cloud: 1 if all lie in it, else 255."""
    field = _intensity_field(points)
    return 1.0 if field is not None and len(points) and float(points[field].max()) <= 1 else FULL_BYTE


def _intensity_field(points: np.ndarray) -> str | None:
    return next((name for name in INTENSITY_FIELDS if name in (points.dtype.names or ())), None)


def sweep_points(points: np.ndarray, scale: float, dt_us: np.ndarray | None) -> SweepPoints:
    """A cloud with its times as the points of a sweep."""
    field = _intensity_field(points)
    intensity = None if field is None else np.clip(np.nan_to_num(points[field].astype(np.float32)) / scale, 0.0, 1.0)
    return SweepPoints(np.stack([points[axis].astype(np.float64) for axis in "xyz"], axis=1), intensity, dt_us)
