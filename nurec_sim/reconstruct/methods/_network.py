"""What the methods of the Instant NuRec network share (docs/network.md)."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

from nurec_sim.errors import WeightsError
from nurec_sim.reconstruct.feedforward.settings import FeedForwardSettings
from nurec_sim.types import Clip, GaussianScene, Progress


class NetworkMethod:
    """The Instant NuRec network, with the decoder that the method is named after."""

    name: str
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

    def reconstruct(
        self,
        clip: Clip,
        settings: FeedForwardSettings,
        *,
        cameras: Sequence[str] | None,
        hold_out_sweeps: Collection[int],
        progress: Progress,
    ) -> GaussianScene:
        """The scene of a log (``types.Method``).

        Args:
            clip: the driving log.
            settings: of this method.
            cameras: ids of the cameras to use; None: as many as the profile takes.
            hold_out_sweeps: LiDAR sweeps that must not be read, by index.
            progress: called with the stage's name and the fraction of all work done.
        """
        from nurec_sim.reconstruct.feedforward.method import feedforward

        return feedforward(clip, self.name, cameras, set(hold_out_sweeps), progress, settings)
