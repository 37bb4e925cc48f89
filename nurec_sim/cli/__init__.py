"""The command line: one function per verb; a verb imports what it needs, and ``health`` next to nothing."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import nurec_sim

__all__ = ["main"]

FIRST_STEPS = """\
nurec-sim, an open closed-loop sensor simulator for driving. To begin with:

  nurec-sim demo           the whole chain on the log that comes with it
  nurec-sim inspect CLIP   what a log of yours holds, and its faults
  nurec-sim run CLIP       reconstruct it, drive policies through it, report

All verbs: nurec-sim --help; the options of one: nurec-sim VERB --help"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one verb; errors of ours become one line and exit status 1, Ctrl-C becomes 130."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words[:1] == ["health"]:  # asked every few seconds by whoever watches over a server
        from nurec_sim.cli import health

        health.run(words[1:])
    elif words == ["--version"]:
        print(f"nurec-sim {nurec_sim.__version__}")
    elif not words:
        print(FIRST_STEPS)
    else:
        from nurec_sim.cli import verbs

        verbs.run(words)
