"""Rules of a consumer as data, and what breaks them as findings."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from nurec_sim.errors import ArchiveError

Severity = Literal["error", "warning"]
Consumer = Literal["alpasim", "carla", "openusd", "own"]
NAMES: Mapping[Consumer, str] = {"alpasim": "AlpaSim", "carla": "CARLA", "openusd": "OpenUSD", "own": "nurec-sim"}
"""Consumers as people call them."""


@dataclass(frozen=True)
class Rule:
    """What a consumer needs; an error is something it cannot run without, a warning something that it will miss."""

    severity: Severity
    needs: str
    loses: str


@dataclass(frozen=True)
class Finding:
    """One broken rule of one consumer; ``found`` says where and what."""

    consumer: Consumer
    rule: str
    severity: Severity
    found: str
    needs: str
    loses: str

    def __str__(self) -> str:
        who = f"{self.severity}: {NAMES[self.consumer]}"
        return f"{who}: {self.found}; needs {self.needs}; otherwise {self.loses} [{self.rule}]"

    def to_json(self) -> dict[str, Any]:
        """All fields, as plain JSON."""
        return dict(vars(self))


@dataclass
class Report:
    """Collects what breaks the rules of one consumer."""

    consumer: Consumer
    rules: Mapping[str, Rule]
    findings: list[Finding] = field(default_factory=list)

    def add(self, name: str, found: str) -> None:
        """A finding; line breaks in ``found`` go, so that it stays one line."""
        rule = self.rules[name]
        found = " ".join(found.split())
        self.findings.append(Finding(self.consumer, name, rule.severity, found, rule.needs, rule.loses))

    @contextlib.contextmanager
    def rule(self, name: str) -> Iterator[None]:
        """Turns an ArchiveError that is raised inside into a finding, and goes on after the block."""
        try:
            yield
        except ArchiveError as error:
            self.add(name, str(error))
