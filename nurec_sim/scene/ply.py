"""Gaussians as a 3DGS PLY file: the released network's layout written, that and everyone else's read.

In the file scales are logarithms, opacities logits, quaternions ``wxyz``, colours coefficients of spherical harmonics
(docs/exchange.md).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from nurec_sim.errors import ArchiveError
from nurec_sim.new_files import new_file
from nurec_sim.scene.columns import Columns, sigmoid
from nurec_sim.scene.harmonics import SH_C0
from nurec_sim.scene.ply_table import VertexTable
from nurec_sim.types import Gaussians, Label

Progress = Callable[[str, float], None]

MOST_OPAQUE = 1 - 1e-6
"""Opacities are kept this far from 0 and 1, whose logits are infinite."""
BLOCK = 1 << 18
POSITION, NORMAL, COLOUR = ("x", "y", "z"), ("nx", "ny", "nz"), ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE, ROTATION = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
NEEDED = (*POSITION, *ROTATION, *SCALE, "opacity", *COLOUR)


def vertex_type(k: int = 0) -> np.dtype:
    """A vertex of the released layout, 77 bytes; 3 k coefficients of view-dependent colour follow ``f_dc``."""
    floats = (*ROTATION, *SCALE, "opacity", *COLOUR, *_rest_names(k))
    return np.dtype(
        [(name, "<f4") for name in POSITION + NORMAL]
        + [(name, "u1") for name in ("red", "green", "blue", "alpha")]
        + [(name, "<f4") for name in floats]
        + [("road_mask", "u1"), ("sky_mask", "<f4")]
    )


def write_ply(
    gaussians: Gaussians, path: Path | str, *, overwrite: bool = False, progress: Progress | None = None
) -> int:
    """Writes a binary little-endian PLY; the file appears complete or not at all.

    Gaussians that have no finite form in the file are left out: a value that is not finite, a scale of zero.
    Labels other than road and sky, LiDAR intensities and ray drop are not kept.

    Args:
        gaussians: what to write, world frame.
        path: the file; its folder is made if need be.
        overwrite: whether an existing file may be replaced.
        progress: hears what is being done and the fraction of it that is.

    Returns:
        How many were written.

    Raises:
        ArchiveError: the file exists.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise ArchiveError(f"{path} exists; pass overwrite=True to replace it")
    rows = np.flatnonzero(_writable(gaussians))
    k = 0 if gaussians.sh_rest is None else gaussians.sh_rest.shape[1]
    with new_file(path) as file:
        file.write(_header(vertex_type(k), len(rows)))
        for first in range(0, len(rows), BLOCK):
            file.write(_vertices(gaussians[rows[first : first + BLOCK]], k).tobytes())
            if progress is not None:
                progress("writing vertices", min(first + BLOCK, len(rows)) / len(rows))
    return len(rows)


def read_ply(path: Path | str) -> tuple[Gaussians, int]:
    """Reads Gaussians from the PLY file of any 3DGS program.

    Properties may have any order and type; ``nx ny nz``, ``f_rest_*`` (0, 9, 24 or 45 of them, channel-major),
    ``road_mask`` and ``sky_mask`` are optional, others are ignored. An infinite opacity means 1 (the released
    network writes it), a normal that is not finite is unknown; any other value that is not finite, a quaternion of
    zero or a scale of zero drops its Gaussian.

    Returns:
        The Gaussians, and how many were dropped.

    Raises:
        ArchiveError: not a PLY file, damaged, cut short, or without the properties of Gaussians.
    """
    table = VertexTable(Path(path))
    if missing := [name for name in NEEDED if name not in table.names]:
        raise ArchiveError(f"{path}: no Gaussians: the vertices lack {missing}; they have {list(table.names)}")
    k = _harmonics_of(table)
    mean, quat, colour = (table.columns(names) for names in (POSITION, ROTATION, COLOUR))
    logit, rest = table.columns(["opacity"]), table.columns(_rest_names(k))
    with np.errstate(over="ignore"):
        scale = np.exp(table.columns(SCALE).astype(np.float64)).astype(np.float32)
    columns = Columns(
        mean_m=mean,
        quat_wxyz=quat,
        scale_m=scale,
        opacity=sigmoid(logit[:, 0]),
        dc=colour,
        rest=rest.reshape(len(table), 3, k).transpose(0, 2, 1) if k else None,
    )
    return columns.gaussians(_labels(table), _normals(table))


