"""Settings of the method ``lidar``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from nurec_sim.errors import ReconstructError


@dataclass(frozen=True)
class LidarSettings:
    """How the sweeps of a log go through the LiDAR branch.

    Attributes:
        profile: ``lidar``, or ``lidar-no-floor`` for the ablation without the scale floor.
        checkpoint: file with weights; None takes the profile's own.
        random_weights: seed of untrained weights instead of any file, which give the footprints of the returns.
        windows: sweeps that are used, evenly over the log, for every 50 m or 10 s, up to eight times as many.
        nearer: a Gaussian is dropped where a window saw its surface from less than this part of its range.
        carve: drop Gaussians that recorded beams passed through; returns that they passed through live briefly.
        ray_drop: whether lost beams follow the network (``network``), or are learnt from the log's own (``log``).
        min_opacity: Gaussians below are dropped.
        max_gaussians: more are thinned, those seen from farthest first.
    """

    profile: Literal["lidar", "lidar-no-floor"] = "lidar"
    checkpoint: Path | None = None
    random_weights: int | None = None
    windows: int = 20
    nearer: float = 0.8
    carve: bool = True
    ray_drop: Literal["network", "log"] = "log"
    min_opacity: float = 0.1
    max_gaussians: int = 4_000_000

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            ReconstructError: a value out of range.
        """
        ranges = {"windows": (1, 1000), "nearer": (0.0, 1.0), "min_opacity": (0.0, 1.0), "max_gaussians": (1, 1e9)}
        for name, (least, most) in ranges.items():
            value = getattr(self, name)
            if not least <= value <= most:
                raise ReconstructError(f"{name} must lie in {least:g}..{most:g}, got {value!r}")
