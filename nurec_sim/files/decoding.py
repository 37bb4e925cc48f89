"""Decoding of untrusted input within limits that are checked before memory is allocated.

A few bytes can request gigabytes: an array by the shape in its header, an archive by compressed zeros, an image by its
size, a text by the objects that its characters become. The limits here apply to all readers.
"""

from __future__ import annotations

import io
import json
import math
import struct
import zipfile
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_NO_JPEG_SIZE = (0xC4, 0xC8, 0xCC)  # tables that sit between the frame headers C0..CF
_ZIP_END, _ZIP64_END, _ZIP64_PLACE = struct.Struct("<4s4H2LH"), struct.Struct("<4sQ2H2L4Q"), struct.Struct("<4sLQL")
_CHUNK = 1 << 20


@dataclass(frozen=True)
class Limits:
    """Maximum sizes of decoded input; driving logs and scenes stay well below them."""

    file_bytes: int = 1 << 30
    """One file of a clip."""
    growth: int = 64
    """Maximum expansion ratio of compressed data, in addition to ``free_bytes``."""
    free_bytes: int = 64 << 20
    directory_bytes: int = 16 << 20
    """The central directory of a ZIP file: some 150,000 members, which take ten times as much memory."""
    array_bytes: int = 128 << 20
    """All arrays of one ``.npz`` file together."""
    sweep_points: int = 1 << 21
    """Points of one LiDAR sweep; each takes up to 400 bytes during motion compensation."""
    image_pixels: int = 7680 * 4320
    """Pixels of one image, the renderer's own maximum; three bytes each."""
    json_bytes: int = 128 << 20
    json_values: int = 8_000_000
    """Numbers, strings, lists and objects of one JSON text; 30 to 70 bytes each."""
    xml_bytes: int = 128 << 20
    xml_tags: int = 4_000_000
    """Start and end tags of one XML text; 100 to 400 bytes each."""
    msgpack_values: int = 1 << 18
    """Names, settings and shapes; an array counts as one value."""
    table_rows: int = 1 << 20
    """Rows of one parquet table."""
    yaml_bytes: int = 1 << 18
    """Some characters of YAML take a thousand bytes of memory each to parse, and much time."""


LIMITS = Limits()


class TooMuchError(ValueError):
    """More than ``Limits`` allow. The text continues a sentence that begins with the input's name: "promises ..."."""


# --------------------------------------------------------------------------------------------------------------- zip


def check_directory(file: BinaryIO) -> None:
    """Checks that the central directory of a ZIP file is small enough to be read; the file is left at its start.

    Files that are not ZIP archives pass: opening them will fail with a proper error.

    Raises:
        TooMuchError: it is too large.
    """
    size = file.seek(0, io.SEEK_END)
    start = max(0, size - _ZIP_END.size - (1 << 16))  # a comment of up to 64 KiB may follow it
    file.seek(start)
    tail = file.read()
    # End-of-central-directory record (APPNOTE 4.3.16), searched backwards as every reader does.
    at = tail.rfind(b"PK\5\6")
    if 0 <= at <= len(tail) - _ZIP_END.size:
        directory = _ZIP_END.unpack_from(tail, at)[5]
        # A ZIP64 locator (4.3.15) directly before it points to the 64-bit record, whose size field then counts.
        place = at - _ZIP64_PLACE.size
        if place >= 0 and tail[place : place + 4] == b"PK\6\7":
            file.seek(min(_ZIP64_PLACE.unpack_from(tail, place)[2], size))
            end = file.read(_ZIP64_END.size)
            if len(end) == _ZIP64_END.size:
                directory = max(directory if directory < 0xFFFFFFFF else 0, _ZIP64_END.unpack(end)[8])
        if directory > LIMITS.directory_bytes:
            raise TooMuchError(f"lists its members in {directory:,} bytes; at most {LIMITS.directory_bytes:,} are read")
    file.seek(0)


def unpacked_limit(packed_bytes: int) -> int:
    """Maximum size that compressed data of a given size may expand to."""
    return LIMITS.growth * packed_bytes + LIMITS.free_bytes


def check_member(info: zipfile.ZipInfo, most_bytes: int) -> None:
    """Checks the declared size of a ZIP member; ``zipfile`` never reads more than the declared size.

    Raises:
        TooMuchError: it is too large, or its expansion ratio is.
    """
    if info.file_size > most_bytes:
        raise TooMuchError(f"unpacks to {info.file_size} bytes; at most {most_bytes} are allowed")
    if info.file_size > (most := unpacked_limit(info.compress_size)):
        raise TooMuchError(f"unpacks from {info.compress_size} to {info.file_size} bytes; at most {most} are allowed")


