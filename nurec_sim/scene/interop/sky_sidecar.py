"""Sky and colour correction beside a PLY: ``<stem>.sky.npz`` of the released network, and a picture of it.

The cubemap has the faces +X -X -Y +Y +Z -Z of the world (``geometry.released_cubemap_directions``), rows down, columns
to the right. Conversion to our layout and back permutes texels without interpolation.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int64

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.files.decoding import check_directory
from nurec_sim.files.new_files import new_file
from nurec_sim.files.npy import array_from_npy, npy_bytes
from nurec_sim.files.zip_package import write_package

FORMAT_VERSION = 1
FACE_ORDER = ("+X", "-X", "-Y", "+Y", "+Z", "-Z")
FACE_AXES = ("u=-Z v=+Y", "u=+Z v=+Y", "u=+X v=+Z", "u=+X v=-Z", "u=+X v=+Y", "u=-X v=+Y")
UV_CONVENTION = "u = (2 column + 1) / size - 1, v = (2 row + 1) / size - 1, direction = face + u u_axis + v v_axis"
FRAME = "ncore_world"
MAX_FACE_TEXELS = 2048
_LARGEST_HALF = 65504.0
_MAX_HEADER_BYTES = 4096
_MAX_CAMERAS = 1024


@dataclass(frozen=True)
class SkySidecar:
    """Contents of a sky file, in our conventions.

    Attributes:
        sky: colours, faces as in ``geometry.cubemap_directions``; not clamped.
        seen: confidence that each texel was observed, 0..1; None if unknown.
        isp: per camera id, as in ``GaussianScene.isp``; None if the file has none.
        source: origin of the sky, free text.
    """

    sky: Float32[np.ndarray, "6 s s 3"]
    seen: Float32[np.ndarray, "6 s s"] | None = None
    isp: Mapping[str, Float64[np.ndarray, "3 4"]] | None = None
    source: str = ""


def sky_paths(ply: Path) -> tuple[Path, Path]:
    """The sky file and the picture that belong to ``<stem>.ply``."""
    return ply.with_name(f"{ply.stem}.sky.npz"), ply.with_name(f"{ply.stem}.sky.png")


def write_sky(
    sidecar: SkySidecar,
    npz: Path,
    png: Path | None = None,
    cameras: Sequence[str] = (),
    world_from_file: Float64[np.ndarray, "3 3"] | None = None,
) -> None:
    """Writes the sky file and optionally a preview image; existing files are replaced.

    Args:
        sidecar: the contents. Colours are stored as half floats; texels count as observed if unknown.
        npz: the sky file.
        png: the preview: +X -X -Y above +Y +Z -Z, 8 bits, clamped to 0..1.
        cameras: the order that ``affine_sensor_indices`` counts in; that of ``sidecar.isp`` if not given.
        world_from_file: a rotation by multiples of 90 degrees from the file's axes to the world; none if None.
    """
    size, isp = sidecar.sky.shape[1], sidecar.isp or {}
    ours = our_texels(size, world_from_file)
    # Stored as half floats, whose largest finite value is 65504.
    sky = np.clip(sidecar.sky.reshape(-1, 3)[ours], -_LARGEST_HALF, _LARGEST_HALF).astype(np.float16)
    seen = np.ones(ours.shape) if sidecar.seen is None else sidecar.seen.reshape(-1)[ours]
    order = {name: k for k, name in enumerate(dict.fromkeys([*cameras, *isp]))}
    matrices = [np.asarray(matrix, np.float32) for matrix in isp.values()]
    arrays = {
        "format_version": np.array(FORMAT_VERSION, np.int64),
        "sky_cubemap": sky,
        "sky_cubemap_mask": seen[..., None].astype(np.float16),
        "affine_matrix": np.stack(matrices) if matrices else np.zeros((0, 3, 4), np.float32),
        "affine_sensor_indices": np.array([order[name] for name in isp], np.int64),
        "affine_sensor_ids": np.array(list(isp), np.str_),
        "face_order": np.array(FACE_ORDER),
        "face_axes": np.array(FACE_AXES),
        "uv_convention": np.array(UV_CONVENTION),
        "coordinate_frame": np.array(FRAME),
        "sky_source": np.array(sidecar.source, np.str_),
        "sky_observed_fraction": np.array(np.nan if sidecar.seen is None else (seen > 0.5).mean(), np.float32),
    }
    if png is not None:
        with new_file(png) as file:
            file.write(_atlas_png(sky))
    write_package(npz, {f"{name}.npy": npy_bytes(array) for name, array in arrays.items()})


def read_sky(path: Path | str, world_from_file: Float64[np.ndarray, "3 3"] | None = None) -> SkySidecar:
    """Reads a sky file, ours or the released network's.

    Args:
        path: the ``.npz``; nothing in it is unpickled.
        world_from_file: a rotation by multiples of 90 degrees from the file's axes to the world; none if None.

    Raises:
        ArchiveError: no such file, another version, frame or order of faces, or arrays of the wrong kind or size.
    """
    path = Path(path)
    arrays = _read_arrays(path)
    sky, seen = arrays["sky_cubemap"], arrays.get("sky_cubemap_mask")
    size = sky.shape[1] if sky.ndim == 4 else 0
    if not 1 <= size <= MAX_FACE_TEXELS:
        raise ArchiveError(f"{path}: sky_cubemap must be [6, s, s, 3], s in 1..{MAX_FACE_TEXELS}, got {sky.shape}")
    _check_shape(path, "sky_cubemap", sky, (6, size, size, 3))
    # ``our_texels`` is a permutation; argsort inverts it.
    release = np.argsort(our_texels(size, world_from_file).reshape(-1)).reshape(6, size, size)
    if seen is not None:
        _check_shape(path, "sky_cubemap_mask", seen, (6, size, size, 1))
        seen = np.clip(seen.astype(np.float32).reshape(-1)[release], 0, 1)
    return SkySidecar(
        sky.astype(np.float32).reshape(-1, 3)[release], seen, _isp(path, arrays), _text(arrays, "sky_source")
    )


def our_texels(
    size: int, world_from_file: Float64[np.ndarray, "3 3"] | None = None
) -> Int64[np.ndarray, "6 size size"]:
    """For every texel of the file's cubemap, the flat index of our texel with the same direction."""
    direction = geometry.released_cubemap_directions(size)
    if world_from_file is not None:
        direction = direction @ world_from_file.T
    face, s, t = geometry.cubemap_coordinates(direction)
    column, row = (np.clip((c * size).astype(np.int64), 0, size - 1) for c in (s, t))
    return (face * size + row) * size + column


