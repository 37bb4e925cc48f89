"""The command line: one function per verb; a verb imports what it needs, and ``health`` next to nothing."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

import nurec_sim

__all__ = ["main"]

FIRST_STEPS = """\
nurec-sim, an open closed-loop sensor simulator for driving. First steps:

  nurec-sim demo           run the whole chain on the bundled demo log
  nurec-sim inspect CLIP   show the contents and faults of your log
  nurec-sim run CLIP       reconstruct it, run policies in it, write a report

All commands: nurec-sim --help; options of a command: nurec-sim COMMAND --help"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one verb; errors of ours become one line and exit status 1, Ctrl-C becomes 130."""
    # Read when NumPy is imported. Matrices here are small: threads of OpenBLAS would wait for each other, in a loop
    # that takes whole cores from the kernels, and sum in another order on another number of cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words[:1] == ["health"]:  # called every few seconds by container health checks
        from nurec_sim.cli import health

        health.run(words[1:])
    elif words == ["--version"]:
        print(f"nurec-sim {nurec_sim.__version__}")
    elif not words:
        print(FIRST_STEPS)
    else:
        from nurec_sim.cli import verbs

        verbs.run(words)
