"""nurec_sim: an open closed-loop sensor simulator for driving."""

__version__ = "0.1.0"
