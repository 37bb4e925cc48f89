"""Procedural MuJoCo towns: a seeded plan, true sensors for any pose, and driving logs.

``town_plan(seed)`` generates a town as plain data, ``TrueWorld(plan)`` renders it, ``write_town_clip`` records a log
with exact boxes and map. Names are loaded on first use, so that importing this package does not load MuJoCo.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "assets.actor_gaussians": ["ACTOR_SIZES_M", "actor_gaussians"],
        "model.assemble": ["Town", "build_town"],
        "plan.layout": ["town_plan"],
        "plan.network": ["TownNetwork"],
        "plan.random_rigs": ["random_readout_us", "random_rig"],
        "plan.rig": ["LIDAR_ID", "street_rig"],
        "plan.road": ["RoadLine"],
        "plan.surface": ["LABEL_OF_CLASS", "SurfaceClass"],
        "plan.town": ["LABEL_OF_KIND", "Actor", "Building", "Prop", "Road", "RoadPiece", "TownPlan"],
        "sense.backend": ["BACKENDS", "pick_backend"],
        "sense.isp": ["CameraResponse", "apply_response", "random_response"],
        "sense.scan": ["LidarResponse", "TrueScan"],
        "sense.simulator": ["TrueView", "TrueWorld"],
        "sense.stage": ["Quality"],
        "sense.truth": ["follow", "scene_flow"],
        "write": ["random_responses", "true_sweep", "write_town_clip"],
    },
)
