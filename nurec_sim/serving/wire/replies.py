"""Images, sweeps, raw outputs of cameras and range maps of LiDARs <-> messages.

Raw arrays are little-endian, rows from top to bottom, channels last.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float32, UInt8

from nurec_sim.errors import RequestError
from nurec_sim.render.images.encode import available_formats, encode_image
from nurec_sim.serving.wire.messages import CameraOutput, ImageFormat
from nurec_sim.types import CameraFrame, CameraModel, LidarFrame, LidarModel, SensorRequest

DEFAULT_QUALITY = 95
ENCODER = {
    ImageFormat.PNG: "png",
    ImageFormat.JPEG: "jpeg",
    ImageFormat.JPEG2000: "jpeg2000",
    ImageFormat.RGB_UINT8_PLANAR: "rgb_planar",
    ImageFormat.AVC: "avc",
    ImageFormat.AV1: "av1",
}
_RAW = {
    CameraOutput.DEPTH: ("depth_m", "<f4", ()),
    CameraOutput.ALPHA: ("alpha", "<f4", ()),
    CameraOutput.LABEL: ("label", "u1", ()),
    CameraOutput.NORMAL: ("normal", "<f4", (3,)),
}
"""Field of the reply and of ``CameraFrame``, type and channels of every raw output."""

Sensor = TypeVar("Sensor", CameraModel, LidarModel)


# ------------------------------------------------------------------------------------------------------- sensor service


@dataclass(frozen=True)
class ImageOptions:
    """How a camera image is finished: file format, quality, and the ego mask laid over it."""

    format: int = ImageFormat.PNG
    quality: int = DEFAULT_QUALITY
    """1..100; without effect on PNG and raw planes."""
    ego_mask: tuple[str, str] | None = None
    """(rig, camera) of the mask, or None. The rig may be empty: the one that has a mask of this camera."""


def offered_formats() -> tuple[enum.IntEnum, ...]:
    """Image formats for which this installation has an encoder."""
    return tuple(number for number, name in ENCODER.items() if name in available_formats())


def sensor_of(request: SensorRequest, kind: type[Sensor]) -> Sensor:
    """The sensor of a request, if it is of a kind.

    Raises:
        RequestError: it is of another.
    """
    if not isinstance(request.sensor, kind):
        raise RequestError(f"the sensor must be a {kind.__name__}, got {type(request.sensor).__name__}")
    return request.sensor


def write_image(rgb: UInt8[np.ndarray, "h w 3"], options: ImageOptions, message) -> None:
    """Fills an ``RGBRenderReturn``."""
    message.image_bytes = encode_image(rgb, ENCODER[options.format], options.quality)


def read_camera_frame(message, request: SensorRequest, field: str = "image_bytes") -> CameraFrame:
    """The frame of an ``RGBRenderReturn`` to a request made by ``write_camera_request``.

    ``field`` is what errors call the picture.

    Raises:
        RequestError: the reply has another size than requested.
    """
    camera = sensor_of(request, CameraModel)
    shape = (3, camera.height_px, camera.width_px)
    if len(message.image_bytes) != int(np.prod(shape)):
        raise RequestError(
            f"camera {camera.id!r}: {field} must hold {camera.width_px}x{camera.height_px} planar RGB, "
            f"{int(np.prod(shape)):,} bytes, got {len(message.image_bytes):,}"
        )
    import cv2

    rgb = cv2.merge(list(np.frombuffer(message.image_bytes, np.uint8).reshape(shape)))  # far quicker than NumPy's copy
    return CameraFrame(camera, request.start_us, request.end_us, rgb)


def write_lidar_frame(frame: LidarFrame, message) -> None:
    """Fills a ``LidarRenderReturn``; only the buffers, not the repeated fields."""
    message.num_points = len(frame.xyz_m)
    message.point_xyzs_buffer = np.ascontiguousarray(frame.xyz_m, "<f4").tobytes()
    message.point_intensities_buffer = np.ascontiguousarray(frame.intensity, "<f4").tobytes()
    message.point_ranges_buffer = np.ascontiguousarray(frame.range_m, "<f4").tobytes()
    message.point_beams_buffer = np.ascontiguousarray(frame.beam, "<i4").tobytes()


def read_lidar_frame(message, request: SensorRequest) -> LidarFrame:
    """The sweep of a ``LidarRenderReturn``.

    From servers without our additions, ranges are the points' norms and beams are -1.

    Raises:
        RequestError: the buffers have different lengths.
    """
    lidar = sensor_of(request, LidarModel)
    xyz = _read_buffer(message, "point_xyzs_buffer", "<f4")
    intensity = _read_buffer(message, "point_intensities_buffer", "<f4")
    if not len(xyz):
        xyz, intensity = np.array(message.point_xyzs, "<f4"), np.array(message.point_intensities, "<f4")
    n = message.num_points
    ranges, beam = (
        _read_buffer(message, "point_ranges_buffer", "<f4"),
        _read_buffer(message, "point_beams_buffer", "<i4"),
    )
    if len(xyz) != 3 * n or len(intensity) != n or len(ranges) not in (0, n) or len(beam) not in (0, n):
        raise RequestError(
            f"lidar {lidar.id!r}: num_points says {n}, but there are {len(xyz)} point_xyzs, {len(intensity)} "
            f"point_intensities, {len(ranges)} point_ranges and {len(beam)} point_beams"
        )
    xyz = xyz.reshape(n, 3).astype(np.float32)
    ranges = ranges.astype(np.float32) if len(ranges) else np.linalg.norm(xyz, axis=1)
    beam = beam.astype(np.int32) if len(beam) else np.full(n, -1, np.int32)
    return LidarFrame(lidar, request.start_us, request.end_us, xyz, ranges, intensity.astype(np.float32), beam)


def _read_buffer(message, name: str, kind: str) -> np.ndarray:
    data = getattr(message, name)
    if len(data) % 4:
        raise RequestError(f"{name} must hold 4 bytes a value, got {len(data)} bytes")
    return np.frombuffer(data, kind)


# -------------------------------------------------------------------------------------------------------- scene service


def outputs_of(numbers: Sequence[int]) -> tuple[str, ...]:
    """The renderer's names of the outputs of a ``RenderCameraRequest``; rgb if none is given.

    Raises:
        RequestError: an unknown number.
    """
    if unknown := sorted(set(numbers) - set(CameraOutput)):
        known = ", ".join(f"{output.name} ({output.value})" for output in CameraOutput)
        raise RequestError(f"outputs must be among {known}; got {unknown}")
    return tuple(output.name.lower() for output in CameraOutput if output in (numbers or [CameraOutput.RGB]))


def bytes_a_pixel(outputs: Sequence[str]) -> int:
    """Bytes per pixel of the raw outputs; 0 for rgb, which depends on the format."""
    chosen = [spec for output, spec in _RAW.items() if output.name.lower() in outputs]
    return sum(np.dtype(kind).itemsize * int(np.prod(channels)) for _, kind, channels in chosen)


def write_outputs(frame: CameraFrame, message) -> None:
    """Fills a ``RenderCameraReply`` with the frame's size and raw outputs."""
    message.height, message.width = frame.rgb.shape[:2]
    for name, kind, _ in _RAW.values():
        values = getattr(frame, name)
        if values is not None:
            setattr(message, name, np.ascontiguousarray(values, kind).tobytes())


