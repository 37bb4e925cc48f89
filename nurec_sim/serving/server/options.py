"""How a server listens, whom it lets in, and what it tells of itself."""

from __future__ import annotations

from dataclasses import dataclass, field

from nurec_sim.serving import wire
from nurec_sim.serving.server.security import Tls


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
        for name in (
            "rate_per_s",
            "rate_burst",
            "max_calls",
            "max_request_bytes",
            "max_message_bytes",
            "max_unread_bytes",
        ):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be above 0, got {value}")
        if not 0 <= self.stop_grace_s < float("inf"):
            raise ValueError(f"stop_grace_s must be finite and not negative, got {self.stop_grace_s}")
