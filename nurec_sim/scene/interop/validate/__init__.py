"""What AlpaSim, CARLA, USD tools and our own reader will miss in a scene archive, whoever wrote it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from nurec_sim.errors import ArchiveError
from nurec_sim.scene.interop.validate import alpasim, carla, openusd, own
from nurec_sim.scene.interop.validate.contents import Contents
from nurec_sim.scene.interop.validate.finding import NAMES, Consumer, Finding, Report, Rule
from nurec_sim.types import GaussianScene

__all__ = [
    "CONSUMERS",
    "NAMES",
    "RULES",
    "Consumer",
    "Finding",
    "Rule",
    "read_and_validate",
    "same_scene_ids",
    "validate_archive",
]

CONSUMERS = tuple(NAMES)
RULES: Mapping[Consumer, Mapping[str, Rule]] = {
    "alpasim": alpasim.RULES,
    "carla": carla.RULES,
    "openusd": openusd.RULES,
    "own": own.RULES,
}
"""Every rule by consumer and name."""


def validate_archive(
    path: Path | str, consumers: Sequence[Consumer] = CONSUMERS, *, usd_limit_s: float | None = None
) -> list[Finding]:
    """Everything that consumers will miss in an archive; empty if nothing.

    Args:
        path: the archive; it need not be ours, nor sound. Our own reader also takes other files of scenes.
        consumers: whom to ask.
        usd_limit_s: run OpenUSD in a process of its own for so many seconds at most, for archives of unknown origin:
            damaged layers can crash it or keep it busy. In this process and without a limit if None.

    Raises:
        ArchiveError: a consumer that is not known.
    """
    unknown = sorted(set(consumers) - set(CONSUMERS))
    if unknown:
        raise ArchiveError(f"consumers are {', '.join(CONSUMERS)}; got {', '.join(unknown)}")
    checks: dict[Consumer, Callable[[Report, Contents], None]] = {
        "alpasim": alpasim.check,
        "carla": carla.check,
        "openusd": functools.partial(openusd.check, limit_s=usd_limit_s),
    }
    reports = [Report(consumer, RULES[consumer]) for consumer in CONSUMERS if consumer in consumers]
    others = [report for report in reports if report.consumer in checks]
    try:
        with np.errstate(all="ignore"), Contents(Path(path)) as contents:  # numbers of others may overflow
            for report in others:
                checks[report.consumer](report, contents)
    except ArchiveError as error:
        for report in others:
            report.add("zip", str(error))
    if "own" in consumers:
        own.check(reports[-1], Path(path))
    return [finding for report in reports for finding in report.findings]


def read_and_validate(path: Path | str) -> tuple[GaussianScene | None, list[Finding]]:
    """A scene, None if it cannot be read, and what our own reader will miss in it."""
    report = Report("own", own.RULES)
    return own.check(report, Path(path)), report.findings


def same_scene_ids(paths: Sequence[Path]) -> list[str]:
    """Texts about archives that share a ``scene_id``: AlpaSim refuses a folder that holds two of one."""
    first: dict[str, Path] = {}
    texts = []
    for path in paths:
        try:
            with Contents(path) as contents:
                metadata = contents.yaml("metadata.yaml")
        except ArchiveError:
            continue
        scene_id = metadata.get("scene_id") if isinstance(metadata, dict) else None
        if not isinstance(scene_id, str):
            continue
        if scene_id in first:
            texts.append(f"{path} and {first[scene_id]} have the same scene_id {scene_id!r}")
        first.setdefault(scene_id, path)
    return texts
