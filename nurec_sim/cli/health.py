"""The command ``health``: checks a gRPC server with minimal start-up time."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from nurec_sim.errors import NurecSimError
from nurec_sim.serving.health import check_health

TIMEOUT_S = 4.0


def run(words: Sequence[str]) -> None:
    """Runs the command with its arguments; prints the status, or one line on stderr and exits with 1."""
    given = _parser().parse_args(words)
    try:
        print(f"{given.address}: {check_health(given.address, root_ca=given.root_ca, timeout_s=given.timeout)}")
    except NurecSimError as error:
        print(f"nurec-sim: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "nurec-sim health",
        description="Check the health of a gRPC server; exit status 1 if it is not serving.",
        allow_abbrev=False,
    )
    parser.add_argument("address", metavar="HOST:PORT", help="the server, or its --health-port")
    parser.add_argument("--root-ca", type=Path, metavar="PATH", help="root certificates (PEM) for TLS")
    parser.add_argument("--timeout", type=_seconds, default=TIMEOUT_S, metavar="SECONDS", help="default: 4")
    return parser


def _seconds(text: str) -> float:
    """A valid timeout; gRPC itself would accept negative values and NaN."""
    value = float(text)
    if not 0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"must be more than 0 and less than a million seconds, got {text}")
    return value
