"""Static Gaussians that a fit has moved or grown into free space: recorded LiDAR beams say where nothing is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int64

from nurec_sim.reconstruct.free_space import SweepBeams, chosen_sweeps, in_free_space, sweep_beams
from nurec_sim.reconstruct.optimize.adam import OPACITY
from nurec_sim.reconstruct.optimize.parameters import Parameters
from nurec_sim.reconstruct.optimize.placing import LEAST_OPACITY
from nurec_sim.types import Clip

CLEARINGS = 4
"""Times per budget that Gaussians in free space are taken out, evenly; the last one is at its end."""
OUT_LOGIT = float(np.log(LEAST_OPACITY / 4))
"""Too faint to be rendered, so nothing changes it any more."""


def recorded_beams(clip: Clip, hold_out: set[int]) -> list[SweepBeams]:
    """The beams of the clip's sweeps, without those held out; a long log is thinned (``chosen_sweeps``)."""
    return [sweep_beams(clip, name, clip.sweep(name, k)) for name, k in chosen_sweeps(clip, hold_out)]


def take_out(parameters: Parameters, beams: Sequence[SweepBeams]) -> Int64[np.ndarray, " k"]:
    """Make the static Gaussians in free space invisible that a step has changed; what was given stays.

    Returns:
        their rows.
    """
    static = parameters.static_count
    faint = parameters.values[:static, OPACITY] < np.log(LEAST_OPACITY)
    rows = np.flatnonzero((parameters.visits[:static] > 0) & ~faint)
    free = rows[in_free_space(parameters.static_gaussians(rows), beams)]
    parameters.values[free, OPACITY] = OUT_LOGIT
    parameters.values_changed()
    return free
