"""Procedural MuJoCo towns: a seeded plan, true sensors for any pose, and driving logs.

``town_plan(seed)`` decides everything as plain data, ``TrueWorld(plan)`` draws it, ``write_town_clip`` writes
a log of it with exact boxes and map.
Names are loaded on first use, so that importing this package does not load MuJoCo.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nurec_sim.world.backend import BACKENDS, pick_backend
    from nurec_sim.world.build import Town, build_town
    from nurec_sim.world.isp import CameraResponse, apply_response, random_response
    from nurec_sim.world.layout import town_plan
    from nurec_sim.world.network import TownNetwork
    from nurec_sim.world.plan import Actor, Building, Prop, Road, RoadPiece, TownPlan
    from nurec_sim.world.random_rigs import random_readout_us, random_rig
    from nurec_sim.world.rig import LIDAR_ID, street_rig
    from nurec_sim.world.road import RoadLine
    from nurec_sim.world.scan import LidarResponse
    from nurec_sim.world.sense import TrueScan, TrueView, TrueWorld
    from nurec_sim.world.stage import Quality
    from nurec_sim.world.surface import LABEL_OF_CLASS, SurfaceClass
    from nurec_sim.world.truth import follow, scene_flow
    from nurec_sim.world.write import random_responses, true_sweep, write_town_clip

_MODULE_OF = {
    "CameraResponse": "isp",
    "apply_response": "isp",
    "random_response": "isp",
    "LidarResponse": "scan",
    "Quality": "stage",
    "follow": "truth",
    "scene_flow": "truth",
    "BACKENDS": "backend",
    "pick_backend": "backend",
    "Town": "build",
    "build_town": "build",
    "town_plan": "layout",
    "TownNetwork": "network",
    "Actor": "plan",
    "Building": "plan",
    "Prop": "plan",
    "Road": "plan",
    "RoadPiece": "plan",
    "TownPlan": "plan",
    "random_readout_us": "random_rigs",
    "random_rig": "random_rigs",
    "LIDAR_ID": "rig",
    "street_rig": "rig",
    "RoadLine": "road",
    "TrueScan": "sense",
    "TrueView": "sense",
    "TrueWorld": "sense",
    "LABEL_OF_CLASS": "surface",
    "SurfaceClass": "surface",
    "random_responses": "write",
    "true_sweep": "write",
    "write_town_clip": "write",
}

__all__ = [
    "Actor",
    "BACKENDS",
    "Building",
    "CameraResponse",
    "LABEL_OF_CLASS",
    "LIDAR_ID",
    "LidarResponse",
    "Prop",
    "Quality",
    "Road",
    "RoadLine",
    "RoadPiece",
    "SurfaceClass",
    "Town",
    "TownNetwork",
    "TownPlan",
    "TrueScan",
    "TrueView",
    "TrueWorld",
    "apply_response",
    "build_town",
    "follow",
    "pick_backend",
    "random_readout_us",
    "random_response",
    "random_responses",
    "random_rig",
    "scene_flow",
    "street_rig",
    "town_plan",
    "true_sweep",
    "write_town_clip",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
