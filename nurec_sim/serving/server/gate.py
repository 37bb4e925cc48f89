"""Interceptor for every call: authentication, rate and memory limits, deadlines, metrics and log."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import math
import time
from collections import Counter, OrderedDict
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator

import grpc

from nurec_sim.serving.calls import HANDLER_KINDS, Call, address_of, enter_call
from nurec_sim.serving.server.options import ServerOptions, shows_token
from nurec_sim.serving.server.telemetry import Telemetry, log_call

Code = grpc.StatusCode
_HEALTH = "Health/"
_DRAIN_STEP_S = 0.02
_QUIET_S = 0.1
"""A client that has read its last reply calls again within this time, and should get UNAVAILABLE."""
_LONGEST_WAIT_FOR_QUIET_S = 1.0
_SECRETS = ("authorization", "cookie")
_MOST_PEERS = 10_000
"""Addresses whose rates are remembered."""


class RateLimit:
    """A token bucket for each client address: a call takes one token; tokens are refilled at a constant rate.

    Args:
        per_s: tokens refilled per second.
        burst: capacity of the bucket.
        clock: seconds, never going back.
    """

    def __init__(self, per_s: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s, self._burst, self._clock = per_s, float(burst), clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()  # address: tokens, when they were counted

    def allows(self, address: str) -> bool:
        """Whether a call may begin now; takes its token if so."""
        now = self._clock()
        tokens, then = self._buckets.pop(address, (self._burst, now))
        tokens = min(self._burst, tokens + self._per_s * (now - then))
        allowed = tokens >= 1
        self._buckets[address] = (tokens - 1 if allowed else tokens, now)
        if len(self._buckets) > _MOST_PEERS:
            self._buckets.popitem(last=False)  # least recently used
        return allowed


class UnreadReplies:
    """Bytes of replies that clients have not received yet.

    Args:
        most: in all; one connection may leave a quarter of it, or a single reply of any size.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._by_peer: Counter[str] = Counter()

    @property
    def total(self) -> int:
        """Bytes in all."""
        return self._by_peer.total()

    def refusal(self, peer: str, size: int = 0) -> str | None:
        """Why a reply of ``size`` bytes cannot be held for a connection; None if it can."""
        unread = self._by_peer[peer] if peer in self._by_peer else 0
        if unread and unread + size > self._most // 4:
            return f"{unread:,} bytes of replies wait to be read by this connection; read them first"
        if (total := self.total) and total + size > self._most:
            return f"{total:,} bytes of replies wait to be read by clients of this server; try again later"
        return None

    def add(self, peer: str, size: int) -> None:
        """Counts a reply that is sent."""
        self._by_peer[peer] += size

    def remove(self, peer: str, size: int) -> None:
        """Counts a reply that was received, or whose client disconnected."""
        self._by_peer[peer] -= size
        if self._by_peer[peer] <= 0:
            del self._by_peer[peer]


