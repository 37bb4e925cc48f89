"""What the scene service gives beyond the sensor service: raw outputs of cameras, and range maps of LiDARs.

Raw arrays are little-endian, rows from top to bottom, channels last.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from nurec_sim.errors import RequestError
from nurec_sim.serving.wire.messages import CameraOutput
from nurec_sim.types import CameraFrame, LidarFrame, SensorRequest

_RAW = {
    CameraOutput.DEPTH: ("depth_m", "<f4", ()),
    CameraOutput.ALPHA: ("alpha", "<f4", ()),
    CameraOutput.LABEL: ("label", "u1", ()),
    CameraOutput.NORMAL: ("normal", "<f4", (3,)),
}
"""Field of the reply and of ``CameraFrame``, type and channels of every raw output."""


def outputs_of(numbers: Sequence[int]) -> tuple[str, ...]:
    """Names, as the renderer knows them, of the outputs that a ``RenderCameraRequest`` asks for; rgb if none.

    Raises:
        RequestError: a number stands for none.
    """
    if unknown := sorted(set(numbers) - set(CameraOutput)):
        known = ", ".join(f"{output.name} ({output.value})" for output in CameraOutput)
        raise RequestError(f"outputs must be among {known}; got {unknown}")
    return tuple(output.name.lower() for output in CameraOutput if output in (numbers or [CameraOutput.RGB]))


def bytes_a_pixel(outputs: Sequence[str]) -> int:
    """Bytes that the raw outputs take for each pixel; none for rgb, whose format says."""
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
        RequestError: the map does not have the beams that were asked for.
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
