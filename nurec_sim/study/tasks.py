"""The tasks of a study: record a town, reconstruct its log, drive in one world. Each skips what is finished.

::

    <study>/
      study.yaml  report.html  agreement.json  rollouts.parquet  rollouts.csv
      scenes/<scene>/plan.json  log.zip  <reconstruction>.usdz  [<reconstruction>.error.txt]
      rollouts/<scene>/<world>/scene.json  values.parquet  <policy>/<seed>/...      as in a run (docs/reports.md)
"""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nurec_sim import logs
from nurec_sim.errors import NurecSimError, ReconstructError, ScenarioError
from nurec_sim.files.new_files import write_file
from nurec_sim.metrics.aggregate import rollout_values
from nurec_sim.metrics.score import score_rollout
from nurec_sim.metrics.table import metric_table
from nurec_sim.render.support import Support, recorded_frames
from nurec_sim.runs import folder as layout
from nurec_sim.runs.added_actors import AddedActors, added_actors
from nurec_sim.runs.common_truth import with_common_truth
from nurec_sim.runs.drive import RolloutJob, drive_job
from nurec_sim.runs.policies import load_policies
from nurec_sim.runs.results import PROFILE
from nurec_sim.runs.scene_file import SceneRecord, record_scene, save_scene_record
from nurec_sim.runs.seen_support import load_support
from nurec_sim.runs.truth import TRUTH
from nurec_sim.scene import read_scene, write_scene
from nurec_sim.sim import load_scenario, scenario_file
from nurec_sim.study.config import Family, StudyConfig, control_name
from nurec_sim.study.controls import CONTROLS
from nurec_sim.types import Clip, DynamicGaussians, Gaussians, GaussianScene, Rollout, Sense, SensorFrame, SensorRequest

SCENES, ROLLOUTS, VALUES, PLAN, LOG = "scenes", "rollouts", "values.parquet", "plan.json", "log.zip"
ROAD = "offroad_true"
"""Off-road is judged by the town's map in every world: rollouts that are identical get identical verdicts."""


@dataclass(frozen=True)
class Task:
    """One piece of a study: a scene, and a world of it (empty for its recording)."""

    folder: Path
    config: StudyConfig
    scene_id: str
    family: Family
    town_seed: int
    world: str = ""

    @property
    def title(self) -> str:
        """For messages."""
        return f"{self.scene_id} {self.world}".strip()

    @property
    def scene_folder(self) -> Path:
        """Where the log and the archives of the scene are."""
        return self.folder / SCENES / self.scene_id

    @property
    def archive(self) -> Path:
        """The reconstruction of this world."""
        return self.scene_folder / f"{self.world}.usdz"

    @property
    def error_file(self) -> Path:
        """Why there is no archive."""
        return self.scene_folder / f"{self.world}.error.txt"

    @property
    def world_folder(self) -> Path:
        """Where the rollouts of this world are."""
        return layout.scene_folder(self.folder / ROLLOUTS, self.scene_id, self.world)

    @property
    def corruption(self) -> str | None:
        """Name of the corruption, if the world is a corrupted copy of a reconstruction."""
        controls = self.config.controls
        return {control_name(controls.of, how): how for how in controls.how}.get(self.world)

    @property
    def source(self) -> Task:
        """The task of the reconstruction that this world shows."""
        return dataclasses.replace(self, world=self.config.controls.of) if self.corruption else self

    def inputs(self) -> list[Path]:
        """Files of the study that exist and that the task reads."""
        if not self.world:
            return []
        needed = [self.scene_folder / name for name in (LOG, PLAN)] + [self.source.archive, self.source.error_file]
        finished = sorted(path for path in self.world_folder.rglob("*") if path.is_file())
        return [path for path in needed if path.exists()] + finished


def record(task: Task) -> list[str]:
    """Generates the town and records its log; returns messages."""
    from nurec_sim.world import street_rig, town_plan, write_town_clip

    log, plan_file = task.scene_folder / LOG, task.scene_folder / PLAN
    if log.exists() and plan_file.exists():
        return []
    settings = task.config.recording
    plan = town_plan(task.town_seed, task.family.split, task.family.template, settings.seconds)
    rig = street_rig(settings.width_px, settings.height_px, settings.lidar_rows, settings.lidar_columns)
    task.scene_folder.mkdir(parents=True, exist_ok=True)
    write_town_clip(plan, log, rig=rig, period_us=round(1e6 / settings.hz), overwrite=True)
    write_file(plan_file, plan.to_json())
    return []


def rebuild(task: Task) -> list[str]:
    """Reconstructs the log of a scene; a failure is kept as a text, for the rollouts that need the reconstruction."""
    import torch

    from nurec_sim.reconstruct import OptimizeSettings, load_method, reconstruct

    if task.archive.exists():
        return []
    torch.set_num_threads(1)
    method = load_method(task.world)
    settings: Any = None
    if method.settings is OptimizeSettings:
        # Steps, not seconds, and on the CPU: the same result on every machine, whatever else it does.
        settings = OptimizeSettings(seconds=None, steps=task.config.optimize_steps, device="cpu")
    try:
        scene = reconstruct(logs.open_clip(task.scene_folder / LOG), method, settings=settings, actors="recorded")
    except ReconstructError as error:
        write_file(task.error_file, f"{error}\n")
        return [f"{task.title} cannot be reconstructed: {error}"]
    write_scene(scene, task.archive)
    task.error_file.unlink(missing_ok=True)
    return []


