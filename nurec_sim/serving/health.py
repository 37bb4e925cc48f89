"""Client of the gRPC health service; imports little, so that a probe starts quickly."""

from __future__ import annotations

from pathlib import Path

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from nurec_sim.errors import ServerError
from nurec_sim.serving.channels import open_channel


def check_health(address: str, *, root_ca: Path | None = None, timeout_s: float = 4.0) -> str:
    """``SERVING``, if that is what a gRPC server answers.

    Args:
        address: ``host:port`` of the server or of its health port.
        root_ca: PEM file of the root certificates to verify the server's TLS certificate; plain text if None.
        timeout_s: for the answer.

    Raises:
        ServerError: no answer, or another than SERVING.
    """
    with open_channel(address, root_ca) as channel:
        try:
            reply = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=timeout_s)
        except grpc.RpcError as error:
            raise ServerError(f"{address}: {error.code().name}: {error.details()}") from None
    status = health_pb2.HealthCheckResponse.ServingStatus.Name(reply.status)
    if status != "SERVING":
        raise ServerError(f"{address}: {status}")
    return status
