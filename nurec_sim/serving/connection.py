"""A connection to one service of a server: TLS, token, time limits, and the server's errors raised as ours."""

from __future__ import annotations

import contextlib
import functools
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypedDict

import grpc
from google.protobuf import message_factory

from nurec_sim.errors import RequestError, ServerError
from nurec_sim.files.closing import Closing
from nurec_sim.serving import channels, wire

_RETRY = {
    "maxAttempts": 5,
    "initialBackoff": "0.2s",
    "maxBackoff": "2s",
    "backoffMultiplier": 2.0,
    "retryableStatusCodes": ["UNAVAILABLE"],
}


class ConnectionOptions(TypedDict, total=False):
    """Keywords of ``Connection``; all may be left out.

    ``timeout_s`` (300): for one call. ``connect_timeout_s`` (10): for the first contact. ``token``: the bearer token
    of the server. ``root_ca``: PEM file of the root certificates that verify the server's; plain text without.
    ``client_cert`` and ``client_key``: PEM files of the certificate to show, for mutual TLS, and of its private key.
    """

    timeout_s: float
    connect_timeout_s: float
    token: str | None
    root_ca: Path | None
    client_cert: Path | None
    client_key: Path | None


class Connection(Closing):
    """One service of a server; what its clients share.

    The first call waits ``connect_timeout_s`` for a server that is starting. Later ones are repeated for some 3 s when
    it goes away in between, so that a server that died is known soon; one that is frozen costs one ``timeout_s``, then
    ``connect_timeout_s`` per call. They raise the errors of ``nurec_sim.errors`` that the server raised, and
    ``ServerError`` when it cannot be reached in time or failed. Use it as a context manager, or call ``close``. Safe to
    use from many threads.

    Args:
        address: ``host:port``.
        service: full name in ``protos/``.
        timeout_s: for one call.
        connect_timeout_s: for the first contact; at most ``timeout_s``.
        token: the bearer token of the server; None if it needs none.
        root_ca: PEM file of the root certificates that verify the server's; plain text if None.
        client_cert: PEM file of the certificate to show, for mutual TLS.
        client_key: PEM file of its private key.

    Raises:
        ServerError: a PEM file cannot be read, or a certificate comes without its key or without ``root_ca``.
    """

    def __init__(
        self,
        address: str,
        service: str,
        *,
        timeout_s: float = 300.0,
        connect_timeout_s: float = 10.0,
        token: str | None = None,
        root_ca: Path | None = None,
        client_cert: Path | None = None,
        client_key: Path | None = None,
    ) -> None:
        self.address, self._timeout_s = address, timeout_s
        self._connect_timeout_s, self._reached = min(connect_timeout_s, timeout_s), False
        self._metadata = [("authorization", f"Bearer {token}")] if token else []
        self._open = functools.partial(open_channel, address, root_ca, client_cert, client_key)
        self._channel = self._open()
        methods = wire.pool.FindServiceByName(service).methods
        self._procedures = {method.name: _procedure(self._channel, service, method) for method in methods}

    def close(self) -> None:
        """Ends the connection."""
        self._channel.close()

    def _options(self, timeout_s: float | None) -> Mapping[str, Any]:
        """Keywords of every call, once the server has been reached; None for no time limit.

        Raises:
            ServerError: it cannot be reached in time.
        """
        if not self._reached:
            self._wait_for_contact()
        return {"timeout": timeout_s, "wait_for_ready": False, "metadata": self._metadata}

    def _wait_for_contact(self) -> None:
        """Waits for a new connection: an existing one does not show whether the server still responds."""
        with self._open() as channel:
            ready = grpc.channel_ready_future(channel)
            try:
                ready.result(self._connect_timeout_s)
            except grpc.FutureTimeoutError:
                raise ServerError(
                    f"{self.address}: the server cannot be reached within {self._connect_timeout_s:g} s"
                ) from None
            finally:
                ready.cancel()
        self._reached = True

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        """``our_errors``; a call without an answer in time puts the contact in doubt."""
        try:
            with our_errors(self.address):
                yield
        except ServerError as error:
            cause = error.__cause__
            if isinstance(cause, grpc.RpcError) and cause.code() is grpc.StatusCode.DEADLINE_EXCEEDED:
                self._reached = False
            raise

    def _call(self, name: str, request: Any) -> Any:
        """The reply of a procedure that streams nothing."""
        with self._errors():
            return self._procedures[name](request, **self._options(self._timeout_s))


def open_channel(
    address: str, root_ca: Path | None = None, client_cert: Path | None = None, client_key: Path | None = None
) -> grpc.Channel:
    """A channel whose calls are retried while the server is unavailable.

    Args:
        address: ``host:port``.
        root_ca: PEM file of the root certificates to verify the server's; plain text if None.
        client_cert: PEM file of the certificate to show, for mutual TLS.
        client_key: PEM file of its private key.

    Raises:
        ServerError: a PEM file cannot be read, or a certificate comes without its key or without ``root_ca``.
    """
    options = channel_options({"methodConfig": [{"name": [{}], "retryPolicy": _RETRY}]})
    return channels.open_channel(address, root_ca, client_cert, client_key, options)


def channel_options(service_config: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Options of every channel of ours: long messages, quick new attempts; and which calls are repeated."""
    return [
        ("grpc.max_receive_message_length", wire.MAX_MESSAGE_BYTES),
        ("grpc.max_send_message_length", wire.MAX_MESSAGE_BYTES),
        ("grpc.max_reconnect_backoff_ms", 1000),
        ("grpc.use_local_subchannel_pool", 1),  # channels of one process must not share a connection
        channels.NO_PROXY,
        ("grpc.service_config", json.dumps(service_config)),
    ]


@contextlib.contextmanager
def our_errors(address: str) -> Iterator[None]:
    """Statuses of gRPC become the errors of ours that the server raised; ``ServerError`` where none corresponds."""
    try:
        yield
    except grpc.RpcError as error:
        ours = wire.error_of(error.code(), error.details() or "no reason given")
        raise (ServerError(f"{address}: {ours}") if isinstance(ours, ServerError) else ours) from error


@contextlib.contextmanager
def malformed_reply(address: str, procedure: str) -> Iterator[None]:
    """What cannot be read in a reply is the server's fault: the readers' ``RequestError`` becomes ``ServerError``."""
    try:
        yield
    except RequestError as error:
        raise ServerError(f"{address}: malformed reply to {procedure}: {error}") from error


def _procedure(channel: grpc.Channel, service: str, method: Any) -> Any:
    """A callable of the procedure's kind."""
    kinds = {
        (False, False): channel.unary_unary,
        (False, True): channel.unary_stream,
        (True, False): channel.stream_unary,
    }
    request, reply = (message_factory.GetMessageClass(kind) for kind in (method.input_type, method.output_type))
    make = kinds[method.client_streaming, method.server_streaming]
    return make(f"/{service}/{method.name}", request.SerializeToString, reply.FromString)
