"""How kernels are compiled: no interpreter lock, NumPy's division, compiled once per machine and source.

Numba's cache only watches the file of the function that is called, not those of the functions it calls in turn. So
the digest of all sources of this folder becomes part of an entry point's name, by which its cache is found.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numba.core.options import DefaultOptions

f4 = np.float32
"""Wraps constants in kernels: a bare Python number would make the expression float64."""

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz", "arcp"}}
# Arrays cost a dozen words each as arguments; where Numba can, small kernels become part of large ones.
_INLINE: dict[str, Any] = {"forceinline": True} if hasattr(DefaultOptions, "forceinline") else {}


def _source_digest() -> str:
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


_DIGEST = _source_digest()


def kernel(function: Callable) -> Callable:
    """An entry point: called from Python, its machine code kept on disk."""
    function.__qualname__ += f"_{_DIGEST}"
    try:
        return njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # no folder to write to: compiled anew in every process
        return njit(**_OPTIONS)(function)


def inner(function: Callable) -> Callable:
    """A function that only kernels call."""
    return njit(**_INLINE, **_OPTIONS)(function)
