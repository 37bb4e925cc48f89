"""The command ``train``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from nurec_sim.cli.console import OnePath, app, err, out, progress
from nurec_sim.errors import TrainingError
from nurec_sim.files.new_files import check_writable

AblationName = Literal["full", "single_stage", "sky_mlp", "no_perceptual", "no_depth_loss", "concatenation"]


@app.command
def train(
    recipe: OnePath,
    *,
    out_path: Annotated[Path | None, tyro.conf.arg(name="out")] = None,
    clips: Path = Path("runs/clips"),
    generators: int = 1,
    loaders: int = 1,
    threads: int | None = None,
    until: int | None = None,
    ablation: AblationName = "full",
) -> None:
    """Train the network in procedural towns generated on the fly (docs/training.md).

    Writes curves, sample renders, checkpoints and weights to the run folder. The same command resumes an interrupted
    run. For several processes or GPUs: `torchrun --nproc-per-node N -m nurec_sim.cli train RECIPE`.

    Args:
        recipe: a YAML file such as nurec_sim/training/recipes/tiny.yaml.
        out_path: the run folder; default: runs/train/RECIPE-NAME.
        clips: cache folder for generated clips, which may be shared between runs.
        generators: processes that generate clips; 0 uses existing clips only.
        loaders: processes that prepare samples; 0 is a thread of the training process.
        threads: of torch and of the renderer; default: all cores.
        until: stop after this step, counted from the start of the recipe.
        ablation: a row of the paper's Table 2; concatenation trains like full.
    """
    import torch

    from nurec_sim.training.ablations import ablated
    from nurec_sim.training.config import read_config
    from nurec_sim.training.data.samples import TownSamples
    from nurec_sim.training.losses.lpips import load_lpips
    from nurec_sim.training.losses.perceptual import perceptual_distance
    from nurec_sim.training.processes import Processes
    from nurec_sim.training.trainer import WEIGHTS, Trainer

    if min(generators, loaders) < 0 or (threads is not None and threads < 1):
        raise TrainingError(
            f"generators and loaders must be 0 or more and threads 1 or more, got {generators}, {loaders}, {threads}"
        )
    config = ablated(read_config(recipe), ablation)
    folder = out_path or Path("runs/train") / (recipe.stem if ablation == "full" else f"{recipe.stem}-{ablation}")
    for place in (folder, clips):
        check_writable(place, folder=True)
    if threads is not None:
        torch.set_num_threads(threads)
    perceptual = perceptual_distance if config.lpips is None else load_lpips(config.lpips)
    processes = Processes.from_torchrun()
    try:
        with (
            TownSamples(config, clips, generators, loaders, processes, _tell) as samples,
            progress("training") as advance,
        ):
            Trainer(config, folder, samples, perceptual, processes, threads).run(advance, until)
    finally:
        processes.leave()
    out.print(f"wrote {folder / WEIGHTS}", soft_wrap=True)


def _tell(line: str) -> None:
    err.print(line, markup=False, highlight=False, soft_wrap=True)
