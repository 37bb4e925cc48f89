"""A part of the demo log, and the same with known errors of beams, mounting and poses."""

import dataclasses
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from nurec_sim import geometry, logs
from nurec_sim.logs.alignment.stored import with_beams
from nurec_sim.logs.beam_errors import BeamErrors
from nurec_sim.logs.moved import corrected
from nurec_sim.types import Rig, Trajectory

LIDAR = "lidar_top"
ELEVATION_RAD = np.radians(np.arange(-30, 10, 0.5))


def street(sweeps: int, *names: str) -> logs.Clip:
    """The first sweeps of the demo log, and the images of some cameras until then."""
    demo = logs.open_clip(Path(__file__).parents[2] / "scenarios" / "demo_clip.zip")
    records = {LIDAR: demo.sweep_records(LIDAR)[:sweeps]}
    cameras = {name: demo.rig.cameras[name] for name in names}
    images = {name: [r for r in demo.image_records(name) if r.end_us <= records[LIDAR][-1].t_us] for name in cameras}
    rig = Rig(cameras, demo.rig.lidars)
    return logs.Clip("street", rig, demo.ego, images, records, demo.source, tracks=demo.tracks)


def turned(degrees, height_m: float = 0.0) -> np.ndarray:
    """A pose turned by a rotation vector and raised."""
    return geometry.pose(Rotation.from_rotvec(degrees, degrees=True).as_matrix(), np.array([0.0, 0.0, height_m]))


class Miscalibrated:
    """The points of a log as a scanner stores them whose beams are off."""

    def __init__(self, source, given: BeamErrors):
        self.source, self.given = source, given

    def sweep(self, lidar_id, index):
        stored = self.source.sweep(lidar_id, index)
        return dataclasses.replace(stored, xyz_m=self.given.removed(stored.xyz_m))

    def __getattr__(self, name):
        return getattr(self.source, name)


def miscalibrated(clip: logs.Clip, turn_deg: float = 0.0) -> logs.Clip:
    """The log with beams above and below -8 degrees 0.1 degrees apart, each off by its own 0.03 degrees besides."""
    own = np.random.default_rng(5).normal(0, np.radians(0.03), len(ELEVATION_RAD))
    error = own + np.radians(np.where(ELEVATION_RAD < np.radians(-8), 0.04, -0.06))
    mounting = clip.rig.lidars[LIDAR].rig_from_lidar
    wrong = with_beams(clip, {LIDAR: mounting @ turned([0, turn_deg, 0])}, {})
    wrong.source = Miscalibrated(clip.source, BeamErrors(ELEVATION_RAD, -error))
    return wrong


def shaken(clip: logs.Clip) -> logs.Clip:
    """The log with poses that roll and pitch by 0.1 degrees and rise by 3 cm, another way at each sweep."""
    times = np.array([record.t_us for record in clip.sweep_records(LIDAR)])
    random = np.random.default_rng(6)
    at = clip.ego.at(times)
    jolts = np.array([turned([*random.normal(0, 0.1, 2), 0], random.normal(0, 0.03)) for _ in times])
    return corrected(clip, Trajectory(times, at @ jolts @ geometry.inverse(at)))
