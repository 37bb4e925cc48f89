"""The USD layers of an archive: the root, and the static Gaussians.

Time codes are milliseconds after ``absoluteTimeOffsetMicroSec``, which is the scene's start.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np

from nurec_sim.errors import ArchiveError
from nurec_sim.files.new_files import temporary_folder
from nurec_sim.files.zip_package import Package
from nurec_sim.scene.usd.crate_check import check_crate
from nurec_sim.scene.usd.fields import author_field
from nurec_sim.types import Gaussians, GaussianScene, Label

LAYER_SUFFIXES = (".usda", ".usdc", ".usd")
STATIC_LAYER, ACTORS_LAYER, CAMERAS_LAYER = "splats_static.usdc", "splats_actors.usdc", "cameras.usdc"
SKY_TEXTURE = "sky/envmap_latlong.exr"

_ROOT_LAYER = """#usda 1.0
(
    customLayerData = {{
        int64 absoluteTimeOffsetMicroSec = {start_us}
        string "nurec_sim:colorNote" = "display-space colours; per-camera corrections are in nurec_sim/isp.json"
        int "nurec_sim:formatVersion" = {format_version}
        string "nurec_sim:generator" = "nurec_sim"
        string "nurec_sim:sceneId" = "{scene_id}"
        matrix4d "nurec_sim:worldToNre" = ( (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1) )
    }}
    defaultPrim = "World"
    endTimeCode = {end}
    metersPerUnit = 1
    startTimeCode = 0
    timeCodesPerSecond = 1000
    upAxis = "Z"
)

def Xform "World"
{{
    def Xform "Static" (
        prepend references = @./splats_static.usdc@
    )
    {{
    }}

    def Xform "Actors" (
        prepend references = @./splats_actors.usdc@
    )
    {{
    }}

    def Xform "Rig" (
        prepend references = @./cameras.usdc@
    )
    {{
    }}

    def DomeLight_1 "Sky"
    {{
        asset inputs:texture:file = @./sky/envmap_latlong.exr@
        token inputs:texture:format = "latlong"
        uniform token poleAxis = "Z"
    }}
}}
"""


def time_code(t_us: int, start_us: int) -> float:
    """USD time code of an instant: milliseconds after the scene's start."""
    return (int(t_us) - start_us) / 1000


def root_layer(scene: GaussianScene, format_version: int) -> bytes:
    """``default.usda``: units, time base, and references to the other layers."""
    start_us, end_us = scene.span_us
    scene_id = scene.id.replace("\\", "\\\\").replace('"', '\\"')
    end = time_code(end_us, start_us)
    return _ROOT_LAYER.format(start_us=start_us, end=end, scene_id=scene_id, format_version=format_version).encode()


def new_stage(root_prim: str):
    """An empty stage in memory: Z up, metres, milliseconds, with an Xform ``/root_prim`` as default prim."""
    from pxr import Sdf, Usd, UsdGeom

    stage = Usd.Stage.Open(Sdf.Layer.CreateAnonymous(".usdc"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    stage.SetTimeCodesPerSecond(1000)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, f"/{root_prim}").GetPrim())
    return stage


def crate_bytes(stage) -> bytes:
    """A stage's root layer in the binary format.

    Raises:
        WriteError: the disk of temporary files is full.
    """
    from pxr import Tf

    with temporary_folder() as folder:
        path = folder / "layer.usdc"
        try:
            text = "" if stage.GetRootLayer().Export(str(path)) else "no reason given"
        except Tf.ErrorException as error:
            text = str(error)
        if text:  # OpenUSD reports disk errors only by the system's message
            number = next((number for number in errno.errorcode if os.strerror(number) in text), errno.EIO)
            raise OSError(number, os.strerror(number))
        return path.read_bytes()


def open_member(package: Path, name: str):
    """Opens a USD layer inside a package without composition: referenced files are not opened.

    Raises:
        ArchiveError: OpenUSD cannot read it.
    """
    from pxr import Ar, Sdf, Tf

    with Package(package) as opened, opened.open(name) as file:
        check_crate(file, f"{package}: {name}")
    try:
        layer = Sdf.Layer.OpenAsAnonymous(Ar.JoinPackageRelativePath(str(package.resolve()), name))
    except Tf.ErrorException as error:
        raise ArchiveError(f"{package}: {name} is no readable USD layer") from error
    if layer is None:
        raise ArchiveError(f"{package}: {name} is no readable USD layer")
    return layer


def static_layer(static: Gaussians) -> bytes:
    """``splats_static.usdc``: /Static/background and /Static/road, split by label."""
    stage = new_stage("Static")
    is_road = static.label == Label.ROAD
    for name, mask in (("background", ~is_road), ("road", is_road)):
        index = np.flatnonzero(mask).astype(np.int32)
        author_field(stage, f"/Static/{name}", static[index], index)
    return crate_bytes(stage)
