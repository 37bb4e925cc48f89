"""Calls and how they reach procedures: the context of a call, parsing of requests, errors as statuses.

A procedure is a coroutine: message in, message out. What it raises becomes a gRPC status.
"""

from __future__ import annotations

import contextlib
import logging
import math
import re
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

import grpc
from google.protobuf import message_factory
from google.protobuf.descriptor import MethodDescriptor
from google.protobuf.message import DecodeError

from nurec_sim.errors import DeadlinePassedError, NurecSimError, RequestError
from nurec_sim.serving import wire

log = logging.getLogger(__name__)

HANDLER_KINDS = {
    (False, False): grpc.unary_unary_rpc_method_handler,
    (False, True): grpc.unary_stream_rpc_method_handler,
    (True, False): grpc.stream_unary_rpc_method_handler,
    (True, True): grpc.stream_stream_rpc_method_handler,
}
"""What makes a handler, by whether requests and replies are streams."""
_MAX_TEXT = 2000  # a status text travels in the HTTP/2 trailers, which end at 8 KiB


@dataclass
class Call:
    """One call in progress."""

    method: str
    """Last part of the service's name, and the procedure: ``SensorsimService/render_rgb``."""
    peer: str = ""
    """Address and port of the client, as gRPC spells it: ``ipv4:127.0.0.1:50123``."""
    metadata: Mapping[str, str] = field(default_factory=dict)
    """Texts that came beside the request, by lower-case name; without the token."""
    deadline_s: float = math.inf
    """When the client stops waiting, on the clock of ``time.monotonic``."""
    scene: str = ""
    """The scene that the request names, for the log; whoever reads the request sets it."""

    @property
    def client(self) -> tuple[str, str]:
        """Whose call it is: the address, and the connection, for several programs may share an address."""
        return address_of(self.peer), self.peer

    def check_deadline(self) -> None:
        """Cancels work whose deadline has passed.

        Raises:
            DeadlinePassedError: the client has stopped waiting.
        """
        late_s = time.monotonic() - self.deadline_s
        if late_s >= 0:
            raise DeadlinePassedError(f"the deadline passed {1e3 * late_s:.0f} ms before the work was done")


def address_of(peer: str) -> str:
    """The address of a client without its port, which differs between connections: ``ipv4:127.0.0.1``."""
    return peer.rsplit(":", 1)[0] if peer.startswith(("ipv4:", "ipv6:")) else peer


_current: ContextVar[Call] = ContextVar("call")


def current_call() -> Call:
    """The call that the running task answers; one without a client outside of any."""
    return _current.get(Call(""))


def enter_call(call: Call) -> None:
    """Makes ``call`` the one that the running task, and the tasks that it starts from now on, answer."""
    _current.set(call)


# ------------------------------------------------------------------------------------------------------ procedures


@dataclass(frozen=True)
class Service:
    """A service and who answers it.

    Attributes:
        name: full name in ``protos/``.
        implementation: an object with a method for each procedure, its name in small_letters. It takes the request
            message, or an asynchronous iterator of them where the client streams; it is a coroutine that gives the
            reply message, or an asynchronous generator of them where the server streams. Errors become a status.
        paths: the names under which it answers; its own if none.
        on_metadata: awaited before a procedure, by the name of the metadata that the call has to come with; what it
            raises becomes a status too.
    """

    name: str
    implementation: Any
    paths: tuple[str, ...] = ()
    on_metadata: Mapping[str, Callable[[], Awaitable[None]]] = field(default_factory=dict)


def register(server: grpc.aio.Server, service: Service) -> None:
    """Makes a server answer a service.

    Raises:
        AttributeError: the implementation lacks a procedure.
    """
    handlers = {
        method.name: _handler(getattr(service.implementation, _python_name(method.name)), method, service)
        for method in wire.pool.FindServiceByName(service.name).methods
    }
    # The package of a message is not on the wire, so one set of handlers serves every spelling of the service.
    for path in service.paths or (service.name,):
        server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(path, handlers),))


def _python_name(procedure: str) -> str:
    """``RenderCamera`` as ``render_camera``."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", procedure).lower()


def _handler(procedure: Callable, method: MethodDescriptor, service: Service) -> grpc.RpcMethodHandler:
    """A handler of raw bytes: what cannot be parsed gets an answer of ours, and the gate sees how long a reply is."""
    kind = message_factory.GetMessageClass(method.input_type)

    async def prepare() -> None:
        metadata = current_call().metadata
        for name, function in service.on_metadata.items():
            if name in metadata:
                await function()

    def read(data: bytes):
        request = parse(kind, data)
        call = current_call()
        call.scene = call.scene or _scene_of(request)
        return request

    async def read_all(parts: AsyncIterator[bytes]) -> AsyncIterator:
        async for part in parts:
            yield read(part)

    take = read_all if method.client_streaming else read

    async def answer(data, context: grpc.aio.ServicerContext) -> bytes:
        try:
            await prepare()
            return (await procedure(take(data))).SerializeToString()
        except Exception as error:
            await _refuse(procedure, error, context)
            raise  # not reached: the line above raises

    async def stream(data, context: grpc.aio.ServicerContext) -> AsyncIterator[bytes]:
        try:
            await prepare()
            async with contextlib.aclosing(procedure(take(data))) as replies:
                async for reply in replies:
                    yield reply.SerializeToString()
        except Exception as error:
            await _refuse(procedure, error, context)

    return HANDLER_KINDS[method.client_streaming, method.server_streaming](
        stream if method.server_streaming else answer
    )


def parse(kind: Any, data: bytes) -> Any:
    """The message of class ``kind`` in ``data``.

    Raises:
        RequestError: the bytes are no such message.
    """
    try:
        return kind.FromString(data)
    except DecodeError as error:
        raise RequestError(f"the {len(data)} bytes received are no {kind.DESCRIPTOR.name} message") from error


async def _refuse(procedure: Callable, error: Exception, context: grpc.aio.ServicerContext) -> None:
    """Ends a call with the status of an error."""
    if isinstance(error, grpc.aio.AbortError):
        raise error
    if not isinstance(error, NurecSimError):
        log.error("%s failed", getattr(procedure, "__name__", "a procedure"), exc_info=error)
    await context.abort(wire.code_of(error), wire.text_of(error)[:_MAX_TEXT])


def _scene_of(request) -> str:
    """The scene that a request names, or the first item of a batch."""
    if "scene_id" in request.DESCRIPTOR.fields_by_name:
        return str(request.scene_id)
    for name in ("items", "rgb_requests", "lidar_requests"):
        if name in request.DESCRIPTOR.fields_by_name and getattr(request, name):
            first = getattr(request, name)[0]
            return _scene_of(first.request if name == "items" else first)
    return ""
