"""Trains the detector of a recipe.

::

    <run>/recipe.json  curves.csv  detector.safetensors  checkpoint.safetensors
"""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor
from torch.nn import functional

from nurec_sim.errors import TrainingError
from nurec_sim.files.new_files import write_file
from nurec_sim.geometry import pose
from nurec_sim.metrics.detection import Places, added, count, match, share
from nurec_sim.network.checkpoints.state_dicts import save_weights
from nurec_sim.network.detector.codec import Detections, Objects
from nurec_sim.network.detector.detector import SCORES, detections
from nurec_sim.network.detector.model import DetectorNetwork
from nurec_sim.network.detector.objects import KINDS
from nurec_sim.training import checkpoint
from nurec_sim.training.checkpoint import Position
from nurec_sim.training.curve_file import Curve
from nurec_sim.training.detection.config import DetectorConfig
from nurec_sim.training.detection.examples import Batch, Examples
from nurec_sim.training.detection.images import TownImages, generate_images, image_camera, image_files, read_images
from nurec_sim.training.rates import learning_rate
from nurec_sim.training.trainer import CURVES, RECIPE
from nurec_sim.training.updates import update

WEIGHTS = "detector.safetensors"
HELD_OUT = ("held_out_vehicle_recall_30m", "held_out_vehicle_precision_30m")
COLUMNS = (
    "step",
    "stage",
    "seconds",
    "rate",
    "loss",
    "heat",
    "place",
    "depth",
    "shape",
    *HELD_OUT,
    "gradient",
    "skipped",
)
MEASURED = 48
"""Images of held-out towns for the curves; all of them decide on the thresholds."""
Progress = Callable[[str, float], None]


class DetectorTrainer:
    """One run of a recipe; resuming gives the same bytes.

    Args:
        config: the recipe.
        folder: the run folder; an unfinished run of the same recipe is resumed.
        images: folder of the generated images, which runs may share.
        backend: that renders them, see ``world.TrueWorld``.

    Raises:
        TrainingError: the folder holds a run of another recipe, or a damaged one.
    """

    def __init__(self, config: DetectorConfig, folder: Path, images: Path, backend: str | None = None) -> None:
        self.config, self.folder, self.images, self.backend = config, folder, images, backend
        self.position = checkpoint.read_position(folder) or Position(0, 0.0, config.digest())
        if self.position.digest != config.digest():
            raise TrainingError(f"{folder} holds a run of another recipe; choose another folder, or remove it")

    @property
    def weights_file(self) -> Path:
        """Where the weights are written."""
        return self.folder / WEIGHTS

    def run(self, progress: Progress | None = None, until: int | None = None) -> Path:
        """Generates missing images, then trains; returns the file of the weights.

        Args:
            progress: called with a text and the share done.
            until: stop after this step.
        """
        report, config = progress or (lambda stage, share: None), self.config
        write_file(self.folder / RECIPE, config.model_dump_json(indent=1) + "\n")
        count = config.data.towns
        for done, _ in enumerate(generate_images(config.data, self.images, self.backend)):
            report(f"town {done + 1}/{count}", 0.3 * done / count)
        last = config.steps if until is None else min(until, config.steps)
        if self.position.step < last or not self.weights_file.is_file():
            towns = [read_images(self.images / name) for name in image_files(config.data)]
            self._train(towns, last, lambda text, part: report(text, 0.3 + 0.7 * part))
        return self.weights_file

    def _train(self, towns: Sequence[TownImages], last: int, report: Progress) -> None:
        config = self.config
        seen = Examples([town for k, town in enumerate(towns) if (k + 1) % config.held_out])
        kept = Examples(towns[config.held_out - 1 :: config.held_out] or towns[:1])
        model = DetectorNetwork(config.seed).train()
        average = copy.deepcopy(model).requires_grad_(False).eval()
        moments = checkpoint.load_networks(self.folder, model, average) if self.position.step else {}
        parameters = dict(model.named_parameters())
        optimiser = torch.optim.AdamW(parameters.values(), lr=config.learning_rate, weight_decay=config.weight_decay)
        checkpoint.restore_optimiser(optimiser, parameters, moments)
        curve, since = Curve(self.folder / CURVES, self.position.step, COLUMNS), time.perf_counter()
        for step in range(self.position.step, last):
            rate = learning_rate(config, step)
            for group in optimiser.param_groups:
                group["lr"] = rate
            loss, figures = detection_loss(model, seen.training(config, step))
            figures |= {"rate": rate, "loss": float(loss.detach())}
            figures |= update(optimiser, loss, model, average, parameters, step=step, clip_norm=config.clip_norm,
                              decay=config.average)  # fmt: skip
            # Means and variances of the normalisation are averages already.
            for mean, now in zip(average.buffers(), model.buffers(), strict=True):
                mean.copy_(now)
            curve.add("train", figures)
            done = step + 1
            keeps = done % config.checkpoint_every == 0 or done == last
            if keeps:
                curve.add("train", _held_out_figures(average, kept))
            if keeps or done % config.log_every == 0:
                now_s = time.perf_counter()
                seconds = self.position.seconds + now_s - since
                self.position, since = dataclasses.replace(self.position, step=done, seconds=seconds), now_s
                curve.write(done, seconds)
            if keeps:
                self._save(model, average, optimiser)
            report(f"step {done}/{config.steps}, loss {figures['loss']:.3f}", done / config.steps)
        self._publish(average, kept)

    def _save(self, model: DetectorNetwork, average: DetectorNetwork, optimiser: torch.optim.AdamW) -> None:
        # The names contain the hash of the settings and the towns, which determine the images.
        data = hashlib.sha256("\n".join(image_files(self.config.data)).encode()).hexdigest()[:16]
        self.position = dataclasses.replace(self.position, data_hash=data)
        checkpoint.save_checkpoint(self.folder, model, average, optimiser, self.position)

    def _publish(self, average: DetectorNetwork, kept: Examples) -> None:
        """Writes the weights with the thresholds that are best on the held-out training towns."""
        scores, figures = best_scores(_detected(average, kept, len(kept.images)), kept)
        facts = {
            "recipe": self.config.model_dump_json(),
            "steps": str(self.position.step),
            "data": self.position.data_hash,
            SCORES: json.dumps(scores),
            "held_out_f1": json.dumps(figures),
            "trained_on": "procedural worlds of nurec_sim.world",
        }
        save_weights(average, self.weights_file, facts, half=True)


