"""How kernels are compiled: no interpreter lock, NumPy's division, compiled once per machine and source.

Numba's cache only watches the file of the function that is called, not those of the functions it calls in turn. So
the digest of all sources of this folder becomes part of an entry point's name, by which its cache is found.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numba import njit

f4 = np.float32
"""Wraps constants in kernels: a bare Python number would make the expression float64."""

_OPTIONS = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz", "arcp"}}


def _source_digest() -> str:
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


_DIGEST = _source_digest()


def kernel(function: Callable) -> Callable:
    """An entry point: called from Python, its machine code kept on disk."""
    function.__qualname__ += f"_{_DIGEST}"
    return njit(cache=True, **_OPTIONS)(function)


def inner(function: Callable) -> Callable:
    """A function that only kernels call."""
    return njit(forceinline=True, **_OPTIONS)(function)
