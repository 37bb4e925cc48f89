"""The CUDA back end: the frames of ``render.spec`` drawn by a GPU, forward and backward; needs the extra ``gpu``.

Nothing outside of this folder imports it, and it imports torch and CUDA's packages only where they are used.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOME = {
    "GpuRenderer": "nurec_sim.render.gpu.renderer",
    "DifferentiableRenderer": "nurec_sim.render.gpu.gradients",
}
__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
