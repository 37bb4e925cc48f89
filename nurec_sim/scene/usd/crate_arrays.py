"""Counts the arrays of a binary USD layer before OpenUSD decompresses them: 100 kB of zeros may expand to gigabytes.

The section FIELDS has a 64-bit word per value: bit 63 marks arrays, 62 inlined values, 61 compressed arrays, bits 48 to
55 are the type, the lowest 48 the offset of the value in the file, where an array begins with its length. Since version
0.4.0 the words themselves are compressed with LZ4 (https://github.com/lz4/lz4/blob/dev/doc/lz4_Block_format.md).
"""

from __future__ import annotations

import struct
from typing import BinaryIO

from nurec_sim.errors import ArchiveError
from nurec_sim.files.decoding import unpacked_limit

MAX_FIELDS = 1 << 20
MAX_SAMPLES = 1 << 20
_ARRAY, _INLINED, _PACKED = 1 << 63, 1 << 62, 1 << 61
_TIME_SAMPLES = 46
_WIDEST = 8
"""Element size in bytes of the widest type that is compressed."""


def check_arrays(file: BinaryIO, start: int, version: tuple[int, ...], where: str) -> None:
    """Checks that the arrays of a layer's fields, and of their time samples, decompress to an allowed size.

    Args:
        file: the layer.
        start: offset of its section FIELDS.
        version: version of the layer, three numbers.
        where: beginning of error texts.

    Raises:
        ArchiveError: an array is outside the file or too large, or their total is.
    """
    (size,) = (file.seek(0, 2),)
    most, total, samples = unpacked_limit(size), 0, 0
    seen: set[int] = set()
    words = _words(file, start, version, where)
    while words:
        word = words.pop()
        place, kind = word & (1 << 48) - 1, word >> 48 & 255
        # Values may share an array; each is counted once. Visited offsets also end cycles of time samples.
        if word & _INLINED or not place or place in seen:
            continue
        if word & _ARRAY:
            seen.add(place)
            count = _length(file, place, version, where)
            # Uncompressed elements take at least one byte each in the file.
            if not word & _PACKED and count > size:
                raise ArchiveError(f"{where} is no readable USD layer: an array claims {count:,} values")
            total += count * _WIDEST if word & _PACKED else 0
            if total > most:
                raise ArchiveError(
                    f"{where}: its packed arrays may unpack to {total:,} bytes or more; at most {most:,} are read"
                )
        elif kind == _TIME_SAMPLES:
            seen.add(place)
            more = _samples(file, place, where)
            samples += len(more)
            if samples > MAX_SAMPLES:
                raise ArchiveError(f"{where} has more than {MAX_SAMPLES:,} time samples")
            words += more


def numbers(file: BinaryIO, at: int, count: int, where: str) -> tuple[int, ...]:
    """Reads unsigned 64-bit little-endian numbers.

    Args:
        file: the layer.
        at: offset of the first number in bytes.
        count: how many to read.
        where: beginning of error texts.

    Raises:
        ArchiveError: the offset is impossible, or the file ends too early.
    """
    if not 0 <= at < 1 << 62:
        raise ArchiveError(f"{where} is no readable USD layer: it refers to byte {at:,}")
    file.seek(at)
    data = file.read(8 * count)
    if len(data) < 8 * count:
        raise ArchiveError(f"{where} is no readable USD layer: it breaks off")
    return struct.unpack(f"<{count}Q", data)


def _length(file: BinaryIO, place: int, version: tuple[int, ...], where: str) -> int:
    if version >= (0, 7, 0):
        return numbers(file, place, 1, where)[0]
    both = numbers(file, place, 1, where)[0]  # 32-bit length; before 0.5.0 it follows the rank, which is 1
    return both >> 32 if version < (0, 5, 0) else both & 0xFFFFFFFF


def _samples(file: BinaryIO, place: int, where: str) -> list[int]:
    """The words of a field's time samples: a relative offset leads to the times, another one to the values."""
    (jump,) = numbers(file, place, 1, where)
    (times,) = numbers(file, place + jump, 1, where)
    second = place + jump + 8
    (jump,) = numbers(file, second, 1, where)
    (count,) = numbers(file, second + jump, 1, where)
    if count > MAX_SAMPLES:
        raise ArchiveError(f"{where} is no readable USD layer: a value claims {count:,} time samples")
    return [times, *numbers(file, second + jump + 8, count, where)]


def _words(file: BinaryIO, start: int, version: tuple[int, ...], where: str) -> list[int]:
    """The value word of every field."""
    (count,) = numbers(file, start, 1, where)
    if count > MAX_FIELDS:
        raise ArchiveError(f"{where} is no readable USD layer: it claims {count:,} fields; at most {MAX_FIELDS:,}")
    if version < (0, 4, 0):
        # Before 0.4.0: pairs of a name's index (with padding) and the value word.
        return list(numbers(file, start + 8, 2 * count, where)[1::2])
    (names,) = numbers(file, start + 8, 1, where)
    (packed,) = numbers(file, start + 16 + names, 1, where)
    # LZ4 expands incompressible data by 1/255 at most; a larger claim is not from a compressor.
    if packed > 8 * count + count // 16 + 64 + 1:
        raise ArchiveError(f"{where} is no readable USD layer: its {count:,} fields claim {packed:,} bytes")
    file.seek(start + 24 + names)
    data = file.read(packed)
    try:
        words = _unpacked(data, 8 * count)
    except (IndexError, ValueError, struct.error):
        raise ArchiveError(f"{where} is no readable USD layer: its fields cannot be unpacked") from None
    return list(struct.unpack(f"<{count}Q", words))


def _unpacked(data: bytes, size: int) -> bytes:
    """Decompresses OpenUSD's framing of LZ4: the number of chunks, 0 for one without length; then lengths and bytes."""
    if not size:
        return b""
    if not data[0]:
        chunks = [data[1:]]
    else:
        chunks, at = [], 1
        for _ in range(data[0]):
            (length,) = struct.unpack_from("<i", data, at)
            chunks.append(data[at + 4 : at + 4 + length])
            at += 4 + length
    result = b"".join(_lz4(chunk, size) for chunk in chunks)
    if len(result) != size:
        raise ValueError("another size")
    return result


def _lz4(data: bytes, most: int) -> bytes:
    """Decompresses an LZ4 block: a sequence of literals, each followed by a copy of earlier output."""
    out, at = bytearray(), 0

    def length(nibble: int) -> int:
        nonlocal at
        # A nibble of 15 continues in further bytes, which are added until one is not 255.
        total = nibble
        while nibble == 15:
            total += data[at]
            at += 1
            if data[at - 1] != 255:
                break
        return total

    while at < len(data):
        token = data[at]
        at += 1
        literals = length(token >> 4)
        out += data[at : at + literals]
        at += literals
        # The last sequence has literals only.
        if at >= len(data):
            break
        back = data[at] | data[at + 1] << 8
        at += 2
        # Matches are at least 4 bytes long, so their length is stored less 4.
        matched = length(token & 15) + 4
        if not 0 < back <= len(out) or len(out) + matched > most:
            raise ValueError("no such bytes before")
        # A match may overlap its own output (back < matched): its bytes then repeat with that period.
        first = len(out) - back
        piece = bytes(out[first : first + matched])
        out += (piece * (matched // back + 1))[:matched] if back < matched else piece
    return bytes(out)
