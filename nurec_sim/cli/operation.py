"""Flags of every verb that serves over gRPC: who may call, how much, and what the server tells of itself."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from nurec_sim.cli.console import err
from nurec_sim.errors import NurecSimError

if TYPE_CHECKING:
    from nurec_sim.serving.sensor_service import ServiceOptions
    from nurec_sim.serving.server import ServerOptions


@dataclass(frozen=True)
class OperationFlags:
    """Who may call, how much, and what the server tells of itself."""

    insecure: bool = False
    """Let anybody who can reach the port call: no TLS, no token."""
    tls_cert: Path | None = None
    """Serve TLS with this certificate (PEM)."""
    tls_key: Path | None = None
    """Private key of the certificate (PEM, no password)."""
    tls_client_ca: Path | None = None
    """Mutual TLS: clients must show a certificate that one of these (PEM) signed."""
    token_file: Path | None = None
    """Clients must send `authorization: Bearer <content of this file>`; $NUREC_SIM_TOKEN holds one too."""
    rate: float | None = None
    """Calls a second that one client address may make; any number if not given."""
    rate_burst: int = 32
    """Calls that it may make at once after a pause."""
    max_pixels: int | None = None
    """Pixels, or beams, of one frame; 33.2 million if not given."""
    max_batch_items: int | None = None
    """Frames of one call; 64 if not given."""
    max_call_rays: int | None = None
    """Pixels and beams of all frames of one call; 134 million if not given."""
    max_client_rays: int | None = None
    """Pixels and beams that the calls of one connection may ask for at a time; 268 million if not given."""
    max_actors: int | None = None
    """Actors that a request for a frame may place; 4096 if not given."""
    max_request_mb: int | None = None
    """Megabytes (2^20 bytes) of a request, or of a part of an upload; 16 if not given."""
    max_message_mb: int | None = None
    """Megabytes (2^20 bytes) of a reply; 64 if not given."""
    device: str = "auto"
    """Device that renders: auto (a GPU if one can be used), cpu, cuda or cuda:N."""
    workers: int | None = None
    """Frames rendered at the same time; as many as there are cores if not given."""
    health_port: int | None = None
    """A second, plain-text port that answers health only."""
    metrics_port: int | None = None
    """HTTP port of Prometheus metrics."""
    metrics_host: str = "127.0.0.1"
    """Address of the metrics; only this machine unless said otherwise."""
    grace: float = 5.0
    """Seconds that calls in progress get to finish after SIGTERM or Ctrl-C; a second signal ends at once."""
    allow_shut_down: bool = False
    """Let clients stop the server with shut_down."""
    allow_remote_scenes: bool = False
    """Let clients name scenes by http(s) address, and not only by file://."""
    scene_dirs: tuple[Path, ...] = ()
    """Folders that a file:// address may lead to, beside those of the scenes given here."""
    allow_any_file: bool = False
    """Let a file:// address lead to any .usdz file that the server can read."""
    upload_dir: Path | None = None
    """Let clients upload scenes and clips, and keep them here."""
    clip_dirs: tuple[Path, ...] = ()
    """Let clients have clips in these folders reconstructed."""
    log_format: Literal["text", "json"] = "text"
    """Log lines on stderr as text or as one JSON object each."""
    log_level: Literal["debug", "info", "warning", "error"] = "warning"
    """The least important lines to log; info has one for each call."""


Operation = Annotated[OperationFlags, tyro.conf.arg(name="")]
NO_FLAGS = OperationFlags()


def server_options(flags: OperationFlags) -> ServerOptions:
    """What the flags ask of the server; sets up the log.

    Raises:
        NurecSimError: the flags contradict each other, or the token cannot be read.
    """
    from nurec_sim.serving.server import ServerOptions, Tls, read_token, set_up_logging

    set_up_logging(flags.log_format, flags.log_level)
    if (flags.tls_cert is None) != (flags.tls_key is None) or (flags.tls_client_ca and flags.tls_cert is None):
        raise NurecSimError("TLS needs both --tls-cert and --tls-key (and --tls-client-ca for mutual TLS)")
    tls = Tls(flags.tls_cert, flags.tls_key, flags.tls_client_ca) if flags.tls_cert and flags.tls_key else None
    token = read_token(flags.token_file)
    if token is not None and tls is None:
        warn("the token travels in plain text; --tls-cert and --tls-key keep it secret")
    try:
        return ServerOptions(
            tls=tls,
            token=token,
            health_port=flags.health_port,
            metrics_port=flags.metrics_port,
            metrics_host=flags.metrics_host,
            rate_per_s=flags.rate,
            rate_burst=flags.rate_burst,
            stop_grace_s=flags.grace,
        )
    except ValueError as error:
        raise NurecSimError(str(error)) from None


def service_options(flags: OperationFlags, **more: Any) -> ServiceOptions:
    """What the flags ask of the service; what is not given stays as it is by default.

    Raises:
        NurecSimError: a limit lets nothing through.
    """
    from nurec_sim.serving.sensor_service import ServiceOptions

    given = {
        "render_workers": flags.workers,
        "max_pixels": flags.max_pixels,
        "max_batch_items": flags.max_batch_items,
        "max_call_rays": flags.max_call_rays,
        "max_client_rays": flags.max_client_rays,
        "max_actors": flags.max_actors,
        "max_request_bytes": None if flags.max_request_mb is None else flags.max_request_mb << 20,
        "max_message_bytes": None if flags.max_message_mb is None else flags.max_message_mb << 20,
    }
    chosen: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    try:
        return ServiceOptions(
            warm_up=True,
            allow_shut_down=flags.allow_shut_down,
            allow_remote_scenes=flags.allow_remote_scenes,
            allow_any_file=flags.allow_any_file,
            **chosen,
            **more,
        )
    except ValueError as error:
        raise NurecSimError(str(error)) from None


def scene_dirs(flags: OperationFlags, sources: Iterable[str | Path]) -> tuple[Path, ...]:
    """What ``file://`` addresses may lead to: the sources, the folders of those that are files, and ``--scene-dirs``.

    Raises:
        NurecSimError: one of ``--scene-dirs`` is no folder.
    """
    for folder in flags.scene_dirs:
        if not folder.is_dir():
            raise NurecSimError(f"--scene-dirs {str(folder)!r} is no folder")
    given = [Path(source) for source in sources]
    return (*flags.scene_dirs, *given, *(path.absolute().parent for path in given if not path.is_dir()))


def warn(text: str) -> None:
    """One yellow line on stderr."""
    err.print(f"warning: {text}", style="yellow", markup=False, highlight=False, soft_wrap=True)
