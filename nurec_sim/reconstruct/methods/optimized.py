"""The method ``optimized``: ``lift``, then fitted to the log (docs/optimisation.md)."""

from __future__ import annotations

from collections.abc import Sequence

from nurec_sim.reconstruct import reconstruct
from nurec_sim.reconstruct.methods._method import ShippedMethod
from nurec_sim.reconstruct.optimize.settings import OptimizeSettings
from nurec_sim.types import Clip, GaussianScene, Progress


class Optimized(ShippedMethod):
    """The result of ``lift``, fitted to the log's images and sweeps."""

    name = "optimized"
    settings = OptimizeSettings

    def run(
        self, clip: Clip, cameras: Sequence[str] | None, held: set[int], progress: Progress, settings: OptimizeSettings
    ) -> GaussianScene:
        """The scene of a log, by default from all its cameras."""
        return reconstruct(
            clip,
            "lift",
            cameras=cameras,
            hold_out_sweeps=sorted(held),
            progress=progress,
            refine=settings,
            actors="recorded",
            align_actors=False,
            align_sweeps=False,
            complete_actors=False,
        )
