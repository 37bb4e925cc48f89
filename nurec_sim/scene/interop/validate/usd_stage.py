"""Validates the layers and the stage of a package with OpenUSD; also a program, to be run as a subprocess.

Layers are checked one by one first: the stage is composed only if all references are to layers of the package, so that
no other file is opened. ``UsdValidation`` runs last; its messages are reported verbatim.
"""

from __future__ import annotations

import contextlib
import json
import posixpath
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nurec_sim.errors import ArchiveError
from nurec_sim.scene.interop.validate.contents import Contents, shown
from nurec_sim.scene.usd.layers import LAYER_SUFFIXES, open_member

SPLATS = "ParticleField3DGaussianSplat"
MEMORY_BYTES = 8 * 2**30
_ALREADY_TOLD = {
    "UnsupportedFileExtensionInPackage",  # files for other programs, allowed beside the layers
    "ByteMisalignment", "CompressionDetected",
    "MissingDefaultPrim", "MissingUpAxisMetadata", "MissingMetersPerUnitMetadata",
}  # fmt: skip

Fault = tuple[str, str]
"""Name of a rule of ``openusd.RULES``, and the finding."""


def stage_faults(path: Path) -> list[Fault]:
    """Violations of the rules about layers, stage and splats."""
    from pxr import Tf

    faults: list[Fault] = []
    try:
        with Contents(path) as contents:
            faults += _layer_faults(contents)
            if not faults:
                faults += _composed_faults(path)
    except (Tf.ErrorException, RuntimeError, MemoryError) as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        faults.append(("opens", f"OpenUSD cannot read the package ({(lines or [type(error).__name__])[-1][:200]})"))
    return faults


def _layer_faults(contents: Contents) -> Iterator[Fault]:
    """Layers that cannot be read, or that refer to anything but layers of the package."""
    for name in contents.names:
        if not name.endswith(LAYER_SUFFIXES):
            continue
        try:
            layer = open_member(contents.path, name)
        except ArchiveError:
            yield "opens", f"{name} is no readable USD layer"
            continue
        assets = {
            asset: posixpath.join(posixpath.dirname(name), asset) for asset in layer.GetCompositionAssetDependencies()
        }
        nested = sorted(asset for asset in assets if ".usdz" in asset)
        if nested:
            yield "nested", f"{name} refers to {shown(nested)}"
        outside = sorted(
            a for a, member in assets.items() if posixpath.normpath(member) not in contents and a not in nested
        )
        if outside:
            yield "self-contained", f"{name} refers to {shown(outside)}"


def _composed_faults(path: Path) -> Iterator[Fault]:
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path.resolve()))
    if not stage.GetDefaultPrim():
        yield "default-prim", f"the root layer names {shown(stage.GetRootLayer().defaultPrim)}"
    units = []
    if not stage.HasAuthoredMetadata("upAxis") or UsdGeom.GetStageUpAxis(stage) != UsdGeom.Tokens.z:
        units.append(f"upAxis is {shown(str(stage.GetMetadata('upAxis')))}")
    if not stage.HasAuthoredMetadata("metersPerUnit") or UsdGeom.GetStageMetersPerUnit(stage) != 1:
        units.append(f"metersPerUnit is {shown(stage.GetMetadata('metersPerUnit'))}")
    if units:
        yield "units", f"the root layer: {', '.join(units)}"
    prims = [prim for prim in stage.Traverse() if prim.GetTypeName() == SPLATS]
    if not prims:
        yield "splats", "the stage has no splat prim"
    faults = [fault for prim in prims for fault in _splat_faults(prim)]
    for rule in ("splat-arrays", "splat-bounds", "vg-035"):
        texts = [text for name, text in faults if name == rule]
        if texts:
            yield rule, texts[0] + (f" (and {len(texts) - 1} more)" if len(texts) > 1 else "")
    yield from _validator_faults(stage)


