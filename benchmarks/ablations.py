"""Trains every ablation of the paper's Table 2 with the same small budget, evaluates all, and compares the signs.

A variant is trained stage by stage. Each stage's run goes by a digest of all that it depends on, earlier stages
included: variants share what they have in common, and what is finished is not trained again.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from render import PLAIN, machine_name, progress
from scenes import ROOT

from nurec_sim.cli.console import err, out
from nurec_sim.errors import TrainingError
from nurec_sim.evaluate import Contender, Protocol, run_protocol
from nurec_sim.evaluate.cells import Table
from nurec_sim.evaluate.run import settings_of
from nurec_sim.evaluate.summary import interval
from nurec_sim.files.new_files import write_file
from nurec_sim.reconstruct import FeedForwardSettings
from nurec_sim.training.ablations import ABLATIONS, ablated, scaled
from nurec_sim.training.checkpoint import read_position
from nurec_sim.training.config import TrainingConfig, read_config
from nurec_sim.training.data.clips import ready_clips
from nurec_sim.training.data.samples import Samples, TownSamples
from nurec_sim.training.losses.perceptual import perceptual_distance
from nurec_sim.training.trainer import WEIGHTS, Trainer

VariantName = Literal[tuple(ABLATIONS)]  # type: ignore[valid-type]
Progress = Callable[[str, float], None]
COLUMNS = {"psnr_db": ("PSNR", 2), "ssim": ("SSIM", 3), "abs_rel": ("AbsRel", 3), "delta1": ("δ1", 3)}
RECIPE = Path(__file__).with_name("ablations.yaml")


@dataclass(frozen=True)
class Options:
    """Train and evaluate the ablations; print the table, write OUT/ablations.json and OUT/ablations.md.

    Without a start every variant begins at random, and small budgets give poor reconstructions: what counts are the
    differences. With one, variants forget what they were not to learn only as far as the budget goes.

    Args:
        variants: which rows; the full training is always there, for the others are compared with it.
        recipe: of the full training.
        steps: of each variant in all, shared out to the stages as in the recipe; the recipe's own if not given.
        pixels: of an input image, at most in training and always in evaluation.
        start: weights that every variant begins with.
        seed: of the training.
        training_clips: generated before training, equal for all; the recipe's number if not given.
        clips: folder for them, OUT/clips if not given; no other process may write to it during the run.
        generators: processes that generate them; with 0 all of them must exist.
        worlds: held-out worlds to evaluate in; three or more give intervals.
        seconds: of each.
        cameras: of each, 1 or 3.
        size_px: width and height of its images.
        frames: of each camera that go through the network at once; what lies beyond is merged.
        threads: of torch and of the renderer; torch's own number if not given.
        out: folder of the runs and the tables.
    """

    variants: tuple[VariantName, ...] = tuple(ABLATIONS)
    recipe: Path = RECIPE
    steps: int | None = None
    pixels: int = 16_464
    start: Path | None = None
    seed: int = 0
    training_clips: int | None = None
    clips: Path | None = None
    generators: int = 1
    worlds: int = 4
    seconds: float = 8.0
    cameras: int = 1
    size_px: tuple[int, int] = (480, 320)
    frames: int = 4
    threads: int | None = None
    out: Path = ROOT / "build" / "ablations"

    @property
    def names(self) -> tuple[str, ...]:
        """Variants in the order of the paper's table."""
        return tuple(name for name in ABLATIONS if name in self.variants or name == "full")


def main() -> None:
    """Run the benchmark."""
    import torch

    options = tyro.cli(Options)
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    began = time.perf_counter()
    config = budget(options)
    clips = options.clips or options.out / "clips"
    with (
        TownSamples(config, clips, options.generators, 0, report=err.print) as samples,
        progress("ablations") as advance,
    ):
        weights = {name: train(ablated(config, name), options, samples, advance) for name in options.names}
    with progress("evaluation") as advance:
        results = evaluate(weights, options, advance)
    table = table_of(results["rows"])
    results |= {"recipe": json.loads(config.model_dump_json()), "machine": machine_name()}
    results["seconds"] = round(time.perf_counter() - began, 1)
    write_file(options.out / "ablations.json", json.dumps(results, indent=1) + "\n")
    write_file(options.out / "ablations.md", table.markdown())
    out.print(table.markdown(), **PLAIN)
    out.print(f"wrote {options.out / 'ablations.json'} and .md", **PLAIN)


# --------------------------------------------------------------------------------------------------------- training


def budget(options: Options) -> TrainingConfig:
    """The full recipe at the budget of the options."""
    recipe = read_config(options.recipe)
    config = scaled(recipe, options.steps or recipe.steps, options.pixels)
    data = config.data.model_copy(update={"clips": options.training_clips or recipe.data.clips, "refresh": False})
    start = options.start or config.start
    return config.model_copy(update={"seed": options.seed, "data": data, "start": start})


