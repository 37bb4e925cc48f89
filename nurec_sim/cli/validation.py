"""Commands that check scene archives: validate, and inspect for archives."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from nurec_sim.cli.console import Paths, app, out, print_table, progress
from nurec_sim.errors import NurecSimError

if TYPE_CHECKING:
    from nurec_sim.scene.interop.validate import Consumer, Finding

USD_LIMIT_S = 300.0


@app.command
def validate(
    scenes: Paths,
    *,
    for_: Annotated[str, tyro.conf.arg(name="for", metavar="NAMES")] = "alpasim,carla,openusd,own",
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Check a scene archive for AlpaSim, CARLA, USD tools and our own reader.

    Works for any archive. Each line gives consumer, finding, requirement and consequence, with the rule name in
    brackets (docs/scene_format.md). Exit status 1 if there is an error; consumers run despite warnings.

    Args:
        scenes: scene archives (.usdz) with different scene_ids.
        for_: consumers, separated by commas: alpasim, carla, openusd, own.
        json_: print one JSON document instead of lines.
    """
    from nurec_sim.scene.interop.validate import same_scene_ids, validate_archive

    consumers = _consumers(for_)
    if not scenes:
        raise NurecSimError("give at least one scene archive")
    found = {}
    for path in scenes:
        with progress(f"looking at {path.name}"):
            found[path] = validate_archive(path, consumers, usd_limit_s=USD_LIMIT_S)
    shared = same_scene_ids(scenes) if "alpasim" in consumers else []
    errors = len(shared) + sum(finding.severity == "error" for findings in found.values() for finding in findings)
    if json_:
        archives = [{"path": str(path), "findings": [finding.to_json() for finding in findings]}
                    for path, findings in found.items()]  # fmt: skip
        document = {"consumers": consumers, "errors": errors, "same_scene_id": shared, "archives": archives}
        print(json.dumps(document, indent=1))
    else:
        for path, findings in found.items():
            _print_findings(path, findings, consumers)
        for text in shared:
            _print_line(f"error: AlpaSim: {text}; it refuses a folder with both", "red")
    if errors:
        raise SystemExit(1)


def inspect_scene(path: Path) -> None:
    """Prints the contents of a scene, then the findings of our reader; exit status 1 if there are errors."""
    from nurec_sim.scene import summary
    from nurec_sim.scene.interop.validate import read_and_validate

    scene, findings = read_and_validate(path)
    if scene is not None:
        print_table(f"scene {scene.id}", summary(scene))
    _print_findings(path, findings, ["own"])
    if scene is None:
        raise SystemExit(1)


def _print_findings(path: Path, findings: list[Finding], consumers: list[Consumer]) -> None:
    """One line per finding, errors in red; one line for consumers without findings."""
    from nurec_sim.scene.interop.validate import NAMES

    for finding in findings:
        _print_line(str(finding), "red" if finding.severity == "error" else "yellow")
    content = [NAMES[name] for name in consumers if not any(finding.consumer == name for finding in findings)]
    if content:
        _print_line(f"{path.name}: nothing missing for {', '.join(content)}", "")


def _print_line(text: str, style: str) -> None:
    out.print(text, style=style, markup=False, highlight=False, soft_wrap=True)


def _consumers(text: str) -> list[Consumer]:
    from nurec_sim.scene.interop.validate import CONSUMERS

    names = {name.strip() for name in text.split(",") if name.strip()}
    if not names or names - set(CONSUMERS):
        raise NurecSimError(f"--for takes {', '.join(CONSUMERS)}, separated by commas; got {text!r}")
    return [consumer for consumer in CONSUMERS if consumer in names]
