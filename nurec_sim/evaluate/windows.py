"""Input logs and target views of a protocol."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Bool

from nurec_sim.evaluate.detection.sights import Sight
from nurec_sim.evaluate.views import ScoredView
from nurec_sim.types import Clip, SensorRequest


@dataclass(frozen=True, eq=False)
class EvaluationView:
    """A target view with its ground truth.

    Attributes:
        name: unique within its window.
        request: camera, exposure and poses.
        true: ground truth at the scored size; depth 0 where unknown.
        movable: mask of vehicles and other movable objects, moving or not; None if unknown.
        left_m: lateral offset from the driven path, left positive.
        beyond: whether it is before the first or after the last input frame.
        shown: mask of what an input image shows; None if unknown.
        sight: the image at its full size with the objects before the camera, where a detector is asked.
    """

    name: str
    request: SensorRequest
    true: ScoredView
    movable: Bool[np.ndarray, "h w"] | None
    left_m: float = 0.0
    beyond: bool = False
    shown: Bool[np.ndarray, "h w"] | None = None
    sight: Sight | None = None


@dataclass(frozen=True, eq=False)
class Window:
    """One sample of an evaluation.

    Attributes:
        id: unique within its protocol.
        clip: the input log.
        targets: the target views.
        about: describes the sample in plain JSON.
        beside: logs of the target sweeps, by the lateral offset in metres at which they were measured, left positive.
    """

    id: str
    clip: Clip
    targets: tuple[EvaluationView, ...]
    about: Mapping[str, str | int | float] = field(default_factory=dict)
    beside: Mapping[float, Clip] = field(default_factory=dict)

    @cached_property
    def cameras(self) -> tuple[str, ...]:
        """Ids of the input cameras."""
        return tuple(name for name in self.clip.rig.cameras if len(self.clip.camera_times_us(name)))
