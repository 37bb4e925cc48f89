"""Input data of a report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from nurec_sim.metrics.collision import Contact
from nurec_sim.metrics.offroad_grid import OffroadGrid
from nurec_sim.types import RoadMap, Rollout, Series

if TYPE_CHECKING:
    import polars as pl


@dataclass(frozen=True)
class ReportScene:
    """A scene with one reconstruction; ``unknown`` lists missing information."""

    id: str
    reconstruction: str
    sha256: str = ""
    counts: Mapping[str, int] = field(default_factory=dict)
    provenance: Mapping[str, object] = field(default_factory=dict)
    unknown: tuple[str, ...] = ()
    road_map: RoadMap | None = None
    grid: OffroadGrid | None = None


@dataclass(frozen=True)
class ReportRollout:
    """A rollout with its metrics; ``video`` is a file to embed, ``video_link`` its path beside the report."""

    rollout: Rollout
    series: Mapping[str, Series]
    contacts: tuple[Contact, ...] = ()
    video: Path | None = None
    video_link: str = ""
    video_error: str = ""
    scenario: str = ""


@dataclass(frozen=True)
class RunReport:
    """A complete run. ``values`` and ``summary`` are the tables of ``metrics.aggregate``."""

    title: str
    profile: str
    scenes: tuple[ReportScene, ...]
    rollouts: tuple[ReportRollout, ...]
    values: pl.DataFrame
    summary: pl.DataFrame
    versions: tuple[Mapping[str, object], ...] = ()
