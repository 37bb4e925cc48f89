"""A gRPC server of any services: listening, health, reflection, metrics, signals, graceful shutdown."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import signal
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Protocol

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_health.v1.health import aio as health
from grpc_reflection.v1alpha import reflection

from nurec_sim.serving import wire
from nurec_sim.serving.calls import Service, register
from nurec_sim.serving.server.gate import Gate
from nurec_sim.serving.server.options import ServerOptions
from nurec_sim.serving.server.telemetry import Telemetry

log = logging.getLogger(__name__)

_SERVING = health_pb2.HealthCheckResponse.SERVING
_NOT_SERVING = health_pb2.HealthCheckResponse.NOT_SERVING
_SWITCH_S = 0.001
"""How long a rendering thread may keep Python's lock while the loop that answers health waits for it."""
_LAST_WORDS_S = 0.2
"""For what only watches, such as health, when all calls have ended."""
_CHANNEL_OPTIONS = (
    ("grpc.so_reuseport", 0),  # a second server on a taken port is an error, not a coin toss
    ("grpc.max_concurrent_streams", 1024),  # of one connection
    ("grpc.max_metadata_size", 16 << 10),
    ("grpc.keepalive_time_ms", 60_000),  # finds out about clients that vanished, and frees what waits for them
    ("grpc.keepalive_timeout_ms", 20_000),
    ("grpc.keepalive_permit_without_calls", 1),
    ("grpc.http2.max_ping_strikes", 0),  # clients may look whether we live as often as they like
)


class Application(Protocol):
    """What a server serves."""

    services: Sequence[Service]

    async def warm_up(self) -> None:
        """Loads what the first calls need; health is NOT_SERVING until it is done. Must not raise."""
        ...

    def gauges(self) -> Mapping[str, tuple[str, float]]:
        """Figures of the moment for the metrics: name, what it is, value."""
        ...

    def close(self) -> None:
        """Ends what the application began; called when no call is in progress any more."""
        ...


class GrpcServer:
    """A server in a background thread (``start``, ``stop``, or ``with``), or in the running event loop (``run``).

    Args:
        make_application: creates the application, at each start; called with a function that requests a stop.
        host: name or address to listen at; ``0.0.0.0`` for all.
        port: 0 picks a free one.
        options: how it listens, and to whom.

    Attributes:
        health_address: ``host:port`` of the second port for health, once started; None without.
        metrics_address: ``host:port`` of the metrics, once started; None without.
    """

    def __init__(
        self,
        make_application: Callable[[Callable[[], None]], Application],
        host: str = "127.0.0.1",
        port: int = 8080,
        *,
        options: ServerOptions | None = None,
    ) -> None:
        self._make_application = make_application
        self._host, self._port = host, port
        self._options = options or ServerOptions()
        self._thread: threading.Thread | None = None
        self._request_stop: Callable[[], None] = lambda: None
        self.health_address: str | None = None
        self.metrics_address: str | None = None

    def start(self) -> str:
        """Starts serving; returns the address ``host:port``.

        Raises:
            OSError: an address cannot be listened at.
            ServerError: TLS cannot be set up.
        """
        if self._thread is not None:
            raise RuntimeError("this server runs already")
        address: Future[str] = Future()

        def run() -> None:
            try:
                asyncio.run(self.run(address.set_result))
            except BaseException as error:
                if address.done():
                    log.exception("the server died")
                else:
                    address.set_exception(error)

        self._thread = threading.Thread(target=run, name="grpc-server", daemon=True)
        self._thread.start()
        try:
            return address.result()
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """Stops serving and waits until it has; harmless if it does not run."""
        if self._thread is not None:
            self._request_stop()
            self._thread.join()
            self._thread = None

    def __enter__(self) -> str:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    async def run(self, on_ready: Callable[[str], None], *, handle_signals: bool = False) -> None:
        """Serves in the running event loop until stopped.

        Args:
            on_ready: called with ``host:port`` once calls are taken.
            handle_signals: stop on SIGINT and SIGTERM, the second of them at once (main thread only).

        Raises:
            OSError: an address cannot be listened at.
            ServerError: TLS cannot be set up.
        """
        loop, stopping = asyncio.get_running_loop(), asyncio.Event()

        def request_stop() -> None:
            loop.call_soon_threadsafe(stopping.set)

        async with contextlib.AsyncExitStack() as stack:
            application = self._make_application(request_stop)
            stack.callback(application.close)
            gate = Gate(self._options)
            server, monitor = self._make_server(gate), health.HealthServicer()
            names = ["", *(path for service in application.services for path in service.paths or (service.name,))]
            for service in application.services:
                register(server, service)
            health_pb2_grpc.add_HealthServicer_to_server(monitor, server)
            reflected = (*(service.name for service in application.services), reflection.SERVICE_NAME)
            reflection.enable_server_reflection(reflected, server, pool=wire.pool)
            for name in names:
                await monitor.set(name, _NOT_SERVING)
            port = _listen(server, self._host, self._port, self._options)
            stack.callback(setattr, self, "_request_stop", lambda: None)
            await self._open_side_ports(stack, monitor, gate, application)
            await server.start()
            self._request_stop = request_stop
            warming = asyncio.create_task(_warm_up(application, monitor, names, settle=handle_signals))
            await asyncio.sleep(0)  # a server with nothing to warm up is SERVING at once
            if handle_signals:
                _stop_on_signals(loop, stopping)
            on_ready(_address(self._host, port))
            await stopping.wait()
            await monitor.enter_graceful_shutdown()
            warming.cancel()
            await gate.drain(self._options.stop_grace_s)
            await server.stop(_LAST_WORDS_S)

    def _make_server(self, gate: Gate) -> grpc.aio.Server:
        limits = (
            ("grpc.max_receive_message_length", self._options.max_request_bytes),
            ("grpc.max_send_message_length", self._options.max_message_bytes),
        )
        return grpc.aio.server(interceptors=(gate,), options=(*limits, *_CHANNEL_OPTIONS))

    async def _open_side_ports(
        self, stack: contextlib.AsyncExitStack, monitor: health.HealthServicer, gate: Gate, application: Application
    ) -> None:
        self.health_address = self.metrics_address = None
        if self._options.health_port is not None:
            probe = grpc.aio.server(options=_CHANNEL_OPTIONS)
            health_pb2_grpc.add_HealthServicer_to_server(monitor, probe)
            port = _listen(probe, self._host, self._options.health_port)
            await probe.start()
            stack.push_async_callback(probe.stop, None)
            self.health_address = _address(self._host, port)
            log.info("health alone at %s", self.health_address)
        if self._options.metrics_port is not None:

            def gauges() -> Mapping[str, tuple[str, float]]:
                return {
                    "requests_in_progress": ("Calls in progress", gate.calls),
                    "unread_reply_bytes": ("Bytes of replies that clients have not taken yet", gate.unread.total),
                    **application.gauges(),
                }

            gate.telemetry = Telemetry(gauges)
            self.metrics_address, close = gate.telemetry.listen(self._options.metrics_host, self._options.metrics_port)
            stack.callback(close)
            log.info("metrics at http://%s/metrics", self.metrics_address)


