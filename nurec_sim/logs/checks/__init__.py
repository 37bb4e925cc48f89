"""Geometric consistency checks of a log: ground, boxes, LiDAR and images."""

from __future__ import annotations

from nurec_sim.logs.checks.beams import check_beams
from nurec_sim.logs.checks.boxes import check_boxes
from nurec_sim.logs.checks.calibration import check_calibration
from nurec_sim.logs.checks.camera_pairs import check_camera_pairs
from nurec_sim.logs.checks.ground import check_ground
from nurec_sim.logs.checks.measure import Measure
from nurec_sim.logs.checks.sampling import sample_sweeps
from nurec_sim.logs.clip import Clip

__all__ = ["Measure", "measure_clip"]


def measure_clip(clip: Clip) -> list[Measure]:
    """Checks the consistency of sensors, ground and boxes of a clip on a sample of its sweeps and images.

    Each row has the quantity, its value and the faults: the ground seen by the LiDAR against z = 0; points of the LiDAR
    against its beams; depth edges of the LiDAR against edges in each camera's images, for the given calibration and for
    alternative interpretations of it; boxes against the points inside. A row without faults may report insufficient
    data.
    """
    sweeps = sample_sweeps(clip)
    return [
        *check_ground(clip, sweeps),
        *check_beams(clip, sweeps),
        *check_calibration(clip, sweeps),
        *check_camera_pairs(clip, sweeps),
        *check_boxes(clip, sweeps),
    ]
