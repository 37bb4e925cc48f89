"""Flags of all gRPC serving commands: access, limits and monitoring."""

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
    """Access, limits and monitoring."""

    insecure: bool = False
    """Accept any client that can reach the port: no TLS, no token."""
    tls_cert: Path | None = None
    """Serve TLS with this certificate (PEM)."""
    tls_key: Path | None = None
    """Private key of the certificate (PEM, no password)."""
    tls_client_ca: Path | None = None
    """Mutual TLS: clients must present a certificate signed by one of these (PEM)."""
    token_file: Path | None = None
    """Clients must send `authorization: Bearer <content of this file>`; alternatively $NUREC_SIM_TOKEN."""
    rate: float | None = None
    """Maximum calls per second per client address; default: unlimited."""
    rate_burst: int = 32
    """Maximum burst of calls per client address."""
    max_pixels: int | None = None
    """Maximum pixels or beams per frame; default: 33.2 million."""
    max_batch_items: int | None = None
    """Maximum frames per call; default: 64."""
    max_call_rays: int | None = None
    """Maximum pixels and beams per call; default: 134 million."""
    max_client_rays: int | None = None
    """Maximum pixels and beams in concurrent calls of one connection; default: 268 million."""
    max_actors: int | None = None
    """Maximum actors per frame request; default: 4096."""
    max_request_mb: int | None = None
    """Maximum size of a request or an upload chunk in MiB; default: 16."""
    max_message_mb: int | None = None
    """Maximum size of a reply in MiB; default: 64."""
    device: str = "auto"
    """Render device: auto (a GPU if available), cpu, cuda or cuda:N."""
    workers: int | None = None
    """Frames rendered concurrently; default: the number of cores."""
    health_port: int | None = None
    """A second, unencrypted port for health checks only."""
    metrics_port: int | None = None
    """HTTP port of Prometheus metrics."""
    metrics_host: str = "127.0.0.1"
    """Listen address for metrics; default: localhost only."""
    grace: float = 5.0
    """Grace period in seconds for running calls after SIGTERM or Ctrl-C; a second signal exits immediately."""
    allow_shut_down: bool = False
    """Let clients stop the server with shut_down."""
    allow_remote_scenes: bool = False
    """Allow clients to load scenes from http(s) addresses, not only file://."""
    scene_dirs: tuple[Path, ...] = ()
    """Folders accessible through file:// addresses, in addition to those of the given scenes."""
    allow_any_file: bool = False
    """Allow file:// addresses of any .usdz file that the server can read."""
    upload_dir: Path | None = None
    """Allow clients to upload scenes and clips to this folder."""
    clip_dirs: tuple[Path, ...] = ()
    """Allow clients to reconstruct clips in these folders."""
    log_format: Literal["text", "json"] = "text"
    """Log format on stderr: text, or one JSON object per line."""
    log_level: Literal["debug", "info", "warning", "error"] = "warning"
    """Minimum log level; info logs every call."""


Operation = Annotated[OperationFlags, tyro.conf.arg(name="")]
NO_FLAGS = OperationFlags()


def server_options(flags: OperationFlags) -> ServerOptions:
    """Server options from the flags; also sets up logging.

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
    """Service options from the flags, with defaults for those not given.

    Raises:
        NurecSimError: a limit is not positive.
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
    """Folders accessible through ``file://``: the sources, the parents of source files, and ``--scene-dirs``.

    Raises:
        NurecSimError: one of ``--scene-dirs`` is not a folder.
    """
    for folder in flags.scene_dirs:
        if not folder.is_dir():
            raise NurecSimError(f"--scene-dirs {str(folder)!r} is no folder")
    given = [Path(source) for source in sources]
    return (*flags.scene_dirs, *given, *(path.absolute().parent for path in given if not path.is_dir()))


def warn(text: str) -> None:
    """One yellow line on stderr."""
    err.print(f"warning: {text}", style="yellow", markup=False, highlight=False, soft_wrap=True)
