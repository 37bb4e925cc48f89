"""The scene service: what we offer beyond the sensor interface (``protos/nurec_sim_v1.proto``, docs/serving_v1.md)."""

from nurec_sim.service_v1.options import SceneOptions
from nurec_sim.service_v1.service import SceneService

__all__ = ["SceneOptions", "SceneService"]
