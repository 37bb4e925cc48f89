"""The processes of a run: one alone, or several started by torchrun."""

from __future__ import annotations

import os
from dataclasses import dataclass

import torch
from torch import nn

from nurec_sim.errors import TrainingError


@dataclass(frozen=True)
class Processes:
    """This process's rank among ``count``."""

    rank: int
    count: int

    @classmethod
    def alone(cls) -> Processes:
        """A run of one process."""
        return cls(0, 1)

    @classmethod
    def from_torchrun(cls) -> Processes:
        """Reads torchrun's environment and joins the process group; a single process without torchrun.

        Raises:
            TrainingError: the environment is inconsistent.
        """
        if "WORLD_SIZE" not in os.environ:
            return cls.alone()
        try:
            rank, count = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
        except (KeyError, ValueError):
            raise TrainingError("WORLD_SIZE is set but RANK is not a number; start the run with torchrun") from None
        if count > 1:
            torch.distributed.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
        return cls(rank, count)

    @property
    def first(self) -> bool:
        """Whether this process writes files."""
        return self.rank == 0

    def wrap(self, objective: nn.Module) -> nn.Module:
        """The objective with gradients averaged over all processes."""
        if self.count == 1:
            return objective
        return nn.parallel.DistributedDataParallel(objective, find_unused_parameters=True)

    def leave(self) -> None:
        """Leaves the process group, if any."""
        if self.count > 1:
            torch.distributed.destroy_process_group()
