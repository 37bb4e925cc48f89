"""Closed-loop metrics: per-rollout series, the off-road grid, tables and summaries.

Public names load on first use, so that importing the package costs nothing.
"""

from importlib import import_module
from typing import Any

_HOMES = {
    "Agreement": "offroad",
    "Contact": "collision",
    "GridSettings": "offroad_grid",
    "METRICS": "series",
    "OffroadGrid": "offroad_grid",
    "build_offroad_grid": "offroad_grid",
    "find_contacts": "collision",
    "judge_footprints": "offroad",
    "metric_table": "table",
    "read_table": "table",
    "offroad_agreement": "offroad",
    "rollout_values": "aggregate",
    "scene_offroad_grid": "offroad_grid",
    "score_rollout": "score",
    "summarize": "aggregate",
    "write_table": "table",
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Import the module that holds a public name."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
