"""How kernels are compiled: no interpreter lock, NumPy's division, compiled once per machine and source.

Numba's cache only watches the file of the function that is called, not those of the functions it calls in turn. So
the digest of that file and of all it imports from this folder becomes part of an entry point's name, by which its
cache is found; the instruction set that vectors are written for is part of it too.
"""

from __future__ import annotations

import functools
import hashlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numba.core.options import DefaultOptions

from nurec_sim.render.cpu.simd import INSTRUCTION_SET

f4 = np.float32
"""Wraps constants in kernels: a bare Python number would make the expression float64."""

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz", "arcp"}}
# Arrays cost a dozen words each as arguments; where Numba can, small kernels become part of large ones.
_INLINE: dict[str, Any] = {"forceinline": True} if hasattr(DefaultOptions, "forceinline") else {}
_IMPORT = re.compile(rb"^from nurec_sim\.render\.cpu\.(\w+) import", re.MULTILINE)


@functools.cache
def _source_digest(module: str) -> str:
    """Digest of a module of this folder and of those that it imports, directly or not."""
    names, seen, digest = [module], set(), hashlib.sha256(INSTRUCTION_SET.encode())
    while names:
        name = names.pop()
        if name not in seen:
            seen.add(name)
            text = (Path(__file__).parent / f"{name}.py").read_bytes()
            digest.update(text)
            names += sorted(found.decode() for found in _IMPORT.findall(text))
    return digest.hexdigest()[:12]


def kernel(function: Callable) -> Callable:
    """An entry point: called from Python, its machine code kept on disk."""
    function.__qualname__ += f"_{_source_digest(function.__module__.rsplit('.', 1)[-1])}"
    try:
        return njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # no folder to write to: compiled anew in every process
        return njit(**_OPTIONS)(function)


def inner(function: Callable) -> Callable:
    """A function that only kernels call."""
    return njit(**_INLINE, **_OPTIONS)(function)


@inner
def keep_alive(array):
    """Use an array again: Numba frees it after its last use by name, whoever still works with its address."""
    return array.size
