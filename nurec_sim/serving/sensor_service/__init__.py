"""What every procedure of the sensor interface does; ``server`` puts it on the network."""

from nurec_sim.serving.sensor_service.options import ServiceOptions, describe
from nurec_sim.serving.sensor_service.sensors import SensorService

__all__ = ["SensorService", "ServiceOptions", "describe"]
