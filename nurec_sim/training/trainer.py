"""The training loop: consecutive stages, with curves, checkpoints and sample renderings in a run folder.

A run folder holds ``recipe.json``, ``curves.csv`` (also plotted), ``checkpoint.safetensors`` (to resume),
``weights.safetensors`` (the moving average in half precision, for inference) and ``samples/``. Under torchrun every
process takes its own samples, and DDP averages the gradients; only the first process writes files.
"""

from __future__ import annotations

import copy
import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from nurec_sim import network
from nurec_sim.errors import TrainingError
from nurec_sim.files.new_files import write_file
from nurec_sim.network.checkpoints.state_dicts import save_weights
from nurec_sim.training import checkpoint
from nurec_sim.training.checkpoint import Position
from nurec_sim.training.config import Stage, TrainingConfig
from nurec_sim.training.curve_file import Curve
from nurec_sim.training.curves import write_curves
from nurec_sim.training.data.sample import TrainingSample
from nurec_sim.training.data.samples import Samples
from nurec_sim.training.losses.objective import Objective, StepOutputs
from nurec_sim.training.processes import Processes
from nurec_sim.training.rates import learning_rate
from nurec_sim.training.rendering import PerceptualLoss
from nurec_sim.training.start import load_shared, prepare
from nurec_sim.training.updates import update

WEIGHTS, RECIPE, CURVES, SAMPLES = "weights.safetensors", "recipe.json", "curves.csv", "samples"
COLUMNS = (
    "step", "stage", "seconds", "rate", "loss", "abs_rel", "psnr", "depth", "edges", "normal", "semantic", "rgb", "sky",
    "motion", "colour", "perceptual", "opacity", "rendered_depth", "gradient", "skipped",
)  # fmt: skip
Progress = Callable[[str, float], None]


