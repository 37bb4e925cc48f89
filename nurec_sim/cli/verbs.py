"""All commands; heavy modules are imported by the command that needs them."""

from __future__ import annotations

import difflib
import errno
import logging
import os
import sys

from nurec_sim import plugins
from nurec_sim.cli import (  # noqa: F401  (each registers its commands)
    comparison,
    conformance,
    converting,
    drive,
    driving,
    evaluation,
    exchange,
    inspection,
    lidar,
    remote,
    scenes,
    serving,
    studies,
    training,
    validation,
    viewing,
    weights,
    worlds,
)
from nurec_sim.cli.console import app, err
from nurec_sim.errors import NurecSimError

KEPT = {
    "run": "finished rollouts are kept: if there are any, resume with --resume runs/latest (or your run folder)",
    "demo": "finished rollouts are kept: if there are any, resume with --resume runs/latest (or your run folder)",
    "study": "finished rollouts are kept: give the same command again",
    "evaluate": "finished windows of a protocol are kept: resume with --resume evaluations/latest (or your run folder)",
}
"""Messages after Ctrl-C."""


def run(words: list[str]) -> None:
    """Run one verb; errors of ours become one line and exit status 1, Ctrl-C becomes 130."""
    logging.basicConfig(format="%(message)s", level=logging.ERROR)
    try:
        if words[:1] == ["serve-grpc"]:
            words[1:] = serving.sort_serve_grpc(words[1:])
        _check_verb(words)
        try:
            app.cli(
                prog="nurec-sim",
                description="An open closed-loop sensor simulator for driving. A log becomes a Gaussian world, a gRPC "
                "server renders it, policies drive through it, a report says which is better. Start with: nurec-sim "
                "demo. `nurec-sim --version` prints the version.",
                args=words,
            )
        finally:
            sys.stdout.flush()
    except NurecSimError as error:
        err.print(f"nurec-sim: {error}", style="red", markup=False, highlight=False, soft_wrap=True)
        raise SystemExit(1) from None
    except BrokenPipeError:
        _forget_output()  # the reader of a pipe has closed it, as `head` does
        raise SystemExit(1) from None
    except OSError as error:
        if error.errno is None:  # not an operating system error: a bug
            raise
        where = error.filename
        if where is None and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO):
            where = "standard output"  # all other outputs have a file name
            _forget_output()
        text = f"{where}: {error.strerror}" if where else error.strerror
        err.print(f"nurec-sim: {text}", style="red", markup=False, highlight=False, soft_wrap=True)
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        err.print(f"interrupted; {KEPT.get(words[0] if words else '', 'nothing half-written was left')}")
        raise SystemExit(130) from None


def _check_verb(words: list[str]) -> None:
    """Suggests the nearest command and exits with 2 if the first word is not a command."""
    known = sorted(getattr(app, "_subcommands", ()))  # tyro has no public API for them
    if not known or not words or words[0].startswith("-") or words[0] in known:
        return
    near = difflib.get_close_matches(words[0], known, n=1, cutoff=0.5)
    hint = f"did you mean '{near[0]}'?" if near else f"have {', '.join(known)}."
    if words[0] in plugins.available(plugins.METHODS):
        hint = f"it is a method: nurec-sim reconstruct LOG --method {words[0]}."
    text = f"nurec-sim: unknown command '{words[0]}'; {hint} All commands: nurec-sim --help"
    err.print(text, style="red", markup=False, highlight=False, soft_wrap=True)
    raise SystemExit(2)


def _forget_output() -> None:
    """Discards unwritable standard output, which Python would retry at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
