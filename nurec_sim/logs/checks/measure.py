"""The result of a geometric check of a clip."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Measure:
    """One quantity measured on a clip's data.

    Attributes:
        what: what was measured, with the sensor's name.
        found: its value as text, or a note that there is too little data.
        faults: faults, one line each; empty if there are none, or too little data to judge.
    """

    what: str
    found: str
    faults: tuple[str, ...] = ()
