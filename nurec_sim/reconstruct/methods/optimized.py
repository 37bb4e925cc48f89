"""The method ``optimized``: ``lift``, then fitted to the log (docs/optimisation.md)."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from nurec_sim.reconstruct import reconstruct
from nurec_sim.reconstruct.optimize.settings import OptimizeSettings
from nurec_sim.types import Clip, GaussianScene, Progress


class Optimized:
    """The result of ``lift``, fitted to the log's images and sweeps."""

    name = "optimized"
    settings = OptimizeSettings

    def files(self, settings: OptimizeSettings) -> tuple[()]:
        """None."""
        return ()

    def reconstruct(
        self,
        clip: Clip,
        settings: OptimizeSettings,
        *,
        cameras: Sequence[str] | None,
        hold_out_sweeps: Collection[int],
        progress: Progress,
    ) -> GaussianScene:
        """The scene of a log (``types.Method``).

        Args:
            clip: the driving log.
            settings: of this method.
            cameras: ids of the cameras to use; None: all of the rig.
            hold_out_sweeps: LiDAR sweeps that must not be read, by index.
            progress: called with the stage's name and the fraction of all work done.
        """
        held = sorted(hold_out_sweeps)
        return reconstruct(clip, "lift", cameras=cameras, hold_out_sweeps=held, progress=progress, refine=settings)