def detection_loss(model: DetectorNetwork, batch: Batch) -> tuple[Tensor, dict[str, float]]:
    """The loss of a batch and its terms.

    Heat: the focal loss of Law and Deng (2018), CornerNet, by the number of objects. Depth: the negative logarithm of
    Laplace's density, whose scale the network answers too. The others: mean absolute errors.
    """
    odds, numbers = model(torch.from_numpy(batch.images), torch.from_numpy(batch.tangents))
    heat, weight = torch.from_numpy(batch.heat), torch.from_numpy(batch.weight)
    right, wrong = functional.logsigmoid(odds), functional.logsigmoid(-odds)
    chance, objects = odds.sigmoid(), heat >= 1
    terms = torch.where(objects, right * (1 - chance) ** 2, wrong * chance**2 * (1 - heat) ** 4)
    of_heat = -(terms * weight).sum() / objects.sum().clamp(min=1)
    known = torch.from_numpy(batch.known)
    at, true = numbers.permute(0, 2, 3, 1)[known], torch.from_numpy(batch.numbers).permute(0, 2, 3, 1)[known]
    count = max(len(at), 1)
    off = (at - true).abs()
    place = off[:, :2].sum() / count
    error = at[:, 3].clamp(-6, 3)
    depth = (off[:, 2] * torch.exp(-error) + error).sum() / count
    shape = off[:, 4:].sum() / count
    loss = of_heat + 0.5 * place + 0.5 * depth + 0.3 * shape
    figures = {"heat": of_heat, "place": place, "depth": depth, "shape": shape}
    return loss, {name: float(value.detach()) for name, value in figures.items()}


def places(objects: Objects) -> Places:
    """Objects in the frame of the camera as seen from above."""
    return Places(objects.kind, objects.ground_m)


def _detected(network: DetectorNetwork, examples: Examples, most: int) -> dict[int, Detections]:
    camera = image_camera(pose(np.eye(3), np.zeros(3)))
    chosen = np.unique(np.linspace(0, len(examples.images) - 1, min(most, len(examples.images))).astype(int))
    return {int(k): detections(network, examples.images[k], camera) for k in chosen}


def _held_out_figures(network: DetectorNetwork, examples: Examples) -> dict[str, float]:
    """Recall and precision of vehicles within 30 m on some held-out images, at the best threshold there."""
    found = _detected(network, examples, MEASURED)
    scores = np.array(best_scores(found, examples)[0])
    sums = added([
        count(places(each.above(scores)), places(examples.objects[k]), examples.objects[k].visible, KINDS)
        for k, each in found.items()
    ])["vehicle 0-30 m"]  # fmt: skip
    recall, precision = share(sums["seen"], sums["there"]), share(sums["right"], sums["found"])
    return dict(zip(HELD_OUT, (recall or 0.0, precision or 0.0), strict=True))


def best_scores(found: dict[int, Detections], examples: Examples) -> tuple[list[float], list[float]]:
    """For each kind the threshold of the score with the best F1 within 60 m, and that F1."""
    scores, figures = [], []
    for kind in range(len(KINDS)):
        rows: list[tuple[float, bool]] = []
        there = 0
        for k, each in found.items():
            objects = examples.objects[k]
            far = np.linalg.norm(objects.ground_m, axis=1) >= 60
            visible = objects.visible & ~far
            owner, _ = match(places(each), places(objects), visible)
            there += int((visible & (objects.kind == kind)).sum())
            near = np.linalg.norm(each.ground_m, axis=1) < 60
            counts = (each.kind == kind) & near & (owner != -2)
            rows += list(zip(each.score[counts].tolist(), (owner[counts] >= 0).tolist(), strict=True))
        score, f1 = _best(np.array(rows, np.float64).reshape(-1, 2), there)
        scores.append(score)
        figures.append(f1)
    return scores, figures


def _best(rows: Float64[np.ndarray, "n 2"], there: int) -> tuple[float, float]:
    """The score at which keeping it and all higher ones gives the best F1; 1 if nothing is right."""
    rows = rows[np.argsort(-rows[:, 0])]
    right = np.cumsum(rows[:, 1])
    if not there or not len(rows) or right[-1] == 0:
        return 1.0, 0.0
    f1 = 2 * right / (np.arange(1, len(rows) + 1) + there)
    best = int(np.argmax(f1))
    return round(float(rows[best, 0]), 4), round(float(f1[best]), 4)
