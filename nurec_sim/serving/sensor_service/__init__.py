"""The procedures of the sensor interface; ``server`` serves them."""

from nurec_sim.serving.sensor_service.discovery import Discovery
from nurec_sim.serving.sensor_service.editing import Editing
from nurec_sim.serving.sensor_service.options import ServiceOptions
from nurec_sim.serving.sensor_service.rendering import Rendering

__all__ = ["SensorService", "ServiceOptions"]


class SensorService(Rendering, Discovery, Editing):
    """The procedures, one coroutine each, by their names on the wire: message in, message out, errors raised.

    It is made of the ``store`` of scenes, ``options`` (limits and choices), and ``request_stop``, which
    ``shut_down`` calls.
    """