def run_until_signal(server: GrpcServer, announce: Callable[[str], None] | None = None) -> None:
    """Serves until SIGINT or SIGTERM; for the main thread of a program.

    Args:
        server: one that does not run.
        announce: called with ``Serving on <host>:<port>`` once calls are taken; prints it if None.

    Raises:
        OSError: an address cannot be listened at.
        ServerError: TLS cannot be set up.
    """
    say = announce or (lambda line: print(line, flush=True))
    _allow_many_connections()
    sys.setswitchinterval(_SWITCH_S)
    asyncio.run(server.run(lambda address: say(f"Serving on {address}"), handle_signals=True))


async def _warm_up(
    application: Application, monitor: health.HealthServicer, names: Sequence[str], *, settle: bool
) -> None:
    """Warms up; ``settle`` for a program: the libraries' objects stay, so Python need not look for garbage in them."""
    await application.warm_up()
    if settle:  # a full collection among a million objects stops all threads for some 0.3 s
        gc.collect()
        gc.freeze()
    for name in names:
        await monitor.set(name, _SERVING)


def _listen(server: grpc.aio.Server, host: str, port: int, options: ServerOptions | None = None) -> int:
    """The port that a server listens at.

    Raises:
        OSError, ServerError: see ``GrpcServer.run``.
    """
    if not 0 <= port <= 65535:
        raise OSError(f"cannot listen at port {port}; ports are 0 (any free one) to 65535")
    address = _address(host, port)
    try:
        if options is not None and options.tls is not None:
            return server.add_secure_port(address, options.tls.credentials())
        return server.add_insecure_port(address)
    except RuntimeError as error:
        raise OSError(f"cannot listen at {address}: {error}") from error


def _address(host: str, port: int) -> str:
    """``host:port``, addresses of IPv6 in brackets."""
    return f"[{host}]:{port}" if ":" in host and not host.startswith("[") else f"{host}:{port}"


def _stop_on_signals(loop: asyncio.AbstractEventLoop, stopping: asyncio.Event) -> None:
    """Asks for a stop at the first signal; the second ends the process at once."""
    numbers = (signal.SIGINT, signal.SIGTERM)

    def stop_once() -> None:
        for number in numbers:
            loop.remove_signal_handler(number)
            signal.signal(number, signal.SIG_DFL)  # SIGINT too: as an exception it would wait for threads
        stopping.set()

    for number in numbers:
        loop.add_signal_handler(number, stop_once)


def _allow_many_connections() -> None:
    """Raises the number of files that this process may have open as far as it may: a connection is one."""
    try:
        import resource
    except ImportError:  # no such limit on this system
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
