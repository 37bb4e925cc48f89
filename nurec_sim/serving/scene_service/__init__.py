"""The scene service: what we offer beyond the sensor interface (``protos/nurec_sim_v1.proto``, docs/serving_v1.md)."""

from nurec_sim.serving.scene_service.options import SceneOptions
from nurec_sim.serving.scene_service.service import SceneService

__all__ = ["SceneOptions", "SceneService"]
