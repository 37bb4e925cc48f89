"""Server of the egodriver interface, for AlpaSim's runtime or our own loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from nurec_sim.serving.driver.service import DriverOptions, DriverService
from nurec_sim.serving.server import GrpcServer, ServerOptions, Service
from nurec_sim.serving.wire.driving import DRIVER_SERVICE
from nurec_sim.types import Policy


class DriverServer(GrpcServer):
    """A driver in a background thread (``start``, ``stop``, or ``with``), or in the running event loop (``run``).

    ::

        with DriverServer(CameraRoadFollower, port=0) as address:
            rollout = run_rollout(scenario, RemotePolicy(address), sense, facts)

    Args:
        make_policy: makes the policy of each session, such as its class.
        host: name or address to listen at; ``0.0.0.0`` for all.
        port: 0 picks a free one.
        options: what the driver allows.
        server_options: how it listens, and to whom; the limit of a message is that of ``options``.
    """

    def __init__(
        self,
        make_policy: Callable[[], Policy],
        host: str = "127.0.0.1",
        port: int = 6789,
        *,
        options: DriverOptions | None = None,
        server_options: ServerOptions | None = None,
    ) -> None:
        chosen = options or DriverOptions()
        size = chosen.max_message_bytes
        listening = replace(server_options or ServerOptions(), max_request_bytes=size, max_message_bytes=size)
        super().__init__(lambda stop: _Driver(make_policy, chosen, stop), host, port, options=listening)


class _Driver:
    """The driver service as an ``Application``."""

    def __init__(
        self, make_policy: Callable[[], Policy], options: DriverOptions, request_stop: Callable[[], None]
    ) -> None:
        self._service = DriverService(make_policy, options, request_stop)
        self.services: Sequence[Service] = (Service(DRIVER_SERVICE, self._service),)
        self._expiry: asyncio.Task[None] | None = None

    async def warm_up(self) -> None:
        self._expiry = asyncio.create_task(self._service.expire())

    def gauges(self) -> Mapping[str, tuple[str, float]]:
        return {"driving_sessions": ("Open driving sessions", len(self._service.session_ids))}

    def close(self) -> None:
        if self._expiry is not None:
            self._expiry.cancel()
        self._service.close()
