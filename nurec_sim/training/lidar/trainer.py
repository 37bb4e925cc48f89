"""The training loop of the LiDAR branch; the run folder is that of ``training.trainer``, without sample pictures."""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from nurec_sim.compute.cores import in_order
from nurec_sim.errors import TrainingError
from nurec_sim.files.new_files import write_file
from nurec_sim.network.checkpoints.state_dicts import save_weights
from nurec_sim.network.lidar.branch import build_lidar
from nurec_sim.network.lidar.profiles import LIDAR_PROFILES
from nurec_sim.training import checkpoint
from nurec_sim.training.checkpoint import Position
from nurec_sim.training.curve_file import Curve
from nurec_sim.training.lidar.config import LidarTrainingConfig
from nurec_sim.training.lidar.objective import scan_loss
from nurec_sim.training.lidar.places import generate_places, place_names, read_place
from nurec_sim.training.lidar.samples import ScanSample, scan_sample
from nurec_sim.training.rates import learning_rate
from nurec_sim.training.trainer import CURVES, RECIPE, WEIGHTS
from nurec_sim.training.updates import update

COLUMNS = ("step", "stage", "seconds", "rate", "loss", "range", "intensity", "alpha", "drop", "label", "median_range",
           "holes", "gradient", "skipped")  # fmt: skip
Progress = Callable[[str, float], None]


class LidarTrainer:
    """One run of a recipe; the sample of a step depends on the seed, the step and the places only.

    Args:
        config: the recipe.
        folder: the run folder; an unfinished run of the same recipe is resumed.
        places: folder of the generated places, which runs may share.
        threads: of the renderer; its default if None.

    Raises:
        TrainingError: the folder holds a run of another recipe, or a damaged one.
    """

    def __init__(self, config: LidarTrainingConfig, folder: Path, places: Path, threads: int | None = None) -> None:
        self.config, self.folder, self.places, self.threads = config, folder, places, threads
        self.position = checkpoint.read_position(folder) or Position(0, 0.0, config.digest())
        if self.position.digest != config.digest():
            raise TrainingError(f"{folder} holds a run of another recipe; choose another folder, or remove it")
        self.model = build_lidar(LIDAR_PROFILES[config.profile], config.seed).train()
        self.average = copy.deepcopy(self.model).requires_grad_(False)
        self._moments: dict[str, torch.Tensor] = {}
        if self.position.step:
            self._moments = checkpoint.load_networks(folder, self.model, self.average)
        self._since = time.perf_counter()

    def run(self, progress: Progress | None = None, until: int | None = None) -> None:
        """Trains to the end of the recipe, or up to a step; generates missing places first."""
        report, config = progress or (lambda stage, fraction: None), self.config
        write_file(self.folder / RECIPE, config.model_dump_json(indent=1) + "\n")
        names = place_names(config.data)
        for done, _ in enumerate(generate_places(config.data, self.places)):
            report("generating sweeps", 0.0 if not len(names) else 0.2 * done / len(names))
        parameters = dict(self.model.named_parameters())
        optimiser = torch.optim.AdamW(
            parameters.values(), lr=config.learning_rate, betas=(0.9, 0.98), weight_decay=config.weight_decay
        )
        checkpoint.restore_optimiser(optimiser, parameters, self._moments)
        self._moments = {}
        curve = Curve(self.folder / CURVES, self.position.step, COLUMNS)
        last = config.steps if until is None else min(until, config.steps)
        self._since = time.perf_counter()
        for sample in in_order(lambda step: self._sample(names, step), range(self.position.step, last)):
            step = self.position.step
            rate = learning_rate(config, step)
            for group in optimiser.param_groups:
                group["lr"] = rate
            loss, figures = scan_loss(self.model, sample, config.losses, self.threads)
            figures |= update(
                optimiser, loss, self.model, self.average, dict(self.model.named_parameters()),
                step=step, clip_norm=self.config.clip_norm, decay=self.config.average,
            ) | {"rate": rate, "loss": float(loss.detach())}  # fmt: skip
            done = step + 1
            self.position = dataclasses.replace(self.position, step=done, seconds=self._seconds())
            curve.add("lidar", {name: value for name, value in figures.items() if math.isfinite(value)})
            if done % config.log_every == 0 or done == last:
                curve.write(done, self.position.seconds)
            if done % config.checkpoint_every == 0 or done == last:
                self._save(optimiser, names)
            report(f"{done}/{config.steps}, range {figures['range']:.3f} m", 0.2 + 0.8 * done / config.steps)

    def _sample(self, names: list[str], step: int) -> ScanSample:
        rng = np.random.default_rng([self.config.seed, step, 0x5CA9])
        scans = read_place(self.places / names[int(rng.integers(len(names)))])
        return scan_sample(scans, self.config.data, rng)

    def _seconds(self) -> float:
        now = time.perf_counter()
        spent, self._since = now - self._since, now
        return self.position.seconds + spent

    def _save(self, optimiser: torch.optim.AdamW, names: list[str]) -> None:
        # The names contain the hash of the settings and the towns, which determine the places.
        data = hashlib.sha256("\n".join(names).encode()).hexdigest()[:16]
        self.position = dataclasses.replace(self.position, data_hash=data)
        checkpoint.save_checkpoint(self.folder, self.model, self.average, optimiser, self.position)
        facts = {
            "recipe": self.config.model_dump_json(),
            "seed": str(self.config.seed),
            "steps": str(self.position.step),
            "seconds": f"{self.position.seconds:.0f}",
            "data": data,
            "trained_on": "procedural worlds of nurec_sim.world",
        }
        save_weights(self.average, self.folder / WEIGHTS, facts, half=True)
