"""Driving logs: open any format that a reader knows, check and describe them; write clip folders."""

from nurec_sim.logs.check import check_clip
from nurec_sim.logs.checks import Measure, measure_clip
from nurec_sim.logs.clip import Clip, ImageRecord
from nurec_sim.logs.conformance import check_reader
from nurec_sim.logs.convert import convert_clip
from nurec_sim.logs.describe import SENSOR_COLUMNS, ClipSummary, describe_clip
from nurec_sim.logs.fired import as_fired, fired_fraction
from nurec_sim.logs.held_out import HeldOut, hold_out, without_images
from nurec_sim.logs.overlay import draw_overlay
from nurec_sim.logs.reader import is_log, open_clip
from nurec_sim.logs.storage import decode_image
from nurec_sim.logs.sweeps import SweepRecord
from nurec_sim.logs.write import CameraEntry, LidarEntry, write_clip

__all__ = [
    "SENSOR_COLUMNS",
    "CameraEntry",
    "Clip",
    "ClipSummary",
    "HeldOut",
    "ImageRecord",
    "LidarEntry",
    "Measure",
    "SweepRecord",
    "as_fired",
    "check_clip",
    "check_reader",
    "convert_clip",
    "decode_image",
    "describe_clip",
    "draw_overlay",
    "fired_fraction",
    "hold_out",
    "is_log",
    "measure_clip",
    "open_clip",
    "without_images",
    "write_clip",
]
