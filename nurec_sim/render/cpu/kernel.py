"""How the renderer's kernels are compiled: NumPy's division, sums in any order, small kernels within large ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numba.core.options import DefaultOptions

from nurec_sim.compute.kernels import entry_point
from nurec_sim.render.cpu.simd import INSTRUCTION_SET

f4 = np.float32
"""Wraps constants in kernels: a bare Python number would make the expression float64."""

# NumPy's error model divides without a test for zero; no "nnan" or "ninf" among the fast-math flags, because NaN and
# infinity must compare as usual.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz", "arcp"}}
# Arrays cost a dozen words each as arguments; where Numba can, small kernels become part of large ones.
_INLINE: dict[str, Any] = {"forceinline": True} if hasattr(DefaultOptions, "forceinline") else {}


def kernel(function: Callable) -> Callable:
    """An entry point: called from Python, its machine code kept on disk for the vectors that it is written for."""
    return entry_point(function, INSTRUCTION_SET, **_OPTIONS)


def inner(function: Callable) -> Callable:
    """A function that only kernels call."""
    return njit(**_INLINE, **_OPTIONS)(function)


def fixed(number: int) -> tuple[int, ...]:
    """A small number that a kernel is compiled for: a tuple as long as it says.

    The length of a tuple is part of its type, so each number has machine code of its own, made when it is first used.
    Of branches on ``len(argument)`` only the one that is taken is compiled.
    """
    return (0,) * number


@inner
def keep_alive(array):
    """Use an array again: Numba frees it after its last use by name, whoever still works with its address."""
    return array.size
