"""Gaussians as ParticleField3DGaussianSplat prims of OpenUSD.

Conventions of OpenUSD: quaternion arrays are ``x, y, z, w`` in memory, spherical harmonics follow 3DGS files (colour =
0.5 + C0 * DC + ...), particle-major with the constant term first.

Positions are float32, most else half floats (``scene.precision``). Data that a ParticleField cannot represent are
primvars of our namespace: the normal unless it is the third axis of all Gaussians of the field, the semantic class,
LiDAR intensity and ray drop, and ``index``, its index in the scene. Archives of version 2 have all normals, and half
floats for intensity and ray drop; those of version 1 are float32 throughout, with the exact display colour as primvar
``rgb``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64, Int32

from nurec_sim.errors import ArchiveError
from nurec_sim.scene.precision import byte_levels, colours, constant_terms, from_byte_levels, half, third_axes
from nurec_sim.types import Gaussians

NAMESPACE = "nurec_sim"
_NO_LABEL = 255
"""What numbers beyond a byte are read as; the check of the scene refuses it."""


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
    # Integers are packed by OpenUSD, bytes and vectors are not.
    columns = [
        ("index", types.IntArray, Vt.IntArray.FromNumpy(np.ascontiguousarray(index))),
        ("semanticClass", types.IntArray, Vt.IntArray.FromNumpy(gaussians.label.astype(np.int32))),
        ("intensity", types.UCharArray, Vt.UCharArray.FromNumpy(byte_levels(gaussians.intensity))),
    ]
    if not np.array_equal(gaussians.normal, third_axes(gaussians.quat_wxyz)):
        columns.append(("normal", types.Normal3hArray, Vt.Vec3hArray.FromNumpy(half(gaussians.normal))))
    if gaussians.ray_drop is not None:
        columns.append(("rayDrop", types.UCharArray, Vt.UCharArray.FromNumpy(byte_levels(gaussians.ray_drop))))
    if gaussians.falloff is not None:
        columns.append(("falloff", types.HalfArray, Vt.HalfArray.FromNumpy(half(gaussians.falloff))))
    for name, kind, array in columns:
        primvars.CreatePrimvar(f"{NAMESPACE}:{name}", kind, UsdGeom.Tokens.vertex).Set(array)
    if not len(gaussians):
        field.GetPrim().SetActive(False)
    return field


def read_field(layer, path: str, what: str) -> tuple[Int32[np.ndarray, " n"], Gaussians]:
    """Reads the Gaussians of one ParticleField and their indices in the scene, of any version of the format.

    Raises:
        ArchiveError: an attribute is missing, of another type, or of another length than the positions.
    """

    def given(name: str, dtypes: tuple[type, ...], *shape: int) -> np.ndarray:
        """The values of an attribute, of one of several types; the schema names that of halves ``<name>h``."""
        specs = (layer.GetAttributeAtPath(f"{path}.{each}") for each in (name, f"{name}h"))
        spec = next((spec for spec in specs if spec is not None and spec.default is not None), None)
        array = None if spec is None else np.array(spec.default)
        if array is None or array.dtype not in dtypes or array.shape[1:] != shape:
            found = "nothing" if array is None else f"{array.dtype} {array.shape}"
            allowed = " or ".join(np.dtype(dtype).name for dtype in dtypes)
            raise ArchiveError(f"{what} {path}.{name} must be {allowed} [n, {shape}], got {found}")
        return array

    def floats(name: str, *shape: int) -> np.ndarray:
        return given(name, (np.float32, np.float16), *shape).astype(np.float32, copy=False)

    def shares(name: str) -> np.ndarray:
        array = given(name, (np.uint8, np.float32, np.float16))
        return from_byte_levels(array) if array.dtype == np.uint8 else array.astype(np.float32, copy=False)

    def has(name: str) -> bool:
        return layer.GetAttributeAtPath(f"{path}.{name}") is not None

    positions = floats("positions", 3)
    n = len(positions)
    degree = layer.GetAttributeAtPath(f"{path}.radiance:sphericalHarmonicsDegree")
    if degree is None or degree.default not in (0, 1, 2, 3):
        raise ArchiveError(f"{what} {path}: the spherical-harmonics degree must be 0, 1, 2 or 3")
    terms = (degree.default + 1) ** 2
    coefficients = floats("radiance:sphericalHarmonicsCoefficients", 3)
    prefix = f"primvars:{NAMESPACE}:"
    quat_wxyz = np.ascontiguousarray(floats("orientations", 4)[:, [3, 0, 1, 2]])
    labels = given(f"{prefix}semanticClass", (np.int32, np.uint8))
    columns = {
        "orientations": quat_wxyz,
        "scales": floats("scales", 3),
        "opacities": floats("opacities"),
        "normal": floats(f"{prefix}normal", 3) if has(f"{prefix}normal") else third_axes(quat_wxyz),
        "label": np.where((labels < 0) | (labels > _NO_LABEL), _NO_LABEL, labels).astype(np.uint8),
        "intensity": shares(f"{prefix}intensity"),
        "index": given(f"{prefix}index", (np.int32,)),
    }
    if has(f"{prefix}rgb"):
        columns["rgb"] = floats(f"{prefix}rgb", 3)
    for name, attribute in (("ray_drop", "rayDrop"), ("falloff", "falloff")):
        if has(f"{prefix}{attribute}"):
            columns[name] = shares(f"{prefix}{attribute}")
    lengths = {name: len(column) for name, column in columns.items()} | {"coefficients": len(coefficients) / terms}
    wrong = {name: length for name, length in lengths.items() if length != n}
    if wrong:
        raise ArchiveError(f"{what} {path}: {n} positions, but other counts in {wrong}")
    coefficients = coefficients.reshape(n, terms, 3)
    rest = np.ascontiguousarray(coefficients[:, 1:]) if terms > 1 else None
    rgb = columns.get("rgb", colours(coefficients[:, 0]))
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
