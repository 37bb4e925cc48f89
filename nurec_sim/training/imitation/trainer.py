"""Trains the end-to-end policies of a recipe, one after the other.

::

    <run>/recipe.json  curves.csv  <policy>.safetensors  <policy>/checkpoint.safetensors
"""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import cast

import torch
from torch import Tensor

from nurec_sim.errors import TrainingError
from nurec_sim.files.new_files import write_file
from nurec_sim.network.checkpoints.state_dicts import save_weights
from nurec_sim.plugins import load_policy
from nurec_sim.training import checkpoint
from nurec_sim.training.checkpoint import Position
from nurec_sim.training.curve_file import Curve
from nurec_sim.training.imitation.config import ImitationConfig
from nurec_sim.training.imitation.drives import PATH_M, Drives, drive_names, generate_drives, read_drives
from nurec_sim.training.imitation.examples import Batch, Examples, Learner
from nurec_sim.training.imitation.network import DrivingNetwork
from nurec_sim.training.rates import learning_rate
from nurec_sim.training.trainer import CURVES, RECIPE
from nurec_sim.training.updates import update

COLUMNS = ("step", "stage", "seconds", "rate", "loss", "path", "speed", "held_out_path_10m", "held_out_path_20m",
           "held_out_speed_2s", "gradient", "skipped")  # fmt: skip
MEASURED = 512
SHARED = ("convolutions.", "camera.")
NEAR_M = 6.0
"""Points of the path up to here have the same weight; the others weigh less in proportion to their distance."""
Progress = Callable[[str, float], None]


class ImitationTrainer:
    """One run of a recipe; resuming gives the same bytes.

    Args:
        config: the recipe.
        folder: the run folder; an unfinished run of the same recipe is resumed.
        drives: folder of the generated examples, which runs may share.
        backend: that renders them, see ``world.TrueWorld``.

    Raises:
        TrainingError: the folder holds a run of another recipe, or a damaged one, or a policy cannot be trained.
    """

    def __init__(self, config: ImitationConfig, folder: Path, drives: Path, backend: str | None = None) -> None:
        self.config, self.folder, self.drives, self.backend = config, folder, drives, backend
        self.learners = {name: _learner(name) for name in config.policies}
        self.positions = {}
        for name in config.policies:
            position = checkpoint.read_position(folder / name) or Position(0, 0.0, config.digest())
            if position.digest != config.digest():
                raise TrainingError(f"{folder} holds a run of another recipe; choose another folder, or remove it")
            self.positions[name] = position

    def run(self, progress: Progress | None = None, until: int | None = None) -> list[Path]:
        """Generates missing examples, then trains; returns the files of the weights.

        Args:
            progress: called with a text and the share done.
            until: stop after this step, counted over all policies.
        """
        report, config = progress or (lambda stage, share: None), self.config
        write_file(self.folder / RECIPE, config.model_dump_json(indent=1) + "\n")
        count = config.data.towns
        for done, _ in enumerate(generate_drives(config.data, self.drives, self.backend)):
            report(f"town {done + 1}/{count}", 0.3 * done / count)
        left = len(config.policies) * config.steps if until is None else until
        towns: list[Drives] = []
        for index, name in enumerate(config.policies):
            share = 0.3 + 0.7 * index / len(config.policies)
            last = min(config.steps, max(0, left - index * config.steps))
            if self.positions[name].step < last:
                towns = towns or [read_drives(self.drives / file) for file in drive_names(config.data)]
                self._train(name, towns, last, lambda text, part, share=share: report(  # type: ignore[misc]
                    text, share + 0.7 * part / len(config.policies)))  # fmt: skip
        return [path for path in map(self.weights_file, config.policies) if path.is_file()]

    def weights_file(self, name: str) -> Path:
        """Where the weights of a policy are written."""
        return self.folder / f"{name}.safetensors"

    def _train(self, name: str, towns: list[Drives], last: int, report: Progress) -> None:
        config, learner, folder = self.config, self.learners[name], self.folder / name
        seen = Examples([t for k, t in enumerate(towns) if (k + 1) % config.held_out or len(towns) == 1], learner,
                        lambda share: report(f"{name}: preparing images", 0.1 * share))  # fmt: skip
        kept = towns[config.held_out - 1 :: config.held_out] or towns[:1]
        measured = Examples(kept, learner, lambda share: None).measuring(MEASURED)
        model = DrivingNetwork(learner.shapes(), config.seed).train()
        position = self.positions[name]
        if position.step == 0 and (before := config.policies.index(name)):
            self._start_from(model, config.policies[before - 1])
        average = copy.deepcopy(model).requires_grad_(False).eval()
        moments = checkpoint.load_networks(folder, model, average) if position.step else {}
        parameters = dict(model.named_parameters())
        optimiser = torch.optim.AdamW(parameters.values(), lr=config.learning_rate, weight_decay=config.weight_decay)
        checkpoint.restore_optimiser(optimiser, parameters, moments)
        first = config.policies.index(name) * config.steps
        curve = Curve(self.folder / CURVES, first + position.step, COLUMNS)
        since = time.perf_counter()
        for step in range(position.step, last):
            rate = learning_rate(config, step)
            for group in optimiser.param_groups:
                group["lr"] = rate
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(config.seed * 1_000_003 + step)  # of the dropout
                loss, figures = imitation_loss(model, seen.training(config, step))
            figures |= {"rate": rate, "loss": float(loss.detach())}
            figures |= update(optimiser, loss, model, average, parameters, step=step, clip_norm=config.clip_norm,
                              decay=config.average)  # fmt: skip
            curve.add(name, figures)
            done = step + 1
            keeps = done % config.checkpoint_every == 0 or done == last
            if keeps:
                curve.add(name, held_out_errors(average, measured))
            if keeps or done % config.log_every == 0:
                now = time.perf_counter()
                position = dataclasses.replace(position, step=done, seconds=position.seconds + now - since)
                since = now
                curve.write(first + done, position.seconds)
            if keeps:
                self.positions[name] = position
                self._save(name, model, average, optimiser)
            report(f"{name} {done}/{config.steps}, loss {figures['loss']:.3f}", 0.1 + 0.9 * done / config.steps)

    def _start_from(self, model: DrivingNetwork, before: str) -> None:
        """Copies what all cameras share from the policy trained before."""
        other = DrivingNetwork(self.learners[before].shapes())
        checkpoint.load_networks(self.folder / before, copy.deepcopy(other), other)
        state = {key: value for key, value in other.state_dict().items() if key.startswith(SHARED)}
        model.load_state_dict({**model.state_dict(), **state})

    def _save(
        self, name: str, model: DrivingNetwork, average: DrivingNetwork, optimiser: torch.optim.AdamW
    ) -> None:  # fmt: skip
        position, names = self.positions[name], drive_names(self.config.data)
        # The names contain the hash of the settings and the towns, which determine the examples.
        data = hashlib.sha256("\n".join(names).encode()).hexdigest()[:16]
        position = self.positions[name] = dataclasses.replace(position, data_hash=data)
        checkpoint.save_checkpoint(self.folder / name, model, average, optimiser, position)
        facts = {
            "recipe": self.config.model_dump_json(),
            "policy": name,
            "seed": str(self.config.seed),
            "steps": str(position.step),
            "data": data,
            "trained_on": "procedural worlds of nurec_sim.world",
        }
        save_weights(average, self.weights_file(name), facts, half=True)