# ------------------------------------------------------------------------------------------------------------ arrays


def npz_arrays(data: bytes) -> dict[str, np.ndarray]:
    """The arrays of an ``.npz`` file, compressed or stored; nothing in it is unpickled.

    Every header is read and counted before memory is allocated for its array.

    Raises:
        TooMuchError: the arrays are larger than allowed.
        ValueError: a member is not an array of plain values, or holds fewer bytes than declared.
        zipfile.BadZipFile, zlib.error and other errors of ``zipfile``: the file is damaged.
    """
    arrays: dict[str, np.ndarray] = {}
    total = 0
    file = io.BytesIO(data)
    check_directory(file)
    with zipfile.ZipFile(file) as package:
        for info in package.infolist():
            name = info.filename.removesuffix(".npy")
            with package.open(info) as member:
                shape, fortran_order, dtype = _npy_header(member, name)
                # At least one byte per element: items of size 0 (``S0``) would allow any shape.
                total += math.prod(shape) * max(dtype.itemsize, 1)
                if total > LIMITS.array_bytes:
                    raise TooMuchError(
                        f"promises {name} of {dtype} {shape}, {total:,} bytes in all; "
                        f"at most {LIMITS.array_bytes:,} are read"
                    )
                array = np.empty(shape[::-1] if fortran_order else shape, dtype)
                _fill(member, array, name)
            arrays[name] = array.T if fortran_order else array
    return arrays


