"""Driving logs: open, check, describe and write clip folders."""

from nurec_sim.logs.check import check_clip
from nurec_sim.logs.checks import Measure, measure_clip
from nurec_sim.logs.clip import Clip
from nurec_sim.logs.describe import SENSOR_COLUMNS, ClipSummary, describe_clip
from nurec_sim.logs.overlay import draw_overlay
from nurec_sim.logs.reader import open_clip
from nurec_sim.logs.write import CameraEntry, LidarEntry, write_clip

__all__ = [
    "SENSOR_COLUMNS",
    "CameraEntry",
    "Clip",
    "ClipSummary",
    "LidarEntry",
    "Measure",
    "check_clip",
    "describe_clip",
    "draw_overlay",
    "measure_clip",
    "open_clip",
    "write_clip",
]
