"""The method ``lidar``: the network's LiDAR branch (docs/network.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nurec_sim.errors import WeightsError
from nurec_sim.reconstruct.methods._method import ShippedMethod
from nurec_sim.reconstruct.range_maps.settings import LidarSettings
from nurec_sim.types import Clip, GaussianScene, Progress


class Lidar(ShippedMethod):
    """The network's LiDAR branch: range maps to Gaussians, no images."""

    name = "lidar"
    settings = LidarSettings

    def files(self, settings: LidarSettings) -> tuple[Path, ...]:
        """The weights; none where none are read, or none are there."""
        if settings.random_weights is not None:
            return ()
        from nurec_sim.network.checkpoints.download import find_weights

        try:
            return (find_weights(settings.profile, settings.checkpoint),)
        except WeightsError:  # says more when the clip is reconstructed
            return ()

    def run(
        self, clip: Clip, cameras: Sequence[str] | None, held: set[int], progress: Progress, settings: LidarSettings
    ) -> GaussianScene:
        """The scene of a log from its sweeps; images are not read."""
        from nurec_sim.reconstruct.range_maps.method import range_maps_to_scene

        return range_maps_to_scene(clip, held, progress, settings)
