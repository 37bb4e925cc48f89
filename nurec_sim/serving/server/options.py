"""Server options: TLS, bearer token, limits, and whether other machines may connect."""

from __future__ import annotations

import hmac
import ipaddress
import os
import ssl
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import grpc

from nurec_sim.errors import ServerError
from nurec_sim.serving import wire

TOKEN_VARIABLE = "NUREC_SIM_TOKEN"
_SCHEME = "bearer "


@dataclass(frozen=True)
class Tls:
    """PEM files of a server's TLS.

    Attributes:
        cert: the server's certificate, and those between it and the root.
        key: its private key, without a password.
        client_ca: clients must show a certificate that one of these signed (mutual TLS); None asks for none.
    """

    cert: Path
    key: Path
    client_ca: Path | None = None

    def credentials(self) -> grpc.ServerCredentials:
        """What gRPC needs.

        Raises:
            ServerError: a file cannot be read, is no PEM, or key and certificate do not belong together.
        """
        try:
            # gRPC would accept anything here and fail at every handshake.
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            context.load_cert_chain(self.cert, self.key, password=lambda: "")
            if self.client_ca is not None:
                context.load_verify_locations(self.client_ca)
            roots = None if self.client_ca is None else self.client_ca.read_bytes()
            pair = (self.key.read_bytes(), self.cert.read_bytes())
        except (OSError, ValueError) as error:  # an SSLError is an OSError
            files = [str(path) for path in (self.cert, self.key, self.client_ca) if path is not None]
            raise ServerError(f"TLS cannot be set up from {files}: {error}") from None
        return grpc.ssl_server_credentials([pair], roots, require_client_auth=roots is not None)


@dataclass(frozen=True)
class ServerOptions:
    """Choices of operation; what is served has options of its own."""

    tls: Tls | None = None
    """None for plain text."""
    token: str | None = field(default=None, repr=False)
    """What clients must show as ``authorization: Bearer <token>``; health needs none."""
    health_port: int | None = None
    """A second port, always plain text, that answers health and nothing else; 0 takes a free one."""
    metrics_port: int | None = None
    """HTTP port of Prometheus metrics; 0 takes a free one."""
    metrics_host: str = "127.0.0.1"
    rate_per_s: float | None = None
    """Calls a second that one client address may make in the long run; None for any number."""
    rate_burst: int = 32
    """Calls that it may make at once after a pause."""
    max_calls: int = 4096
    """Calls in progress; more are refused."""
    max_request_bytes: int = wire.MAX_MESSAGE_BYTES
    """Of a message from a client; what is larger is not even received."""
    max_message_bytes: int = wire.MAX_MESSAGE_BYTES
    """Of a message to a client."""
    max_unread_bytes: int = 1 << 30
    """Of replies that their clients have not taken yet; one connection may leave a quarter of it, but one reply
    always."""
    stop_grace_s: float = 5.0
    """Time that calls in progress get to finish when the server stops."""

    def __post_init__(self) -> None:
        sizes = ("max_request_bytes", "max_message_bytes", "max_unread_bytes")
        for name in ("rate_per_s", "rate_burst", "max_calls", *sizes):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be above 0, got {value}")
        if not 0 <= self.stop_grace_s < float("inf"):
            raise ValueError(f"stop_grace_s must be finite and not negative, got {self.stop_grace_s}")


def read_token(path: Path | None) -> str | None:
    """The token that clients must show: from a file, else from ``$NUREC_SIM_TOKEN``; None if there is neither.

    Raises:
        ServerError: the file cannot be read, or holds no token: visible ASCII without spaces, at least 8 characters.
    """
    if path is None and TOKEN_VARIABLE not in os.environ:
        return None
    source = f"${TOKEN_VARIABLE}" if path is None else str(path)
    try:
        token = os.environ[TOKEN_VARIABLE] if path is None else path.read_text("ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise ServerError(f"the token cannot be read from {source}: {error}") from None
    token = token.strip()
    if len(token) < 8 or not all("!" <= letter <= "~" for letter in token):
        raise ServerError(
            f"{source} must hold a token of at least 8 visible ASCII characters without spaces, got {len(token)} in all"
        )
    return token


def shows_token(metadata: Mapping[str, str | bytes], token: str) -> bool:
    """Whether the ``authorization`` of a call is ``Bearer <token>``; takes as long for every wrong token."""
    given = metadata.get("authorization", "")
    if not isinstance(given, str) or given[: len(_SCHEME)].lower() != _SCHEME:
        return False
    return hmac.compare_digest(given[len(_SCHEME) :].strip().encode(), token.encode())


def is_loopback(host: str) -> bool:
    """Whether only programs of this machine can reach ``host``."""
    if host.startswith("unix:") or host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def check_exposure(host: str, *, protected: bool, insecure: bool) -> None:
    """Refuses to listen for other machines unless the server is protected, or ``insecure`` allows it.

    Raises:
        ServerError: other machines can reach ``host``, and neither is the case.
    """
    if not (is_loopback(host) or protected or insecure):
        raise ServerError(
            f"refused to listen at {host!r}, which other machines can reach, for anybody to call; "
            "give --tls-cert and --tls-key, or --token-file, or --insecure if the network is trusted"
        )
