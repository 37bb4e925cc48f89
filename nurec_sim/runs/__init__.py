"""Run folders: drive policies, keep every rollout on disk, measure, report; interrupted runs go on where they stopped.

Public names load on first use, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import Any

_HOMES = {
    "execute": "drive",
    "headline": "results",
    "load_policies": "policies",
    "load_rollout": "rollout_file",
    "record_video": "video",
    "save_rollout": "rollout_file",
    "true_world": "truth",
    "write_report": "results",
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Import the module that holds a public name."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
