"""The ``lift`` method: coloured LiDAR lifted to Gaussians, no network, no optimisation (docs/lift.md)."""
