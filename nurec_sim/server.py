"""The gRPC sensor server: the NuRec sensor interface over a ``SceneStore``.

One asyncio loop takes the calls; scenes load and frames render in threads of their own, so that health and discovery
answer while something renders. A call that its client gave up is not rendered.
"""

from __future__ import annotations

import asyncio
import logging
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_health.v1.health import aio as health
from grpc_reflection.v1alpha import reflection

from nurec_sim import wire
from nurec_sim.errors import NurecSimError
from nurec_sim.scene_store import SceneStore
from nurec_sim.service import SensorService, ServiceOptions, UnsupportedError, describe

log = logging.getLogger(__name__)

_MAX_TEXT = 2000  # a status text travels in the HTTP/2 trailers, which end at 8 KiB


class SensorServer:
    """A sensor server in a background thread.

    ::

        with SensorServer(SceneStore(["scene.usdz"]), port=0) as address:
            frames = RemoteSensors(address, "scene").sense(requests)

    Args:
        store: the scenes.
        host: name or address to listen at; ``0.0.0.0`` for all.
        port: 0 picks a free one.
        options: limits and choices.
        stop_grace_s: time that calls in progress get to finish when the server stops.
    """

    def __init__(
        self,
        store: SceneStore,
        host: str = "127.0.0.1",
        port: int = 8080,
        *,
        options: ServiceOptions | None = None,
        stop_grace_s: float = 5.0,
    ) -> None:
        self._store, self._host, self._port = store, host, port
        self._options = options or ServiceOptions()
        self._stop_grace_s = stop_grace_s
        self._thread: threading.Thread | None = None
        self._request_stop: Callable[[], None] = lambda: None

    def start(self) -> str:
        """Starts serving; gives the address ``host:port``.

        Raises:
            OSError: the address cannot be listened at.
        """
        if self._thread is not None:
            raise RuntimeError("this server runs already")
        address: Future[str] = Future()

        def run() -> None:
            try:
                asyncio.run(self.run(address.set_result))
            except BaseException as error:
                if address.done():
                    log.exception("the sensor server died")
                else:
                    address.set_exception(error)

        self._thread = threading.Thread(target=run, name="sensor-server", daemon=True)
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
            handle_signals: stop on SIGINT and SIGTERM (main thread only).

        Raises:
            OSError: the address cannot be listened at.
        """
        if not 0 <= self._port <= 65535:
            raise OSError(f"cannot listen at port {self._port}; ports are 0 (any free one) to 65535")
        loop, stopping = asyncio.get_running_loop(), asyncio.Event()

        def request_stop() -> None:
            loop.call_soon_threadsafe(stopping.set)

        service = SensorService(self._store, self._options, request_stop)
        try:
            server = grpc.aio.server(
                options=[
                    ("grpc.max_receive_message_length", self._options.max_message_bytes),
                    ("grpc.max_send_message_length", self._options.max_message_bytes),
                    ("grpc.so_reuseport", 0),  # a second server on a taken port is an error, not a coin toss
                ]
            )
            monitor = await _register(server, service)
            try:
                port = server.add_insecure_port(f"{self._host}:{self._port}")
            except RuntimeError as error:
                raise OSError(f"cannot listen at {self._host}:{self._port}: {error}") from error
            await server.start()
            self._request_stop = request_stop
            if handle_signals:
                for number in (signal.SIGINT, signal.SIGTERM):
                    loop.add_signal_handler(number, _stop_once, loop, number, stopping)
            on_ready(f"{self._host}:{port}")
            warming = asyncio.create_task(service.warm_up()) if self._options.warm_up and self._store.ids else None
            await stopping.wait()
            if warming:
                warming.cancel()
            await monitor.enter_graceful_shutdown()
            await server.stop(self._stop_grace_s)
        finally:
            self._request_stop = lambda: None
            service.close()


def serve(
    store: SceneStore,
    host: str = "127.0.0.1",
    port: int = 8080,
    *,
    options: ServiceOptions | None = None,
    announce: Callable[[str], None] | None = None,
) -> None:
    """Serves until SIGINT or SIGTERM; for the main thread.

    Args:
        store: the scenes.
        host: name or address to listen at; ``0.0.0.0`` for all.
        port: 0 picks a free one.
        options: limits and choices.
        announce: called with ``Serving on <host>:<port>`` once calls are taken; prints it if None.

    Raises:
        OSError: the address cannot be listened at.
    """
    say = announce or (lambda line: print(line, flush=True))
    server = SensorServer(store, host, port, options=options)
    asyncio.run(server.run(lambda address: say(f"Serving on {address}"), handle_signals=True))


def _stop_once(loop: asyncio.AbstractEventLoop, number: int, stopping: asyncio.Event) -> None:
    """Asks for a stop; the next signal of the kind ends the process as usual."""
    loop.remove_signal_handler(number)
    stopping.set()


async def _register(server: grpc.aio.Server, service: SensorService) -> health.HealthServicer:
    handlers = {
        name: grpc.unary_unary_rpc_method_handler(
            _answering(getattr(service, name), method), response_serializer=method.reply.SerializeToString
        )
        for name, method in wire.METHODS.items()
    }
    # The package of a message is not on the wire, so one set of handlers serves every spelling of the service.
    for path in wire.SERVICE_PATHS:
        server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(path, handlers),))
    monitor = health.HealthServicer()
    health_pb2_grpc.add_HealthServicer_to_server(monitor, server)
    for name in ("", *wire.SERVICE_PATHS):
        await monitor.set(name, health_pb2.HealthCheckResponse.SERVING)
    reflection.enable_server_reflection((wire.SERVICE, reflection.SERVICE_NAME), server, pool=wire.pool)
    return monitor


def _answering(procedure: Callable, method: wire.Method) -> Callable:
    """A gRPC handler of raw request bytes that turns what the procedure raises into a status."""

    async def handler(data: bytes, context: grpc.aio.ServicerContext):
        try:
            return await procedure(wire.parse(method.request, data))
        except UnsupportedError as error:
            code, text = grpc.StatusCode.UNIMPLEMENTED, str(error)
        except NurecSimError as error:
            code, text = wire.code_of(error), str(error)
        except Exception as error:
            log.exception("%s failed", procedure.__name__)
            code, text = grpc.StatusCode.INTERNAL, describe(error)
        await context.abort(code, text[:_MAX_TEXT])

    return handler
