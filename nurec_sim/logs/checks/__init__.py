"""Does a log fit together: ground, boxes, LiDAR and images."""

from __future__ import annotations

from nurec_sim.logs.checks.boxes import check_boxes
from nurec_sim.logs.checks.calibration import check_calibration
from nurec_sim.logs.checks.ground import check_ground
from nurec_sim.logs.checks.measure import Measure
from nurec_sim.logs.checks.sampling import sample_sweeps
from nurec_sim.logs.clip import Clip

__all__ = ["Measure", "measure_clip"]


def measure_clip(clip: Clip) -> list[Measure]:
    """Whether the sensors, the ground and the boxes of a clip fit together, from some of its sweeps and images.

    Each row says what was measured, the figure, and the faults: the ground that the LiDAR sees against z = 0; borders
    in the LiDAR against borders in each camera's images, as calibrated and in other readings of the calibration; boxes
    against the points they hold. A row without faults may say that there is too little to tell by.
    """
    sweeps = sample_sweeps(clip)
    return [*check_ground(clip, sweeps), *check_calibration(clip, sweeps), *check_boxes(clip, sweeps)]
