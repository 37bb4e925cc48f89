"""What a foreign file turns out to hold, before it is a scene."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim.types import Gaussians


@dataclass
class Found:
    """Parts of a foreign scene in the frame of its file, collected while it is read.

    Attributes:
        static: sets of Gaussians that do not move.
        boxed: sets of Gaussians in the frames of boxes, by the name that the file has for the box.
        sky: a cubemap, faces as in ``geometry.cubemap_directions``; None if the file has none.
        exposure: factors on the colours of cameras, in the order of the file's cameras.
        dropped: how many Gaussians were no Gaussians: not finite, without extent, with a quaternion of zero.
        volumes: where a stage puts the NuRec files that it shows, z up in metres, by their names.
        unknown: what the file holds but is not read, and what it should hold but does not, one sentence each.
    """

    static: list[Gaussians] = field(default_factory=list)
    boxed: dict[str, list[Gaussians]] = field(default_factory=dict)
    sky: Float32[np.ndarray, "6 h h 3"] | None = None
    exposure: list[float] = field(default_factory=list)
    dropped: int = 0
    volumes: dict[str, Float64[np.ndarray, "4 4"]] = field(default_factory=dict)
    unknown: list[str] = field(default_factory=list)

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return sum(map(len, self.static)) + sum(len(part) for parts in self.boxed.values() for part in parts)
