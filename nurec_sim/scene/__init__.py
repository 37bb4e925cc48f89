"""Scene archives: a GaussianScene as a USDZ that other simulators open, written and read without loss."""

from nurec_sim.scene.archive import FORMAT_VERSION, archive_faults, read_scene, write_scene
from nurec_sim.scene.checks import check_scene
from nurec_sim.scene.describe import scene_hash, summary
from nurec_sim.scene.sidecars import alpasim_id

__all__ = [
    "FORMAT_VERSION",
    "alpasim_id",
    "archive_faults",
    "check_scene",
    "read_scene",
    "scene_hash",
    "summary",
    "write_scene",
]
