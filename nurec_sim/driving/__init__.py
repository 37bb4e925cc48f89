"""Policies on the far side of a wire, both ends: serve one as AlpaSim's egodriver, drive any egodriver in our loop."""

from nurec_sim.driving.remote import RemotePolicy
from nurec_sim.driving.server import DriverServer
from nurec_sim.driving.service import DriverOptions, DriverService

__all__ = ["DriverOptions", "DriverServer", "DriverService", "RemotePolicy"]
