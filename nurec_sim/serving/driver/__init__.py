"""Policies on the far side of a wire, both ends: serve one as AlpaSim's egodriver, drive any egodriver in our loop."""

from nurec_sim.serving.driver.remote_policy import RemotePolicy
from nurec_sim.serving.driver.server import DriverServer
from nurec_sim.serving.driver.service import DriverOptions, DriverService

__all__ = ["DriverOptions", "DriverServer", "DriverService", "RemotePolicy"]
