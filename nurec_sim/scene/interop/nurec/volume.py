"""``volume.nurec``: a gzip file of one msgpack object that holds a reconstruction's arrays as raw bytes.

Each array lies under its name, its shape under the name plus ``.shape``; values are little-endian, half floats unless
their byte count says otherwise. Memory is limited to a fixed multiple of the file size.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from nurec_sim.errors import ArchiveError
from nurec_sim.files.decoding import TooMuchError, msgpack_value, unpacked_limit
from nurec_sim.scene.interop.nurec.state import NurecState, read_entries

_INTEGERS = ("gaussian_cuboid_ids", "n_active_features")
_MAX_DIMENSIONS = 8


def read_volume(data: bytes, where: str) -> NurecState:
    """Reads the bytes of a ``.nurec`` file.

    Raises:
        ArchiveError: not such a file, truncated, damaged, or unpacking to more than the limit.
    """
    content = _unpacked(gunzipped(data, where), where)
    nre = content.get("nre_data") if isinstance(content, dict) else None
    if not isinstance(nre, dict) or not isinstance(nre.get("state_dict"), dict):
        raise ArchiveError(f"{where}: no NuRec volume: 'nre_data' with a 'state_dict' is missing")
    state = nre["state_dict"]
    shapes = {f"{key}.shape" for key in state}
    found, others, track_ids = read_entries((key, value) for key, value in state.items() if key not in shapes)
    arrays = {name: _array(name, value, state.get(f"{key}.shape"), where) for name, (key, value) in found.items()}
    config = nre.get("config")
    version = nre.get("version")
    return NurecState(
        arrays,
        track_ids,
        config if isinstance(config, Mapping) else {},
        others,
        version if isinstance(version, str) else "",
    )


def gunzipped(data: bytes, where: str) -> bytes:
    """Decompresses a gzip file within limits.

    Raises:
        ArchiveError: not such a file, truncated, damaged, or unpacking to more than the limit.
    """
    limit = unpacked_limit(len(data))
    # 15 bits of window, plus 16 for the gzip header.
    unpacker = zlib.decompressobj(wbits=31)
    try:
        content = unpacker.decompress(data, limit)
    except zlib.error as error:
        raise ArchiveError(f"{where}: not a gzip file, or damaged ({error})") from error
    if unpacker.unconsumed_tail:
        raise ArchiveError(f"{where}: {len(data):,} bytes that unpack to more than {limit:,}")
    if not unpacker.eof:
        raise ArchiveError(f"{where}: cut short: the gzip stream does not end")
    if unpacker.unused_data.strip(b"\0"):
        raise ArchiveError(f"{where}: {len(unpacker.unused_data):,} bytes follow the gzip stream")
    return content


def _unpacked(content: bytes, where: str) -> Any:
    import msgpack

    try:
        return msgpack_value(content)
    except TooMuchError as error:
        raise ArchiveError(f"{where}: {error}") from None
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise ArchiveError(f"{where}: damaged, or no msgpack object ({error or type(error).__name__})") from error


def _array(name: str, value: object, shape: object, where: str) -> np.ndarray:
    """The array of some bytes; the byte count determines its type."""
    if not isinstance(value, bytes) or not isinstance(shape, list):
        raise ArchiveError(f"{where}: {name} must be bytes with a shape, got {type(value).__name__} and {shape!r:.60}")
    if len(shape) > _MAX_DIMENSIONS or any(type(n) is not int or n < 0 for n in shape):
        raise ArchiveError(f"{where}: {name} has the impossible shape {shape!r:.60}")
    count = math.prod(shape)
    kind = "i" if name.endswith(_INTEGERS) else "f"
    if count == 0 and not value:
        return np.zeros(shape, f"{kind}4")
    size = len(value) // count if count else 0
    if count == 0 or size * count != len(value) or size not in (2, 4, 8):
        raise ArchiveError(f"{where}: {name} of shape {shape!r:.60} cannot have {len(value):,} bytes")
    return np.frombuffer(value, f"<{kind}{size}").reshape(shape)
