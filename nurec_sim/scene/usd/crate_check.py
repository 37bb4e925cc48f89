"""Validates the sizes declared in a binary USD layer, before OpenUSD trusts them and allocates gigabytes.

A crate begins with ``PXR-USDC``, 8 bytes of version and the offset of its table of contents: a count, then entries of a
16-byte name, a start and a size. Sections begin with their number of entries. All numbers are 64-bit little-endian.

Arrays referenced by its fields are counted too (``scene.usd.crate_arrays``).
"""

from __future__ import annotations

import os
from typing import BinaryIO

from nurec_sim.errors import ArchiveError
from nurec_sim.scene.usd.crate_arrays import check_arrays, numbers

MAGIC = b"PXR-USDC"
_MAX_SECTIONS = 64
_MAX_RATIO = 255  # maximum compression ratio of LZ4
_INTEGERS_A_BYTE = 4  # most integers per byte of the encoding before LZ4
_PACKED_SINCE = (0, 4, 0)  # earlier versions store names uncompressed
_COUNTED = (b"FIELDS", b"FIELDSETS", b"PATHS", b"SPECS")


def check_crate(file: BinaryIO, where: str) -> None:
    """Checks that the sections of a layer lie in its file and can hold the declared entries; text layers are skipped.

    Raises:
        ArchiveError: they do not; the text begins with ``where``.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        return
    version = tuple(file.read(3))
    # The bootstrap: magic (8 bytes), version (8), offset of the table of contents (8).
    (contents,) = numbers(file, 16, 1, where)
    (count,) = numbers(file, contents, 1, where)
    if count > _MAX_SECTIONS:
        raise ArchiveError(f"{where} is no readable USD layer: it claims {count:,} sections")
    for i in range(count):
        at = contents + 8 + 32 * i
        file.seek(at)
        name = file.read(16).rstrip(b"\0")
        start, length = numbers(file, at + 16, 2, where)
        if start + length > size:
            raise ArchiveError(
                f"{where} is no readable USD layer: section {name.decode(errors='replace')} ends beyond it"
            )
        if length >= 8:
            _check_section(file, name, start, length, where, packs=version >= _PACKED_SINCE)
        if name == b"FIELDS" and length >= 8:
            check_arrays(file, start, version, where)


def _check_section(file: BinaryIO, name: bytes, start: int, length: int, where: str, *, packs: bool) -> None:
    """Checks that a section can hold the number of entries that it declares."""
    (count,) = numbers(file, start, 1, where)
    most = count
    if name in _COUNTED:
        most = length * _MAX_RATIO * _INTEGERS_A_BYTE
    # Strings are 32-bit indices into the tokens.
    elif name == b"STRINGS":
        most = length // 4
    elif name == b"TOKENS" and length >= 24 and packs:
        # Tokens are NUL-terminated names in one LZ4 block: each takes at least one byte unpacked.
        unpacked, packed = numbers(file, start + 8, 2, where)
        most = min(unpacked, (length + 8) * _MAX_RATIO)
        if packed > length or unpacked > (packed + 8) * _MAX_RATIO:
            raise ArchiveError(f"{where} is no readable USD layer: its names claim {unpacked:,} bytes")
    if count > most:
        what = f"section {name.decode(errors='replace')} claims {count:,} entries in {length:,} bytes"
        raise ArchiveError(f"{where} is no readable USD layer: {what}")