def _atlas_png(sky: np.ndarray) -> bytes:
    import cv2

    rgb = np.round(np.clip(sky.astype(np.float32), 0, 1) * 255).astype(np.uint8)
    atlas = np.concatenate([np.concatenate(list(rgb[k : k + 3]), axis=1) for k in (0, 3)])
    return cv2.imencode(".png", cv2.cvtColor(atlas, cv2.COLOR_RGB2BGR))[1].tobytes()


# -------------------------------------------------------------------------------------------------------- reading


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The validated arrays by name."""
    limits = {
        "format_version": 64, "sky_cubemap": 6 * MAX_FACE_TEXELS**2 * 3 * 4, "affine_matrix": _MAX_CAMERAS * 96,
        "sky_cubemap_mask": 6 * MAX_FACE_TEXELS**2 * 4, "affine_sensor_ids": _MAX_CAMERAS * 1024, "face_order": 4096,
        "coordinate_frame": 4096, "sky_source": 2**16,
    }  # fmt: skip
    arrays = {}
    try:
        with path.open("rb") as file:
            check_directory(file)
        with zipfile.ZipFile(path) as package:
            held = {entry.filename: entry for entry in package.infolist()}
            for name, limit in limits.items():
                entry = held.get(f"{name}.npy")
                if entry is None:
                    continue
                if entry.file_size > limit + _MAX_HEADER_BYTES:
                    raise ArchiveError(f"{path}: {name} takes {entry.file_size:,} bytes; at most {limit:,} are read")
                with package.open(entry) as member:  # members that exceed their declared size are cut off, then refused
                    arrays[name] = array_from_npy(member.read(entry.file_size), f"{path}: {name}", kinds="iufU")
    except OSError as error:
        raise ArchiveError(f"{path}: cannot be opened ({error.strerror or error})") from error
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, ValueError) as error:
        raise ArchiveError(f"{path}: not a readable .npz file, or cut short ({error})") from error
    if missing := [name for name in ("format_version", "sky_cubemap") if name not in arrays]:
        raise ArchiveError(f"{path}: no sky file: {missing} missing; it holds {sorted(held)[:20]}")
    version = arrays["format_version"].reshape(-1).tolist()
    if version != [FORMAT_VERSION]:
        raise ArchiveError(f"{path}: format_version {version}; this nurec_sim reads [{FORMAT_VERSION}]")
    if _text(arrays, "coordinate_frame") not in ("", FRAME):
        raise ArchiveError(f"{path}: coordinate_frame {_text(arrays, 'coordinate_frame')!r}; only {FRAME!r} is read")
    faces = re.findall(r"[+-][XYZ]", " ".join(map(str, np.atleast_1d(arrays.get("face_order", [])))).upper())
    if len(faces) == 6 and tuple(faces) != FACE_ORDER:  # a description in other words is not taken for an order
        raise ArchiveError(f"{path}: face_order {faces}; only {list(FACE_ORDER)} is read")
    return arrays


def _isp(path: Path, arrays: Mapping[str, np.ndarray]) -> dict[str, Float64[np.ndarray, "3 4"]] | None:
    if "affine_matrix" not in arrays or "affine_sensor_ids" not in arrays:
        return None
    ids = [str(name) for name in np.atleast_1d(arrays["affine_sensor_ids"])]
    _check_shape(path, "affine_matrix", arrays["affine_matrix"], (len(ids), 3, 4))
    if len(set(ids)) != len(ids):
        raise ArchiveError(f"{path}: affine_sensor_ids must differ, got {ids[:20]}")
    return dict(zip(ids, arrays["affine_matrix"].astype(np.float64), strict=True))


def _check_shape(path: Path, name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape or array.dtype.kind != "f":
        raise ArchiveError(f"{path}: {name} must be floats {shape}, got {array.dtype} {array.shape}")
    if not np.isfinite(array).all():
        raise ArchiveError(f"{path}: {name} is not finite")


def _text(arrays: Mapping[str, np.ndarray], name: str) -> str:
    return str(arrays[name].reshape(-1)[0]) if name in arrays and arrays[name].size == 1 else ""
