"""Verb that checks any sensor server: conformance."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated

import tyro

from nurec_sim.cli.console import app, out
from nurec_sim.errors import NurecSimError

_STYLE = {"PASS": "green", "FAIL": "bold red", "SKIP": "yellow"}


@app.command
def conformance(
    address: Annotated[str, tyro.conf.Positional] = "",
    *,
    scene: str = "",
    only: tuple[str, ...] = (),
    changes: bool = False,
    timeout_s: float = 120.0,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
    rules: bool = False,
) -> None:
    """Check any sensor server against the published contract; exit status 1 if a rule is violated.

    Args:
        address: host:port of a server without TLS.
        scene: id of the scene to use; default: the first one listed.
        only: names of the checks to run; default: all.
        changes: also run the check that edits the scene temporarily, which other clients would see.
        timeout_s: per call; the first may have to load the scene.
        as_json: print one JSON document.
        rules: list the rules and stop.
    """
    from nurec_sim.serving.conformance import CHECKS, Target, run_checks

    if rules:
        for one in CHECKS.values():
            out.print(f"{one.name:26} {one.rule}", markup=False, highlight=False, soft_wrap=True)
        return
    if not address:
        raise NurecSimError("conformance needs the address of a server, as host:port")
    if unknown := sorted(set(only) - set(CHECKS)):
        raise NurecSimError(f"there are no checks {unknown}; have {sorted(CHECKS)}")
    outcomes = []
    with Target(address, scene, timeout_s=timeout_s, allow_changes=changes) as target:
        target.connect()
        for outcome in run_checks(target, only):
            outcomes.append(outcome)
            if not as_json:
                out.print(f"[{_STYLE[outcome.verdict]}]{outcome.verdict}[/] {outcome.name:26} ", end="")
                out.print(outcome.text, markup=False, highlight=False, soft_wrap=True)
    counts = {verdict: sum(outcome.verdict == verdict for outcome in outcomes) for verdict in _STYLE}
    if as_json:
        print(json.dumps({"address": address, "counts": counts, "outcomes": [asdict(one) for one in outcomes]}))
    else:
        out.print(", ".join(f"{count} {verdict}" for verdict, count in counts.items()))
    if counts["FAIL"]:
        raise SystemExit(1)
