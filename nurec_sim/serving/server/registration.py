"""Puts objects whose coroutines are named like the procedures of a service on a gRPC server."""

from __future__ import annotations

import contextlib
import logging
import re
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from typing import Any

import grpc
from google.protobuf import message_factory
from google.protobuf.descriptor import MethodDescriptor

from nurec_sim.errors import NurecSimError
from nurec_sim.serving import wire
from nurec_sim.serving.calls import current_call
from nurec_sim.serving.sensor_service import describe

log = logging.getLogger(__name__)

HANDLER_KINDS = {
    (False, False): grpc.unary_unary_rpc_method_handler,
    (False, True): grpc.unary_stream_rpc_method_handler,
    (True, False): grpc.stream_unary_rpc_method_handler,
    (True, True): grpc.stream_stream_rpc_method_handler,
}
"""What makes a handler, by whether requests and replies are streams."""
_MAX_TEXT = 2000  # a status text travels in the HTTP/2 trailers, which end at 8 KiB


@dataclass(frozen=True)
class Service:
    """A service and who answers it.

    Attributes:
        name: full name in ``protos/``.
        implementation: an object with a method for each procedure, its name in small_letters. It takes the request
            message, or an asynchronous iterator of them where the client streams; it is a coroutine that gives the
            reply message, or an asynchronous generator of them where the server streams. Errors become a status.
        paths: the names under which it answers; its own if none.
        prepare: awaited before every procedure; what it raises becomes a status too.
    """

    name: str
    implementation: Any
    paths: tuple[str, ...] = ()
    prepare: Callable[[], Awaitable[None]] | None = None


def register(server: grpc.aio.Server, service: Service) -> None:
    """Makes a server answer a service.

    Raises:
        AttributeError: the implementation lacks a procedure.
    """
    handlers = {
        method.name: _handler(getattr(service.implementation, _python_name(method.name)), method, service.prepare)
        for method in wire.pool.FindServiceByName(service.name).methods
    }
    # The package of a message is not on the wire, so one set of handlers serves every spelling of the service.
    for path in service.paths or (service.name,):
        server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(path, handlers),))


def _python_name(procedure: str) -> str:
    """``RenderCamera`` as ``render_camera``."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", procedure).lower()


def _handler(
    procedure: Callable, method: MethodDescriptor, prepare: Callable[[], Awaitable[None]] | None
) -> grpc.RpcMethodHandler:
    """A handler of raw bytes: what cannot be parsed gets an answer of ours, and the gate sees how long a reply is."""
    kind = message_factory.GetMessageClass(method.input_type)

    def read(data: bytes):
        request = wire.parse(kind, data)
        call = current_call()
        call.scene = call.scene or _scene_of(request)
        return request

    async def read_all(parts: AsyncIterator[bytes]) -> AsyncIterator:
        async for part in parts:
            yield read(part)

    take = read_all if method.client_streaming else read

    async def answer(data, context: grpc.aio.ServicerContext) -> bytes:
        try:
            if prepare is not None:
                await prepare()
            return (await procedure(take(data))).SerializeToString()
        except Exception as error:
            await _refuse(procedure, error, context)
            raise  # not reached: the line above raises

    async def stream(data, context: grpc.aio.ServicerContext) -> AsyncIterator[bytes]:
        try:
            if prepare is not None:
                await prepare()
            async with contextlib.aclosing(procedure(take(data))) as replies:
                async for reply in replies:
                    yield reply.SerializeToString()
        except Exception as error:
            await _refuse(procedure, error, context)

    return HANDLER_KINDS[method.client_streaming, method.server_streaming](
        stream if method.server_streaming else answer
    )


async def _refuse(procedure: Callable, error: Exception, context: grpc.aio.ServicerContext) -> None:
    """Ends a call with the status of an error."""
    if isinstance(error, grpc.aio.AbortError):
        raise error
    if not isinstance(error, NurecSimError):
        log.error("%s failed", getattr(procedure, "__name__", "a procedure"), exc_info=error)
    await context.abort(wire.code_of(error), describe(error)[:_MAX_TEXT])


def _scene_of(request) -> str:
    """The scene that a request names, or the first item of a batch."""
    if "scene_id" in request.DESCRIPTOR.fields_by_name:
        return str(request.scene_id)
    for name in ("items", "rgb_requests", "lidar_requests"):
        if name in request.DESCRIPTOR.fields_by_name and getattr(request, name):
            first = getattr(request, name)[0]
            return _scene_of(first.request if name == "items" else first)
    return ""
