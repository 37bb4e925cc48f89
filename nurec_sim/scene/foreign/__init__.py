"""Scenes of other programs: NuRec archives, OpenUSD particle fields, 3DGS PLY files (docs/foreign_scenes.md)."""

from nurec_sim.scene.foreign.reader import read_foreign

__all__ = ["read_foreign"]
