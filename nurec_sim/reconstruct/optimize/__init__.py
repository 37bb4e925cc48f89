"""Per-scene optimisation: Gaussians, sky and responses fitted to a log through the differentiable renderer."""

from nurec_sim.reconstruct.optimize.settings import OptimizeSettings

__all__ = ["OptimizeSettings"]
