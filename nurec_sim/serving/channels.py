"""gRPC channels: plain text or TLS, checked; imports next to nothing, so that a probe of a server's health is quick."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import grpc

from nurec_sim.errors import ServerError

NO_PROXY = ("grpc.enable_http_proxy", 0)
"""Servers of ours are near; a proxy for the web is not for them."""


def open_channel(
    address: str,
    root_ca: Path | None = None,
    client_cert: Path | None = None,
    client_key: Path | None = None,
    options: Sequence[tuple[str, Any]] = (NO_PROXY,),
) -> grpc.Channel:
    """A channel to ``host:port``.

    Args:
        address: ``host:port``.
        root_ca: PEM file of the root certificates that verify the server's; plain text if None.
        client_cert: PEM file of the certificate to show, for mutual TLS.
        client_key: PEM file of its private key.
        options: of gRPC, in place of the default.

    Raises:
        ServerError: a PEM file cannot be read, or a certificate comes without its key or without ``root_ca``.
    """
    if (client_cert is None) != (client_key is None) or (client_cert and root_ca is None):
        raise ServerError("mutual TLS needs root_ca, client_cert and client_key together")
    if root_ca is None:
        return grpc.insecure_channel(address, options)
    try:
        roots, key, cert = (None if path is None else path.read_bytes() for path in (root_ca, client_key, client_cert))
    except OSError as error:
        raise ServerError(f"TLS cannot be set up: {error}") from None
    return grpc.secure_channel(address, grpc.ssl_channel_credentials(roots, key, cert), options)
