"""Checkpoints of a training run: one safetensors file, written atomically.

It holds the network, its moving average, and the optimiser's two moments; the position in the recipe is in the file's
metadata. No random state is saved, because the sample of step k depends on the seed and k only.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn

from nurec_sim.errors import TrainingError
from nurec_sim.files.new_files import write_file

CHECKPOINT = "checkpoint.safetensors"
_KEY = "nurec_sim_training"
_MOMENTS = ("exp_avg", "exp_avg_sq")


@dataclass(frozen=True)
class Position:
    """Progress of a run: ``step`` steps done over all stages, ``seconds`` spent, under the recipe of ``digest``."""

    step: int
    seconds: float
    digest: str
    data_hash: str = ""


def save_checkpoint(
    folder: Path, model: nn.Module, average: nn.Module, optimiser: torch.optim.AdamW | None, position: Position
) -> Path:
    """Writes the state of a run.

    Args:
        folder: the run folder.
        model: the network.
        average: its moving average.
        optimiser: its moments are saved; None between two stages, since each stage starts with fresh moments.
        position: progress of the run, stored as metadata.

    Returns:
        the file.
    """
    tensors = {f"model/{name}": value for name, value in model.state_dict().items()}
    tensors |= {f"average/{name}": value for name, value in average.state_dict().items()}
    if optimiser is not None:
        for name, parameter in model.named_parameters():
            state = optimiser.state.get(parameter)
            if state:
                tensors |= {f"{moment}/{name}": state[moment] for moment in _MOMENTS}
                tensors[f"count/{name}"] = state["step"]
    # ``clone``: safetensors refuses tensors that share memory.
    contiguous = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    data = safetensors.torch.save(contiguous, {_KEY: json.dumps(asdict(position), sort_keys=True)})
    path = folder / CHECKPOINT
    write_file(path, data)
    return path


def read_position(folder: Path) -> Position | None:
    """Position of the run in a folder, None without a checkpoint.

    Raises:
        TrainingError: the checkpoint is damaged or not one of a training run.
    """
    path = folder / CHECKPOINT
    if not path.is_file():
        return None
    try:
        with safetensors.safe_open(path, "pt") as file:
            return Position(**json.loads((file.metadata() or {})[_KEY]))
    except (safetensors.SafetensorError, KeyError, TypeError, ValueError) as error:
        raise TrainingError(f"{path} is damaged or no checkpoint of a training run: {error}") from None


def load_networks(folder: Path, model: nn.Module, average: nn.Module) -> dict[str, Tensor]:
    """Loads the network and its average; returns the optimiser's tensors (for ``restore_optimiser``).

    Raises:
        TrainingError: the checkpoint is damaged, or of another network.
    """
    path = folder / CHECKPOINT
    try:
        tensors = safetensors.torch.load_file(path)
    except (OSError, safetensors.SafetensorError) as error:
        raise TrainingError(f"{path} cannot be read: {error}") from None
    for prefix, module in (("model/", model), ("average/", average)):
        state = {name.removeprefix(prefix): tensors.pop(name) for name in list(tensors) if name.startswith(prefix)}
        try:
            module.load_state_dict(state)
        except RuntimeError as error:
            raise TrainingError(f"{path} is of another network: {str(error).splitlines()[0]}") from None
    return tensors


def restore_optimiser(
    optimiser: torch.optim.AdamW, trained: Mapping[str, nn.Parameter], tensors: Mapping[str, Tensor]
) -> None:
    """Restores the optimiser's moments."""
    for name, parameter in trained.items():
        if f"count/{name}" in tensors:
            optimiser.state[parameter] = {moment: tensors[f"{moment}/{name}"].clone() for moment in _MOMENTS}
            optimiser.state[parameter]["step"] = tensors[f"count/{name}"].clone()
