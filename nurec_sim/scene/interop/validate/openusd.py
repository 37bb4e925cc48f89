"""Rules for USD tools: the package, the stage, and the splats in it.

A damaged binary layer can make OpenUSD crash, or allocate and search for minutes. Layers of unknown origin are
therefore read in a subprocess with a time limit.
"""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile

from nurec_sim.errors import ArchiveError
from nurec_sim.files.zip_package import ALIGNMENT, MAX_PACKAGE_BYTES, name_fault
from nurec_sim.scene.interop.validate.contents import Contents, shown
from nurec_sim.scene.interop.validate.finding import Report, Rule
from nurec_sim.scene.interop.validate.usd_stage import SPLATS, Fault, stage_faults
from nurec_sim.scene.usd.layers import LAYER_SUFFIXES

_PROGRAM = ("-c", "from nurec_sim.scene.interop.validate.usd_stage import main; main()")

RULES = {
    "zip": Rule("error", "a readable ZIP", "nothing is opened"),
    "first-layer": Rule("error", "a USD layer as the first member", "the package does not open"),
    "stored": Rule("error", "members that are stored, not compressed", "they cannot be read from the package"),
    "aligned": Rule(
        "warning", f"members that start at multiples of {ALIGNMENT} bytes", "strict tools refuse the package"
    ),
    "size": Rule("error", "less than 4 GiB (there is no ZIP64 in USDZ)", "the package does not open"),
    "opens": Rule("error", "layers that OpenUSD reads", "the package does not open"),
    "self-contained": Rule("error", "references to members of the package only", "parts are missing on other machines"),
    "nested": Rule("warning", "layers, no packages in the package", "what is in them is not checked"),
    "default-prim": Rule("error", "a defaultPrim that exists", "the package cannot be referenced"),
    "units": Rule("warning", 'upAxis = "Z" and metersPerUnit = 1', "the scene is turned or scaled"),
    "splats": Rule("warning", f"{SPLATS} prims", "nothing of the scene is drawn"),
    "splat-arrays": Rule(
        "error",
        "per splat prim: equally many positions, orientations, scales and opacities, (degree + 1)^2 coefficients each, "
        "finite, unit quaternions, opacities 0..1",
        "that prim is not drawn, or wrongly",
    ),
    "splat-bounds": Rule("warning", "an extent and elementSize on each splat prim", "bounds and culling are wrong"),
    "vg-035": Rule(
        "warning",
        'per splat prim: harmonics with interpolation = "vertex", one Gaussian or more, scales above 0',
        "NVIDIA's asset validator refuses it (requirement VG.035)",
    ),
    "validators": Rule("error", "no error of UsdValidation", "strict tools refuse the package"),
    "advice": Rule("warning", "no warning of UsdValidation", "some tools may behave otherwise"),
}


def check(report: Report, contents: Contents, limit_s: float | None) -> None:
    """Adds the findings for USD tools; with a limit in seconds, OpenUSD runs in a subprocess."""
    _check_package(report, contents)
    if any(finding.severity == "error" for finding in report.findings):
        return
    with report.rule("opens"):
        for rule, found in stage_faults(contents.path) if limit_s is None else _faults_apart(contents, limit_s):
            report.add(rule, found)


def _faults_apart(contents: Contents, limit_s: float) -> list[Fault]:
    """``stage_faults`` in a subprocess.

    Raises:
        ArchiveError: OpenUSD crashed or exceeded the limit.
    """
    command = [sys.executable, *_PROGRAM, str(contents.path)]
    try:
        done = subprocess.run(command, capture_output=True, timeout=limit_s, stdin=subprocess.DEVNULL, check=False)
    except subprocess.TimeoutExpired as error:
        raise ArchiveError(f"OpenUSD did not come to an end in {limit_s:g} s") from error
    if done.returncode != 0:
        raise ArchiveError(f"OpenUSD crashed on the package (exit status {done.returncode})")
    return [(rule, found) for rule, found in json.loads(done.stdout)]


def _check_package(report: Report, contents: Contents) -> None:
    first = contents.entries[0].filename if contents.entries else "nothing"
    if not first.endswith(LAYER_SUFFIXES):
        report.add("first-layer", f"the first member is {shown(first)}")
    packed = [entry.filename for entry in contents.entries if entry.compress_type != zipfile.ZIP_STORED]
    if packed:
        report.add("stored", f"{len(packed)} of {len(contents.entries)} members are compressed: {shown(packed)}")
    unsafe = [name for name in contents.names if name_fault(name)]
    if unsafe:
        report.add("self-contained", f"names that leave the package: {shown(unsafe)}")
    size = contents.path.stat().st_size
    if size > MAX_PACKAGE_BYTES:
        report.add("size", f"the package has {size:,} bytes")
    with report.rule("opens"):
        askew = [each.filename for each in contents.entries if contents.data_offset(each) % ALIGNMENT]
        if askew:
            report.add("aligned", f"{len(askew)} of {len(contents.entries)} members are not aligned: {shown(askew)}")
