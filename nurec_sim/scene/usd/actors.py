"""The moving part of an archive as USD: actors with their boxes, and windows of moving Gaussians.

``/Actors/track_<id>`` has the label, the size, a guide box that follows the recorded path, and one ParticleField per
window. A window is a set of Gaussians with the same three knot times: its positions have three time samples and it is
visible from the first knot to the last. Positions are in the world, as recorded; Gaussians without a track are under
``/Actors/untracked``. The fade of opacity within a window is not represented in USD. Rigid parts of an actor form one
window in the frame of the box, animated with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Int32, Int64

from nurec_sim.errors import ArchiveError
from nurec_sim.geometry import quat_from_matrix
from nurec_sim.scene.usd.fields import NAMESPACE, author_field, extent_of
from nurec_sim.scene.usd.layers import crate_bytes, new_stage, time_code
from nurec_sim.types import DynamicGaussians, Gaussians, GaussianScene, Track

MAX_WINDOWS = 5000
_COARSE_WINDOW_US = 500_000


def actors_layer(scene: GaussianScene, columns: Mapping[str, Int32[np.ndarray, " n"]]) -> bytes:
    """``splats_actors.usdc``; ``columns`` of all moving Gaussians, in the scene's order, are attributes of /Actors."""
    stage = new_stage("Actors")
    _author_columns(stage.GetPrimAtPath("/Actors"), columns)
    start_us = scene.span_us[0]
    prims = _prim_names(scene.tracks)
    for track, name in zip(scene.tracks, prims, strict=True):
        _author_track(stage, f"/Actors/{name}", track, start_us)
    for number, (owner, index) in enumerate(_windows(scene.dynamic)):
        parent = prims[owner] if owner >= 0 else "untracked"
        if owner < 0:
            stage.DefinePrim("/Actors/untracked", "Xform")
        path = f"/Actors/{parent}/window_{number:05d}"
        if scene.dynamic.in_box is not None and scene.dynamic.in_box[index[0]]:
            _author_rigid(stage, path, scene.dynamic.gaussians[index], index, scene.tracks[owner], start_us)
        else:
            _author_window(stage, path, scene.dynamic, index, start_us)
    return crate_bytes(stage)


def field_paths(layer) -> list[str]:
    """Paths of the ParticleFields in a layer written by ``actors_layer``."""
    root = layer.GetPrimAtPath("/Actors")
    if root is None:
        return []
    fields = (field for actor in root.nameChildren for field in actor.nameChildren)
    return [str(field.path) for field in fields if field.typeName == "ParticleField3DGaussianSplat"]


def read_columns(layer, names: Iterable[str], what: str) -> dict[str, Int32[np.ndarray, " n"]]:
    """Columns of ``actors_layer``.

    Raises:
        ArchiveError: one is missing, or holds anything but integers.
    """
    columns = {}
    for name in names:
        spec = layer.GetAttributeAtPath(f"/Actors.{NAMESPACE}:{name}")
        column = None if spec is None or spec.default is None else np.array(spec.default)
        if column is None or column.dtype != np.int32:
            found = "nothing" if column is None else column.dtype
            raise ArchiveError(f"{what} /Actors.{NAMESPACE}:{name} must be int32 [n], got {found}")
        columns[name] = column
    return columns


def _author_columns(prim, columns: Mapping[str, Int32[np.ndarray, " n"]]) -> None:
    from pxr import Sdf, Vt

    for name, column in columns.items():
        prim.CreateAttribute(f"{NAMESPACE}:{name}", Sdf.ValueTypeNames.IntArray).Set(Vt.IntArray.FromNumpy(column))


def _prim_names(tracks: Sequence[Track]) -> list[str]:
    """One prim name per track; ids that differ only in characters invalid in USD get their index appended."""
    from pxr import Tf

    names: list[str] = []
    for number, track in enumerate(tracks):
        name = Tf.MakeValidIdentifier(f"track_{track.id}")
        names.append(f"{name}_{number}" if name in names else name)
    return names


def _author_track(stage, path: str, track: Track, start_us: int) -> None:
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdSemantics, Vt

    actor = UsdGeom.Xform.Define(stage, path).GetPrim()
    UsdSemantics.LabelsAPI.Apply(actor, "class").CreateLabelsAttr(Vt.TokenArray([track.label]))
    types = Sdf.ValueTypeNames
    actor.CreateAttribute(f"{NAMESPACE}:trackId", types.String).Set(track.id)
    actor.CreateAttribute(f"{NAMESPACE}:size", types.Double3).Set(Gf.Vec3d(*map(float, track.size_m)))
    actor.CreateAttribute(f"{NAMESPACE}:controllable", types.Bool).Set(bool(track.controllable))

    box = UsdGeom.Cube.Define(stage, f"{path}/box")
    box.CreatePurposeAttr(UsdGeom.Tokens.guide)
    box.CreateSizeAttr(1.0)
    box.CreateExtentAttr(Vt.Vec3fArray([Gf.Vec3f(-0.5), Gf.Vec3f(0.5)]))
    author_path(box, track.path.t_us, track.path.world_from_body, start_us)
    box.AddScaleOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*map(float, track.size_m)), Usd.TimeCode.Default())


