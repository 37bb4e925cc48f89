"""Input data of a report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nurec_sim.metrics.agreement import Agreement
from nurec_sim.metrics.collision import Contact
from nurec_sim.metrics.offroad_grid import OffroadGrid
from nurec_sim.types import RoadMap, Rollout, Series

if TYPE_CHECKING:
    import polars as pl


@dataclass(frozen=True)
class Video:
    """A video file, and its path from the report's folder."""

    path: Path
    link: str


@dataclass(frozen=True)
class ReportScene:
    """A scene with one reconstruction.

    ``unknown`` lists missing information, ``fidelity`` is the result of ``evaluate.measure_fidelity``, and ``recorded``
    are videos of the recorded drive.
    """

    id: str
    reconstruction: str
    sha256: str = ""
    counts: Mapping[str, int] = field(default_factory=dict)
    provenance: Mapping[str, object] = field(default_factory=dict)
    unknown: tuple[str, ...] = ()
    road_map: RoadMap | None = None
    grid: OffroadGrid | None = None
    fidelity: Mapping[str, Any] = field(default_factory=dict)
    recorded: tuple[Video, ...] = ()


@dataclass(frozen=True)
class ReportRollout:
    """A rollout with its metrics, and its videos: the front camera and, if compared, the LiDAR from above."""

    rollout: Rollout
    series: Mapping[str, Series]
    contacts: tuple[Contact, ...] = ()
    videos: tuple[Video, ...] = ()
    video_error: str = ""
    scenario: str = ""


@dataclass(frozen=True)
class Comparison:
    """Reconstructions against the first one, all judged by the same actors and the same road.

    ``road`` names the road that decides off-road. ``values`` and ``summary`` are the tables of ``metrics.aggregate`` by
    that road; ``agreements`` are by metric and reconstruction, ``ceilings`` those of the reference with itself by
    metric, None where it has one seed only. ``notes`` says what was left out.
    """

    worlds: tuple[str, ...]
    road: str
    values: pl.DataFrame
    summary: pl.DataFrame
    agreements: Mapping[tuple[str, str], Agreement]
    ceilings: Mapping[str, Agreement | None]
    notes: tuple[str, ...] = ()

    @property
    def reference(self) -> str:
        """What the others are compared with."""
        return self.worlds[0]


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
    comparison: Comparison | None = None
