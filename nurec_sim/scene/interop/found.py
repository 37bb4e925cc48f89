"""Contents of a third-party file before conversion to a scene."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim.types import Gaussians


@dataclass
class Found:
    """Parts of a third-party scene in the frame of its file.

    Attributes:
        static: sets of Gaussians that do not move.
        boxed: sets of Gaussians in box frames, by the box name in the file.
        sky: a cubemap, faces as in ``geometry.cubemap_directions``; None if the file has none.
        exposure: factors on the colours of cameras, in the order of the file's cameras.
        dropped: number of invalid Gaussians: not finite, zero scale, or zero quaternion.
        volumes: transforms of NuRec files referenced by a stage, z up in metres, by name.
        unknown: ignored and missing parts of the file, one sentence each.
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
