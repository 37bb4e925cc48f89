"""Export of scenes as PLY with a sky file, and import of third-party files."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nurec_sim.errors import ArchiveError
from nurec_sim.scene.formats import is_foreign, read_scene
from nurec_sim.scene.interop.ply import LAYOUTS, Layout, Progress, write_ply
from nurec_sim.scene.interop.reader import read_foreign
from nurec_sim.scene.interop.sky_sidecar import SkySidecar, read_sky, sky_paths, write_sky
from nurec_sim.scene.interop.surroundings import colours_in, first_colours, surroundings_of, taken_from
from nurec_sim.scene.transform import joined, transformed, world_from_up
from nurec_sim.types import Clip, Gaussians, GaussianScene


@dataclass(frozen=True)
class Exported:
    """Result of an export: files, number of Gaussians, and numbers of skipped ones by reason."""

    paths: tuple[Path, ...]
    written: int
    not_finite: int
    moving_left_out: int


def export_scene(
    scene: GaussianScene,
    path: Path | str,
    *,
    layout: Layout = "inria",
    up: str = "z",
    at_us: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Exported:
    """Writes ``X.ply``, ``X.sky.npz`` and ``X.sky.png``, the PLY last, each atomically.

    Args:
        scene: the scene, of which the static layer, the sky and the colour correction are written.
        path: ends in ``.ply``.
        layout: vertex layout of the PLY, one of ``LAYOUTS``.
        up: up axis of the files, one of ``UP_AXES``; Gaussians and sky are rotated.
        at_us: also write the moving Gaussians at this time; None skips them.
        overwrite: whether existing files may be replaced.
        progress: called with stage and fraction done.

    Raises:
        ArchiveError: a file exists, the name does not end in ``.ply``, the instant is outside of the scene's span,
            or an unknown layout or axis.
    """
    path = Path(path)
    if path.suffix != ".ply":
        raise ArchiveError(f"the name of a PLY file must end in .ply, got {path.name!r}")
    if layout not in LAYOUTS:
        raise ArchiveError(f"layout must be one of {list(LAYOUTS)}, got {layout!r}")
    world_from_file = world_from_up(up)
    npz, png = sky_paths(path)
    taken = [str(file) for file in (path, npz, png) if file.exists()]
    if taken and not overwrite:
        raise ArchiveError(f"{', '.join(taken)} exists; pass overwrite=True to replace it")
    start_us, end_us = scene.span_us
    if at_us is not None and not start_us <= at_us < end_us:
        raise ArchiveError(f"instant {at_us} us is outside of the scene, which spans [{start_us}, {end_us}) us")
    gaussians = scene.static if at_us is None else _with_moving(scene, at_us)
    sidecar = SkySidecar(scene.sky, isp=scene.isp, source=str(scene.provenance.get("method", "unknown")))
    write_sky(sidecar, npz, png, cameras=list(scene.rig.cameras), world_from_file=world_from_file)
    written = write_ply(gaussians, path, layout=layout, up=up, overwrite=overwrite, progress=progress)
    left_out = len(scene.dynamic) if at_us is None else 0
    return Exported((path, npz, png), written, len(gaussians) - written, left_out)


def import_scene(
    path: Path | str, *, sky: Path | str | None = None, like: GaussianScene | Clip | None = None, up: str | None = None
) -> GaussianScene:
    """Imports a third-party file; ``provenance["unknown"]`` lists missing information.

    Args:
        path: a file for ``interop.reader.read_foreign``, or our own archive.
        sky: a sky file with colour corrections; default: ``X.sky.npz`` beside ``X.ply``, if it exists.
        like: a scene or a log in the same world that supplies missing data: sensors with path and times, tracks, the
            map, and, from a scene, the sky and the colour correction. Otherwise the car is at the origin for one
            second, with one camera, 1.5 m high, facing along x, under a black sky.
        up: up axis of a PLY or SPZ file, one of ``UP_AXES``, rotated to z. Default: y for SPZ; for PLY the axis
            recorded by our export, else z. Other formats define it themselves.

    Raises:
        ArchiveError: a file cannot be read, or ``up`` is not an axis.
    """
    path = Path(path)
    if path.suffix.lower() != ".usdz" or not path.is_file() or is_foreign(path):
        return read_foreign(path, sky=sky, like=like, up=up)
    if up not in (None, "z"):
        raise ArchiveError(f"{path}: an archive of nurec_sim has z up; got {up!r}")
    scene = read_scene(path)
    cubemap, isp = first_colours([colours_in(None if sky is None else read_sky(sky)), (scene.sky, scene.isp)], [])
    road_map = scene.road_map or surroundings_of(like)["road_map"]
    provenance = dict(scene.provenance) | taken_from(sky, like)
    return dataclasses.replace(scene, sky=cubemap, isp=isp, road_map=road_map, provenance=provenance)


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