def _npy_header(member: Any, name: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(member)
    if version == (1, 0):
        shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(member)
    elif version == (2, 0):
        shape, fortran_order, dtype = np.lib.format.read_array_header_2_0(member)
    else:
        raise ValueError(f"{name} is an array of format {version}; 1.0 and 2.0 are read")
    if dtype.kind not in "biufcSU" or any(n < 0 for n in shape):
        raise ValueError(f"{name} must hold plain values, got {dtype} {shape}")
    return tuple(int(n) for n in shape), fortran_order, dtype


def _fill(member: Any, array: np.ndarray, name: str) -> None:
    """Reads an array's values in chunks: pages of the array beyond the available data are never touched."""
    if not array.nbytes:
        return
    target, at = array.reshape(-1).view(np.uint8).data, 0
    while at < len(target):
        piece = member.read(min(_CHUNK, len(target) - at))
        if not piece:
            raise ValueError(f"{name} promises {len(target):,} bytes but holds {at:,}")
        target[at : at + len(piece)] = piece
        at += len(piece)
    if member.read(1):
        raise ValueError(f"{name} holds more than the {len(target):,} bytes that it promises")


# ---------------------------------------------------------------------------------------------------------- pictures


def image_size(data: bytes) -> tuple[int, int]:
    """Width and height of a PNG or JPEG file from its header; no pixels are decoded.

    Raises:
        ValueError: neither format, truncated, or no pixels. The text continues a sentence begun by the file's name.
    """
    size: tuple[int, int] | None
    if data.startswith(_PNG):
        # IHDR is the first chunk: 8 bytes of signature, 4 of length, its name, then width and height.
        header, complete = data[12:24], b"IEND" in data[-64:]
        size = struct.unpack(">II", header[4:]) if len(header) == 12 and header.startswith(b"IHDR") else None
    elif data.startswith(_JPEG):
        size, complete = _jpeg_size(data), b"\xff\xd9" in data[-64:]
    else:
        raise ValueError(f"must be a PNG or a JPEG file, got {len(data)} bytes that begin with {data[:8]!r}")
    if size is None or not complete:
        raise ValueError(f"is truncated: {len(data)} bytes without an end mark or a size")
    width, height = size
    if width < 1 or height < 1:
        raise ValueError(f"has no pixels: {width} x {height}")
    return width, height


def check_image(data: bytes, most_pixels: int | None = None) -> tuple[int, int]:
    """Width and height of an image, if it is small enough to be decoded.

    Raises:
        TooMuchError: it has more than ``most_pixels``, or ``Limits.image_pixels``.
        ValueError: see ``image_size``.
    """
    most = LIMITS.image_pixels if most_pixels is None else most_pixels
    width, height = image_size(data)
    if width * height > most:
        raise TooMuchError(f"may have {most} pixels, got {width} x {height}")
    return width, height


def image_pixels(data: bytes, flags: int, most_pixels: int | None = None) -> np.ndarray:
    """The pixels of a JPEG or PNG file, channels as OpenCV gives them.

    Args:
        data: the file.
        flags: of ``cv2.imdecode``.
        most_pixels: see ``check_image``.

    Raises:
        ValueError: it is truncated, not an image, or has too many pixels.
    """
    import cv2

    check_image(data, most_pixels)  # decoders silently fill the missing part of a truncated file with grey
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise ValueError("cannot be decoded")
    return pixels


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        # SOFn segment: length (2), precision (1), height (2), width (2), big-endian.
        if 0xC0 <= marker <= 0xCF and marker not in _NO_JPEG_SIZE:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        at += 2 + struct.unpack_from(">H", data, at + 2)[0]
    return None


# ------------------------------------------------------------------------------------------------------------- texts


def check_json(data: bytes) -> None:
    """Checks that a JSON text is small enough to be parsed, or to be written by us.

    Raises:
        TooMuchError: too many bytes or values.
    """
    if len(data) > LIMITS.json_bytes:
        raise TooMuchError(f"has {len(data):,} bytes; at most {LIMITS.json_bytes:,} are read")
    # An upper bound without parsing: every value follows one of these characters, or is the root.
    values = 1 + sum(data.count(mark) for mark in (b",", b":", b"[", b"{"))
    if values > LIMITS.json_values:
        raise TooMuchError(f"holds up to {values:,} values; at most {LIMITS.json_values:,} are read")


def json_value(data: bytes, **hooks: Any) -> Any:
    """The value of a JSON text in UTF-8; ``hooks`` are those of ``json.loads``.

    Raises:
        TooMuchError: see ``check_json``.
        ValueError, RecursionError: not JSON, or nested too deeply.
    """
    check_json(data)
    return json.loads(data.decode("utf-8"), **hooks)


def check_xml(data: bytes) -> None:
    """Checks that an XML text is small enough to be parsed.

    Raises:
        TooMuchError: it is not.
    """
    if len(data) > LIMITS.xml_bytes:
        raise TooMuchError(f"has {len(data):,} bytes; at most {LIMITS.xml_bytes:,} are read")
    # Upper bounds without parsing: every tag has a "<", every attribute a "=".
    tags, attributes = data.count(b"<"), data.count(b"=")
    if max(tags, attributes // 4) > LIMITS.xml_tags:
        raise TooMuchError(
            f"has {tags:,} tags and up to {attributes:,} attributes; at most {LIMITS.xml_tags:,} and "
            f"{4 * LIMITS.xml_tags:,} are read"
        )


def msgpack_value(data: bytes) -> Any:
    """The value of a msgpack object of plain values, which are counted while they are read.

    Raises:
        TooMuchError: it holds too many values.
        ValueError, TypeError, RecursionError, msgpack.UnpackException: not such an object, or nested too deeply.
    """
    import msgpack

    def refuse(code: int, _: bytes) -> None:
        raise ValueError(f"extension type {code}; none is read")

    size = len(data)
    unpacker = msgpack.Unpacker(
        raw=False, strict_map_key=False, max_buffer_size=max(size, 1), max_str_len=size, max_bin_len=size,
        max_array_len=LIMITS.msgpack_values, max_map_len=LIMITS.msgpack_values, max_ext_len=16, ext_hook=refuse,
    )  # fmt: skip
    unpacker.feed(data)
    left = LIMITS.msgpack_values

    def read() -> Any:
        nonlocal left
        # fixarray 0x90..0x9f, array16/32 0xdc/0xdd; fixmap 0x80..0x8f, map16/32 0xde/0xdf (msgpack specification).
        kind = data[unpacker.tell()] if unpacker.tell() < size else None
        if kind is not None and (0x90 <= kind <= 0x9F or kind in (0xDC, 0xDD)):
            count = unpacker.read_array_header()
            spend(count)
            return [read() for _ in range(count)]
        if kind is not None and (0x80 <= kind <= 0x8F or kind in (0xDE, 0xDF)):
            count = unpacker.read_map_header()
            spend(2 * count)
            return {_key(read()): read() for _ in range(count)}
        return unpacker.unpack()

    def spend(count: int) -> None:
        nonlocal left
        left -= count
        if left < 0:
            raise TooMuchError(f"holds more than {LIMITS.msgpack_values:,} values")

    value = read()
    if unpacker.tell() != size:
        raise ValueError(f"{size - unpacker.tell():,} bytes follow the object")
    return value


def _key(value: Any) -> Any:
    if isinstance(value, (list, dict)):
        raise ValueError("a key must be a plain value")
    return value
