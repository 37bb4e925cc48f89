"""A scene as PLY with its sky beside it, for programs that know nothing else; and such files as a scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.scene.ply import Progress, read_ply, write_ply
from nurec_sim.scene.sky_sidecar import SkySidecar, read_sky, sky_paths, write_sky
from nurec_sim.scene.transform import joined, transformed
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
    gaussians = scene.static if at_us is None else _with_moving(scene, at_us)
    sidecar = SkySidecar(scene.sky, isp=scene.isp, source=str(scene.provenance.get("method", "unknown")))
    write_sky(sidecar, npz, png, cameras=list(scene.rig.cameras))
    written = write_ply(gaussians, path, overwrite=overwrite, progress=progress)
    left_out = len(scene.dynamic) if at_us is None else 0
    return Exported((path, npz, png), written, len(gaussians) - written, left_out)


def import_scene(
    path: Path | str, *, sky: Path | str | None = None, like: GaussianScene | Clip | None = None, up: str = "z"
) -> GaussianScene:
    """A scene from a file of another program; ``provenance["unknown"]`` says what could not be known.

    Args:
        path: a PLY, whose Gaussians become the static layer, its stem the scene's id; or any file that
            ``foreign.read_foreign`` reads.
        sky: a sky file with colour corrections; ``X.sky.npz`` beside ``X.ply`` is taken if None and it is there.
        like: a scene or a log in the same world: its rig, path, span, tracks and map are taken, and of a scene also
            sky and colour correction where no sky file gives them. Else the car stands at the origin for one second,
            with one camera, 1.5 m up, that looks along x, under a black sky.
        up: axis of the PLY that points up, one of ``UP_AXES``; the file is turned so that it is z. Other files say it
            themselves.

    Raises:
        ArchiveError: a file cannot be read, or ``up`` is no axis.
    """
    path = Path(path)
    if path.suffix.lower() != ".ply":
        return _import_other(path, sky, like, up)
    if up not in UP_AXES:
        raise ArchiveError(f"up must be one of {list(UP_AXES)}, got {up!r}")
    world_from_file = np.array(UP_AXES[up], np.float64)
    gaussians, dropped = read_ply(path)
    if up != "z":
        gaussians = transformed(gaussians, geometry.pose(world_from_file, np.zeros(3)))
    unknown = ["no moving Gaussians: a PLY holds one instant", "no LiDAR intensity: a PLY holds none"]
    if not (gaussians.label == Label.ROAD).any():
        unknown.append("no road: no vertex has a road_mask")
    surroundings = default_surroundings() if like is None else _surroundings(like)
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


def _import_other(path: Path, sky: Path | str | None, like: GaussianScene | Clip | None, up: str) -> GaussianScene:
    """A scene from a file that says itself which way is up, and may know sensors, path and sky."""
    from nurec_sim.scene.foreign import read_foreign

    if up != "z":
        raise ArchiveError(f"{path}: only for PLY files can another axis than z be given as up; got {up!r}")
    scene = read_foreign(path)
    changes: dict[str, Any] = {}
    if sky is not None:
        sidecar = read_sky(sky)
        changes |= {"sky": sidecar.sky, "isp": dict(scene.isp) | dict(sidecar.isp)}
    if like is not None and scene.tracks:
        raise ArchiveError(f"{path} has tracks of its own; like is for files without")
    if like is not None:
        changes |= _surroundings(like)
    used = {"sky_file": None if sky is None else Path(sky).name, "like": None if like is None else like.id}
    return dataclasses.replace(scene, provenance=dict(scene.provenance) | used, **changes)


def _with_moving(scene: GaussianScene, at_us: int) -> Gaussians:
    """Both layers at an instant."""
    rows, mean_m, fade = scene.dynamic.at(at_us)
    moving = scene.dynamic.gaussians[rows]
    opacity = (moving.opacity * fade).astype(np.float32)
    moving = dataclasses.replace(moving, mean_m=mean_m.astype(np.float32), opacity=opacity)
    owner, in_box = scene.dynamic.track[rows], np.zeros(len(rows), bool)
    if scene.dynamic.in_box is not None:
        in_box = scene.dynamic.in_box[rows]
    parts = [scene.static, moving[~in_box]]
    for index in np.unique(owner[in_box]).tolist():
        path = scene.tracks[index].path
        if path.covers(at_us):
            parts.append(transformed(moving[in_box & (owner == index)], path.at(at_us)))
    return joined(parts)


def default_surroundings() -> dict[str, Any]:
    """Everything of a scene beside Gaussians, sky and colours, where nothing is known: a car that stands at the origin.

    It stands there for ``DEFAULT_SPAN_US``, with one camera, ``CAMERA_HEIGHT_M`` up, that looks along x.
    """
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


def _surroundings(like: GaussianScene | Clip) -> dict[str, Any]:
    """The same, taken from a scene or a log of the same place."""
    known = {name: getattr(like, name) for name in ("rig", "ego", "tracks", "road_map", "span_us")}
    if isinstance(like, GaussianScene):
        return known | {"camera_times_us": like.camera_times_us}
    return known | {"camera_times_us": {name: like.camera_times_us(name) for name in like.rig.cameras}}
