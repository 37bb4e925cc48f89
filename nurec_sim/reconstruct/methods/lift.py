"""The method ``lift``: coloured LiDAR and lifted pixels, without learning (docs/lift.md)."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from nurec_sim.reconstruct.lift.settings import LiftSettings
from nurec_sim.types import Clip, GaussianScene, Progress


class Lift:
    """Coloured LiDAR and stereo, no learning."""

    name = "lift"
    settings = LiftSettings

    def files(self, settings: LiftSettings) -> tuple[()]:
        """None."""
        return ()

    def reconstruct(
        self,
        clip: Clip,
        settings: LiftSettings,
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
        from nurec_sim.reconstruct.lift.method import lift

        chosen = list(clip.rig.cameras) if cameras is None else list(cameras)
        return lift(clip, chosen, set(hold_out_sweeps), progress, settings)
