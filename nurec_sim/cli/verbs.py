"""All verbs together; heavy modules are imported by the verb that needs them."""

from __future__ import annotations

import difflib
import errno
import logging
import os
import sys

from nurec_sim.cli import (  # noqa: F401  (each adds its verbs to the app)
    conformance,
    drive,
    driving,
    evaluation,
    exchange,
    inspection,
    remote,
    scenes,
    serving,
    training,
    validation,
    weights,
    worlds,
)
from nurec_sim.cli.console import app, err
from nurec_sim.errors import NurecSimError

KEPT = {
    "run": "finished rollouts are kept: go on with --resume runs/latest (or your run folder)",
    "demo": "finished rollouts are kept: go on with --resume runs/latest (or your run folder)",
    "evaluate": "finished windows of a protocol are kept: go on with --resume evaluations/latest (or your run folder)",
}
"""What an interrupted verb leaves behind."""


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
        _forget_output()  # whoever read the output has left, as `head` does
        raise SystemExit(1) from None
    except OSError as error:
        if error.errno is None:  # not the system's: a bug
            raise
        where = error.filename
        if where is None and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO):
            where = "standard output"  # whatever else is written has a name
            _forget_output()
        text = f"{where}: {error.strerror}" if where else error.strerror
        err.print(f"nurec-sim: {text}", style="red", markup=False, highlight=False, soft_wrap=True)
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        err.print(f"interrupted; {KEPT.get(words[0] if words else '', 'nothing half-written was left')}")
        raise SystemExit(130) from None


def _check_verb(words: list[str]) -> None:
    """Names the verb that was meant, and ends with 2, where the first word is none."""
    known = sorted(getattr(app, "_subcommands", ()))  # tyro has no public name for them, and a help of its own without
    if not known or not words or words[0].startswith("-") or words[0] in known:
        return
    near = difflib.get_close_matches(words[0], known, n=1, cutoff=0.5)
    hint = f"did you mean '{near[0]}'?" if near else f"have {', '.join(known)}."
    text = f"nurec-sim: there is no verb '{words[0]}'; {hint} All of them: nurec-sim --help"
    err.print(text, style="red", markup=False, highlight=False, soft_wrap=True)
    raise SystemExit(2)


def _forget_output() -> None:
    """Lets what cannot be written to standard output go, which Python would try once more at the end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
