"""Arrays as ``.npy`` bytes: plain values only, nothing is pickled or unpickled."""

from __future__ import annotations

import io
import tokenize

import numpy as np

from nurec_sim.errors import ArchiveError


def npy_bytes(array: np.ndarray) -> bytes:
    """An array in format version 1.0."""
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asarray(array, order="C"), version=(1, 0), allow_pickle=False)
    return buffer.getvalue()


def array_from_npy(data: bytes, where: str, kinds: str = "iuf") -> np.ndarray:
    """The array; its size is checked against the bytes that are there before memory is taken.

    Args:
        data: the file, of format version 1.0.
        where: what to call it in errors.
        kinds: NumPy's letters of the kinds of values allowed.

    Raises:
        ArchiveError: no such file, other values, Fortran order, or not as many bytes as promised.
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
    if int(np.prod([int(n) for n in shape], dtype=object)) * dtype.itemsize != len(body):
        raise ArchiveError(f"{where} promises {dtype} {shape} but holds {len(body):,} bytes")
    return np.frombuffer(body, dtype).reshape(shape).copy()