def _splat_faults(prim) -> Iterator[Fault]:
    """(rule, finding) of one prim; arrays with time samples are checked at their first one."""
    from pxr import Usd, UsdGeom

    path = prim.GetPath()

    def values(name: str) -> np.ndarray:
        for each in (name, name + "h"):
            attribute = prim.GetAttribute(each)
            value = attribute.Get(Usd.TimeCode.EarliestTime()) if attribute else None
            if value is not None:
                return np.array(value)
        return np.zeros(0)

    arrays = {name: values(name) for name in ("positions", "orientations", "scales", "opacities")}
    lengths = {name: len(array) for name, array in arrays.items()}
    count = lengths["positions"]
    degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get()
    terms = (int(degree if degree is not None else 3) + 1) ** 2
    coefficients = values("radiance:sphericalHarmonicsCoefficients")
    if set(lengths.values()) != {count} or len(coefficients) != count * terms:
        message = ", ".join(f"{name} {length}" for name, length in lengths.items())
        yield "splat-arrays", f"{path} has {message}, {len(coefficients)} coefficients of degree {degree}"
        return
    if count == 0:
        yield "vg-035", f"{path} has no Gaussians; leave the prim out or make it inactive"
        return
    finite = {**arrays, "coefficients": coefficients}
    wild = [name for name, array in finite.items() if not np.isfinite(array).all()]
    with np.errstate(all="ignore"):
        norm = np.linalg.norm(arrays["orientations"].astype(np.float64), axis=1)
    opacity = arrays["opacities"]
    if wild:
        yield "splat-arrays", f"{path}: {', '.join(wild)} hold numbers that are not finite"
    elif np.abs(norm - 1).max() > 1e-2:
        yield "splat-arrays", f"{path}: a quaternion has the length {float(norm[np.abs(norm - 1).argmax()]):.3g}"
    elif opacity.min() < 0 or opacity.max() > 1:
        yield "splat-arrays", f"{path}: opacities from {float(opacity.min()):.3g} to {float(opacity.max()):.3g}"
    extent = prim.GetAttribute("extent")
    if not extent or extent.Get(Usd.TimeCode.EarliestTime()) is None:
        yield "splat-bounds", f"{path} has no extent"
    radiance = prim.GetAttribute("radiance:sphericalHarmonicsCoefficients")
    radiance = radiance if radiance and radiance.HasValue() else prim.GetAttribute(f"{radiance.GetName()}h")
    if terms > 1 and radiance.GetMetadata("elementSize") != terms:
        yield "splat-bounds", f"{path}: elementSize is {radiance.GetMetadata('elementSize')}, not {terms}"
    interpolation = UsdGeom.Primvar(radiance).GetInterpolation()
    if interpolation != UsdGeom.Tokens.vertex:
        text = f'{path}: the harmonics have interpolation = "{interpolation}"'
        yield "vg-035", f"{text}; `nurec-sim import` writes the archive anew with the right one"
    elif not (arrays["scales"] > 0).all():
        yield "vg-035", f"{path}: a scale is {float(arrays['scales'].min()):.3g}"


def _validator_faults(stage) -> Iterator[Fault]:
    """Findings of OpenUSD's own validators, one line for each kind."""
    from pxr import UsdValidation

    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    kinds: dict[tuple[str, str], list[str]] = {}
    for error in context.Validate(stage):
        if error.GetName() not in _ALREADY_TOLD:
            rule = "validators" if str(error.GetType()).endswith("Error") else "advice"
            kinds.setdefault((rule, error.GetName()), []).append(error.GetMessage())
    for (rule, name), texts in kinds.items():
        more = f" (and {len(texts) - 1} more)" if len(texts) > 1 else ""
        yield rule, f"{name}: {texts[0][:300]}{more}"


def _limit_memory(path: Path) -> None:
    """Limits the memory of this process, so that a damaged layer with huge arrays ends only it."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        limit = MEMORY_BYTES + 4 * path.stat().st_size
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def main() -> None:
    """Prints the faults of the archive given as first argument, as JSON."""
    path = Path(sys.argv[1])
    _limit_memory(path)
    print(json.dumps(stage_faults(path)))
