"""The method ``lift``: coloured LiDAR and lifted pixels, without learning (docs/lift.md)."""

from __future__ import annotations

from collections.abc import Sequence

from nurec_sim.reconstruct.lift.settings import LiftSettings
from nurec_sim.reconstruct.methods._method import ShippedMethod
from nurec_sim.types import Clip, GaussianScene, Progress


class Lift(ShippedMethod):
    """Coloured LiDAR and stereo, no learning."""

    name = "lift"
    settings = LiftSettings

    def run(
        self, clip: Clip, cameras: Sequence[str] | None, held: set[int], progress: Progress, settings: LiftSettings
    ) -> GaussianScene:
        """The scene of a log, by default from all its cameras."""
        from nurec_sim.reconstruct.lift.method import lift

        return lift(clip, list(clip.rig.cameras if cameras is None else cameras), held, progress, settings)
