"""Compressed PLY files of PlayCanvas (SuperSplat, splat-transform): 16 bytes a Gaussian, and a byte per harmonic.

Layout: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply. Chunks of 256 Gaussians hold the
bounds of positions, logarithmic scales and, in newer files, colours. A vertex has four 32-bit words: position and scale
with 11, 10 and 11 bits between those bounds; the quaternion (w, x, y, z) as the number of its largest component and
10 bits for each of the others; colour and opacity with 8 bits each, red in the highest.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from nurec_sim.errors import ArchiveError
from nurec_sim.scene.harmonics import SH_C0
from nurec_sim.scene.interop.columns import Columns
from nurec_sim.scene.interop.ply_table import VertexTable
from nurec_sim.types import Gaussians

CHUNK = 256
SH_RANGE = 8.0
"""Harmonics are stored over -4..4."""
_WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def is_compressed(table: VertexTable) -> bool:
    """Whether the vertices of a file have this format."""
    return _WORDS[0] in table.names


def read_compressed(table: VertexTable) -> tuple[Gaussians, int]:
    """The Gaussians of a compressed file, and the number dropped for non-finite values.

    Raises:
        ArchiveError: elements or properties are missing, or of the wrong type or number.
    """
    if missing := [name for name in _WORDS if name not in table.names]:
        raise ArchiveError(f"{table.path}: a compressed PLY whose vertices lack {missing}")
    words = {name: table.column(name) for name in _WORDS}
    if wrong := [name for name, word in words.items() if word.dtype.itemsize != 4 or word.dtype.kind != "u"]:
        raise ArchiveError(f"{table.path}: a compressed PLY; {wrong} must be of type uint")
    chunks = VertexTable(table.path, "chunk")
    if len(chunks) != -(-len(table) // CHUNK):
        raise ArchiveError(
            f"{table.path}: {len(table):,} vertices need {-(-len(table) // CHUNK):,} chunks, got {len(chunks):,}"
        )
    chunk = np.arange(len(table)) // CHUNK
    position, log_scale = (
        _between(chunks, chunk, prefix, "xyz", _fields(words[name], (21, 11, 0), (11, 10, 11)))
        for prefix, name in (("", "packed_position"), ("scale_", "packed_scale"))
    )
    colour = _fields(words["packed_color"], (24, 16, 8, 0), (8, 8, 8, 8))
    rgb = _between(chunks, chunk, "", "rgb", colour[:, :3]) if "min_r" in chunks.names else colour[:, :3]
    with np.errstate(over="ignore"):
        columns = Columns(
            mean_m=position,
            quat_wxyz=_quaternions(words["packed_rotation"]),
            scale_m=np.exp(log_scale),
            opacity=colour[:, 3],
            dc=(rgb - 0.5) / SH_C0,
            rest=_harmonics(table),
        )
    return columns.gaussians()


def _fields(word: np.ndarray, shifts: tuple[int, ...], bits: tuple[int, ...]) -> Float64[np.ndarray, "n fields"]:
    """Bit fields of each word as fractions from 0 to 1."""
    word = word.astype(np.int64)
    most = [(1 << width) - 1 for width in bits]
    return np.stack([(word >> shift & top) / top for shift, top in zip(shifts, most, strict=True)], axis=1)


def _between(
    chunks: VertexTable, chunk: np.ndarray, prefix: str, axes: str, share: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Linear interpolation between the bounds of the chunk."""
    low, high = (
        chunks.columns([f"{end}_{prefix}{axis}" for axis in axes]).astype(np.float64) for end in ("min", "max")
    )
    with np.errstate(invalid="ignore"):  # bounds that are not finite: such Gaussians are dropped
        return low[chunk] + share * (high - low)[chunk]


def _quaternions(word: np.ndarray) -> Float64[np.ndarray, "n 4"]:
    """Quaternions by smallest-three encoding: the largest component follows from unit length."""
    largest = (word >> 30).astype(np.int64)
    # All but the largest component are at most 1 / sqrt(2) in magnitude, so 10 bits cover -0.707..0.707.
    others = (_fields(word, (20, 10, 0), (10, 10, 10)) - 0.5) * np.sqrt(2)
    rest = np.sqrt(np.clip(1 - (others**2).sum(axis=1), 0, None))
    place = (largest[:, None] + 1 + np.arange(3)) % 4
    place.sort(axis=1)
    quat = np.empty((len(word), 4))
    np.put_along_axis(quat, place, others, axis=1)
    np.put_along_axis(quat, largest[:, None], rest[:, None], axis=1)
    return quat


def _harmonics(table: VertexTable) -> np.ndarray | None:
    """Coefficients [n, k, 3]; the file stores bytes, channel-major."""
    if "sh" not in table.elements:
        return None
    sh = VertexTable(table.path, "sh")
    count = len(sh.names)
    if count not in (9, 24, 45) or set(sh.names) != {f"f_rest_{i}" for i in range(count)} or len(sh) != len(table):
        raise ArchiveError(
            f"{table.path}: the element 'sh' must have f_rest_0 to f_rest_8, 23 or 44 for each of {len(table):,} "
            f"vertices, got {count} properties and {len(sh):,} rows"
        )
    bytes_ = sh.columns([f"f_rest_{i}" for i in range(count)])
    # Bytes 0 and 255 are the exact ends of the range, others the middle of their interval.
    share = np.where(bytes_ == 0, 0.0, np.where(bytes_ == 255, 1.0, (bytes_ + 0.5) / 256))
    return ((share - 0.5) * SH_RANGE).reshape(len(table), 3, count // 3).transpose(0, 2, 1)