def drive(task: Task) -> list[str]:
    """Drives all policies and trials in one world, and scores them; returns a message for each failure."""
    messages: list[str] = []
    config, base = task.config, load_scenario(task.family.scenario)
    log_facts = facts_of(task)
    try:
        added = added_actors(base, log_facts, scenario_file(task.family.scenario).parent)
    except ScenarioError as error:
        # Its rollouts fail, as rows of the study: they lack the actors.
        added = AddedActors()
        messages.append(f"{task.title}: {error}")
    facts = added.in_facts(log_facts)
    with _world(task, log_facts, added) as (scene, sense, support):
        record = dataclasses.replace(record_scene(scene), place=config.all_worlds.index(task.world))
        save_scene_record(record, task.world_folder)
        policies = load_policies(config.policies)
        scored = []
        try:
            for policy in policies:
                for seed in config.seeds(task.town_seed):
                    target = layout.rollout_folder(task.folder / ROLLOUTS, task.scene_id, task.world, policy.name, seed)
                    job = RolloutJob(scene, record, policy, seed, base, target, compared=True)
                    rollout = job.finished(messages.append)
                    if rollout is None:
                        rollout = drive_job(job, sense, False, None, lambda share: None, support)
                    if rollout.status != "ok":
                        messages.append(f"{job.title} failed: {rollout.error}")
                    scored.append((rollout, load_support(target / layout.SUPPORT)))
        finally:
            for policy in policies:
                policy.host.close()
    _save_values(task, scored, record, facts)
    return messages


def facts_of(task: Task) -> GaussianScene:
    """The facts of a scene, as its log has them, without anything to render."""
    clip: Clip = logs.open_clip(task.scene_folder / LOG)
    return GaussianScene(
        id=task.scene_id, static=Gaussians.empty(), dynamic=DynamicGaussians.empty(),
        sky=np.zeros((6, 1, 1, 3), np.float32), isp={}, rig=clip.rig, ego=clip.ego, tracks=tuple(clip.tracks),
        road_map=clip.road_map, span_us=clip.span_us,
        camera_times_us={name: clip.camera_times_us(name) for name in clip.rig.cameras},
        provenance={"method": TRUTH, "unknown": []},
    )  # fmt: skip


@contextmanager
def _world(
    task: Task, facts: GaussianScene, added: AddedActors
) -> Iterator[tuple[GaussianScene, Sense, Support | None]]:
    """The scene of a world with the facts of the log, what renders it, and the support of a reconstruction.

    Args:
        task: which world.
        facts: of the log.
        added: actors of the scenario, which all worlds get.
    """
    if task.world == TRUTH:
        from nurec_sim.world import TownPlan, TrueWorld

        plan = TownPlan.from_json((task.scene_folder / PLAN).read_text(encoding="utf-8"))
        with TrueWorld(added.in_town(plan)) as town:
            yield added.in_facts(facts), town.sense, None
        return
    from nurec_sim.render import make_renderer

    source, corruption = task.source, task.corruption
    named = {**facts.provenance, "method": source.world, "reconstruction": task.world}
    if not source.archive.exists():
        text = source.error_file.read_text(encoding="utf-8").strip()
        yield dataclasses.replace(added.in_facts(facts), provenance=named), _failing(text), None
        return
    scene = read_scene(source.archive)
    scene = added.in_scene(with_common_truth([facts, scene])[1])
    if corruption is not None:
        scene = CONTROLS[corruption](scene)
    scene = dataclasses.replace(scene, provenance={**scene.provenance, **named})
    renderer = make_renderer(scene, "cpu", threads=1)
    yield scene, renderer.sense, Support(renderer) if recorded_frames(scene) else None


def _failing(text: str) -> Sense:
    """A renderer for a world that could not be made: it fails the rollouts that look at something."""

    def sense(requests: Sequence[SensorRequest]) -> list[SensorFrame]:
        raise NurecSimError(f"this world could not be reconstructed: {text}")

    return sense


def _save_values(
    task: Task, rollouts: Sequence[tuple[Rollout, dict[int, float]]], record: SceneRecord, facts: GaussianScene
) -> None:
    """One row per rollout and metric."""
    scored = [
        (rollout, score_rollout(rollout, record.grid, facts.road_map, PROFILE, actors_known=True, support=support))
        for rollout, support in rollouts
    ]
    values = rollout_values(metric_table(scored, task.config.name), PROFILE, ROAD)
    content = io.BytesIO()  # so that a disk error is reported as one
    values.write_parquet(content)
    write_file(task.world_folder / VALUES, content.getvalue())