def stage_runs(config: TrainingConfig, folder: Path) -> list[tuple[Path, TrainingConfig]]:
    """Run folders and one-stage recipes of a recipe, each starting from the weights of the one before."""
    runs: list[tuple[Path, TrainingConfig]] = []
    before = "" if config.start is None else hashlib.sha256(config.start.read_bytes()).hexdigest()
    for number, stage in enumerate(config.stages):
        alone = config.model_copy(update={"stages": (stage,), "seed": config.seed + number, "start": None})
        before = hashlib.sha256((before + alone.model_dump_json()).encode()).hexdigest()
        start = runs[-1][0] / WEIGHTS if runs else config.start
        every = max(1, min(250, stage.steps // 4))
        changes = {"start": start, "log_every": min(10, stage.steps), "sample_every": every, "checkpoint_every": every}
        runs.append((folder / f"{stage.name}-{before[:12]}", alone.model_copy(update=changes)))
    return runs


def train(config: TrainingConfig, options: Options, samples: TownSamples | Samples, advance: Progress) -> Path:
    """Train a variant, as far as it is not; its weights."""
    folder = options.out / "runs"
    for run, recipe in stage_runs(config, folder):
        position = read_position(run)
        if position is None or position.step < recipe.steps or not (run / WEIGHTS).is_file():
            if isinstance(samples, TownSamples):
                wait_for_clips(samples, recipe.data.clips, advance)
            Trainer(recipe, run, samples, perceptual_distance, None, options.threads).run(advance)
    return run / WEIGHTS


def wait_for_clips(samples: TownSamples, count: int, advance: Progress) -> None:
    """All variants must see the same clips, so that training begins when all of them exist.

    Raises:
        TrainingError: some are missing, and no process generates them.
    """
    while (ready := len(ready_clips(samples.cache.clips))) < count:
        if not samples.generators:
            raise TrainingError(
                f"{samples.cache.clips} holds {ready} clips, and {count} are needed; give --generators 1 or more"
            )
        advance(f"generating clips, {ready} of {count}", 0.0)
        time.sleep(1.0)


# ------------------------------------------------------------------------------------------------------- evaluation


def evaluate(weights: Mapping[str, Path], options: Options, advance: Progress) -> dict[str, Any]:
    """Protocol ``clip`` over all variants side by side; rows of figures and differences from the full training."""
    protocol = Protocol(
        "clip",
        tuple(range(options.worlds)),
        size_px=options.size_px,
        seconds=options.seconds,
        cameras=options.cameras,
    )
    methods = [contender(name, path, options) for name, path in weights.items()]
    settings = settings_of(protocol, methods)
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
    results = run_protocol(protocol, methods, options.out / "evaluations" / digest[:12], advance)
    return {"rows": rows_of(results["windows"], list(weights)), "evaluation": settings}


def contender(name: str, weights: Path, options: Options) -> Contender:
    """A variant's network as a method of the evaluation."""
    profile = json.loads((weights.parent / "recipe.json").read_text())["profile"]
    merge = ABLATIONS[name].merge
    settings = FeedForwardSettings(
        profile, weights, frames=options.frames, image_pixels=options.pixels, max_chunks=100, merge=merge
    )
    return Contender(name, "dense", settings)


def rows_of(windows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> list[dict[str, Any]]:
    """Per variant: means over the views, and over the worlds how they differ from the full training."""
    by_world = {name: [_means(window["methods"][name]) for window in windows] for name in names}
    rows = []
    for name in names:
        figures = {column: _mean([world[column] for world in by_world[name]]) for column in COLUMNS}
        row: dict[str, Any] = {"variant": name, "text": ABLATIONS[name].text, **figures, "differences": {}}
        for column in COLUMNS if name != "full" else ():
            pairs = zip(by_world[name], by_world["full"], strict=True)
            gaps = [a[column] - b[column] for a, b in pairs if a[column] is not None and b[column] is not None]
            paper = getattr(ABLATIONS[name].paper, column) - getattr(ABLATIONS["full"].paper, column)
            row["differences"][column] = {"ours": _mean(gaps), "interval": interval(gaps), "paper": round(paper, 4)}
        rows.append(row)
    return rows


def _means(record: Mapping[str, Any]) -> dict[str, float | None]:
    targets = record.get("targets", [])
    return {column: _mean([target["full"].get(column) for target in targets]) for column in COLUMNS}


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


# ------------------------------------------------------------------------------------------------------------ table


def table_of(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Figures, differences from the full training, those of the paper, and whether the signs agree."""
    lines = []
    for row in rows:
        cells = [row["text"]]
        for column, (_, digits) in COLUMNS.items():
            value, difference = row[column], row["differences"].get(column)
            cells.append("-" if value is None else f"{value:.{digits}f}")
            cells.append("" if difference is None else verdict(difference, digits))
        lines.append(tuple(cells))
    heading = ("variant", *(cell for title, _ in COLUMNS.values() for cell in (title, "change (paper)")))
    note = (
        "Change: from the full training, in brackets the paper's. ✓: same sign; ✗: the other one; ?: the interval over "
        "the worlds (95 %, bootstrap) holds 0, or either change is 0."
    )
    return Table("ablations", "Ablations at equal budget", heading, tuple(lines), note)


def verdict(difference: Mapping[str, Any], digits: int) -> str:
    """A change, the paper's, and whether they have one sign."""
    ours, paper, bounds = difference["ours"], difference["paper"], difference["interval"]
    if ours is None:
        return f"- ({paper:+.{digits}f})"
    unclear = (bounds is not None and bounds[0] <= 0 <= bounds[1]) or round(ours, digits) == 0 or paper == 0
    mark = "?" if unclear else "✓" if (ours > 0) == (paper > 0) else "✗"
    return f"{ours:+.{digits}f} ({paper:+.{digits}f}) {mark}"


if __name__ == "__main__":
    main()
