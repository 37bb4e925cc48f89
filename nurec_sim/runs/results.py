"""Computes the metrics of a run folder; writes its tables and its report."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path

from nurec_sim.errors import RunError
from nurec_sim.files.new_files import write_file
from nurec_sim.metrics.aggregate import rollout_values, summarize
from nurec_sim.metrics.collision import find_contacts
from nurec_sim.metrics.score import score_rollout
from nurec_sim.metrics.table import metric_table, read_table, write_table
from nurec_sim.report import ReportRollout, ReportScene, RunReport, Video, render_report
from nurec_sim.runs import folder as layout
from nurec_sim.runs.compared import compare_reconstructions
from nurec_sim.runs.rollout_file import load_rollout
from nurec_sim.runs.scene_file import SceneRecord, load_scene_record
from nurec_sim.runs.seen_support import load_support
from nurec_sim.types import Rollout, Series

PROFILE = "strict"


def write_report(run: Path | str, progress: Callable[[str, float], None] | None = None) -> Path:
    """Write ``metrics.parquet``, ``metrics.csv`` and ``report.html`` from the rollouts and scenes in a run folder.

    Returns:
        The report.

    Raises:
        RunError: no such folder, it holds no rollout, or a file in it is broken.
    """
    say = progress or (lambda stage, share: None)
    run = layout.existing_run_folder(Path(run))
    places = layout.rollout_folders(run)
    if not places:
        raise RunError(f"run folder {run} has no rollout")
    records = {place: load_scene_record(place) for place in layout.scene_folders(run)}
    scored = []
    for index, place in enumerate(places):
        say("scoring", 0.6 * index / len(places))
        record = records.get(place.parent.parent)
        if record is None:
            raise RunError(f"{place.parent.parent} lacks {layout.SCENE}; run again with --resume")
        rollout = load_rollout(place / layout.ROLLOUT)
        series = score_rollout(
            rollout,
            record.grid,
            record.road_map,
            profile=PROFILE,
            actors_known=record.actors_known,
            support=load_support(place / layout.SUPPORT),
        )
        scored.append((rollout, series))
    table = metric_table(scored, run.name)
    write_table(table, run)
    values = rollout_values(table, PROFILE)
    compared = compare_reconstructions(scored, list(records.values()), PROFILE)
    comparison, judged = compared or (None, scored)
    entries = [_report_entry(run, place, *each) for place, each in zip(places, judged, strict=True)]
    say("writing the report", 0.7)
    report = RunReport(
        title=run.name,
        profile=PROFILE,
        scenes=tuple(_report_scene(run, place, record) for place, record in records.items()),
        rollouts=tuple(entries),
        values=values,
        summary=summarize(values),
        versions=_versions(places),
        comparison=comparison,
    )
    path = run / layout.REPORT
    write_file(path, render_report(report))
    return path


def headline(run: Path | str) -> list[tuple[str, ...]]:
    """The headline table of a finished run as rows of text, header first."""
    run = layout.existing_run_folder(Path(run))
    path = run / "metrics.parquet"
    if not path.exists():
        raise RunError(f"run folder {run} has no metrics.parquet; it was not finished")
    columns = {
        "collision_any": "collision",
        "offroad": "off-road",
        "collision_offroad_mean": "(C+O)/2",
        "offroad_unknown_frac": "road unknown",
        "progress": "progress",
        "scene_score": "scene score",
    }
    rows = [("policy", "reconstruction", "rollouts", "failed", *columns.values())]
    for (reconstruction, policy), part in (
        summarize(rollout_values(read_table(path), PROFILE)).group_by("reconstruction", "policy", maintain_order=True)
    ):  # fmt: skip
        cells = {row["name"]: row for row in part.iter_rows(named=True)}
        first = next(iter(cells.values()))
        shown = ["unknown" if cells[name]["mean"] is None else f"{cells[name]['mean']:.2f}" for name in columns]
        rows.append((policy, reconstruction, str(first["n"]), str(first["n_failed"]), *shown))
    return rows


def _report_entry(run: Path, place: Path, rollout: Rollout, series: Iterable[Series]) -> ReportRollout:
    video_error = place / layout.VIDEO_ERROR
    return ReportRollout(
        rollout=rollout,
        series={one.name: one for one in series},
        contacts=tuple(find_contacts(rollout, PROFILE)),
        videos=_videos(run, place / layout.VIDEO, place / layout.LIDAR),
        video_error=video_error.read_text(encoding="utf-8").strip() if video_error.exists() else "",
        scenario=(place / layout.SCENARIO).read_text(encoding="utf-8") if (place / layout.SCENARIO).exists() else "",
    )


def _report_scene(run: Path, place: Path, record: SceneRecord) -> ReportScene:
    return ReportScene(
        id=record.id, reconstruction=record.reconstruction, sha256=record.sha256, counts=record.counts,
        provenance=record.provenance, unknown=record.unknown, road_map=record.road_map, grid=record.grid,
        fidelity=record.fidelity,
        recorded=_videos(run, place.parent / layout.RECORDED, place.parent / layout.RECORDED_LIDAR),
    )  # fmt: skip


def _videos(run: Path, *paths: Path) -> tuple[Video, ...]:
    return tuple(Video(path, path.relative_to(run).as_posix()) for path in paths if path.exists())


def _versions(places: list[Path]) -> tuple[dict[str, object], ...]:
    """The distinct software versions of the rollouts."""
    found = []
    for place in places:
        path = place / layout.VERSIONS
        facts = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        facts.pop("scene_sha256", None)
        if facts and facts not in found:
            found.append(facts)
    return tuple(found)
