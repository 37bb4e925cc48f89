"""Policies over gRPC, both ends: serve a policy as an egodriver, use any egodriver as a policy."""

from nurec_sim.serving.driver.remote_policy import RemotePolicy
from nurec_sim.serving.driver.server import DriverServer
from nurec_sim.serving.driver.service import DriverOptions, DriverService

__all__ = ["DriverOptions", "DriverServer", "DriverService", "RemotePolicy"]
