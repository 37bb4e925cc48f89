"""Drive policies through scenes into a run folder; whatever is finished there already is kept."""

from __future__ import annotations

import datetime
import json
import platform
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import yaml

from nurec_sim.errors import NurecSimError, ScenarioError, WriteError
from nurec_sim.new_files import writing
from nurec_sim.plugins import load_policy
from nurec_sim.runs import folder as layout
from nurec_sim.runs.results import write_report
from nurec_sim.runs.rollout_file import load_rollout, save_rollout
from nurec_sim.runs.scene_file import SceneRecord, record_scene, save_scene_record
from nurec_sim.runs.video import record_video
from nurec_sim.sim import Scenario, run_rollout
from nurec_sim.sim.actors import Actors
from nurec_sim.sim.sensing import find_camera
from nurec_sim.types import GaussianScene, Policy, Rollout, Sense

Progress = Callable[[str, float], None]
DRIVING_SHARE = 0.6
"""Share of a rollout's progress that driving takes; its video takes the rest."""


@dataclass(frozen=True)
class _Job:
    """One rollout to be driven."""

    scene: GaussianScene
    record: SceneRecord
    reference: str
    policy: Policy
    seed: int
    scenario: Scenario
    target: Path

    @property
    def scenario_text(self) -> str:
        """The scenario as it is run, every key written out; it can be loaded again."""
        resolved = self.scenario.model_copy(update={"seeds": (self.seed,), "policies": (self.reference,)})
        return yaml.safe_dump(resolved.model_dump(mode="json"), sort_keys=False)

    @property
    def versions_text(self) -> str:
        """What the rollout depends on."""
        packages = {}
        for name in ("nurec-sim", "numpy", "scipy", "numba", "opencv-contrib-python-headless", "av", "torch"):
            try:
                packages[name] = version(name)
            except PackageNotFoundError:
                continue
        facts = {"python": platform.python_version(), "machine": platform.machine(), "packages": packages}
        return json.dumps({**facts, "scene_sha256": self.record.sha256}, indent=1) + "\n"

    def finished(self) -> bool:
        """Whether the folder holds this very rollout: it did not fail, same scenario, same scene."""
        files = {name: self.target / name for name in (layout.ROLLOUT, layout.SCENARIO, layout.VERSIONS)}
        if not all(path.is_file() for path in files.values()) or (self.target / layout.ERROR).exists():
            return False
        if files[layout.SCENARIO].read_text(encoding="utf-8") != self.scenario_text:
            return False
        try:
            return json.loads(files[layout.VERSIONS].read_text(encoding="utf-8"))["scene_sha256"] == self.record.sha256
        except (ValueError, KeyError, TypeError):
            return False


def execute(
    scenes: Sequence[GaussianScene],
    scenario: Scenario,
    policies: Sequence[str | Policy],
    sense_for: Callable[[str], Sense],
    out_dir: Path | str,
    *,
    seeds: Sequence[int] | None = None,
    resume: Path | str | None = None,
    video: bool = True,
    progress: Progress | None = None,
    stamp: str | None = None,
) -> Path:
    """Drive every policy through every scene with every seed, score all, and write the report.

    A rollout that fails is kept with its error and is a row of every table. Interrupted at any time, the folder holds
    complete rollouts only; the same call with ``resume`` drives those that are missing, failed, or were driven under
    another scenario or scene.

    Args:
        scenes: what to drive through.
        scenario: how.
        policies: references as ``plugins.load_policy`` takes them, or policies.
        sense_for: scene id -> the renderer of that scene; called once per scene, when it is first needed.
        out_dir: folder that collects run folders.
        seeds: the scenario's own if None.
        resume: a run folder to go on with, instead of a new one.
        video: also record the front camera of every rollout.
        progress: hears what is being done and the share that is done.
        stamp: name of the new run folder; the local date and time if None.

    Returns:
        The run folder.

    Raises:
        ScenarioError: nothing to drive, a policy cannot be loaded, or two policies or scenes have the same name.
        RunError: ``resume`` is no folder.
    """
    say = progress or (lambda stage, share: None)
    seeds = tuple(scenario.seeds if seeds is None or len(seeds) == 0 else seeds)
    loaded = _load_policies(policies)
    _check_scenes(scenes)
    if resume is None:
        stamp = stamp or datetime.datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
        run = layout.new_run_folder(Path(out_dir), stamp)
    else:
        run = layout.existing_run_folder(Path(resume))
        layout.point_latest(run)
    jobs = []
    for index, scene in enumerate(scenes):
        say(f"reading the road of {scene.id}", 0.05 * index / len(scenes))
        record = record_scene(scene)
        save_scene_record(record, layout.scene_folder(run, record.id, record.reconstruction))
        for reference, policy in loaded:
            for seed in seeds:
                target = layout.rollout_folder(run, scene.id, record.reconstruction, policy.name, seed)
                jobs.append(_Job(scene, record, reference, policy, seed, scenario, target))
    senses: dict[str, Sense] = {}
    for index, job in enumerate(jobs):

        def advance(share: float, job: _Job = job, index: int = index) -> None:
            done = min(0.05 + 0.9 * (index + share) / len(jobs), 0.95)
            say(f"{job.policy.name} in {job.scene.id}, seed {job.seed}", done)

        advance(0.0)
        wants_video = video and bool(job.scene.rig.cameras)
        done = job.finished()
        if done and (not wants_video or (job.target / layout.VIDEO).exists()):
            continue
        if job.scene.id not in senses:
            senses[job.scene.id] = sense_for(job.scene.id)
        _drive(job, senses[job.scene.id], wants_video, done, advance)
    say("scoring", 0.95)
    write_report(run, progress=lambda stage, share: say(stage, 0.95 + 0.05 * share))
    say("", 1.0)
    return run


