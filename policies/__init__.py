"""Drivers that anyone can copy, one file each; found by name through ``nurec_sim.plugins``."""
