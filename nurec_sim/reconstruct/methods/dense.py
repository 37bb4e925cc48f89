"""The method ``dense`` (docs/network.md)."""

from nurec_sim.reconstruct.methods._network import NetworkMethod


class Dense(NetworkMethod):
    """The Instant NuRec network, one Gaussian per pixel."""

    name = "dense"
