"""Conformance kit: whether a sensor server keeps the published contract, one small check for each rule.

The checks speak the interface's published fields only and know nothing of who answers. A feature that a server may
leave out is skipped with the reason; a rule that it breaks fails with what was asked, what came and what should have.
"""

# isort: off
# Checks run in the order in which their modules are imported.
from nurec_sim.serving.conformance import (
    discovery,
    pictures,
    cameras,
    times,
    poses,
    batches,
    actors,
    lidars,
    limits,
    edits,
)

# isort: on
from nurec_sim.serving.conformance.kit import CHECKS, Check, Outcome, Verdict, run_checks
from nurec_sim.serving.conformance.target import Target

__all__ = [
    "CHECKS",
    "Check",
    "Outcome",
    "Target",
    "Verdict",
    "actors",
    "batches",
    "cameras",
    "discovery",
    "edits",
    "lidars",
    "limits",
    "pictures",
    "poses",
    "run_checks",
    "times",
]
