"""What the shipped reconstruction methods share."""

from __future__ import annotations

import abc
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from nurec_sim.types import Clip, GaussianScene, Progress


class ShippedMethod(abc.ABC):
    """A reconstruction method (``types.Method``)."""

    name: str
    settings: type[Any]

    def files(self, settings: Any) -> Sequence[Path]:
        """None."""
        return ()

    def reconstruct(
        self,
        clip: Clip,
        settings: Any,
        *,
        cameras: Sequence[str] | None,
        hold_out_sweeps: Collection[int],
        progress: Progress,
    ) -> GaussianScene:
        """The scene of a log; arguments as for ``types.Method``."""
        return self.run(clip, cameras, set(hold_out_sweeps), progress, settings)

    @abc.abstractmethod
    def run(
        self, clip: Clip, cameras: Sequence[str] | None, held: set[int], progress: Progress, settings: Any
    ) -> GaussianScene:
        """``reconstruct`` by position; ``held`` are the sweeps that must not be read."""
