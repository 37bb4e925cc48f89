"""Particle fields of third-party USD files (``.usda``, ``.usdc``, ``.usd``, ``.usdz``): OpenUSD's Gaussians.

Conventions of OpenUSD: scales and opacities after activation, quaternions ``x y z w`` in memory, harmonics as in 3DGS
files, particle-major with the constant term first. Lengths are in the stage's units, y or z is up.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

import nurec_sim
from nurec_sim.errors import ArchiveError
from nurec_sim.files.new_files import temporary_folder
from nurec_sim.files.npy import array_from_npy
from nurec_sim.scene import codec
from nurec_sim.scene.harmonics import SH_C0
from nurec_sim.scene.interop.columns import Columns
from nurec_sim.scene.interop.found import Found
from nurec_sim.scene.transform import UP_AXES, transformed
from nurec_sim.types import Label

MAX_SECONDS = 600
_FEW_THREADS = {"PXR_WORK_THREAD_LIMIT": "4", "MALLOC_ARENA_MAX": "4"}
"""On machines with many cores thread stacks alone would exceed the memory limit."""


def read_particle_fields(path: Path) -> Found:
    """All visible fields of a stage and the transforms of NuRec volumes, in metres with z up; both may be empty.

    OpenUSD runs in a subprocess, which may crash on unsafe files.

    Raises:
        ArchiveError: the file cannot be read, or a field is damaged.
    """
    with temporary_folder() as folder:
        _run(path.resolve(), folder)
        report = codec.load((folder / "fields.json").read_bytes(), f"{path}: the stage")
        found = Found(unknown=list(report["notes"]))
        scale = report["meters_per_unit"]
        if not 0 < scale < np.inf:
            raise ArchiveError(f"{path}: metersPerUnit must be positive, got {scale}")
        world_from_stage = np.eye(4)
        world_from_stage[:3, :3] = np.array(UP_AXES[report["up_axis"].lower()]) * scale
        for volume in report["volumes"]:
            placed = world_from_stage @ _invertible(volume["matrix"], f"{path}: a volume")
            found.volumes |= dict.fromkeys(volume["files"], placed)
        for number, field in enumerate(report["fields"]):
            _add_field(found, folder, number, field, world_from_stage, f"{path}: {field['path']}")
    return found


def _run(path: Path, folder: Path) -> None:
    package_root = str(Path(nurec_sim.__file__).parents[1])
    paths = [package_root, *filter(None, [os.environ.get("PYTHONPATH")])]
    command = [sys.executable, "-m", "nurec_sim.scene.interop.usd.child_process", str(path), str(folder)]
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            cwd=folder,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(paths), **_FEW_THREADS},
            timeout=MAX_SECONDS,
        )
    except subprocess.TimeoutExpired:
        raise ArchiveError(f"{path}: OpenUSD did not read it within {MAX_SECONDS} s") from None
    if done.returncode:
        lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
        last = lines[-1][:300] if lines else "no error text"
        if done.returncode == 3:
            raise ArchiveError(last)
        raise ArchiveError(f"{path}: OpenUSD cannot read it (process ended with {done.returncode}: {last})")


def _add_field(
    found: Found, folder: Path, number: int, field: dict[str, Any], world_from_stage: np.ndarray, where: str
) -> None:
    columns = {
        file.name.split(".")[1]: array_from_npy(file.read_bytes(), f"{where}: {file.name}")
        for file in folder.glob(f"{number}.*.npy")
    }
    lacking = [name for name in ("positions", "scales") if name not in columns]
    if lacking:
        found.unknown.append(f"{field['path']} is not drawn: it has no {' and no '.join(lacking)}")
        return
    n = len(columns["positions"])
    dc, rest = _colours(found, columns, n, field, where)
    quat = columns.get("orientations", np.tile(np.array([0, 0, 0, 1], np.float32), (n, 1)))
    given = Columns(
        mean_m=columns["positions"],
        quat_wxyz=quat[:, [3, 0, 1, 2]] if quat.ndim == 2 and quat.shape[1] == 4 else quat,
        scale_m=columns["scales"],
        opacity=columns.get("opacities", np.ones(n, np.float32)),
        dc=dc,
        rest=rest,
    )
    given.check(where)
    gaussians, dropped = given.gaussians(Label.ROAD if field["road"] else Label.OTHER)
    found.dropped += dropped
    found.static.append(transformed(gaussians, world_from_stage @ _invertible(field["matrix"], where)))


def _invertible(values: list[list[float]], where: str) -> np.ndarray:
    matrix = np.array(values, np.float64)
    # The bound allows scaling by a millionth: 1e-6 cubed.
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:3, :3])) < 1e-18:
        raise ArchiveError(f"{where}: its transform is not finite, or flattens it: {matrix.tolist()}")
    return matrix


def _colours(
    found: Found, columns: dict[str, np.ndarray], n: int, field: dict[str, Any], where: str
) -> tuple[np.ndarray, np.ndarray | None]:
    coefficients = columns.get("sphericalHarmonicsCoefficients")
    if coefficients is None:
        shown = columns.get("displayColor", np.full((1, 3), 0.5, np.float32))
        if shown.ndim != 2 or shown.shape[1] != 3 or len(shown) not in (1, n):
            raise ArchiveError(f"{where}: displayColor must be [1 or {n}, 3], got {shown.shape}")
        source = "displayColor" if "displayColor" in columns else "grey"
        found.unknown.append(f"{field['path']} has no sphericalHarmonicsCoefficients; its colour is {source}")
        return np.broadcast_to((shown - 0.5) / SH_C0, (n, 3)), None
    degree = field["degree"]
    terms = (degree + 1) ** 2
    if not 0 <= degree <= 16 or coefficients.shape != (n * terms, 3):
        raise ArchiveError(
            f"{where}: sphericalHarmonicsCoefficients of degree {degree} must be {(n * terms, 3)}, "
            f"got {coefficients.shape}"
        )
    coefficients = coefficients.reshape(n, terms, 3)
    if degree > 3:
        found.unknown.append(f"{field['path']}: harmonics of degree {degree} are cut to degree 3")
    # Degree 3 has 16 terms with the constant one.
    return coefficients[:, 0], coefficients[:, 1:16] if degree else None
