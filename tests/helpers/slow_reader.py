"""A client that asks over HTTP/2 and then does not read: just enough of RFC 9113 to do so on purpose."""

from __future__ import annotations

import socket
import struct

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
DATA, HEADERS, SETTINGS = 0, 1, 4
END_STREAM, END_HEADERS = 1, 4
INITIAL_WINDOW_SIZE = 4


def _frame(kind: int, flags: int, stream: int, payload: bytes) -> bytes:
    return len(payload).to_bytes(3, "big") + bytes([kind, flags]) + struct.pack(">I", stream) + payload


def _header(name: str, value: str) -> bytes:
    """A literal field that is not to be indexed, in HPACK (RFC 7541 6.2.2)."""
    assert len(name) < 127 and len(value) < 127
    return bytes([0, len(name)]) + name.encode() + bytes([len(value)]) + value.encode()


class SlowReader:
    """A connection whose replies may not exceed ``window`` bytes, and are read only on request."""

    def __init__(self, address: str, window: int = 1) -> None:
        host, port = address.rsplit(":", 1)
        self._socket = socket.create_connection((host, int(port)), timeout=10)
        self._socket.sendall(PREFACE + _frame(SETTINGS, 0, 0, struct.pack(">HI", INITIAL_WINDOW_SIZE, window)))
        self._next_stream = 1

    def ask(self, path: str, message: bytes) -> None:
        """Sends a unary call and goes on."""
        fields = {
            ":method": "POST",
            ":scheme": "http",
            ":path": path,
            ":authority": "localhost",
            "te": "trailers",
            "content-type": "application/grpc",
        }
        stream, self._next_stream = self._next_stream, self._next_stream + 2
        head = b"".join(_header(name, value) for name, value in fields.items())
        body = b"\0" + struct.pack(">I", len(message)) + message
        self._socket.sendall(_frame(HEADERS, END_HEADERS, stream, head) + _frame(DATA, END_STREAM, stream, body))

    def answered(self) -> bool:
        """Reads until a call's trailers end its stream; False if the connection ends before."""
        while True:
            head = self._read(9)
            if len(head) < 9:
                return False
            kind, flags = head[3], head[4]
            self._read(int.from_bytes(head[:3], "big"))
            if kind == HEADERS and flags & END_STREAM:
                return True

    def _read(self, count: int) -> bytes:
        data = b""
        while len(data) < count and (part := self._socket.recv(count - len(data))):
            data += part
        return data

    def __enter__(self) -> SlowReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