def author_path(prim, t_us: Int64[np.ndarray, " t"], poses: np.ndarray, start_us: int) -> None:
    """Adds time samples of a pose: translation (linear) and orientation (slerp), as in ``Trajectory.at``.

    Args:
        prim: the ``UsdGeom.Xformable`` to animate; both operations are appended to its transform.
        t_us: [t] sample times, microseconds.
        poses: [t,4,4] rigid transforms from the prim's frame to its parent's.
        start_us: the scene's start, time code 0.
    """
    from pxr import Gf, UsdGeom

    translate = prim.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble)
    orient = prim.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    quats = quat_from_matrix(poses[:, :3, :3])
    for t, pose, (w, x, y, z) in zip(t_us, poses, quats.tolist(), strict=True):
        code = time_code(t, start_us)
        translate.Set(Gf.Vec3d(*pose[:3, 3].tolist()), code)
        orient.Set(Gf.Quatd(w, x, y, z), code)


def _windows(dynamic: DynamicGaussians) -> list[tuple[int, Int64[np.ndarray, " k"]]]:
    """(track, indices of its Gaussians) for every window, in order of track and time.

    If almost every Gaussian has its own knot times, times are binned coarsely instead: one prim per Gaussian would be
    unusable. The exact knots are stored beside the layer in any case.
    """
    if len(dynamic) == 0:
        return []
    in_box = np.zeros(len(dynamic), bool) if dynamic.in_box is None else dynamic.in_box
    # Rigid parts are animated by the box's path: one window is enough for them, whatever their knots.
    keys = np.column_stack([dynamic.track, in_box, np.where(in_box[:, None], 0, dynamic.knot_t_us)])
    unique, window = np.unique(keys, axis=0, return_inverse=True)
    if len(unique) > MAX_WINDOWS:
        keys[:, 2:] //= _COARSE_WINDOW_US
        unique, window = np.unique(keys, axis=0, return_inverse=True)
    # Group indices by window with one sort instead of one search per window.
    order = np.argsort(window.reshape(-1), kind="stable")
    starts = np.searchsorted(window.reshape(-1)[order], np.arange(len(unique)))
    return [(int(key[0]), part) for key, part in zip(unique, np.split(order, starts[1:]), strict=True)]


def _author_window(stage, path: str, dynamic: DynamicGaussians, index: Int64[np.ndarray, " k"], start_us: int) -> None:
    from pxr import Vt

    gaussians: Gaussians = dynamic.gaussians[index]
    knots_m = np.ascontiguousarray(np.moveaxis(dynamic.knot_m[index], 1, 0))
    # Equal within a window, unless the times were binned.
    times_us = np.median(dynamic.knot_t_us[index], axis=0).astype(np.int64)
    field = author_field(stage, path, gaussians, index.astype(np.int32))
    positions = field.GetPositionsAttr()
    for t_us, knot_m in zip(times_us, knots_m, strict=True):
        positions.Set(Vt.Vec3fArray.FromNumpy(knot_m), time_code(t_us, start_us))
    extent = extent_of([gaussians.mean_m, *knots_m], gaussians.scale_m)
    field.GetExtentAttr().Set(Vt.Vec3fArray.FromNumpy(extent))
    _author_life(field, times_us[0], times_us[2], start_us)


def _author_rigid(
    stage, path: str, gaussians: Gaussians, index: Int64[np.ndarray, " k"], track: Track, start_us: int
) -> None:
    field = author_field(stage, path, gaussians, index.astype(np.int32))
    author_path(field, track.path.t_us, track.path.world_from_body, start_us)
    _author_life(field, track.path.start_us, track.path.end_us, start_us)


def _author_life(field, first_us: int, last_us: int, start_us: int) -> None:
    """Makes a field visible from one instant to another, both included."""
    from pxr import UsdGeom

    visibility = field.CreateVisibilityAttr()
    # Visibility is a token: samples are held until the next one, not interpolated.
    visibility.Set(UsdGeom.Tokens.invisible, time_code(first_us - 1, start_us))
    visibility.Set(UsdGeom.Tokens.inherited, time_code(first_us, start_us))
    visibility.Set(UsdGeom.Tokens.invisible, time_code(last_us + 1, start_us))
