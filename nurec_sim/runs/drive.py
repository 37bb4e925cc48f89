"""Runs policies in scenes into a run folder; finished rollouts are kept."""

from __future__ import annotations

import datetime
import json
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import yaml

import nurec_sim
from nurec_sim.errors import RunError, ScenarioError
from nurec_sim.render.support import Support
from nurec_sim.runs import folder as layout
from nurec_sim.runs.policies import LoadedPolicy, load_policies
from nurec_sim.runs.recording import Recorder, record_recording
from nurec_sim.runs.results import write_report
from nurec_sim.runs.rollout_file import load_rollout, save_rollout
from nurec_sim.runs.scene_file import SceneRecord, reconstruction_of, record_scene, save_scene_record
from nurec_sim.runs.seen_support import save_support, seen_support
from nurec_sim.sim import Scenario, run_rollout
from nurec_sim.sim.policy_host import PLAN_TIMEOUT_S
from nurec_sim.types import Clip, GaussianScene, Policy, Rollout, Sense

Progress = Callable[[str, float], None]
Notice = Callable[[str], None]
SupportFor = Callable[[GaussianScene], Support | None]
DRIVING_SHARE = 0.6
"""Fraction of a rollout's progress for driving; the rest is its video."""


@dataclass(frozen=True)
class RolloutJob:
    """One rollout to run: what is driven, by whom, and the folder that it is written to."""

    scene: GaussianScene
    record: SceneRecord
    policy: LoadedPolicy
    seed: int
    scenario: Scenario
    target: Path
    compared: bool
    """Whether the run has other reconstructions of the same log."""

    @property
    def scenario_text(self) -> str:
        """The fully resolved scenario, as loadable YAML."""
        resolved = self.scenario.model_copy(update={"seeds": (self.seed,), "policies": (self.policy.reference,)})
        return yaml.safe_dump(resolved.model_dump(mode="json"), sort_keys=False)

    @property
    def versions_text(self) -> str:
        """Software versions and scene hash."""
        packages = {"nurec-sim": nurec_sim.__version__}
        for name in ("numpy", "scipy", "numba", "opencv-contrib-python-headless", "av", "torch"):
            try:
                packages[name] = version(name)
            except PackageNotFoundError:
                continue
        facts = {"python": platform.python_version(), "machine": platform.machine(), "packages": packages}
        return json.dumps({**facts, "scene_sha256": self.record.sha256}, indent=1) + "\n"

    @property
    def title(self) -> str:
        """Display name of the rollout."""
        return f"{self.policy.name} in {self.scene.id} ({self.record.reconstruction}), seed {self.seed}"

    def finished(self, notice: Notice) -> Rollout | None:
        """The stored rollout if it is readable, did not fail, and has the same scenario and scene."""
        files = {name: self.target / name for name in (layout.ROLLOUT, layout.SCENARIO, layout.VERSIONS)}
        if not all(path.is_file() for path in files.values()) or (self.target / layout.ERROR).exists():
            return None
        try:
            if files[layout.SCENARIO].read_text(encoding="utf-8") != self.scenario_text:
                return None
            driven_in = json.loads(files[layout.VERSIONS].read_text(encoding="utf-8"))["scene_sha256"]
            return load_rollout(files[layout.ROLLOUT]) if driven_in == self.record.sha256 else None
        except (ValueError, KeyError, TypeError):
            return None
        except RunError as error:
            notice(f"{self.title} is repeated: {error}")
            return None


def execute(
    scenes: Sequence[GaussianScene],
    scenario: Scenario,
    policies: Sequence[str | Policy | LoadedPolicy],
    sense_for: Callable[[GaussianScene], Sense],
    out_dir: Path | str,
    *,
    logs: Mapping[str, Clip] | None = None,
    fidelity: Mapping[tuple[str, str], Mapping[str, Any]] | None = None,
    seeds: Sequence[int] | None = None,
    resume: Path | str | None = None,
    video: bool = True,
    progress: Progress | None = None,
    notice: Notice | None = None,
    stamp: str | None = None,
    plan_timeout_s: float = PLAN_TIMEOUT_S,
    support_for: SupportFor | None = None,
) -> Path:
    """Runs every policy in every scene with every seed, computes metrics, and writes the report.

    A failed rollout is kept with its error as a row of every table, without a video. The folder contains complete
    rollouts only, even after an interruption; the same call with ``resume`` runs those that are missing, failed,
    damaged, or belong to another scenario or scene.

    Args:
        scenes: the scenes. Several of one id are reconstructions of one log, to be compared with the first; they should
            have the same facts (``common_truth.with_common_truth``).
        scenario: the scenario.
        policies: references for ``plugins.load_policy``, policies, or results of ``load_policies``.
        sense_for: scene -> its renderer; called once per scene, on first use.
        out_dir: parent folder of run folders.
        logs: logs by scene id, for videos of what was recorded beside those of reconstructions.
        fidelity: results of ``evaluate.measure_fidelity`` by scene id and reconstruction, for the report.
        seeds: default: those of the scenario.
        resume: run folder to resume.
        video: also record the front camera of every rollout.
        progress: called with stage and fraction done.
        notice: called with a line of text for failed rollouts and damaged files.
        stamp: name of the new run folder; the local date and time if None.
        plan_timeout_s: time limit for creating a policy, and for each plan.
        support_for: scene -> what its cameras recorded, or None if that is not known; called once per scene, when a
            policy with a camera has driven. It tells how much of what policies saw rests on recorded views; None does
            not measure it.

    Returns:
        The run folder.

    Raises:
        ScenarioError: no policy or scene, a policy cannot be loaded, or two policies or scenes have the same name.
        RunError: ``resume`` is not a folder, or another run is writing to it.
    """
    say, tell = progress or (lambda stage, share: None), notice or (lambda text: None)
    seeds = tuple(scenario.seeds if seeds is None or len(seeds) == 0 else seeds)
    _check_scenes(scenes)
    loaded = load_policies(policies, plan_timeout_s)
    try:
        if resume is None:
            layout.tidy(Path(out_dir) / "latest")
            stamp = stamp or datetime.datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
            run = layout.new_run_folder(Path(out_dir), stamp)
        else:
            run = layout.existing_run_folder(Path(resume))
        with layout.owned(run):
            layout.point_latest(run)
            jobs = _jobs(run, scenes, scenario, loaded, seeds, fidelity or {}, say)
            _drive_all(jobs, sense_for, support_for or (lambda scene: None), video, say, tell)
            if video:
                for job in {job.scene.id: job for job in jobs if job.compared}.values():
                    if (clip := (logs or {}).get(job.scene.id)) is not None:
                        record_recording(clip, job.scene, scenario, job.target.parents[2])
            say("scoring", 0.95)
            write_report(run, progress=lambda stage, share: say(stage, 0.95 + 0.05 * share))
    finally:
        for policy in loaded:
            if policy not in policies:
                policy.host.close()
    say("", 1.0)
    return run


