"""Measures reconstructions: against what a log recorded, and against the true world.

``evaluate`` scores one log with cameras and sweeps that were held out. ``run_protocol`` compares methods side by side
(docs/evaluation.md) on windows of drawn worlds or of real logs. Public names load on first use.
"""

from importlib import import_module
from typing import Any

_HOMES = {
    "CHOICES": "methods",
    "Contender": "methods",
    "PROTOCOLS": "protocols",
    "Protocol": "protocols",
    "Target": "windows",
    "Window": "windows",
    "as_fired": "log",
    "contenders": "methods",
    "evaluate": "log",
    "held_out": "log",
    "run_protocol": "run",
    "score_window": "scoring",
    "sensing": "log",
    "summarize": "summary",
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Import the module that holds a public name."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
