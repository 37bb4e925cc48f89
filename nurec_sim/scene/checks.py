"""Validation of scenes before writing and after reading."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from nurec_sim import sensors
from nurec_sim.errors import ArchiveError
from nurec_sim.types import GAUSSIAN_FIELDS, DynamicGaussians, Gaussians, GaussianScene, Label, Rig, Trajectory

MIN_START_US = 1_000_000  # AlpaSim requests times up to half a second before the start, as unsigned integers
MAX_FACE_TEXELS = 4096
"""Largest edge of a face of the sky."""
_GAUSSIAN_SHAPES = {
    "mean_m": (3,),
    "quat_wxyz": (4,),
    "scale_m": (3,),
    "opacity": (),
    "rgb": (3,),
    "normal": (3,),
    "label": (),
    "intensity": (),
}


def check_scene(scene: GaussianScene) -> None:
    """Checks shapes, types, ranges and references of a scene.

    Raises:
        ArchiveError: with the fault, the given and the allowed values.
    """
    if not scene.id or not scene.id.isprintable():
        raise ArchiveError(f"a scene needs a printable id, got {scene.id!r}")
    check_gaussians(scene.static, "static")
    _check_dynamic(scene.dynamic, len(scene.tracks))
    _check_array(scene.sky, "sky", np.float32, (6, *scene.sky.shape[1:2] * 2, 3))
    _refuse(~np.isfinite(scene.sky).reshape(6, -1).all(axis=1), "sky", "face", "not finite")
    if not 1 <= scene.sky.shape[1] <= MAX_FACE_TEXELS:
        raise ArchiveError(f"the sky needs faces of 1 to {MAX_FACE_TEXELS} texels, got {scene.sky.shape[1]}")
    for camera_id, matrix in scene.isp.items():
        _check_array(matrix, f"isp[{camera_id!r}]", np.float64, (3, 4))
        if not np.isfinite(matrix).all():
            raise ArchiveError(f"isp[{camera_id!r}] is not finite: {matrix.tolist()}")
    for camera_id, frames in scene.exposures.items():
        if not len(scene.camera_times_us.get(camera_id, ())):
            raise ArchiveError(f"exposures[{camera_id!r}]: camera_times_us has no frames of that camera")
        _check_array(frames, f"exposures[{camera_id!r}]", np.float64, (len(scene.camera_times_us[camera_id]), 3, 4))
        if not np.isfinite(frames).all():
            raise ArchiveError(f"exposures[{camera_id!r}] are not finite")
    for camera_id, image in scene.ego_images.items():
        if (camera := scene.rig.cameras.get(camera_id)) is None:
            raise ArchiveError(f"ego_images[{camera_id!r}]: the rig has no such camera; have {list(scene.rig.cameras)}")
        _check_array(image, f"ego_images[{camera_id!r}]", np.uint8, (camera.height_px, camera.width_px, 4))
    _check_facts(scene)


def _check_facts(scene: GaussianScene) -> None:
    start_us, end_us = scene.span_us
    if not MIN_START_US <= start_us < end_us:
        raise ArchiveError(f"span_us must be [start, end) with start >= {MIN_START_US}, got {scene.span_us}")
    ids = [track.id for track in scene.tracks]
    if len(set(ids)) != len(ids):
        raise ArchiveError(f"track ids must differ, got {sorted({i for i in ids if ids.count(i) > 1})} more than once")
    _check_path("ego", scene.ego)
    for track in scene.tracks:
        _check_path(f"track {track.id!r}", track.path)
    _check_rig(scene.rig)
    for camera_id, times in scene.camera_times_us.items():
        _check_array(times, f"camera_times_us[{camera_id!r}]", np.int64, (len(times), 2))
        if (times[:, 0] > times[:, 1]).any():
            raise ArchiveError(f"camera_times_us[{camera_id!r}]: an exposure ends before it starts")


def _check_rig(rig: Rig) -> None:
    own_ids = [camera.id for camera in rig.cameras.values()] + [lidar.id for lidar in rig.lidars.values()]
    for key, own_id in zip([*rig.cameras, *rig.lidars], own_ids, strict=True):
        if own_id != key:
            raise ArchiveError(f"the rig lists the sensor {own_id!r} as {key!r}; both must be the same")
    try:
        sensors.check_rig(rig)
    except ValueError as error:
        raise ArchiveError(str(error)) from error


def _check_path(what: str, path: Trajectory) -> None:
    rotation = path.world_from_body[:, :3, :3]
    skew = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max(axis=(1, 2))
    _refuse((skew > 1e-3) | (np.linalg.det(rotation) < 0), what, "poses", "not rotations")


def check_gaussians(gaussians: Gaussians, what: str) -> None:
    """Checks one set of Gaussians: shapes, dtypes, finite values, ranges.

    Raises:
        ArchiveError: with the field, the count of bad Gaussians and the first one.
    """
    n = len(gaussians.mean_m)
    for name in GAUSSIAN_FIELDS:
        dtype = np.uint8 if name == "label" else np.float32
        _check_array(getattr(gaussians, name), f"{what}.{name}", dtype, (n, *_GAUSSIAN_SHAPES[name]))
    if gaussians.sh_rest is not None:
        shape = gaussians.sh_rest.shape
        _check_array(gaussians.sh_rest, f"{what}.sh_rest", np.float32, (n, *shape[1:2], 3))
        if shape[1] not in (3, 8, 15):
            raise ArchiveError(f"{what}.sh_rest has {shape[1]} coefficients; degrees 1, 2, 3 have 3, 8, 15")
    for name in ("ray_drop", "falloff"):
        values = getattr(gaussians, name)
        if values is not None:
            _check_array(values, f"{what}.{name}", np.float32, (n,))
    for name in ("mean_m", "quat_wxyz", "scale_m", "opacity", "rgb", "normal", "sh_rest", "ray_drop", "falloff"):
        values = getattr(gaussians, name)
        if values is not None and not np.isfinite(values).all():
            _refuse(~np.isfinite(values.reshape(n, -1)).all(axis=1), what, name, "not finite")
    _refuse(np.any(gaussians.scale_m < 0, axis=1), what, "scale_m", "negative")
    _refuse((gaussians.opacity < 0) | (gaussians.opacity > 1), what, "opacity", "outside 0..1")
    _refuse((gaussians.intensity < 0) | (gaussians.intensity > 1), what, "intensity", "outside 0..1 (NaN is unknown)")
    for name in ("ray_drop", "falloff"):
        values = getattr(gaussians, name)
        if values is not None:
            _refuse((values < 0) | (values > 1), what, name, "outside 0..1")
    _refuse(~np.isin(gaussians.label, [int(label) for label in Label]), what, "label", "not a Label")
    norm = np.sqrt(np.einsum("ij,ij->i", gaussians.quat_wxyz, gaussians.quat_wxyz))
    _refuse(np.abs(norm - 1) > 1e-3, what, "quat_wxyz", "not of unit length")


def _check_dynamic(dynamic: DynamicGaussians, track_count: int) -> None:
    check_gaussians(dynamic.gaussians, "dynamic")
    n = len(dynamic)
    _check_array(dynamic.knot_t_us, "dynamic.knot_t_us", np.int64, (n, 3))
    _check_array(dynamic.knot_m, "dynamic.knot_m", np.float32, (n, 3, 3))
    _check_array(dynamic.track, "dynamic.track", np.int32, (n,))
    _refuse(~np.isfinite(dynamic.knot_m).all(axis=(1, 2)), "dynamic", "knot_m", "not finite")
    _refuse(np.any(np.diff(dynamic.knot_t_us, axis=1) < 0, axis=1), "dynamic", "knot_t_us", "not in order of time")
    if dynamic.in_box is not None:
        _check_array(dynamic.in_box, "dynamic.in_box", np.bool_, (n,))
        _refuse(dynamic.in_box & (dynamic.track < 0), "dynamic", "in_box", "in the box of no track")
    outside = (dynamic.track < -1) | (dynamic.track >= track_count)
    _refuse(outside, "dynamic", "track", f"outside -1..{track_count - 1}")


def _check_array(values: np.ndarray, what: str, dtype: type, shape: tuple[int, ...]) -> None:
    if not isinstance(values, np.ndarray) or values.dtype != dtype or values.shape != shape:
        given = f"{values.dtype} {values.shape}" if isinstance(values, np.ndarray) else type(values).__name__
        raise ArchiveError(f"{what} must be {np.dtype(dtype).name} {shape}, got {given}")


def _refuse(bad: Bool[np.ndarray, " n"], what: str, name: str, fault: str) -> None:
    if bad.any():
        first = int(np.argmax(bad))
        raise ArchiveError(
            f"{what}.{name}: {int(bad.sum()):,} of {len(bad):,} are {fault}; the first is number {first}"
        )