# -------------------------------------------------------------------------------------------------------- writing


def _writable(gaussians: Gaussians) -> Bool[np.ndarray, " n"]:
    sound = np.isfinite(gaussians.opacity) & (gaussians.scale_m > 0).all(axis=1)
    for name in ("mean_m", "quat_wxyz", "scale_m", "rgb", "sh_rest"):
        values = getattr(gaussians, name)
        if values is not None:
            sound &= np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    return sound


def _header(dtype: np.dtype, count: int) -> bytes:
    names = {"<f4": "float", "|u1": "uchar"}
    properties = [f"property {names[dtype[name].str]} {name}" for name in dtype.names or ()]
    lines = ["ply", "format binary_little_endian 1.0", "comment 3D Gaussians, world frame, metres, z up",
             f"element vertex {count}", *properties, "end_header"]  # fmt: skip
    return "".join(f"{line}\n" for line in lines).encode("ascii")


def _vertices(gaussians: Gaussians, k: int) -> np.ndarray:
    """Gaussians in the file's units, as an array of ``vertex_type``."""
    opacity = np.clip(gaussians.opacity.astype(np.float64), 1 - MOST_OPAQUE, MOST_OPAQUE)
    columns = {
        POSITION: gaussians.mean_m,
        NORMAL: np.where(np.isfinite(gaussians.normal).all(axis=1, keepdims=True), gaussians.normal, 0),
        ("red", "green", "blue"): np.round(np.clip(gaussians.rgb, 0, 1) * 255),
        ROTATION: gaussians.quat_wxyz,
        SCALE: np.log(gaussians.scale_m.astype(np.float64)),
        COLOUR: (gaussians.rgb.astype(np.float64) - 0.5) / SH_C0,
    }
    if gaussians.sh_rest is not None:
        columns[_rest_names(k)] = gaussians.sh_rest.transpose(0, 2, 1).reshape(len(gaussians), 3 * k)
    vertices = np.zeros(len(gaussians), vertex_type(k))
    for names, values in columns.items():
        for name, column in zip(names, values.T, strict=True):
            vertices[name] = column
    vertices["alpha"] = 255
    vertices["opacity"] = np.log(opacity / (1 - opacity))
    vertices["road_mask"] = gaussians.label == Label.ROAD
    vertices["sky_mask"] = gaussians.label == Label.SKY
    return vertices


def _rest_names(k: int) -> tuple[str, ...]:
    """Channel-major: all k coefficients of red first."""
    return tuple(f"f_rest_{i}" for i in range(3 * k))


# -------------------------------------------------------------------------------------------------------- reading


def _harmonics_of(table: VertexTable) -> int:
    """How many view-dependent coefficients per channel a file has: 0, 3, 8 or 15."""
    given = {name for name in table.names if name.startswith("f_rest_")}
    for k in (0, 3, 8, 15):
        if given == set(_rest_names(k)):
            return k
    raise ArchiveError(
        f"{table.path}: {len(given)} properties f_rest_*; degrees 0 to 3 have 0, 9, 24 and 45, numbered from 0"
    )


def _normals(table: VertexTable) -> Float32[np.ndarray, "n 3"]:
    """Unit normals; zero where the file has none, or none that is finite."""
    if not set(NORMAL) <= set(table.names):
        return np.zeros((len(table), 3), np.float32)
    normal = table.columns(NORMAL)
    normal[~np.isfinite(normal).all(axis=1)] = 0
    length = np.linalg.norm(normal.astype(np.float64), axis=1, keepdims=True)
    off = (np.abs(length - 1) > 1e-3) & (length > 1e-6)
    return np.where(off, normal / np.where(off, length, 1), np.where(length > 1e-6, normal, 0)).astype(np.float32)


def _labels(table: VertexTable) -> UInt8[np.ndarray, " n"]:
    label = np.full(len(table), Label.OTHER, np.uint8)
    for name, value in (("road_mask", Label.ROAD), ("sky_mask", Label.SKY)):
        if name in table.names:
            label[table.columns([name])[:, 0] > 0.5] = value
    return label