class Gate(grpc.aio.ServerInterceptor):
    """Admits or refuses calls of every service; health is always answered.

    Args:
        options: what is allowed.
        telemetry: counts every call that ended; None for no metrics.
    """

    def __init__(self, options: ServerOptions, telemetry: Telemetry | None = None) -> None:
        self._options = options
        self.telemetry = telemetry
        self.calls = 0
        """Calls in progress, but for those that ask for health."""
        self._stopping = False
        self._last_change_s = -math.inf
        self.unread = UnreadReplies(options.max_unread_bytes)
        self._rate = RateLimit(options.rate_per_s, options.rate_burst) if options.rate_per_s else None

    async def drain(self, seconds: float) -> None:
        """Refuses new calls; waits for calls in progress, for replies to be read, and for a pause without calls.

        gRPC's own way to stop would cut off calls that it has received and not begun with CANCELLED, which clients do
        not take for a reason to ask elsewhere.
        """
        self._stopping = True
        end = time.monotonic() + seconds
        while (self.calls or self.unread.total) and time.monotonic() < end:
            await asyncio.sleep(_DRAIN_STEP_S)
        end = min(end, time.monotonic() + _LONGEST_WAIT_FOR_QUIET_S)
        while time.monotonic() < min(end, self._last_change_s + _QUIET_S):
            await asyncio.sleep(_DRAIN_STEP_S)

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[grpc.RpcMethodHandler]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> grpc.RpcMethodHandler:
        """The handler of a call with the gate before it."""
        handler = await continuation(handler_call_details)
        if handler is None:
            self._note("unknown", Code.UNIMPLEMENTED, 0.0, Call("unknown"))
            return handler
        service, _, procedure = handler_call_details.method.rpartition("/")
        name = f"{service.rpartition('.')[2].removeprefix('/')}/{procedure}"
        streams = handler.request_streaming, handler.response_streaming
        inner = next(
            behaviour
            for behaviour in (handler.unary_unary, handler.unary_stream, handler.stream_unary, handler.stream_stream)
            if behaviour is not None
        )
        through = self._streaming if inspect.isasyncgenfunction(inner) else self._answering
        return HANDLER_KINDS[streams](through(inner, name), handler.request_deserializer, handler.response_serializer)

    def _answering(self, inner: Callable, name: str) -> Callable:
        async def behaviour(request, context: grpc.aio.ServicerContext):
            with self._passing(name, context):
                await self._admit(name, context)
                reply = await inner(request, context)
                if isinstance(reply, bytes):
                    await self._hold(reply, context)
                return reply

        return behaviour

    def _streaming(self, inner: Callable, name: str) -> Callable:
        async def behaviour(request, context: grpc.aio.ServicerContext) -> AsyncIterator:
            with self._passing(name, context):
                await self._admit(name, context)
                async with contextlib.aclosing(inner(request, context)) as replies:
                    async for reply in replies:
                        yield reply

        return behaviour

    @contextlib.contextmanager
    def _passing(self, name: str, context: grpc.aio.ServicerContext) -> Iterator[None]:
        """Notes how a call ends."""
        remaining_s = context.time_remaining()
        metadata = {key: value for key, value in context.invocation_metadata() or () if isinstance(value, str)}
        deadline_s = math.inf if remaining_s is None else time.monotonic() + remaining_s
        public = {key: value for key, value in metadata.items() if key not in _SECRETS}
        call = Call(name, context.peer(), public, deadline_s)
        enter_call(call)
        counted = not name.startswith(_HEALTH)
        self._change_calls(counted)
        begin, code = time.perf_counter(), Code.OK
        try:
            yield
            code = _code(context) or Code.OK
        except (asyncio.CancelledError, GeneratorExit):
            code = Code.DEADLINE_EXCEEDED if time.monotonic() >= deadline_s else Code.CANCELLED
            raise
        except BaseException:
            code = _code(context) or Code.UNKNOWN
            raise
        finally:
            self._change_calls(-counted)
            self._note(name, code, time.perf_counter() - begin, call)

    def _change_calls(self, by: int) -> None:
        if by:
            self.calls += by
            self._last_change_s = time.monotonic()

    async def _admit(self, name: str, context: grpc.aio.ServicerContext) -> None:
        if name.startswith(_HEALTH):
            return
        if self._stopping:
            await context.abort(Code.UNAVAILABLE, "the server is stopping")
        options, peer = self._options, context.peer()
        if options.token is not None and not shows_token(dict(context.invocation_metadata() or ()), options.token):
            await context.abort(
                Code.UNAUTHENTICATED, "this server wants 'authorization: Bearer <token>' with each call"
            )
        if self.calls > options.max_calls:
            await context.abort(Code.RESOURCE_EXHAUSTED, f"{options.max_calls} calls are in progress; try again later")
        if self._rate is not None and not self._rate.allows(address_of(peer)):
            text = f"more than {options.rate_per_s:g} calls a second from this address; try again later"
            await context.abort(Code.RESOURCE_EXHAUSTED, text)
        if refusal := self.unread.refusal(peer):
            await context.abort(Code.RESOURCE_EXHAUSTED, refusal)
        if context.time_remaining() == 0:
            await context.abort(Code.DEADLINE_EXCEEDED, "the deadline passed before the call began")

    async def _hold(self, reply: bytes, context: grpc.aio.ServicerContext) -> None:
        """Counts a reply as unread until its client has received it; refuses it if too many bytes are unread."""
        peer, size = context.peer(), len(reply)
        if refusal := self.unread.refusal(peer, size):
            await context.abort(Code.RESOURCE_EXHAUSTED, refusal)
        self.unread.add(peer, size)
        context.add_done_callback(lambda _: self._release(peer, size))

    def _release(self, peer: str, size: int) -> None:
        self.unread.remove(peer, size)
        self._last_change_s = time.monotonic()

    def _note(self, name: str, code: grpc.StatusCode, seconds: float, call: Call) -> None:
        if self.telemetry is not None:
            self.telemetry.count(name, code.name, seconds)
        log_call(name, code.name, seconds, call.scene, call.peer)


_CODE_OF_NUMBER = {code.value[0]: code for code in grpc.StatusCode}


def _code(context: grpc.aio.ServicerContext) -> grpc.StatusCode | None:
    """The status that a handler has set; the asyncio flavour of gRPC gives it as a number or an enum."""
    code = context.code()
    return code if isinstance(code, grpc.StatusCode) or code is None else _CODE_OF_NUMBER.get(code)
