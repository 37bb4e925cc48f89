"""The scene service: what we add to the sensor interface (``protos/nurec_sim_v1.proto``, docs/scene_service.md)."""

from nurec_sim.serving.scene_service.service import SceneOptions, SceneService

__all__ = ["SceneOptions", "SceneService"]
