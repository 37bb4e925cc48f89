"""A scene as PLY with its sky beside it, for programs that know nothing else; and such files as a scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.scene.harmonics import rotate_harmonics
from nurec_sim.scene.ply import Progress, read_ply, write_ply
from nurec_sim.scene.sky_sidecar import SkySidecar, read_sky, sky_paths, write_sky
from nurec_sim.types import (
    CameraModel,
    Clip,
    DynamicGaussians,
    Gaussians,
    GaussianScene,
    Label,
    Pinhole,
    Rig,
    Trajectory,
)

UP_AXES: Mapping[str, tuple[tuple[int, int, int], ...]] = {
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "y": ((0, 0, -1), (-1, 0, 0), (0, 1, 0)),
    "-y": ((0, 0, 1), (-1, 0, 0), (0, -1, 0)),
    "x": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "-x": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
}
"""world_from_file by the axis of the file that points up. The world's x is what such files have ahead: +z where y
points down (COLMAP, most trained 3DGS files), -z where y points up (OpenGL)."""
DEFAULT_SPAN_US = (1_000_000, 2_000_000)
CAMERA_HEIGHT_M = 1.5


@dataclass(frozen=True)
class Exported:
    """What an export wrote: the files, the Gaussians in the PLY, and how many were left out and why."""

    paths: tuple[Path, ...]
    written: int
    not_finite: int
    moving_left_out: int


def export_scene(
    scene: GaussianScene,
    path: Path | str,
    *,
    at_us: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Exported:
    """Writes ``X.ply``, ``X.sky.npz`` and ``X.sky.png``, the PLY last; each appears complete or not at all.

    Args:
        scene: what to write: the static layer, the sky and the colour correction.
        path: ends in ``.ply``.
        at_us: also write the moving Gaussians, as they are at this instant; left out if None.
        overwrite: whether existing files may be replaced.
        progress: hears what is being done and the fraction of it that is.

    Raises:
        ArchiveError: a file exists, the name does not end in ``.ply``, or the instant is outside of the scene's span.
    """
    path = Path(path)
    if path.suffix != ".ply":
        raise ArchiveError(f"the name of a PLY file must end in .ply, got {path.name!r}")
    npz, png = sky_paths(path)
    taken = [str(file) for file in (path, npz, png) if file.exists()]
    if taken and not overwrite:
        raise ArchiveError(f"{', '.join(taken)} exists; pass overwrite=True to replace it")
    start_us, end_us = scene.span_us
    if at_us is not None and not start_us <= at_us < end_us:
        raise ArchiveError(f"instant {at_us} us is outside of the scene, which spans [{start_us}, {end_us}) us")
    gaussians = scene.static if at_us is None else _with_moving(scene.static, scene.dynamic, at_us)
    sidecar = SkySidecar(scene.sky, isp=scene.isp, source=str(scene.provenance.get("method", "unknown")))
    write_sky(sidecar, npz, png, cameras=list(scene.rig.cameras))
    written = write_ply(gaussians, path, overwrite=overwrite, progress=progress)
    left_out = len(scene.dynamic) if at_us is None else 0
    return Exported((path, npz, png), written, len(gaussians) - written, left_out)


def import_scene(
    path: Path | str, *, sky: Path | str | None = None, like: GaussianScene | Clip | None = None, up: str = "z"
) -> GaussianScene:
    """A scene from a PLY of any 3DGS program; ``provenance["unknown"]`` says what could not be known.

    Args:
        path: the PLY; its Gaussians become the static layer, its stem the scene's id.
        sky: a sky file with colour corrections; ``X.sky.npz`` beside ``X.ply`` is taken if None and it is there.
        like: a scene or a log in the same world: its rig, path, span, tracks and map are taken, and of a scene also
            sky and colour correction where no sky file gives them. Else the car stands at the origin for one second,
            with one camera, 1.5 m up, that looks along x, under a black sky.
        up: axis of the file that points up, one of ``UP_AXES``; the file is turned so that it is z.

    Raises:
        ArchiveError: a file cannot be read, or ``up`` is no axis.
    """
    path = Path(path)
    if up not in UP_AXES:
        raise ArchiveError(f"up must be one of {list(UP_AXES)}, got {up!r}")
    world_from_file = np.array(UP_AXES[up], np.float64)
    gaussians, dropped = read_ply(path)
    if up != "z":
        gaussians = _turned(gaussians, world_from_file)
    unknown = ["no moving Gaussians: a PLY holds one instant", "no LiDAR intensity: a PLY holds none"]
    if not (gaussians.label == Label.ROAD).any():
        unknown.append("no road: no vertex has a road_mask")
    surroundings = _surroundings(like)
    if like is None:
        unknown.append(
            "no sensors, path, times, tracks and map: the car stands at the origin, one camera looks along x"
        )
    sky = sky or next((file for file in sky_paths(path)[:1] if file.exists()), None)
    if sky is not None:
        sidecar = read_sky(sky, world_from_file)
    elif isinstance(like, GaussianScene):
        sidecar = SkySidecar(like.sky, isp=like.isp)
    else:
        sidecar = SkySidecar(np.zeros((6, 1, 1, 3), np.float32))
        unknown.append("no sky: it is black")
    provenance = {
        "method": "import",
        "file": path.name,
        "sky_file": None if sky is None else Path(sky).name,
        "like": None if like is None else like.id,
        "up": up,
        "dropped": dropped,
        "unknown": unknown,
    }
    return GaussianScene(
        id=path.stem,
        static=gaussians,
        dynamic=DynamicGaussians.empty(),
        sky=sidecar.sky,
        isp=sidecar.isp,
        provenance=provenance,
        **surroundings,
    )


def _with_moving(static: Gaussians, dynamic: DynamicGaussians, at_us: int) -> Gaussians:
    """Both layers at an instant."""
    rows, mean_m, fade = dynamic.at(at_us)
    moving = dynamic.gaussians[rows]
    opacity = (moving.opacity * fade).astype(np.float32)
    moving = dataclasses.replace(moving, mean_m=mean_m.astype(np.float32), opacity=opacity)
    parts = [static, moving]
    k = max(0 if part.sh_rest is None else part.sh_rest.shape[1] for part in parts)
    return Gaussians.concatenate([_with_harmonics(part, k) if k else part for part in parts])


def _with_harmonics(gaussians: Gaussians, k: int) -> Gaussians:
    """The same colours with k coefficients per channel, no fewer than there are."""
    rest = np.zeros((len(gaussians), k, 3), np.float32)
    if gaussians.sh_rest is not None:
        rest[:, : gaussians.sh_rest.shape[1]] = gaussians.sh_rest
    return dataclasses.replace(gaussians, sh_rest=rest)


def _turned(gaussians: Gaussians, rotation: Float64[np.ndarray, "3 3"]) -> Gaussians:
    """Gaussians rotated about the origin, their view-dependent colours with them."""
    quat = geometry.quat_multiply(geometry.quat_from_matrix(rotation)[None], gaussians.quat_wxyz)
    rest = gaussians.sh_rest
    return dataclasses.replace(
        gaussians,
        mean_m=(gaussians.mean_m @ rotation.T).astype(np.float32),
        quat_wxyz=geometry.quat_normalize(quat).astype(np.float32),
        normal=(gaussians.normal @ rotation.T).astype(np.float32),
        sh_rest=None if rest is None else rotate_harmonics(rest, rotation),
    )


def _surroundings(like: GaussianScene | Clip | None) -> dict[str, Any]:
    """Everything of a scene that a PLY and a sky file do not hold."""
    if like is None:
        ahead = geometry.pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.0, 0, CAMERA_HEIGHT_M]))
        camera = CameraModel("camera", 1280, 720, Pinhole(640.0, 640.0, 640.0, 360.0), ahead)
        start_us = DEFAULT_SPAN_US[0]
        return {
            "rig": Rig({camera.id: camera}, {}),
            "ego": Trajectory(np.array([start_us]), np.eye(4)[None]),
            "tracks": [],
            "road_map": None,
            "span_us": DEFAULT_SPAN_US,
            "camera_times_us": {camera.id: np.array([[start_us, start_us]])},
        }
    known = {name: getattr(like, name) for name in ("rig", "ego", "tracks", "road_map", "span_us")}
    if isinstance(like, GaussianScene):
        return known | {"camera_times_us": like.camera_times_us}
    return known | {"camera_times_us": {name: like.camera_times_us(name) for name in like.rig.cameras}}
