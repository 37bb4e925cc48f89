"""The USD layers of an archive: the root, and Gaussians as ParticleField3DGaussianSplat prims.

Conventions of OpenUSD: quaternion arrays are ``x, y, z, w`` in memory, spherical harmonics follow 3DGS files (colour =
0.5 + C0 * DC + ...), particle-major with the constant term first. Time codes are milliseconds after
``absoluteTimeOffsetMicroSec``, which is the scene's start.

Positions are float32, everything else half floats (``scene.precision``). Data that a ParticleField cannot represent are
primvars of our namespace: the normal, the semantic class, LiDAR intensity and ray drop, and ``index``, its index in the
scene. Archives of version 1 are float32 throughout, with the exact display colour as primvar ``rgb``.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int32

from nurec_sim.errors import ArchiveError
from nurec_sim.files.new_files import temporary_folder
from nurec_sim.files.zip_package import Package
from nurec_sim.scene.precision import colours, constant_terms, half
from nurec_sim.scene.usd.crate_check import check_crate
from nurec_sim.types import Gaussians, GaussianScene, Label

NAMESPACE = "nurec_sim"
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


def extent_of(positions: Sequence[Float32[np.ndarray, "n 3"]], scale_m: Float32[np.ndarray, "n 3"]) -> np.ndarray:
    """Bounds [2,3] of Gaussians at any of several sets of positions, three standard deviations wide."""
    if len(scale_m) == 0:
        return np.zeros((2, 3), np.float32)
    # The largest axis bounds the ellipsoid whatever its rotation.
    margin = 3 * scale_m.max(axis=1, keepdims=True).astype(np.float64)
    low = np.min([(p - margin).min(axis=0) for p in positions], axis=0)
    high = np.max([(p + margin).max(axis=0) for p in positions], axis=0)
    return _to_float32(np.stack([low, high]))


def _to_float32(values: Float64[np.ndarray, "*n"]) -> Float32[np.ndarray, "*n"]:
    """Nearest float32, clamped to the largest finite one."""
    largest = np.finfo(np.float32).max
    return np.clip(values, -largest, largest).astype(np.float32)


def author_field(stage, path: str, gaussians: Gaussians, index: Int32[np.ndarray, " n"]):
    """Adds Gaussians as one ParticleField.

    An empty field is written for our reader, but inactive: NVIDIA's asset requirement VG.035 refuses empty fields.

    Args:
        stage: the ``Usd.Stage`` to add to.
        path: prim path of the field.
        gaussians: n Gaussians, in the frame of the prim.
        index: [n] their indices in the scene's layer, by which ``gather`` restores the order.

    Returns:
        The ``UsdVol.ParticleField3DGaussianSplat`` schema object.
    """
    from pxr import Sdf, Usd, UsdGeom, UsdVol, Vt

    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, path)
    rest = gaussians.sh_rest
    dc = constant_terms(gaussians.rgb)[:, None]
    coefficients = dc if rest is None else np.concatenate([dc, half(rest)], axis=1)
    terms = coefficients.shape[1]

    field.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(gaussians.mean_m)))
    field.CreateOrientationshAttr(Vt.QuathArray.FromNumpy(half(gaussians.quat_wxyz[:, [1, 2, 3, 0]])))
    field.CreateScaleshAttr(Vt.Vec3hArray.FromNumpy(half(gaussians.scale_m)))
    field.CreateOpacitieshAttr(Vt.HalfArray.FromNumpy(half(gaussians.opacity)))
    # Degree d has (d + 1)^2 terms.
    field.CreateRadianceSphericalHarmonicsDegreeAttr(int(np.sqrt(terms)) - 1)
    radiance = field.CreateRadianceSphericalHarmonicsCoefficientshAttr(
        Vt.Vec3hArray.FromNumpy(np.ascontiguousarray(coefficients.reshape(-1, 3)))
    )
    # ``elementSize`` values of the flat array belong to one particle.
    radiance.SetMetadata("elementSize", terms)
    radiance.SetMetadata("interpolation", UsdGeom.Tokens.vertex)  # the default is "constant"; VG.035 requires "vertex"
    field.CreateSortingModeHintAttr("cameraDistance")
    field.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent_of([gaussians.mean_m], gaussians.scale_m)))
    Usd.ColorSpaceAPI.Apply(field.GetPrim()).CreateColorSpaceNameAttr("srgb_rec709_display")

    types = Sdf.ValueTypeNames
    primvars = UsdGeom.PrimvarsAPI(field)
    columns = [
        ("index", types.IntArray, Vt.IntArray.FromNumpy(np.ascontiguousarray(index))),
        ("normal", types.Normal3hArray, Vt.Vec3hArray.FromNumpy(half(gaussians.normal))),
        ("semanticClass", types.UCharArray, Vt.UCharArray.FromNumpy(np.ascontiguousarray(gaussians.label))),
        ("intensity", types.HalfArray, Vt.HalfArray.FromNumpy(half(gaussians.intensity))),
    ]
    for name, values in (("rayDrop", gaussians.ray_drop), ("falloff", gaussians.falloff)):
        if values is not None:
            columns.append((name, types.HalfArray, Vt.HalfArray.FromNumpy(half(values))))
    for name, kind, array in columns:
        primvars.CreatePrimvar(f"{NAMESPACE}:{name}", kind, UsdGeom.Tokens.vertex).Set(array)
    if not len(gaussians):
        field.GetPrim().SetActive(False)
    return field


def read_field(layer, path: str, what: str) -> tuple[Int32[np.ndarray, " n"], Gaussians]:
    """Reads the Gaussians of one ParticleField and their indices in the scene.

    Raises:
        ArchiveError: an attribute is missing, of another type, or of another length than the positions.
    """

    def values(name: str, dtype: type, *shape: int) -> np.ndarray:
        """The values of an attribute; floats may be halves, which the schema names ``<name>h``."""
        specs = (layer.GetAttributeAtPath(f"{path}.{each}") for each in (name, f"{name}h"))
        spec = next((spec for spec in specs if spec is not None and spec.default is not None), None)
        given = None if spec is None else np.array(spec.default)
        allowed = (np.float32, np.float16) if dtype is np.float32 else (dtype,)
        if given is None or given.dtype not in allowed or given.shape[1:] != shape:
            found = "nothing" if given is None else f"{given.dtype} {given.shape}"
            raise ArchiveError(f"{what} {path}.{name} must be {np.dtype(dtype).name} [n, {shape}], got {found}")
        return given.astype(dtype, copy=False)

    positions = values("positions", np.float32, 3)
    n = len(positions)
    degree = layer.GetAttributeAtPath(f"{path}.radiance:sphericalHarmonicsDegree")
    if degree is None or degree.default not in (0, 1, 2, 3):
        raise ArchiveError(f"{what} {path}: the spherical-harmonics degree must be 0, 1, 2 or 3")
    terms = (degree.default + 1) ** 2
    coefficients = values("radiance:sphericalHarmonicsCoefficients", np.float32, 3)
    prefix = f"primvars:{NAMESPACE}:"
    columns = {
        "orientations": values("orientations", np.float32, 4),
        "scales": values("scales", np.float32, 3),
        "opacities": values("opacities", np.float32),
        "normal": values(f"{prefix}normal", np.float32, 3),
        "label": values(f"{prefix}semanticClass", np.uint8),
        "intensity": values(f"{prefix}intensity", np.float32),
        "index": values(f"{prefix}index", np.int32),
    }
    for name, attribute, *shape in (("rgb", "rgb", 3), ("ray_drop", "rayDrop"), ("falloff", "falloff")):
        if layer.GetAttributeAtPath(f"{path}.{prefix}{attribute}") is not None:
            columns[name] = values(f"{prefix}{attribute}", np.float32, *shape)
    lengths = {name: len(column) for name, column in columns.items()} | {"coefficients": len(coefficients) / terms}
    wrong = {name: length for name, length in lengths.items() if length != n}
    if wrong:
        raise ArchiveError(f"{what} {path}: {n} positions, but other counts in {wrong}")
    coefficients = coefficients.reshape(n, terms, 3)
    rest = np.ascontiguousarray(coefficients[:, 1:]) if terms > 1 else None
    rgb = columns.get("rgb", colours(coefficients[:, 0]))
    quat_wxyz = np.ascontiguousarray(columns["orientations"][:, [3, 0, 1, 2]])
    return columns["index"], Gaussians(
        positions, quat_wxyz, columns["scales"], columns["opacities"], rgb, columns["normal"],
        columns["label"], columns["intensity"], rest, columns.get("ray_drop"),
        columns.get("falloff"),
    )  # fmt: skip


def gather(parts: Sequence[tuple[Int32[np.ndarray, " k"], Gaussians]], count: int, what: str) -> Gaussians:
    """Restores the scene's order of Gaussians from several fields.

    Raises:
        ArchiveError: the indices are not a permutation of 0..count-1, or the parts have different degrees.
    """
    places = np.concatenate([index for index, _ in parts]) if parts else np.zeros(0, np.int32)
    if len(places) != count or not np.array_equal(np.sort(places), np.arange(count)):
        raise ArchiveError(f"{what}: the archive promises {count:,} Gaussians, each in its place; got {len(places):,}")
    try:
        merged = Gaussians.concatenate([part for _, part in parts])
    except ValueError as error:
        raise ArchiveError(f"{what}: the fields differ in spherical-harmonics degree") from error
    # ``places`` is a permutation; its inverse sorts the concatenated parts.
    order = np.empty(count, np.int64)
    order[places] = np.arange(count)
    return merged[order]