def _drive(job: _Job, sense: Sense, video: bool, driven: bool, advance: Callable[[float], None]) -> None:
    """Drive one job (unless only its video is missing) and put its folder in place."""
    if driven:
        rollout = load_rollout(job.target / layout.ROLLOUT)
    else:
        rollout = run_rollout(
            job.scenario, job.policy, sense, job.scene, reconstruction=job.record.reconstruction, seed=job.seed,
            progress=lambda share: advance(share * (DRIVING_SHARE if video else 1.0)),
        )  # fmt: skip
    with layout.written_at_once(job.target) as part:
        save_rollout(rollout, part / layout.ROLLOUT)
        (part / layout.SCENARIO).write_text(job.scenario_text, encoding="utf-8")
        (part / layout.VERSIONS).write_text(job.versions_text, encoding="utf-8")
        if rollout.status != "ok":
            (part / layout.ERROR).write_text(rollout.error + "\n", encoding="utf-8")
        if video and rollout.states:
            _record(job, rollout, sense, part, lambda share: advance(DRIVING_SHARE + share * (1 - DRIVING_SHARE)))


def _record(job: _Job, rollout: Rollout, sense: Sense, part: Path, advance: Callable[[float], None]) -> None:
    """Record the front camera; a renderer that fails costs the video, not the rollout."""
    try:
        camera = find_camera(job.scene.rig, "front")
        actors = Actors(job.scene.tracks, job.scenario.actors)
        with writing(part / layout.VIDEO):
            record_video(
                rollout,
                sense,
                camera,
                part / layout.VIDEO,
                grid=job.record.grid,
                overrides=actors.overrides,
                progress=advance,
            )
    except WriteError:
        raise
    except NurecSimError as error:
        (part / layout.VIDEO).unlink(missing_ok=True)
        (part / layout.VIDEO_ERROR).write_text(f"{error}\n", encoding="utf-8")


def _load_policies(policies: Sequence[str | Policy]) -> list[tuple[str, Policy]]:
    if not policies:
        raise ScenarioError("no policy to drive: name one, or let the scenario list some under 'policies'")
    loaded = [(entry, load_policy(entry)) if isinstance(entry, str) else (entry.name, entry) for entry in policies]
    names = [layout.folder_name(policy.name) for _, policy in loaded]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ScenarioError(f"policies need different names, but {twice} come more than once")
    odd = [policy.name for _, policy in loaded if not re.search(r"[A-Za-z0-9]", policy.name)]
    if odd:
        raise ScenarioError(f"a policy's name needs a letter or a digit, got {odd}")
    return loaded


def _check_scenes(scenes: Sequence[GaussianScene]) -> None:
    if not scenes:
        raise ScenarioError("no scene to drive through")
    names = [layout.folder_name(scene.id) for scene in scenes]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ScenarioError(f"scenes need different ids, but {twice} come more than once")
