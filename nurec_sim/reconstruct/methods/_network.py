"""What the methods of the Instant NuRec network share (docs/network.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nurec_sim.errors import WeightsError
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings
from nurec_sim.reconstruct.methods._method import ShippedMethod
from nurec_sim.types import Clip, GaussianScene, Progress


class NetworkMethod(ShippedMethod):
    """The Instant NuRec network, with the decoder that the method is named after."""

    settings = FeedForwardSettings

    def files(self, settings: FeedForwardSettings) -> tuple[Path, ...]:
        """The weights; none where none are read, or none are there."""
        if settings.random_weights is not None:
            return ()
        from nurec_sim.network.checkpoints.download import find_weights
        from nurec_sim.reconstruct.feedforward.method import profile_name

        try:
            return (find_weights(profile_name(self.name, settings.profile), settings.checkpoint),)
        except WeightsError:  # says more when the clip is reconstructed
            return ()

    def run(
        self,
        clip: Clip,
        cameras: Sequence[str] | None,
        held: set[int],
        progress: Progress,
        settings: FeedForwardSettings,
    ) -> GaussianScene:
        """The scene of a log, by default from as many cameras as the profile takes."""
        from nurec_sim.reconstruct.feedforward.method import feedforward

        return feedforward(clip, self.name, cameras, held, progress, settings)
