"""Sizes of the LiDAR branch."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class LidarProfile:
    """Every number that the branch's architecture depends on.

    Attributes:
        name: of the profile and its weights file.
        per_return: M of the paper, Gaussians per valid return.
        beam_width: channels at the resolution of beams.
        token_width: channels of tokens, one per 4 x 4 beams.
        blocks: convolution blocks over the tokens; half of them see every second token.
        scale_floor: whether footprints are at least as wide as the spacing of beams; without (the paper's ablation)
            scales are decoded like those of the camera branch.
    """

    name: Literal["lidar", "lidar-no-floor"]
    per_return: int = 1
    beam_width: int = 24
    token_width: int = 64
    blocks: int = 6
    scale_floor: bool = True


_LIDAR = LidarProfile("lidar")
LIDAR_PROFILES: Mapping[str, LidarProfile] = {
    profile.name: profile for profile in (_LIDAR, dataclasses.replace(_LIDAR, name="lidar-no-floor", scale_floor=False))
}
"""By name. ``lidar-no-floor`` is for the ablation of the paper's Table 3."""
