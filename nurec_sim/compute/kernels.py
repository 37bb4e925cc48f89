"""Numba compilation of kernels: without the GIL, cached on disk per machine and source.

Numba's cache only tracks the file of the entry function, not those of inlined callees. So a digest of all these files
is part of an entry point's name, the key of its machine code on disk. Without a writable folder every process compiles
again.
"""

from __future__ import annotations

import functools
import hashlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

_ROOT = Path(__file__).parents[1]
_IMPORT = re.compile(rb"^from (nurec_sim[\w.]+) import", re.MULTILINE)


@functools.cache
def source_digest(module: str, salt: str = "") -> str:
    """Digest of all source files that may be compiled into a module's kernels: its own and its transitive imports.

    Kernels import functions and constants from their defining module, not from a re-exporting package (tested), so
    packages themselves are excluded.
    """
    # Depth-first over the import graph; modules reached twice are hashed once.
    names, seen, digest = [module], set(), hashlib.sha256(salt.encode())
    while names:
        name = names.pop()
        path = _ROOT.joinpath(*name.split(".")[1:]).with_suffix(".py")
        if name in seen or not path.is_file():
            continue
        seen.add(name)
        text = path.read_bytes()
        digest.update(text)
        names += sorted(found.decode() for found in _IMPORT.findall(text))
    return digest.hexdigest()[:12]


def entry_point(function: Callable, salt: str = "", **options: Any) -> Callable:
    """A compiled function callable from Python, with Numba ``options``, cached on disk.

    ``salt`` is anything else that its machine code depends on.
    """
    # Numba builds the file name of its cache from the qualified name.
    function.__qualname__ += f"_{source_digest(function.__module__, salt)}"
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # no writable folder
        return njit(**options)(function)


def kernel(function: Callable) -> Callable:
    """An entry point with default (strict IEEE) arithmetic, releasing the GIL."""
    return entry_point(function, nogil=True)


def inner(function: Callable) -> Callable:
    """A device function, callable from kernels only."""
    return njit(nogil=True)(function)


def unchecked_kernel(function: Callable) -> Callable:
    """A ``kernel`` whose divisions by zero give infinity or NaN.

    A check of each divisor is a branch, and a loop with a branch does not become vector instructions.
    """
    return entry_point(function, nogil=True, error_model="numpy")


def unchecked_inner(function: Callable) -> Callable:
    """The same of ``inner``, for unchecked kernels."""
    return njit(nogil=True, error_model="numpy")(function)
