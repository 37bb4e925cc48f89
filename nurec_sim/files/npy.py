"""Arrays as ``.npy`` bytes: plain values only, nothing is pickled or unpickled."""

from __future__ import annotations

import io
import tokenize

import numpy as np

from nurec_sim.errors import ArchiveError


def npy_bytes(array: np.ndarray) -> bytes:
    """An array encoded as ``.npy``, format version 1.0."""
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asarray(array, order="C"), version=(1, 0), allow_pickle=False)
    return buffer.getvalue()


def array_from_npy(data: bytes, where: str, kinds: str = "iuf") -> np.ndarray:
    """Decodes an array; its declared size is checked against the available bytes before memory is allocated.

    Args:
        data: the file, of format version 1.0.
        where: name of the file in error texts.
        kinds: allowed NumPy dtype kinds, one letter each.

    Raises:
        ArchiveError: not an array file, a dtype of another kind, Fortran order, or fewer or more bytes than declared.
    """
    buffer = io.BytesIO(data)
    try:
        if np.lib.format.read_magic(buffer) != (1, 0):
            raise ValueError("npy version 1.0 is needed")
        shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(buffer)
    except (ValueError, SyntaxError, tokenize.TokenError, RecursionError) as error:  # NumPy parses it as Python
        raise ArchiveError(f"{where} is no array file: {error}") from error
    if dtype.hasobject or dtype.kind not in kinds or fortran_order:
        raise ArchiveError(
            f"{where} must hold plain {'numbers' if kinds == 'iuf' else 'values'} in C order, got {dtype}"
        )
    body = data[buffer.tell() :]
    # In Python integers: a crafted shape would overflow int64 and pass the comparison.
    if int(np.prod([int(n) for n in shape], dtype=object)) * dtype.itemsize != len(body):
        raise ArchiveError(f"{where} promises {dtype} {shape} but holds {len(body):,} bytes")
    return np.frombuffer(body, dtype).reshape(shape).copy()
