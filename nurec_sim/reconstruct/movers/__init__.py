"""Movers of a log that no box labels, found in its sweeps; boxes and tracks from moving points."""

from nurec_sim.reconstruct.movers.alignment import with_aligned_actors
from nurec_sim.reconstruct.movers.choice import with_actors
from nurec_sim.reconstruct.movers.find import NAME, find_actors

__all__ = ["NAME", "find_actors", "with_actors", "with_aligned_actors"]
