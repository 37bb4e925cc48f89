"""Writing a clip folder (or a zip of one) in our own format, ``docs/clip_format.md``."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shutil
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from nurec_sim import sensors
from nurec_sim.errors import ClipError
from nurec_sim.files.new_files import swap, writing
from nurec_sim.logs import calibration, tables
from nurec_sim.logs.consistency import EARLIEST_US
from nurec_sim.logs.storage import META_FILE
from nurec_sim.logs.stored import encode_points
from nurec_sim.types import Rig, RoadMap, Sweep, Track, Trajectory

SCHEMA = "nurec-sim-clip-1"
INTENSITY_SCALE = 255
_SAFE_ID = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
_ZIP_DATE = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True, eq=False)
class CameraEntry:
    """One image to write: RGB pixels, or a JPEG or PNG file as it is.

    ``world_from_camera`` at the start and end of the exposure is optional; without it readers use the ego's trajectory
    and ``rig_from_camera``.
    """

    camera_id: str
    start_us: int
    end_us: int
    image: UInt8[np.ndarray, "h w 3"] | bytes
    world_from_camera: Float64[np.ndarray, "2 4 4"] | None = None


@dataclass(frozen=True, eq=False)
class LidarEntry:
    """One motion-compensated sweep to write."""

    lidar_id: str
    sweep: Sweep


def write_clip(
    path: str | Path,
    *,
    id: str,
    rig: Rig,
    ego: Trajectory,
    frames: Iterable[CameraEntry | LidarEntry],
    tracks: Sequence[Track] = (),
    road_map: RoadMap | None = None,
    facts: Mapping[str, Any] | None = None,
    jpeg_quality: int | None = 95,
    attachments: Mapping[str, bytes] | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a driving log atomically.

    Args:
        path: folder to create, or a ``.zip`` file of it.
        id: name of the clip.
        rig: sensors and outline of the car; every entry of ``frames`` names one of them.
        ego: poses of the rig, at any rate.
        frames: images and sweeps, consumed one at a time, so a generator can create them on the fly; sensors in any
            order, the frames of each in temporal order.
        tracks: labelled objects, poses of box centres in the world.
        road_map: drivable areas and lanes, if known.
        facts: additional metadata, as plain JSON (source, seed, licence, ...).
        jpeg_quality: 1 to 100 for images given as pixels, or None for lossless PNG.
        attachments: additional files beside the log's own, by name (``map.xodr``); readers ignore them.
        overwrite: replace what is at ``path``.

    Returns:
        ``path``.

    Raises:
        ClipError: something is at ``path`` already, an entry names no sensor of the rig, has another size than its
            camera, a time below 1 s, times that go back, or values that are not finite.
        WriteError: the disk is full, or the place cannot be written.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise ClipError(f"{str(path)!r} exists; choose another path or allow overwriting")
    _check_rig(rig)
    if ego.start_us < EARLIEST_US:
        raise ClipError(f"clips start at {EARLIEST_US} us or later; the ego's first pose is at {ego.start_us}")
    with writing(path), _work_folder(path) as work:
        folder = work / "clip"
        folder.mkdir()
        records = _write_frames(folder, rig, frames, jpeg_quality)
        meta = {
            "schema": SCHEMA,
            "name": id,
            "n_images": sum(len(rows) for rows in records["cameras"].values()),
            "n_sweeps": sum(len(rows) for rows in records["lidars"].values()),
            **{key: value for key, value in (facts or {}).items() if key not in ("schema", "name")},
        }
        records["ego"] = {"t_us": ego.t_us.tolist(), "T_world_ego": ego.world_from_body.tolist()}
        _write_json(folder / META_FILE, meta, indent=1)
        _write_json(folder / "calib.json", calibration.rig_to_json(rig, INTENSITY_SCALE))
        _write_json(folder / "frames.json", records)
        if tracks:
            _write_json(folder / "tracks.json", {"tracks": [tables.track_to_json(track) for track in tracks]})
        if road_map is not None:
            _write_json(folder / "map.json", tables.map_to_json(road_map))
        for name, data in (attachments or {}).items():
            if not _SAFE_ID.fullmatch(name) or (folder / name).exists():
                raise ClipError(f"attachment {name!r} needs a plain file name that the clip does not use itself")
            _write_bytes(folder / name, data)
        _move_into_place(folder, path, work)
    return path


@contextlib.contextmanager
def _work_folder(path: Path) -> Iterator[Path]:
    """A hidden folder beside ``path`` for the duration of the block, on the same file system as ``path``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _check_rig(rig: Rig) -> None:
    for name in (*rig.cameras, *rig.lidars):
        if not _SAFE_ID.fullmatch(name):
            raise ClipError(f"sensor id {name!r} cannot name a folder; use letters, digits, '_', '-' and '.'")
    if shared := set(rig.cameras) & set(rig.lidars):
        raise ClipError(f"a camera and a LiDAR share the id {sorted(shared)[0]!r}")
    try:
        sensors.check_rig(rig)
    except ValueError as error:
        raise ClipError(str(error)) from error


