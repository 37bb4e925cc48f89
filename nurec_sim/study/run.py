"""Runs a study: all logs, then all reconstructions, then all rollouts; finished parts are kept."""

from __future__ import annotations

import dataclasses
import io
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import polars as pl
import yaml

from nurec_sim.errors import RunError
from nurec_sim.files.new_files import write_file, writing
from nurec_sim.runs import folder as layout
from nurec_sim.runs.policies import load_policies
from nurec_sim.runs.truth import TRUTH
from nurec_sim.sim import load_scenario
from nurec_sim.study.config import StudyConfig
from nurec_sim.study.executor import Executor
from nurec_sim.study.page import render_study
from nurec_sim.study.results import AGREEMENT, as_json, gather
from nurec_sim.study.tasks import LOG, PLAN, ROLLOUTS, VALUES, Task, drive, rebuild, record

Progress = Callable[[str, float], None]
STUDY = "study.yaml"
RECORD_SHARE, REBUILD_SHARE, DRIVE_SHARE = 0.1, 0.25, 0.63
"""Fractions of the work, about, for the progress bar; the rest is the report."""


def run_study(
    config: StudyConfig,
    folder: Path,
    executor: Executor,
    *,
    progress: Progress | None = None,
    notice: Callable[[str], None] | None = None,
) -> Path:
    """Runs what is missing of a study, and writes its report.

    The same study gives the same files, byte for byte, whatever the executor and however often it was interrupted.
    Rollouts that failed are repeated when a study is run again.

    Args:
        config: the study.
        folder: its folder; a new one, or one with the same study.
        executor: where the tasks run.
        progress: called with stage and fraction done.
        notice: called with a line of text for each failure.

    Returns:
        The report.

    Raises:
        RunError: the folder holds another study, another process is writing to it, or a worker died.
        ScenarioError: a policy or a scenario cannot be loaded.
    """
    say, tell = progress or (lambda stage, share: None), notice or (lambda text: None)
    seeing = _seeing(config)
    with writing(folder):
        (folder / ROLLOUTS).mkdir(parents=True, exist_ok=True)
    with layout.owned(folder), layout.owned(folder / ROLLOUTS):
        _claim(folder, config)
        scenes = [Task(folder, config, *scene) for scene in config.scenes]
        methods = [world for world in config.worlds if world != TRUTH]
        logs = [task for task in scenes if not all((task.scene_folder / name).exists() for name in (LOG, PLAN))]
        _run(executor, record, logs, "recording towns", _counted(say, 0.0, RECORD_SHARE), tell)
        archives = [dataclasses.replace(task, world=world) for task in scenes for world in methods]
        archives = [task for task in archives if not task.archive.exists()]
        _run(executor, rebuild, archives, "reconstructing", _counted(say, RECORD_SHARE, REBUILD_SHARE), tell)
        # Scene by scene, so that an interrupted study has complete scenes.
        worlds = [dataclasses.replace(task, world=world) for task in scenes for world in config.all_worlds]
        rollouts = _Rollouts(folder, config.rollouts, say)
        _run(executor, drive, [task for task in worlds if not _finished(task)], "driving", rollouts.count, tell)
        say("writing the report", RECORD_SHARE + REBUILD_SHARE + DRIVE_SHARE)
        report = _write_report(folder, config, seeing)
    say("", 1.0)
    return report


def report_again(config: StudyConfig, folder: Path) -> Path:
    """Rewrites the tables and the report of a finished study.

    Raises:
        RunError: the folder holds no study, another one, or an unfinished one.
        ScenarioError: a policy or a scenario cannot be loaded.
    """
    if not (folder / STUDY).exists():
        raise RunError(f"{folder} holds no study; run it first")
    with layout.owned(folder):
        _claim(folder, config)
        return _write_report(folder, config, _seeing(config))


def resolved(config: StudyConfig) -> str:
    """Everything that the results depend on, as YAML: the study, with its scenarios in full."""
    names = sorted({family.scenario for family in config.families})
    scenarios = {name: load_scenario(name).model_dump(mode="json") for name in names}
    return yaml.safe_dump({"study": config.model_dump(mode="json"), "scenarios": scenarios}, sort_keys=False)