class Trainer:
    """One run of a recipe.

    Args:
        config: the recipe.
        folder: the run folder; an unfinished run of the same recipe is resumed.
        samples: source of the samples.
        perceptual: the perceptual term.
        processes: this process among those of the run.
        threads: threads of the renderer; its default if None.

    Raises:
        TrainingError: the folder holds a run of another recipe, or a damaged one.
        WeightsError: ``config.start`` cannot be read.
    """

    def __init__(
        self,
        config: TrainingConfig,
        folder: Path,
        samples: Samples,
        perceptual: PerceptualLoss,
        processes: Processes | None = None,
        threads: int | None = None,
    ) -> None:
        self.config, self.folder, self.samples, self.perceptual = config, folder, samples, perceptual
        self.processes = processes or Processes.alone()
        self.threads = threads
        self.position = checkpoint.read_position(folder) or Position(0, 0.0, config.digest())
        if self.position.digest != config.digest():
            raise TrainingError(f"{folder} holds a run of another recipe; choose another folder, or remove it")
        self.model = network.build(config.profile, seed=config.seed)
        prepare(self.model)
        if config.start is not None and self.position.step == 0:
            load_shared(self.model, config.start)
        self.average = copy.deepcopy(self.model).requires_grad_(False)
        self._moments: dict[str, Tensor] = {}
        if self.position.step:
            self._moments = checkpoint.load_networks(folder, self.model, self.average)
        self._since = time.perf_counter()

    def run(self, progress: Progress | None = None, until: int | None = None) -> None:
        """Trains to the end of the recipe, or (for tests) up to a step."""
        report = progress or (lambda stage, fraction: None)
        if self.processes.first:
            write_file(self.folder / RECIPE, self.config.model_dump_json(indent=1) + "\n")
        report("waiting for a first town", self.position.step / self.config.steps)
        last = self.config.steps if until is None else min(until, self.config.steps)
        for stage, first in _stages_with_starts(self.config):
            if self.position.step < first + stage.steps and self.position.step < last:
                self._train_stage(stage, first, min(last, first + stage.steps), report)
        if self.processes.first and self.position.step:
            write_curves(self.folder)

    def _train_stage(self, stage: Stage, first: int, last: int, report: Progress) -> None:
        objective = Objective(self.model, stage, self.perceptual, self.config.precision, self.threads)
        objective.train()
        trained = objective.trained()
        optimiser = torch.optim.AdamW(
            _groups(trained, self.config.weight_decay), lr=stage.learning_rate, betas=(0.9, 0.98), eps=1e-8
        )
        checkpoint.restore_optimiser(optimiser, trained, self._moments)
        self._moments = {}
        wrapped = self.processes.wrap(objective)
        curve = Curve(self.folder / CURVES, self.position.step, COLUMNS) if self.processes.first else None
        with self.samples.stream(stage, self.position.step, self.processes) as stream:
            for step in range(self.position.step, last):
                sample = next(stream)
                rate = learning_rate(stage, step - first)
                for group in optimiser.param_groups:
                    group["lr"] = rate
                loss, figures, outputs = wrapped(sample)
                figures |= update(
                    optimiser, loss, self.model, self.average, trained,
                    step=step, clip_norm=self.config.clip_norm, decay=self.config.average,
                ) | {"rate": rate, "loss": float(loss.detach())}  # fmt: skip
                done = step + 1
                self.position = dataclasses.replace(self.position, step=done, seconds=self._seconds())
                if curve is not None:
                    curve.add(stage.name, figures)
                    if done % self.config.log_every == 0 or done == last:
                        curve.write(done, self.position.seconds)
                    if done % self.config.sample_every == 0 or done == last:
                        self._write_sample(done, sample, outputs)
                    # At the end of a stage the moments are dropped: the next stage trains other parameters.
                    if done % self.config.checkpoint_every == 0 or done == last:
                        self._save(None if done == first + stage.steps else optimiser)
                shown = f"PSNR {figures['psnr']:.1f} dB" if "psnr" in figures else f"AbsRel {figures['abs_rel']:.3f}"
                report(f"{stage.name} {done - first}/{stage.steps}, {shown}", done / self.config.steps)

    def _save(self, optimiser: torch.optim.AdamW | None) -> None:
        self.position = dataclasses.replace(self.position, data_hash=self.samples.data_hash())
        checkpoint.save_checkpoint(self.folder, self.model, self.average, optimiser, self.position)
        self._write_weights()

    def _seconds(self) -> float:
        now = time.perf_counter()
        spent, self._since = now - self._since, now
        return self.position.seconds + spent

    def _write_weights(self) -> None:
        # File names without folders: the weights are published, local paths are not.
        named = {key: Path(path.name) for key in ("start", "lpips") if (path := getattr(self.config, key))}
        facts = {
            "recipe": self.config.model_copy(update=named).model_dump_json(),
            "seed": str(self.config.seed),
            "steps": str(self.position.step),
            "seconds": f"{self.position.seconds:.0f}",
            "data": self.position.data_hash,
            "trained_on": "procedural worlds of nurec_sim.world",
        }
        save_weights(self.average, self.folder / WEIGHTS, facts, half=True)

    def _write_sample(self, step: int, sample: TrainingSample, outputs: StepOutputs) -> None:
        from nurec_sim.training.view import sample_sheet

        renders = [rendering.rgb.detach().numpy() for rendering in outputs.renderings]
        sheet = sample_sheet(sample, outputs.context, renders)
        picture = cv2.imencode(".png", np.ascontiguousarray(sheet[..., ::-1]))[1]
        write_file(self.folder / SAMPLES / f"{step:06d}.png", picture.tobytes())


def _stages_with_starts(config: TrainingConfig) -> Iterator[tuple[Stage, int]]:
    first = 0
    for stage in config.stages:
        yield stage, first
        first += stage.steps


def _groups(trained: Mapping[str, nn.Parameter], decay: float) -> list[dict[str, object]]:
    """Weight decay for matrices and kernels only, not for biases, norms, scales, tokens and position embeddings."""
    decays = [each for name, each in trained.items() if each.ndim >= 2 and not name.endswith(("embed", "tokens"))]
    known = {id(each) for each in decays}
    others = [each for each in trained.values() if id(each) not in known]
    return [{"params": decays, "weight_decay": decay}, {"params": others, "weight_decay": 0.0}]
