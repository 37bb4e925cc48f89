"""A small MuJoCo street: a seeded plan, true sensors for any pose, and driving logs.

``street_plan(seed)`` decides everything as plain data, ``TrueWorld(plan)`` draws it, ``write_street_clip`` writes
a log of it with exact boxes and map.
Names are loaded on first use, so that importing this package does not load MuJoCo.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nurec_sim.world.backend import BACKENDS, pick_backend
    from nurec_sim.world.build import Street, build_street
    from nurec_sim.world.layout import street_plan, town_plan
    from nurec_sim.world.network import TownNetwork
    from nurec_sim.world.plan import Actor, Building, Prop, Road, RoadPiece, StreetPlan, TownPlan
    from nurec_sim.world.random_rigs import random_readout_us, random_rig
    from nurec_sim.world.rig import LIDAR_ID, street_rig
    from nurec_sim.world.road import RoadLine
    from nurec_sim.world.sense import TrueScan, TrueView, TrueWorld
    from nurec_sim.world.surface import LABEL_OF_CLASS, SurfaceClass
    from nurec_sim.world.write import write_street_clip

_MODULE_OF = {
    "BACKENDS": "backend",
    "pick_backend": "backend",
    "Street": "build",
    "build_street": "build",
    "street_plan": "layout",
    "town_plan": "layout",
    "TownNetwork": "network",
    "Actor": "plan",
    "Building": "plan",
    "Prop": "plan",
    "Road": "plan",
    "RoadPiece": "plan",
    "StreetPlan": "plan",
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
    "write_street_clip": "write",
}

__all__ = [
    "Actor",
    "BACKENDS",
    "Building",
    "LABEL_OF_CLASS",
    "LIDAR_ID",
    "Prop",
    "Road",
    "RoadLine",
    "RoadPiece",
    "Street",
    "StreetPlan",
    "SurfaceClass",
    "TownNetwork",
    "TownPlan",
    "TrueScan",
    "TrueView",
    "TrueWorld",
    "build_street",
    "pick_backend",
    "random_readout_us",
    "random_rig",
    "street_plan",
    "street_rig",
    "town_plan",
    "write_street_clip",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
