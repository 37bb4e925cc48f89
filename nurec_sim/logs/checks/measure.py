"""What a check of a clip's geometry answers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Measure:
    """One figure taken from a clip's data.

    Attributes:
        what: what was measured, with the sensor's name.
        found: the figure, in words; says so where there is too little to judge by.
        faults: what is wrong, one line each; empty when nothing is, or when nothing can be told.
    """

    what: str
    found: str
    faults: tuple[str, ...] = ()