def read_outputs(message) -> dict[str, np.ndarray]:
    """The raw outputs in a ``RenderCameraReply``, by name: ``depth_m``, ``alpha``, ``label``, ``normal``.

    Raises:
        RequestError: one of them does not have the size that the reply says.
    """
    shape, found = (message.height, message.width), {}
    for name, kind, channels in _RAW.values():
        data = getattr(message, name)
        if not data:
            continue
        values = _values(data, kind, name)
        if values.size != np.prod((*shape, *channels)):
            raise RequestError(f"{name} has {values.size:,} values, which do not make {message.width}x{message.height}")
        found[name] = values.reshape(*shape, *channels).astype(np.dtype(kind).newbyteorder("="))
    return found


def write_range_map(frame: LidarFrame, message) -> None:
    """Fills a ``RangeMap``."""
    rows, columns = len(frame.lidar.elevation_rad), len(frame.lidar.azimuth_rad)
    message.rows, message.columns = rows, columns
    for name in ("range_m", "intensity"):
        values = np.zeros(rows * columns, "<f4")
        values[frame.beam] = getattr(frame, name)
        setattr(message, name, values.tobytes())


def read_range_map(
    message, request: SensorRequest
) -> tuple[Float32[np.ndarray, "rows columns"], Float32[np.ndarray, "rows columns"]]:
    """Range in metres and intensity of every beam of a ``RangeMap``, 0 where none came back.

    Raises:
        RequestError: the map does not have the requested beams.
    """
    shape = (message.rows, message.columns)
    asked = (len(request.sensor.elevation_rad), len(request.sensor.azimuth_rad))  # type: ignore[union-attr]
    maps = [_values(getattr(message, name), "<f4", name) for name in ("range_m", "intensity")]
    if shape != asked or any(values.size != np.prod(shape) for values in maps):
        sizes = [values.size for values in maps]
        raise RequestError(
            f"range_m and intensity must hold {asked[0]}x{asked[1]} values, got {sizes} and (rows, columns) = {shape}"
        )
    range_m, intensity = (values.reshape(shape).astype(np.float32) for values in maps)
    return range_m, intensity


def _values(data: bytes, kind: str, name: str) -> np.ndarray:
    size = np.dtype(kind).itemsize
    if len(data) % size:
        raise RequestError(f"{name} must hold {size} bytes a value, got {len(data):,} bytes")
    return np.frombuffer(data, kind)
