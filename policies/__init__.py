"""Example policies, one file each; found by name through ``nurec_sim.plugins``."""