def _write_frames(
    folder: Path, rig: Rig, frames: Iterable[CameraEntry | LidarEntry], jpeg_quality: int | None
) -> dict[str, Any]:
    """Write all images and sweeps; return the rows of frames.json."""
    rows: dict[str, Any] = {"cameras": {name: [] for name in rig.cameras}, "lidars": {name: [] for name in rig.lidars}}
    for entry in frames:
        if isinstance(entry, CameraEntry):
            group, name, times = "cameras", entry.camera_id, (entry.start_us, entry.end_us)
        else:
            group, name, times = "lidars", entry.lidar_id, (entry.sweep.start_us, entry.sweep.end_us)
        if name not in rows[group]:
            raise ClipError(f"a frame names {name!r}, which the rig does not have; {group}: {list(rows[group])}")
        own = rows[group][name]
        where = f"frame {len(own)} of {name!r}"
        if not EARLIEST_US <= times[0] <= times[1]:
            raise ClipError(f"{where}: needs {EARLIEST_US} <= start <= end, got {times[0]}, {times[1]} us")
        if own and times[0] <= own[-1]["start_us"]:
            raise ClipError(f"{where}: starts at {times[0]} us, not after the frame before ({own[-1]['start_us']} us)")
        if isinstance(entry, CameraEntry):
            own.append(_write_image(folder, rig, entry, len(own), where, jpeg_quality))
        else:
            own.append(_write_sweep(folder, entry, len(own), where))
    return rows


def _write_image(
    folder: Path, rig: Rig, entry: CameraEntry, index: int, where: str, jpeg_quality: int | None
) -> dict[str, Any]:
    if isinstance(entry.image, bytes):
        data = entry.image
        suffix = ".png" if data[:4] == b"\x89PNG" else ".jpg"
    else:
        camera = rig.cameras[entry.camera_id]
        expected = (camera.height_px, camera.width_px, 3)
        if entry.image.shape != expected or entry.image.dtype != np.uint8:
            raise ClipError(f"{where}: needs uint8 pixels {expected}, got {entry.image.dtype} {entry.image.shape}")
        data, suffix = _encode_image(entry.image, jpeg_quality)
    file = f"images/{entry.camera_id}/{index:04d}{suffix}"
    _write_bytes(folder / file, data)
    row: dict[str, Any] = {"file": file, "start_us": int(entry.start_us), "end_us": int(entry.end_us)}
    if entry.world_from_camera is not None:
        poses = np.asarray(entry.world_from_camera, np.float64)
        if poses.shape != (2, 4, 4) or not np.isfinite(poses).all():
            raise ClipError(f"{where}: world_from_camera must be finite [2,4,4], got {poses.shape}")
        row["T_world_cam"] = poses.tolist()
    return row


def _encode_image(rgb: UInt8[np.ndarray, "h w 3"], jpeg_quality: int | None) -> tuple[bytes, str]:
    import cv2

    suffix, options = ".png", [cv2.IMWRITE_PNG_COMPRESSION, 6]
    if jpeg_quality is not None:
        full_colour = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
        suffix = ".jpg"
        options = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, full_colour]
    return cv2.imencode(suffix, np.ascontiguousarray(rgb[:, :, ::-1]), options)[1].tobytes(), suffix


def _write_sweep(folder: Path, entry: LidarEntry, index: int, where: str) -> dict[str, Any]:
    sweep = entry.sweep
    if not np.isfinite(sweep.xyz_m).all() or not np.isfinite(sweep.world_from_lidar).all():
        raise ClipError(f"{where}: points and pose must be finite")
    arrays = {"dxyz_mm": encode_points(sweep.xyz_m)}
    if sweep.intensity is not None:
        arrays["intensity"] = np.rint(np.clip(sweep.intensity, 0.0, 1.0) * INTENSITY_SCALE).astype(np.uint8)
    if (np.asarray(sweep.point_t_us) != sweep.t_us).any():
        arrays["dt_us"] = (sweep.point_t_us - sweep.start_us).astype(np.int32)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    file = f"lidar/{entry.lidar_id}/{index:04d}.npz"
    _write_bytes(folder / file, buffer.getvalue())
    return {
        "file": file,
        "num_points": len(sweep.xyz_m),
        "t_us": int(sweep.t_us),
        "start_us": int(sweep.start_us),
        "end_us": int(sweep.end_us),
        "motion_compensated": True,
        "T_world_lidar": np.asarray(sweep.world_from_lidar, np.float64).tolist(),
    }


def _write_bytes(file: Path, data: bytes) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(data)


def _write_json(file: Path, value: dict[str, Any], indent: int | None = None) -> None:
    try:
        text = json.dumps(value, allow_nan=False, indent=indent)
    except (TypeError, ValueError) as error:
        raise ClipError(f"{file.name} cannot be written as JSON: {error}") from error
    _write_bytes(file, (text + "\n").encode())


def _move_into_place(folder: Path, path: Path, work: Path) -> None:
    """Rename the finished clip to ``path``; an existing one is removed only once the new one is complete."""
    ready = folder
    if path.suffix == ".zip":
        ready = work / "clip.zip"
        _zip_folder(folder, ready)
    swap(ready, path, work / "replaced")


def _zip_folder(folder: Path, target: Path) -> None:
    """Zip a folder reproducibly: the same files give the same bytes."""
    with zipfile.ZipFile(target, "w") as archive:
        for file in sorted(item for item in folder.rglob("*") if item.is_file()):
            info = zipfile.ZipInfo(file.relative_to(folder).as_posix(), date_time=_ZIP_DATE)
            # Images and npz files are compressed already.
            compressed = file.suffix in (".jpg", ".png", ".npz")
            info.compress_type = zipfile.ZIP_STORED if compressed else zipfile.ZIP_DEFLATED
            archive.writestr(info, file.read_bytes())