def _jobs(
    run: Path, scenes: Sequence[GaussianScene], scenario: Scenario, policies: Sequence[LoadedPolicy],
    seeds: Sequence[int], fidelity: Mapping[tuple[str, str], Mapping[str, Any]], say: Progress,
) -> list[RolloutJob]:  # fmt: skip
    """All rollouts of the run; also writes the scene records."""
    jobs = []
    for index, scene in enumerate(scenes):
        say(f"reading the road of {scene.id}", 0.05 * index / len(scenes))
        ids = [other.id for other in scenes]
        record = record_scene(scene, fidelity.get((scene.id, reconstruction_of(scene))), ids[:index].count(scene.id))
        save_scene_record(record, layout.scene_folder(run, record.id, record.reconstruction))
        for policy in policies:
            for seed in seeds:
                target = layout.rollout_folder(run, scene.id, record.reconstruction, policy.name, seed)
                jobs.append(RolloutJob(scene, record, policy, seed, scenario, target, compared=ids.count(scene.id) > 1))
    return jobs


def _drive_all(
    jobs: Sequence[RolloutJob], sense_for: Callable[[GaussianScene], Sense], support_for: SupportFor, video: bool,
    say: Progress, tell: Notice,
) -> None:  # fmt: skip
    """Runs all unfinished rollouts."""
    senses: dict[tuple[str, str], Sense] = {}
    supports: dict[tuple[str, str], Support | None] = {}
    for index, job in enumerate(jobs):

        def advance(share: float, job: RolloutJob = job, index: int = index) -> None:
            done = min(0.05 + 0.9 * (index + share) / len(jobs), 0.95)
            where = f"{job.scene.id} ({job.record.reconstruction})" if job.compared else job.scene.id
            say(f"{job.policy.name} in {where}, seed {job.seed}", done)

        advance(0.0)
        wants_video = video and bool(job.scene.rig.cameras)
        done = job.finished(tell)
        if done is not None and (not wants_video or (job.target / layout.VIDEO).exists()):
            continue
        key = job.scene.id, job.record.reconstruction
        if key not in senses:
            senses[key] = sense_for(job.scene)
        if key not in supports and job.policy.host.needs.cameras:
            supports[key] = support_for(job.scene)
        rollout = drive_job(job, senses[key], wants_video, done, advance, supports.get(key))
        if rollout.status != "ok":
            tell(f"{job.title} failed: {rollout.error}")


def drive_job(
    job: RolloutJob, sense: Sense, video: bool, driven: Rollout | None, advance: Callable[[float], None],
    support: Support | None = None,
) -> Rollout:  # fmt: skip
    """Runs one job (or only renders its missing video) and moves its folder into place."""
    rollout, recorder = driven, None
    if video:
        needs = job.policy.host.needs
        recorder = Recorder(job.scene, job.scenario, needs, job.record.grid, with_lidar=job.compared)
    if rollout is None:
        rollout = run_rollout(
            job.scenario, job.policy.host, sense, job.scene, reconstruction=job.record.reconstruction, seed=job.seed,
            progress=lambda share: advance(share * (DRIVING_SHARE if video else 1.0)), on_frames=recorder,
        )  # fmt: skip
    with layout.written_at_once(job.target) as part:
        save_rollout(rollout, part / layout.ROLLOUT)
        (part / layout.SCENARIO).write_text(job.scenario_text, encoding="utf-8")
        (part / layout.VERSIONS).write_text(job.versions_text, encoding="utf-8")
        if rollout.status != "ok":
            (part / layout.ERROR).write_text(rollout.error + "\n", encoding="utf-8")
        elif support is not None and job.policy.host.needs.cameras:
            found = seen_support(rollout, job.scene, job.scenario, job.policy.host.needs, support)
            save_support(found, part / layout.SUPPORT)
        if rollout.status == "ok" and recorder is not None:
            recorder.write(rollout, sense, part, lambda share: advance(DRIVING_SHARE + share * (1 - DRIVING_SHARE)))
    return rollout


def _check_scenes(scenes: Sequence[GaussianScene]) -> None:
    if not scenes:
        raise ScenarioError("no scene to run in")
    names = [(layout.folder_name(scene.id), layout.folder_name(reconstruction_of(scene))) for scene in scenes]
    twice = sorted({"/".join(name) for name in names if names.count(name) > 1})
    if twice:
        raise ScenarioError(f"scenes of one id need reconstruction names of their own; repeated: {twice}")
