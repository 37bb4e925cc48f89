"""Compiles a plan to a MuJoCo model with class, instance and reflectivity per geom."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8

from nurec_sim import geometry
from nurec_sim.world.model.actor_models import ActorBuilder, Gait
from nurec_sim.world.model.builder import SpecBuilder
from nurec_sim.world.model.materials import add_materials
from nurec_sim.world.model.scenery import add_scenery
from nurec_sim.world.model.sky import Sky
from nurec_sim.world.model.weather import add_fog, add_lights
from nurec_sim.world.plan.network import TownNetwork
from nurec_sim.world.plan.town import TownPlan

EXTENT_M = 100.0
NEAR_M, FAR_M = 0.1, 1400.0

ActorPlaces = tuple[Float64[np.ndarray, "n actors 3"], Float64[np.ndarray, "n actors 4"]]
"""Positions and quaternions of all actors at n instants, in MuJoCo's order."""


@dataclass(frozen=True, eq=False)
class Town:
    """A compiled town. Per geom: its class, its instance (0 static, actor i is i + 1), reflectivity, plain colour."""

    plan: TownPlan
    network: TownNetwork
    model: Any
    geom_class: UInt8[np.ndarray, " g"]
    geom_instance: Int32[np.ndarray, " g"]
    geom_reflectivity: Float64[np.ndarray, " g"]
    geom_rgb: Float64[np.ndarray, "g 3"]
    actor_mocap: dict[str, int]
    gaits: tuple[tuple[Gait, dict[str, int]], ...]
    sun: Float64[np.ndarray, " 3"]
    sky: Sky

    def actor_places(self, actors: dict[str, Float64[np.ndarray, "n 4 4"]], count: int) -> ActorPlaces:
        """MuJoCo poses of all actors at ``count`` instants, from their ``world_from_box``."""
        places = np.zeros((count, self.model.nmocap, 3)), np.zeros((count, self.model.nmocap, 4))
        for name, world_from_box in actors.items():
            places[0][:, self.actor_mocap[name]] = world_from_box[:, :3, 3]
            places[1][:, self.actor_mocap[name]] = geometry.quat_from_matrix(world_from_box[:, :3, :3])
        return places

    def pose(self, data: Any, t_us: float, places: ActorPlaces, instant: int = 0) -> None:
        """Poses all actors and their limbs for an instant, and updates the kinematics.

        Args:
            data: MuJoCo state to update.
            t_us: time of the instant, for the phase of limbs.
            places: poses of all actors (``actor_places``).
            instant: index of the instant in ``places``.
        """
        data.mocap_pos[:], data.mocap_quat[:] = places[0][instant], places[1][instant]
        for gait, addresses in self.gaits:
            for joint, angle in gait.angles(t_us).items():
                data.qpos[addresses[joint]] = angle
        # Only body and light poses: no dynamics are simulated.
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_camlight(self.model, data)

    def through_air(
        self, rgb: UInt8[np.ndarray, "h w 3"], range_m: Float32[np.ndarray, "h w"]
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Applies the weather's fog to an image; ``range_m`` is 0 for the sky."""
        return add_fog(rgb, range_m, self.sky, self.plan.weather.fog_per_m)


def build_town(plan: TownPlan, network: TownNetwork | None = None) -> Town:
    """Textures, meshes, lights and actors of a plan; deterministic; takes about two seconds."""
    network = TownNetwork(plan) if network is None else network
    builder = SpecBuilder()
    spec = builder.spec
    spec.stat.extent, spec.stat.center = EXTENT_M, [0, 0, 0]
    visual = spec.visual
    # MuJoCo measures these in units of the model's extent.
    visual.map.znear, visual.map.zfar, visual.map.shadowclip = NEAR_M / EXTENT_M, FAR_M / EXTENT_M, 0.5
    visual.quality.shadowsize, visual.quality.offsamples = 2048, 4
    sky = Sky(np.random.default_rng([plan.style.texture_seed, 30]), plan.weather)
    builder.texture("sky", sky.skybox(), mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    add_lights(spec, plan.weather)
    add_materials(builder, plan, sky)
    add_scenery(builder, network)
    actors = ActorBuilder(builder, plan)
    gaits = [actors.add(actor, index + 1) for index, actor in enumerate(plan.actors)]
    model = spec.compile()
    # Filled in by SpecBuilder for every geom.
    user = model.geom_user
    return Town(
        plan=plan,
        network=network,
        model=model,
        geom_class=user[:, 0].astype(np.uint8),
        geom_instance=user[:, 1].astype(np.int32),
        geom_reflectivity=user[:, 2].copy(),
        geom_rgb=np.clip(user[:, 3:6], 0, 1),
        actor_mocap={a.id: int(model.body_mocapid[model.body(a.id).id]) for a in plan.actors},
        gaits=tuple(
            (gait, {name: int(model.joint(name).qposadr[0]) for name in gait.joints.values()})
            for gait in gaits
            if gait is not None
        ),
        sun=sky.sun,
        sky=sky,
    )
