"""The sky as a latitude-longitude OpenEXR texture for USD dome lights.

Orientation (UsdLux, from the OpenEXR document): rows from the pole down, columns from longitude +pi on the left to -pi
on the right. With the pole on z, longitude 0 looks along -y and longitude pi/2 along +x. Colours become linear.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim.geometry import cubemap_coordinates

MAX_ROWS = 512
_BLOCK_ROWS = 16


def latlong_directions(rows: int) -> Float64[np.ndarray, "rows columns 3"]:
    """World directions (z up) of the texel centres of a ``rows`` x ``2 * rows`` texture."""
    latitude = np.pi / 2 - (np.arange(rows) + 0.5) / rows * np.pi
    longitude = np.pi - (np.arange(2 * rows) + 0.5) / (2 * rows) * 2 * np.pi
    latitude, longitude = np.meshgrid(latitude, longitude, indexing="ij")
    x = np.cos(latitude) * np.sin(longitude)
    y = -np.cos(latitude) * np.cos(longitude)
    return np.stack([x, y, np.sin(latitude)], axis=-1)


def sample_cubemap(
    sky: Float32[np.ndarray, "6 h h 3"], directions: Float64[np.ndarray, "*n 3"]
) -> Float64[np.ndarray, "*n 3"]:
    """Colours of a cubemap in given directions, bilinear within each face (clamped at face edges)."""
    size = sky.shape[1]
    face, s, t = cubemap_coordinates(directions)
    # Texel centres are at half-integers.
    column, row = (np.clip(c * size - 0.5, 0, size - 1) for c in (s, t))
    left, top = column.astype(np.int64), row.astype(np.int64)
    right, bottom = np.minimum(left + 1, size - 1), np.minimum(top + 1, size - 1)
    u, v = (column - left)[..., None], (row - top)[..., None]
    upper = sky[face, top, left] * (1 - u) + sky[face, top, right] * u
    lower = sky[face, bottom, left] * (1 - u) + sky[face, bottom, right] * u
    return upper * (1 - v) + lower * v


def latlong_exr(sky: Float32[np.ndarray, "6 h h 3"]) -> bytes:
    """A cubemap of display colours as a linear lat-long OpenEXR image."""
    display = np.clip(sample_cubemap(sky, latlong_directions(min(2 * sky.shape[1], MAX_ROWS))), 0, None)
    # Inverse of the sRGB transfer function (IEC 61966-2-1).
    linear = np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
    # 65504 is the largest finite half float.
    return encode_exr(np.minimum(linear, 65504.0).astype(np.float16))


def encode_exr(image: np.ndarray) -> bytes:
    """A single-part scan-line OpenEXR file of half-float RGB ``[h, w, 3]``, in ZIP compression.

    Layout: https://openexr.com/en/latest/OpenEXRFileLayout.html. (OpenCV's wheels cannot write EXR.)
    """
    height, width, _ = image.shape

    def attribute(name: str, kind: str, data: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<I", len(data)) + data

    half, linear_channel, zip_of_16_lines = 1, 0, b"\3"
    channels = b"".join(
        name + b"\0" + struct.pack("<iBBBBii", half, linear_channel, 0, 0, 0, 1, 1) for name in (b"B", b"G", b"R")
    )
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    header = (
        # Magic number and version 2 without flags: single-part scan lines.
        struct.pack("<II", 20000630, 2)
        + attribute("channels", "chlist", channels + b"\0")
        + attribute("compression", "compression", zip_of_16_lines)
        + attribute("dataWindow", "box2i", window)
        + attribute("displayWindow", "box2i", window)
        + attribute("lineOrder", "lineOrder", b"\0")
        + attribute("pixelAspectRatio", "float", struct.pack("<f", 1.0))
        + attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0))
        + attribute("screenWindowWidth", "float", struct.pack("<f", 1.0))
        + b"\0"
    )
    # Channels are stored in alphabetical order, one after the other within a scan line.
    rows = np.ascontiguousarray(image[:, :, ::-1].transpose(0, 2, 1), dtype="<f2")  # [h, BGR, w]
    starts = range(0, height, _BLOCK_ROWS)
    blocks = [_zip_block(rows[y : y + _BLOCK_ROWS].tobytes()) for y in starts]
    blocks = [struct.pack("<ii", y, len(data)) + data for y, data in zip(starts, blocks, strict=True)]
    # The offset table: each block is its first y, its size in bytes, and the data.
    first = len(header) + 8 * len(blocks)
    offsets = first + np.cumsum([0, *map(len, blocks[:-1])])
    return header + offsets.astype("<u8").tobytes() + b"".join(blocks)


def _zip_block(data: bytes) -> bytes:
    """A block of scan lines as OpenEXR compresses it: even bytes, then odd ones, as differences from the one before.

    A block that would not become smaller is stored as it is; readers tell by its size.
    """
    given = np.frombuffer(data, np.uint8)
    planes = np.concatenate([given[::2], given[1::2]])
    planes[1:] -= planes[:-1].copy() + np.uint8(128)  # modulo 256
    packed = zlib.compress(planes.tobytes())
    return packed if len(packed) < len(data) else data
