"""Subprocess that extracts particle fields from third-party USD files, since OpenUSD may crash on damaged ones.

``python -m nurec_sim.scene.interop.usd.child_process FILE FOLDER`` writes ``fields.json`` and one
``<k>.<column>.npy`` per column of field k. Only FILE is opened and, unless it is a package, referenced layers in its
folder.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from nurec_sim.errors import ArchiveError
from nurec_sim.files.npy import npy_bytes
from nurec_sim.scene.interop.usd.composition import LayerSource, joined_layers

_COLUMNS = {
    "positions": "positionsh",
    "orientations": "orientationsh",
    "scales": "scalesh",
    "opacities": "opacitiesh",
    "radiance:sphericalHarmonicsCoefficients": "radiance:sphericalHarmonicsCoefficientsh",
}
_SILENT_TYPES = {"", "GeomSubset", "Material", "OmniNuRecFieldAsset", "RenderProduct", "Scope", "Shader", "Xform"}
_EXTRA_BYTES, _GROWTH, _CPU_SECONDS = 6 * 2**30, 32, 600


def main(path: Path, folder: Path) -> None:
    """Extracts the contents of ``path`` to ``folder``."""
    _limit(path.stat().st_size)
    from pxr import Usd, UsdGeom

    root, notes = joined_layers(LayerSource.of(path))
    stage = Usd.Stage.Open(root)
    fields: list[dict[str, Any]] = []
    volumes: list[dict[str, Any]] = []
    others: Counter[str] = Counter()
    # Instances share one prototype; each proxy has its own transform.
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        kind = str(prim.GetTypeName())
        if files := _nurec_files(prim):
            volumes.append({"files": files, "matrix": _world_from_prim(prim)[0]})
        elif not kind.startswith("ParticleField"):
            others[kind] += kind not in _SILENT_TYPES
        elif (fault := _hidden(prim)) is not None:
            notes.append(f"{prim.GetPath()} is not drawn: {fault}")
        else:
            fields.append(_take(prim, len(fields), folder, notes))
    if shown := [f"{count} {kind}" for kind, count in sorted(others.items()) if count]:
        notes.append(f"not drawn: {', '.join(shown[:12])}")
    for name, authored in (("metersPerUnit", UsdGeom.StageHasAuthoredMetersPerUnit(stage)),
                           ("upAxis", root.pseudoRoot.HasInfo("upAxis"))):  # fmt: skip
        if fields and not authored:
            notes.append(f"the stage says no {name}; OpenUSD's own is taken")
    report = {
        "fields": fields,
        "volumes": volumes,
        "notes": notes,
        "meters_per_unit": float(UsdGeom.GetStageMetersPerUnit(stage)),
        "up_axis": str(UsdGeom.GetStageUpAxis(stage)),
    }
    (folder / "fields.json").write_text(json.dumps(report))


def _limit(size: int) -> None:
    """Limits memory and time, so that an unsafe file ends only this process."""
    try:
        import resource
    except ImportError:  # not on Windows
        return
    memory = _EXTRA_BYTES + _GROWTH * size
    for kind, limit in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, _CPU_SECONDS), (resource.RLIMIT_CORE, 0)):
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))


def _hidden(prim) -> str | None:
    """Reason why a field is not rendered, or None."""
    from pxr import UsdGeom

    imageable = UsdGeom.Imageable(prim)
    if imageable and imageable.ComputeVisibility() == UsdGeom.Tokens.invisible:
        return "it is invisible"
    if imageable and imageable.ComputePurpose() in (UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy):
        return f"its purpose is {imageable.ComputePurpose()}"
    return None


def _nurec_files(prim) -> list[str]:
    """Names of the NuRec files referenced by a volume; none for other prims."""
    if str(prim.GetTypeName()) != "Volume":
        return []
    assets = [child.GetAttribute("filePath").Get() for child in prim.GetChildren() if child.HasAttribute("filePath")]
    return sorted({Path(asset.path).name for asset in assets if asset is not None and asset.path.endswith(".nurec")})


def _take(prim, number: int, folder: Path, notes: list[str]) -> dict[str, Any]:
    """Writes the columns of a field; returns its metadata."""
    path = str(prim.GetPath())
    moving: list[str] = []
    for name, half in _COLUMNS.items():
        column = _values(prim, name, moving)
        # The schema has a half-precision variant of every attribute, with the suffix "h".
        column = _values(prim, half, moving) if column is None else column
        if column is not None:
            (folder / f"{number}.{name.rsplit(':', 1)[-1]}.npy").write_bytes(npy_bytes(column))
    colour = _values(prim, "primvars:displayColor", moving)
    if colour is not None:
        (folder / f"{number}.displayColor.npy").write_bytes(npy_bytes(colour))
    degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree")
    degree = degree.Get() if degree else None
    matrix, moves = _world_from_prim(prim)
    if moving or moves:
        notes.append(f"{path} changes over time ({', '.join(moving + moves)}); read as it stands at the start")
    space = prim.GetAttribute("colorSpace:name")
    if space and str(space.Get() or "").startswith("lin_"):
        notes.append(f"{path}: colours are linear ({space.Get()}); shown as they are")
    if any("Surflet" in name for name in [*prim.GetAppliedSchemas(), str(prim.GetTypeName())]):
        notes.append(f"{path}: surflets are drawn as Gaussians")
    return {"path": path, "matrix": matrix, "degree": 3 if degree is None else int(degree), "road": _is_road(prim)}


def _values(prim, name: str, moving: list[str]) -> np.ndarray | None:
    """An attribute's default value, else its first sample."""
    attribute = prim.GetAttribute(name)
    if not attribute or not attribute.HasAuthoredValue():
        return None
    value, samples = attribute.Get(), attribute.GetTimeSamples()
    if samples:
        moving.append(name)
        value = attribute.Get(samples[0]) if value is None else value
    if value is None:
        return None
    array = np.array(value)
    return array if array.dtype.kind in "iuf" else None


def _world_from_prim(prim) -> tuple[list[list[float]], list[str]]:
    """The world transform as a matrix for column vectors, and whether it is animated."""
    from pxr import Usd, UsdGeom

    moving, only_samples = [], []
    ancestor = prim
    while ancestor and not ancestor.IsPseudoRoot():
        for op in UsdGeom.Xformable(ancestor).GetOrderedXformOps() if UsdGeom.Xformable(ancestor) else ():
            if op.GetNumTimeSamples():
                moving.append("transform")
                if op.Get(Usd.TimeCode.Default()) is None:
                    only_samples.append(op.GetTimeSamples()[0])
        ancestor = ancestor.GetParent()
    time = Usd.TimeCode(min(only_samples)) if only_samples else Usd.TimeCode.Default()
    # USD matrices multiply row vectors, hence the transpose.
    matrix = UsdGeom.XformCache(time).GetLocalToWorldTransform(prim)
    return np.array(matrix).T.tolist(), moving[:1]


def _is_road(prim) -> bool:
    """Whether the field or an ancestor is named or labelled road."""
    while prim and not prim.IsPseudoRoot():
        labels = [a.Get() for a in prim.GetAttributes() if a.GetName().startswith("semantics:labels:")]
        if prim.GetName().lower() == "road" or any("road" in [str(x).lower() for x in label or ()] for label in labels):
            return True
        prim = prim.GetParent()
    return False


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]), Path(sys.argv[2]))
    except ArchiveError as error:
        print(error, file=sys.stderr)
        sys.exit(3)