def _write_report(folder: Path, config: StudyConfig, seeing: Sequence[str]) -> Path:
    """Writes ``rollouts.parquet``, ``rollouts.csv``, ``agreement.json`` and ``report.html``; returns the last.

    Args:
        folder: of the study.
        config: the study.
        seeing: policies that look at a rendered sensor.

    Raises:
        RunError: the rollouts of a world are missing.
    """
    results = gather(folder, config, seeing)
    for name, write in (("rollouts.parquet", results.values.write_parquet), ("rollouts.csv", results.values.write_csv)):
        content = io.BytesIO()
        write(content)
        write_file(folder / name, content.getvalue())
    write_file(folder / AGREEMENT, json.dumps(as_json(results), indent=1) + "\n")
    path = folder / layout.REPORT
    write_file(path, render_study(results))
    return path


def _claim(folder: Path, config: StudyConfig) -> None:
    """Writes ``study.yaml``, or checks that the folder holds this study."""
    path, text = folder / STUDY, resolved(config)
    if not path.exists():
        if {path.name for path in folder.iterdir()} - {ROLLOUTS}:
            raise RunError(f"{folder} is not empty and holds no study; choose another folder")
        write_file(path, text)
    elif path.read_text(encoding="utf-8") != text:
        raise RunError(f"{folder} holds another study than '{config.name}' as it is now ({path} differs); "
                       "choose another folder with --out, or run the old study")  # fmt: skip


def _seeing(config: StudyConfig) -> tuple[str, ...]:
    """Names of the policies that look at a rendered sensor.

    Raises:
        ScenarioError: one cannot be loaded, or two have the same name.
    """
    loaded = load_policies(config.policies)
    try:
        return tuple(each.name for each in loaded if each.host.needs.cameras or each.host.needs.lidars)
    finally:
        for policy in loaded:
            policy.host.close()


def _finished(task: Task) -> bool:
    """Whether all rollouts of a world are scored, and none failed."""
    path = task.world_folder / VALUES
    return path.exists() and not (pl.read_parquet(path)["status"] != "ok").any()


def _run(
    executor: Executor, work: Callable[[Task], list[str]], tasks: Sequence[Task], stage: str,
    count: Callable[[str, int, int], None], tell: Callable[[str], None],
) -> None:  # fmt: skip
    """Runs tasks, and reports how many are done."""
    done = 0

    def tick() -> None:
        count(stage, done, len(tasks))

    for _, messages in executor.run(work, tasks, tick):
        done += 1
        tick()
        for message in messages:
            tell(message)


def _counted(say: Progress, first: float, share: float) -> Callable[[str, int, int], None]:
    return lambda stage, done, of: say(f"{stage}, {done} of {of}", first + share * done / max(of, 1))


class _Rollouts:
    """Progress of driving: counts the finished rollouts on disk, whoever wrote them."""

    def __init__(self, folder: Path, total: int, say: Progress) -> None:
        self._folder, self._total, self._say = folder / ROLLOUTS, total, say
        self._since_s, self._before = time.monotonic(), -1
        self._next_s = 0.0

    def count(self, stage: str, done: int, of: int) -> None:
        """Says how many are finished, and how many per minute."""
        now_s = time.monotonic()
        # Looking through thousands of folders takes a while: at most every few seconds.
        if now_s < self._next_s and done < of:
            return
        self._next_s = now_s + 3.0
        finished = len(layout.rollout_folders(self._folder))
        if self._before < 0:
            self._before = finished
        text = f"{stage}, {finished} of {self._total} rollouts"
        if finished > self._before and now_s > self._since_s:
            text += f", {60 * (finished - self._before) / (now_s - self._since_s):.1f} per minute"
        share = RECORD_SHARE + REBUILD_SHARE + DRIVE_SHARE * finished / self._total
        self._say(text, share)
