"""Gaussians as 3DGS PLY files: writes two layouts, reads all common ones.

In the file scales are logarithms, opacities logits, quaternions ``wxyz``, colours coefficients of spherical harmonics
(docs/exchange.md).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.files.new_files import new_file
from nurec_sim.scene.harmonics import SH_C0
from nurec_sim.scene.interop.columns import Columns, sigmoid
from nurec_sim.scene.interop.compressed_ply import is_compressed, read_compressed
from nurec_sim.scene.interop.ply_table import VertexTable
from nurec_sim.scene.transform import UP_AXES, transformed, world_from_up
from nurec_sim.types import Gaussians, Label

Progress = Callable[[str, float], None]
Layout = Literal["inria", "release"]
LAYOUTS = get_args(Layout)

MOST_OPAQUE = 1 - 1e-6
"""Distance of clamped opacities from 0 and 1, whose logits are infinite."""
BLOCK = 1 << 18
_UP_COMMENT = "3D Gaussians, metres, {up} up"
POSITION, NORMAL, COLOUR = ("x", "y", "z"), ("nx", "ny", "nz"), ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE, ROTATION = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
NEEDED = (*POSITION, *ROTATION, *SCALE, "opacity", *COLOUR)


def vertex_type(k: int = 0, layout: Layout = "inria") -> np.dtype:
    """A vertex with 3 k coefficients of view-dependent colour; 68 bytes, or 77 in the released layout, if k is 0.

    ``inria`` is what the code of Kerbl et al., "3D Gaussian Splatting" (2023) writes, floats only; many viewers misread
    any other property as a float. ``release`` is what the released Instant NuRec network writes.
    """
    if layout == "inria":
        names = (*POSITION, *NORMAL, *COLOUR, *_rest_names(k), "opacity", *SCALE, *ROTATION)
        return np.dtype([(name, "<f4") for name in names])
    floats = (*ROTATION, *SCALE, "opacity", *COLOUR, *_rest_names(k))
    return np.dtype(
        [(name, "<f4") for name in POSITION + NORMAL]
        + [(name, "u1") for name in ("red", "green", "blue", "alpha")]
        + [(name, "<f4") for name in floats]
        + [("road_mask", "u1"), ("sky_mask", "<f4")]
    )


def write_ply(
    gaussians: Gaussians,
    path: Path | str,
    *,
    layout: Layout = "inria",
    up: str = "z",
    overwrite: bool = False,
    progress: Progress | None = None,
) -> int:
    """Writes a binary little-endian PLY atomically.

    Gaussians with non-finite values or zero scale are skipped. LiDAR intensities and ray drop are not stored; of the
    labels, road and sky in the layout ``release`` only.

    Args:
        gaussians: Gaussians in the world frame.
        path: the file; missing folders are created.
        layout: vertex layout.
        up: up axis of the file, one of ``UP_AXES``; Gaussians and view-dependent colours are rotated.
        overwrite: whether an existing file may be replaced.
        progress: called with stage and fraction done.

    Returns:
        Number of written Gaussians.

    Raises:
        ArchiveError: the file exists, or an unknown layout or axis.
    """
    path = Path(path)
    if layout not in LAYOUTS:
        raise ArchiveError(f"layout must be one of {list(LAYOUTS)}, got {layout!r}")
    file_from_world = geometry.pose(world_from_up(up).T, np.zeros(3))
    if path.exists() and not overwrite:
        raise ArchiveError(f"{path} exists; pass overwrite=True to replace it")
    rows = np.flatnonzero(_writable(gaussians))
    k = 0 if gaussians.sh_rest is None else gaussians.sh_rest.shape[1]
    with new_file(path) as file:
        file.write(_header(vertex_type(k, layout), len(rows), up))
        for first in range(0, len(rows), BLOCK):
            block = gaussians[rows[first : first + BLOCK]]
            turned = block if up == "z" else transformed(block, file_from_world)
            file.write(_vertices(turned, vertex_type(k, layout)).tobytes())
            if progress is not None:
                progress("writing vertices", min(first + BLOCK, len(rows)) / len(rows))
    return len(rows)


def read_ply(path: Path | str) -> tuple[Gaussians, int]:
    """Reads Gaussians from a 3DGS PLY file.

    Compressed files (``compressed_ply``) are detected by their properties. In others properties may have any order and
    type; ``nx ny nz``, ``f_rest_*`` (0, 9, 24 or 45 of them, channel-major), ``road_mask`` and ``sky_mask`` are
    optional, others are ignored. An infinite opacity means 1 (the released network writes it), a normal that is not
    finite is unknown; any other value that is not finite, a quaternion of zero or a scale of zero drops its Gaussian.

    Returns:
        The Gaussians, and the number of dropped ones.

    Raises:
        ArchiveError: not a PLY file, damaged, truncated, or without the properties of Gaussians.
    """
    table = VertexTable(Path(path))
    if is_compressed(table):
        return read_compressed(table)
    if missing := [name for name in NEEDED if name not in table.names]:
        raise ArchiveError(f"{path}: no Gaussians: the vertices lack {missing}; they have {list(table.names)}")
    k = _harmonics_of(table)
    mean, quat, colour = (table.columns(names) for names in (POSITION, ROTATION, COLOUR))
    logit, rest = table.columns(["opacity"]), table.columns(_rest_names(k))
    with np.errstate(over="ignore"):
        # In float64: exp overflows float32 beyond 88.7, and infinite scales are dropped later.
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


def ply_up(path: Path | str) -> str:
    """The up axis recorded by ``write_ply`` in a comment; z for other files.

    Raises:
        ArchiveError: as of ``read_ply``.
    """
    notes = {_UP_COMMENT.format(up=up): up for up in UP_AXES}
    return next((notes[text] for text in VertexTable(Path(path)).comments if text in notes), "z")


# -------------------------------------------------------------------------------------------------------- writing


def _writable(gaussians: Gaussians) -> Bool[np.ndarray, " n"]:
    sound = np.isfinite(gaussians.opacity) & (gaussians.scale_m > 0).all(axis=1)
    for name in ("mean_m", "quat_wxyz", "scale_m", "rgb", "sh_rest"):
        values = getattr(gaussians, name)
        if values is not None:
            sound &= np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    return sound


def _header(dtype: np.dtype, count: int, up: str) -> bytes:
    names = {"<f4": "float", "|u1": "uchar"}
    properties = [f"property {names[dtype[name].str]} {name}" for name in dtype.names or ()]
    lines = ["ply", "format binary_little_endian 1.0", f"comment {_UP_COMMENT.format(up=up)}",
             f"element vertex {count}", *properties, "end_header"]  # fmt: skip
    return "".join(f"{line}\n" for line in lines).encode("ascii")


def _vertices(gaussians: Gaussians, dtype: np.dtype) -> np.ndarray:
    """Gaussians in the file's units, as an array of ``vertex_type``."""
    k = 0 if gaussians.sh_rest is None else gaussians.sh_rest.shape[1]
    # Opacities of exactly 0 and 1 have infinite logits.
    opacity = np.clip(gaussians.opacity.astype(np.float64), 1 - MOST_OPAQUE, MOST_OPAQUE)
    columns: dict[tuple[str, ...], np.ndarray] = {
        POSITION: gaussians.mean_m,
        NORMAL: np.where(np.isfinite(gaussians.normal).all(axis=1, keepdims=True), gaussians.normal, 0),
        ROTATION: gaussians.quat_wxyz,
        SCALE: np.log(gaussians.scale_m.astype(np.float64)),
        COLOUR: (gaussians.rgb.astype(np.float64) - 0.5) / SH_C0,
    }
    if gaussians.sh_rest is not None:
        columns[_rest_names(k)] = gaussians.sh_rest.transpose(0, 2, 1).reshape(len(gaussians), 3 * k)
    if "alpha" in (dtype.names or ()):
        columns[("red", "green", "blue")] = np.round(np.clip(gaussians.rgb, 0, 1) * 255)
        columns[("alpha",)] = np.full((len(gaussians), 1), 255)
        columns[("road_mask", "sky_mask")] = np.stack([gaussians.label == each for each in (Label.ROAD, Label.SKY)], 1)
    vertices = np.zeros(len(gaussians), dtype)
    vertices["opacity"] = np.log(opacity / (1 - opacity))
    for names, values in columns.items():
        for name, column in zip(names, values.T, strict=True):
            vertices[name] = column
    return vertices


def _rest_names(k: int) -> tuple[str, ...]:
    """Channel-major: all k coefficients of red first."""
    return tuple(f"f_rest_{i}" for i in range(3 * k))


# -------------------------------------------------------------------------------------------------------- reading


def _harmonics_of(table: VertexTable) -> int:
    """Number of view-dependent coefficients per channel: 0, 3, 8 or 15."""
    given = {name for name in table.names if name.startswith("f_rest_")}
    for k in (0, 3, 8, 15):
        if given == set(_rest_names(k)):
            return k
    raise ArchiveError(
        f"{table.path}: {len(given)} properties f_rest_*; degrees 0 to 3 have 0, 9, 24 and 45, numbered from 0"
    )


def _normals(table: VertexTable) -> Float32[np.ndarray, "n 3"]:
    """Unit normals; zero where missing or not finite."""
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
