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
        """The scene of a log (``types.Method``)."""
        from nurec_sim.reconstruct.lift.method import lift

        chosen = list(clip.rig.cameras) if cameras is None else list(cameras)
        return lift(clip, chosen, set(hold_out_sweeps), progress, settings)
