"""Kernel compilation, and cooperative scheduling of long computations."""
