"""Renders Gaussian scenes: cameras of any lens and shutter, spinning LiDARs; ``spec`` is the readable reference."""

from __future__ import annotations

import importlib
from typing import Any

_HOME = {
    "Renderer": "nurec_sim.render.renderer",
    "encode_image": "nurec_sim.render.encode",
    "check_request": "nurec_sim.render.requests",
    "spec": "nurec_sim.render.spec",
}
__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(_HOME[name])
    return module if name == "spec" else getattr(module, name)


def __dir__() -> list[str]:
    return sorted(__all__)
