"""How loops are compiled with Numba: without the interpreter lock, and once per machine and source.

Numba's cache only watches the file of the function that is called, not those of the functions that it calls in turn
and compiles into it. So a digest of all these files becomes part of an entry point's name, by which its machine code
is found on disk. Where nothing can be written it is compiled anew in every process.
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
    """Digest of the files that the kernels of a module may be made of: its own, and all that it imports in turn.

    A kernel takes functions and constants from where they are written, not from a package that passes them on (there
    is a test of that), so packages themselves are left out.
    """
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
    """A function that Python calls, compiled with Numba's ``options``, its machine code kept on disk.

    ``salt`` is what else its machine code depends on.
    """
    function.__qualname__ += f"_{source_digest(function.__module__, salt)}"
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # no folder to write to
        return njit(**options)(function)


def kernel(function: Callable) -> Callable:
    """An entry point with Python's arithmetic."""
    return entry_point(function, nogil=True)


def inner(function: Callable) -> Callable:
    """A function that only kernels call."""
    return njit(nogil=True)(function)
