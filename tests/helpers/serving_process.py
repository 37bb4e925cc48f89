"""A server of the command line in a process of its own, for tests that start and end one."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).parent


@contextlib.contextmanager
def serving(*words: str, **environment: str) -> Iterator[tuple[subprocess.Popen, str]]:
    """Runs ``nurec-sim <words>``; gives the process and the address that it says it serves on."""
    process = subprocess.Popen(
        [sys.executable, "-W", "error", "-m", "nurec_sim.cli", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=HERE.parents[1],
        env=os.environ | environment,
    )
    try:
        line = process.stdout.readline()
        said = re.fullmatch(r"Serving on (\S+:\d+)\n", line)
        assert said, f"{line!r}: {process.communicate(timeout=20)[1]}"
        yield process, said[1]
    finally:
        process.kill()
        process.communicate()


def ended(process: subprocess.Popen) -> tuple[int, str, str]:
    """Exit status, and what else it printed on stdout and stderr."""
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err
