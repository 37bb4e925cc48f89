"""The command ``train``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from nurec_sim.cli.console import OnePath, app, err, out, progress
from nurec_sim.errors import TrainingError
from nurec_sim.files.new_files import check_writable

AblationName = Literal["full", "single_stage", "sky_mlp", "no_perceptual", "no_depth_loss", "concatenation",
                       "no_scale_floor"]  # fmt: skip


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
    """Train the network, its LiDAR branch, end-to-end policies or the detector, in procedural towns (docs/training.md).

    Writes curves, sample renders, checkpoints and weights to the run folder. The same command resumes an interrupted
    run. For several processes or GPUs: `torchrun --nproc-per-node N -m nurec_sim.cli train RECIPE`.

    Args:
        recipe: a YAML file such as nurec_sim/training/recipes/tiny.yaml; lidar.yaml for the LiDAR branch,
            end-to-end.yaml for the policies, detector.yaml for the camera detector.
        out_path: the run folder; default: runs/train/RECIPE-NAME.
        clips: cache folder for generated clips, which may be shared between runs.
        generators: processes that generate clips; 0 uses existing clips only. The LiDAR branch, the
            policies and the detector ignore it and loaders.
        loaders: processes that prepare samples; 0 is a thread of the training process.
        threads: of torch and of the renderer; default: all cores.
        until: stop after this step, counted from the start of the recipe.
        ablation: a row of the paper's Table 2, where concatenation trains like full; for the LiDAR branch
            no_scale_floor, of Table 3.
    """
    import torch

    from nurec_sim.training.ablations import ablated
    from nurec_sim.training.config import read_config
    from nurec_sim.training.data.samples import TownSamples
    from nurec_sim.training.detection.config import is_detector_recipe
    from nurec_sim.training.imitation.config import is_imitation_recipe
    from nurec_sim.training.lidar.config import is_lidar_recipe
    from nurec_sim.training.losses.lpips import load_lpips
    from nurec_sim.training.losses.perceptual import perceptual_distance
    from nurec_sim.training.processes import Processes
    from nurec_sim.training.trainer import WEIGHTS, Trainer

    if min(generators, loaders) < 0 or (threads is not None and threads < 1):
        raise TrainingError(
            f"generators and loaders must be 0 or more and threads 1 or more, got {generators}, {loaders}, {threads}"
        )
    folder = out_path or Path("runs/train") / (recipe.stem if ablation == "full" else f"{recipe.stem}-{ablation}")
    if threads is not None:
        torch.set_num_threads(threads)
    if is_lidar_recipe(recipe):
        _train_lidar(recipe, folder, clips, threads, until, ablation)
        return
    if is_imitation_recipe(recipe):
        _train_policies(recipe, folder, clips, until, ablation)
        return
    if is_detector_recipe(recipe):
        _train_detector(recipe, folder, clips, until, ablation)
        return
    config = ablated(read_config(recipe), ablation)
    for place in (folder, clips):
        check_writable(place, folder=True)
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


def _train_lidar(
    recipe: Path, folder: Path, places: Path, threads: int | None, until: int | None, ablation: AblationName
) -> None:
    from nurec_sim.training.lidar.config import read_lidar_config
    from nurec_sim.training.lidar.trainer import WEIGHTS, LidarTrainer

    config = read_lidar_config(recipe)
    if ablation == "no_scale_floor":
        config = config.without_floor()
    elif ablation != "full":
        raise TrainingError(f"the LiDAR branch has the ablation no_scale_floor only, got {ablation}")
    for place in (folder, places):
        check_writable(place, folder=True)
    with progress("training") as advance:
        LidarTrainer(config, folder, places, threads).run(advance, until)
    out.print(f"wrote {folder / WEIGHTS}", soft_wrap=True)


def _train_policies(recipe: Path, folder: Path, drives: Path, until: int | None, ablation: AblationName) -> None:
    from nurec_sim.training.imitation.config import read_imitation_config
    from nurec_sim.training.imitation.trainer import ImitationTrainer

    config = read_imitation_config(recipe)
    if ablation != "full":
        raise TrainingError(f"end-to-end policies have no ablations, got {ablation}")
    for place in (folder, drives):
        check_writable(place, folder=True)
    with progress("training") as advance:
        files = ImitationTrainer(config, folder, drives).run(advance, until)
    for path in files:
        out.print(f"wrote {path}", soft_wrap=True)


def _train_detector(recipe: Path, folder: Path, images: Path, until: int | None, ablation: AblationName) -> None:
    from nurec_sim.training.detection.config import read_detector_config
    from nurec_sim.training.detection.trainer import DetectorTrainer

    config = read_detector_config(recipe)
    if ablation != "full":
        raise TrainingError(f"the detector has no ablations, got {ablation}")
    for place in (folder, images):
        check_writable(place, folder=True)
    with progress("training") as advance:
        path = DetectorTrainer(config, folder, images).run(advance, until)
    out.print(f"wrote {path}", soft_wrap=True)


def _tell(line: str) -> None:
    err.print(line, markup=False, highlight=False, soft_wrap=True)
