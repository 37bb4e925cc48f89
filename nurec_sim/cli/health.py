"""The verb ``health``: whether a gRPC server serves, asked with a fraction of what other verbs take to start."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from nurec_sim.errors import NurecSimError, ServerError
from nurec_sim.serving.channels import open_channel

TIMEOUT_S = 4.0


def health(address: str, *, root_ca: Path | None = None, timeout: float = TIMEOUT_S) -> str:
    """Ask a gRPC server whether it serves; exit status 1 if it does not, or not yet.

    Args:
        address: host:port, of the server or of its --health-port.
        root_ca: certificates (PEM) that vouch for a server with TLS.
        timeout: seconds to wait for an answer.

    Raises:
        ServerError: no answer, or another than SERVING.
    """
    with open_channel(address, root_ca) as channel:
        try:
            reply = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=timeout)
        except grpc.RpcError as error:
            raise ServerError(f"{address}: {error.code().name}: {error.details()}") from None
    status = health_pb2.HealthCheckResponse.ServingStatus.Name(reply.status)
    if status != "SERVING":
        raise ServerError(f"{address}: {status}")
    return status


def run(words: Sequence[str]) -> None:
    """The verb, from the words that follow it; prints the status, or one line on stderr and exits with 1."""
    given = _parser().parse_args(words)
    try:
        print(f"{given.address}: {health(given.address, root_ca=given.root_ca, timeout=given.timeout)}")
    except NurecSimError as error:
        print(f"nurec-sim: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "nurec-sim health",
        description="Ask a gRPC server whether it serves; exit status 1 if it does not, or not yet.",
        allow_abbrev=False,
    )
    parser.add_argument("address", metavar="HOST:PORT", help="the server, or its --health-port")
    parser.add_argument("--root-ca", type=Path, metavar="PATH", help="certificates (PEM) that vouch for TLS")
    parser.add_argument("--timeout", type=_seconds, default=TIMEOUT_S, metavar="SECONDS", help="default: 4")
    return parser


def _seconds(text: str) -> float:
    """A time to wait; gRPC itself would take a negative one, or NaN."""
    value = float(text)
    if not 0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"must be more than 0 and less than a million seconds, got {text}")
    return value
