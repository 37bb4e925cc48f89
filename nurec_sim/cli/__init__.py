"""The command line: one function per verb; a verb imports what it needs, and ``health`` next to nothing."""

from __future__ import annotations

import sys
from collections.abc import Sequence

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one verb; errors of ours become one line and exit status 1, Ctrl-C becomes 130."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words[:1] == ["health"]:  # asked every few seconds by whoever watches over a server
        from nurec_sim.cli import health

        health.run(words[1:])
    else:
        from nurec_sim.cli import verbs

        verbs.run(words)
