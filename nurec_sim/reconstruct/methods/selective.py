"""The method ``selective`` (docs/network.md)."""

from nurec_sim.reconstruct.methods._network import NetworkMethod


class Selective(NetworkMethod):
    """The Instant NuRec network, clusters around chosen points."""

    name = "selective"