def _learner(name: str) -> Learner:
    """A policy that can be trained.

    Raises:
        TrainingError: it has no network.
    """
    policy = load_policy(name)
    if not all(hasattr(policy, part) for part in ("shapes", "view", "numbers", "targets", "path_m", "after_s")):
        raise TrainingError(f"policy '{name}' has no network to train")
    return cast(Learner, policy)


def imitation_loss(model: DrivingNetwork, batch: Batch) -> tuple[Tensor, dict[str, float]]:
    """Mean absolute error of path and speeds, in the network's units (10 m, 10 m/s), and its two terms."""
    error = (_outputs(model, batch) - torch.from_numpy(batch.targets)).abs()
    count = 2 * len(PATH_M)
    weight = torch.from_numpy(NEAR_M / PATH_M).clamp(max=1.0).float().repeat_interleave(2)
    path, speed = (error[:, :count] * weight).sum(dim=1).mean() / 2, error[:, count:].mean()
    return path + speed, {"path": float(path.detach()), "speed": float(speed.detach())}


def held_out_errors(model: DrivingNetwork, batch: Batch) -> dict[str, float]:
    """Mean errors on towns that training has not seen: of the path, metres, and of the speed, m/s."""
    with torch.no_grad():
        error = 10 * (_outputs(model, batch) - torch.from_numpy(batch.targets))
    count = 2 * len(PATH_M)
    path = error[:, :count].reshape(len(error), -1, 2).norm(dim=2).mean(dim=0)
    speed = error[:, count:].abs().mean(dim=0)
    return {"held_out_path_10m": float(path[2]), "held_out_path_20m": float(path[4]),
            "held_out_speed_2s": float(speed[2])}  # fmt: skip


def _outputs(model: DrivingNetwork, batch: Batch) -> Tensor:
    outputs: Tensor = model(torch.from_numpy(batch.images), torch.from_numpy(batch.numbers))
    return outputs
