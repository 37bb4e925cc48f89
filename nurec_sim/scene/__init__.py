"""Scene archives: a GaussianScene as a USDZ that other simulators open, written and read without loss. And PLY."""

from nurec_sim.scene.archive import FORMAT_VERSION, archive_faults, write_scene
from nurec_sim.scene.checks import check_scene
from nurec_sim.scene.describe import scene_hash, summary
from nurec_sim.scene.formats import SCENE_SUFFIXES, read_scene
from nurec_sim.scene.interop.exchange import export_scene, import_scene
from nurec_sim.scene.interop.ply import read_ply, write_ply
from nurec_sim.scene.sidecars import alpasim_id

__all__ = [
    "FORMAT_VERSION",
    "SCENE_SUFFIXES",
    "alpasim_id",
    "archive_faults",
    "check_scene",
    "export_scene",
    "import_scene",
    "read_ply",
    "read_scene",
    "scene_hash",
    "summary",
    "write_ply",
    "write_scene",
]
