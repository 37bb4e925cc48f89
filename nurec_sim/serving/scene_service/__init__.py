"""The scene service: what we offer beyond the sensor interface (``protos/nurec_sim_v1.proto``, docs/serving_v1.md)."""

from nurec_sim.serving.scene_service.service import SceneOptions, SceneService

__all__ = ["SceneOptions", "SceneService"]
