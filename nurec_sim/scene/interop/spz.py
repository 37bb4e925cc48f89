"""SPZ files of Niantic (versions 1 to 3): a gzip file with a header and consecutive arrays.

Layout: https://github.com/nianticlabs/spz. Header of 16 bytes: "NGSP", version, count, degree of the harmonics,
fractional bits of positions, flags, a reserved byte; numbers are little-endian. y is up, -z forward.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from nurec_sim.errors import ArchiveError
from nurec_sim.scene.interop.columns import Columns
from nurec_sim.scene.interop.nurec.volume import gunzipped
from nurec_sim.types import Gaussians

MAGIC, GZIP = b"NGSP", b"\x1f\x8b"
HEADER = struct.Struct("<4sIIBBBB")
VERSIONS = (1, 2, 3)
_HARMONICS = (0, 3, 8, 15)
_COLOUR_SCALE = 0.15


def read_spz(path: Path | str) -> tuple[Gaussians, int]:
    """The Gaussians of a file, in its axes, and the number dropped for non-finite values.

    Raises:
        ArchiveError: not such a file, of another version, damaged or truncated.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ArchiveError(f"{path}: cannot be opened ({error.strerror or error})") from error
    if data[:4] == MAGIC:
        version = int.from_bytes(data[4:8], "little")
        raise ArchiveError(
            f"{path}: SPZ version {version} is not read, only {list(VERSIONS)}; "
            f"`splat-transform {path.name} {path.stem}.ply` (npm: @playcanvas/splat-transform) makes a PLY of it"
        )
    if data[:2] != GZIP:
        raise ArchiveError(f"{path}: not an SPZ file; it begins with {data[:4]!r}")
    content = gunzipped(data, str(path))
    if len(content) < HEADER.size or content[:4] != MAGIC:
        raise ArchiveError(f"{path}: not an SPZ file; unpacked it begins with {content[:4]!r}")
    _, version, count, degree, point_bits, _, _ = HEADER.unpack_from(content)
    if version not in VERSIONS or degree > 3:
        raise ArchiveError(
            f"{path}: SPZ version {version} with harmonics of degree {degree}; "
            f"versions {list(VERSIONS)} and degrees 0 to 3 are read"
        )
    k = _HARMONICS[degree]
    # Bytes per Gaussian: position, opacity, colour, scale, rotation, harmonics.
    widths = (6 if version == 1 else 9, 1, 3, 3, 4 if version == 3 else 3, 3 * k)
    needed, held = count * sum(widths), len(content) - HEADER.size
    if held < needed:
        raise ArchiveError(f"{path}: {count:,} Gaussians take {needed:,} bytes, {held:,} follow the header")
    parts, start = [], HEADER.size
    for width in widths:
        parts.append(np.frombuffer(content, np.uint8, count * width, start).reshape(count, width))
        start += count * width
    position, opacity, colour, scale, rotation, rest = parts
    columns = Columns(
        mean_m=_halves(position) if version == 1 else _fixed_point(position, point_bits),
        quat_wxyz=_smallest_three(rotation) if version == 3 else _first_three(rotation),
        # Logarithmic scales in steps of 1/16 from -10.
        scale_m=np.exp(scale / 16.0 - 10),
        opacity=opacity[:, 0] / 255.0,
        dc=(colour / 255.0 - 0.5) / _COLOUR_SCALE,
        rest=(rest.astype(np.float64) - 128).reshape(count, k, 3) / 128 if k else None,
    )
    return columns.gaussians()


def _halves(position: UInt8[np.ndarray, "n 6"]) -> Float64[np.ndarray, "n 3"]:
    return np.ascontiguousarray(position).view("<f2").astype(np.float64)


def _fixed_point(position: UInt8[np.ndarray, "n 9"], point_bits: int) -> Float64[np.ndarray, "n 3"]:
    """Signed 24-bit fixed-point numbers with ``point_bits`` fractional bits."""
    low, middle, high = np.moveaxis(position.reshape(-1, 3, 3).astype(np.int64), -1, 0)
    # XOR and subtraction of 128 extend the sign of the highest byte.
    return (low | middle << 8 | (high ^ 128) - 128 << 16) / 2.0**point_bits


def _first_three(rotation: UInt8[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 4"]:
    """x, y, z as bytes over -1..1; w >= 0 follows from unit length."""
    xyz = rotation / 127.5 - 1
    w = np.sqrt(np.clip(1 - (xyz**2).sum(axis=1, keepdims=True), 0, None))
    return np.concatenate([w, xyz], axis=1)


def _smallest_three(rotation: UInt8[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 4"]:
    """Of (x, y, z, w) the index of the largest in 2 bits, the others with sign and 9 bits each, the last one lowest."""
    word = np.ascontiguousarray(rotation).view("<u4")[:, 0].astype(np.int64)
    largest = word >> 30
    parts = np.stack([word >> 20, word >> 10, word], axis=1)
    others = (parts & 511) / 511 * np.sqrt(0.5) * np.where(parts & 512, -1, 1)
    rest = np.sqrt(np.clip(1 - (others**2).sum(axis=1), 0, None))
    place = np.sort((largest[:, None] + 1 + np.arange(3)) % 4, axis=1)
    xyzw = np.empty((len(word), 4))
    np.put_along_axis(xyzw, place, others, axis=1)
    np.put_along_axis(xyzw, largest[:, None], rest[:, None], axis=1)
    return xyzw[:, [3, 0, 1, 2]]
