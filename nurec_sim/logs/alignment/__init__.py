"""Sweeps of a log aligned: beams, mountings of LiDARs and poses corrected until sweeps and images see the same.

On grazing ground a beam that is off by a twentieth of a degree is off by decimetres of range, and an image by a pixel.
Scanners are calibrated no better, nor are the angles of most poses; but every stretch of road is seen from far and from
near, by many beams, and every house by many images.
"""

from nurec_sim.logs.alignment.align import with_aligned_sensors, with_aligned_sweeps
from nurec_sim.logs.alignment.stored import CAMERA_FACT, FACT, aligned_as

__all__ = ["CAMERA_FACT", "FACT", "aligned_as", "with_aligned_sensors", "with_aligned_sweeps"]
