"""Rules of consumers as data, and findings for violations."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from nurec_sim.errors import ArchiveError

Severity = Literal["error", "warning"]
Consumer = Literal["alpasim", "carla", "openusd", "own"]
NAMES: Mapping[Consumer, str] = {"alpasim": "AlpaSim", "carla": "CARLA", "openusd": "OpenUSD", "own": "nurec-sim"}
"""Display names of consumers."""


@dataclass(frozen=True)
class Rule:
    """A requirement of a consumer; violated errors prevent it from running, warnings do not."""

    severity: Severity
    needs: str
    loses: str


@dataclass(frozen=True)
class Finding:
    """A violated rule; ``found`` gives location and fault."""

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
    """Collects the findings of one consumer."""

    consumer: Consumer
    rules: Mapping[str, Rule]
    findings: list[Finding] = field(default_factory=list)

    def add(self, name: str, found: str) -> None:
        """Adds a finding as one line."""
        rule = self.rules[name]
        found = " ".join(found.split())
        self.findings.append(Finding(self.consumer, name, rule.severity, found, rule.needs, rule.loses))

    @contextlib.contextmanager
    def rule(self, name: str) -> Iterator[None]:
        """Converts an ArchiveError in the block into a finding and continues."""
        try:
            yield
        except ArchiveError as error:
            self.add(name, str(error))
