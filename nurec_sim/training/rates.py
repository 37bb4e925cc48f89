"""The learning rate over the steps."""

from __future__ import annotations

import math
from typing import Protocol


class Schedule(Protocol):
    """What a stage or a recipe says about its learning rate."""

    @property
    def steps(self) -> int:
        """Number of steps."""
        ...

    @property
    def learning_rate(self) -> float:
        """The peak."""
        ...

    @property
    def warm_up(self) -> int:
        """Steps of its linear rise."""
        ...

    @property
    def final_rate(self) -> float:
        """The last rate by the peak."""
        ...


def learning_rate(schedule: Schedule, step: int) -> float:
    """Linear warm-up, then half a cosine down to ``final_rate`` of the peak."""
    if step < schedule.warm_up:
        return schedule.learning_rate * (step + 1) / schedule.warm_up
    along = (step - schedule.warm_up) / max(1, schedule.steps - schedule.warm_up)
    return schedule.learning_rate * (
        schedule.final_rate + (1 - schedule.final_rate) * (1 + math.cos(math.pi * along)) / 2
    )
