"""Validation of any scene archive for AlpaSim, CARLA, USD tools and our own reader."""

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
    """All findings for an archive; empty if it satisfies all consumers.

    Args:
        path: any archive, possibly damaged. Our own reader also accepts other scene files.
        consumers: the consumers to check for.
        usd_limit_s: run OpenUSD in a subprocess with this time limit, for untrusted archives: damaged layers can crash
            or hang it. None runs it in this process without a limit.

    Raises:
        ArchiveError: an unknown consumer.
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
    """A scene (None if unreadable) and the findings of our own reader."""
    report = Report("own", own.RULES)
    return own.check(report, Path(path)), report.findings


def same_scene_ids(paths: Sequence[Path]) -> list[str]:
    """Texts for archives with the same ``scene_id``, which AlpaSim refuses."""
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
