"""From a plan to a compiled MuJoCo model whose every geom knows what it is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float64, Int32, UInt8

from nurec_sim import geometry
from nurec_sim.world.builder import SpecBuilder
from nurec_sim.world.plan import Actor, StreetPlan
from nurec_sim.world.street_scenery import add_materials, add_scenery
from nurec_sim.world.surface import SurfaceClass
from nurec_sim.world.textures import Sky
from nurec_sim.world.vehicles import car_parts

EXTENT_M = 100.0
NEAR_M, FAR_M = 0.1, 1400.0
GAIT_HZ = 0.9
LIMB_SWING = np.array([1.0, -0.6, -1.0, 0.6])
LASER_OF_PART = {"taillight": 0.9, "headlight": 0.8, "rim": 0.8, "glass": 0.1}


ActorPlaces = tuple[Float64[np.ndarray, "n actors 3"], Float64[np.ndarray, "n actors 4"]]
"""Positions and quaternions of all actors at n instants, in MuJoCo's order."""


@dataclass(frozen=True, eq=False)
class Street:
    """A compiled street. Per geom: its class, its instance (0 static, actor i is i + 1), reflectivity, plain colour."""

    plan: StreetPlan
    model: Any
    geom_class: UInt8[np.ndarray, " g"]
    geom_instance: Int32[np.ndarray, " g"]
    geom_reflectivity: Float64[np.ndarray, " g"]
    geom_rgb: Float64[np.ndarray, "g 3"]
    actor_mocap: dict[str, int]
    actor_limbs: dict[str, tuple[int, ...]]
    sun: Float64[np.ndarray, " 3"]
    sky: Sky

    def actor_places(self, actors: dict[str, Float64[np.ndarray, "n 4 4"]], count: int) -> ActorPlaces:
        """Where MuJoCo wants the actors at ``count`` instants, from the ``world_from_box`` of every one of them."""
        places = np.zeros((count, self.model.nmocap, 3)), np.zeros((count, self.model.nmocap, 4))
        for name, world_from_box in actors.items():
            places[0][:, self.actor_mocap[name]] = world_from_box[:, :3, 3]
            places[1][:, self.actor_mocap[name]] = geometry.quat_from_matrix(world_from_box[:, :3, :3])
        return places

    def pose(self, data: Any, t_us: float, places: ActorPlaces, instant: int = 0) -> None:
        """Puts all actors where ``places`` says for an instant, swings limbs, and updates the kinematics."""
        data.mocap_pos[:], data.mocap_quat[:] = places[0][instant], places[1][instant]
        swing = 0.42 * np.sin(2 * np.pi * GAIT_HZ * t_us * 1e-6)
        for limbs in self.actor_limbs.values():
            data.qpos[list(limbs)] = swing * LIMB_SWING
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_camlight(self.model, data)

    def through_air(self, rgb: np.ndarray, range_m: np.ndarray) -> np.ndarray:
        """Clear air."""
        return rgb


def build_street(plan: StreetPlan) -> Street:
    """Textures, meshes, lights and actors of a plan; about two seconds of work, the same for the same plan."""
    builder = SpecBuilder()
    spec = builder.spec
    spec.stat.extent, spec.stat.center = EXTENT_M, [0, 0, 0]
    visual = spec.visual
    visual.map.znear, visual.map.zfar, visual.map.shadowclip = NEAR_M / EXTENT_M, FAR_M / EXTENT_M, 0.5
    visual.quality.shadowsize, visual.quality.offsamples = 2048, 4
    visual.quality.numslices, visual.quality.numstacks, visual.quality.numquads = 12, 8, 1
    elevation, azimuth = plan.sun_elevation_rad, plan.sun_azimuth_rad
    sun = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    sky = Sky(np.random.default_rng([plan.seed, 0x5C]), sun, plan.cloud_cover)
    builder.texture("sky", sky.skybox(), mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    _lights(builder, sun)
    add_materials(builder, np.random.default_rng([plan.seed, 0x7E]))
    add_scenery(builder, plan, np.random.default_rng([plan.seed, 0x5E]))
    limbs: dict[str, tuple[str, ...]] = {}
    for index, actor in enumerate(plan.actors):
        body = spec.worldbody.add_body(name=actor.id, mocap=True)
        if actor.kind == "pedestrian":
            limbs[actor.id] = _person(builder, body, actor, index + 1)
        else:
            _car(builder, body, actor, index + 1)
    model = spec.compile()
    user = model.geom_user
    return Street(
        plan=plan,
        model=model,
        geom_class=user[:, 0].astype(np.uint8),
        geom_instance=user[:, 1].astype(np.int32),
        geom_reflectivity=user[:, 2].copy(),
        geom_rgb=np.clip(user[:, 3:6], 0, 1),
        actor_mocap={a.id: int(model.body_mocapid[model.body(a.id).id]) for a in plan.actors},
        actor_limbs={k: tuple(int(model.joint(j).qposadr[0]) for j in joints) for k, joints in limbs.items()},
        sun=sun,
        sky=sky,
    )


def _lights(builder: SpecBuilder, sun: np.ndarray) -> None:
    """A sun that casts shadows, a weak fill from the other side so that shaded walls keep their shape, and ambient."""
    world, directional = builder.world, mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    fill = np.array([-sun[0], -sun[1], 0.8])
    world.add_light(name="sun", type=directional, pos=(sun * 120).tolist(), dir=(-sun).tolist(), ambient=[0, 0, 0],
                    diffuse=[0.74, 0.71, 0.65], specular=[0.35] * 3, castshadow=True)  # fmt: skip
    world.add_light(name="fill", type=directional, dir=(-fill / np.linalg.norm(fill)).tolist(), ambient=[0, 0, 0],
                    diffuse=[0.16, 0.17, 0.19], specular=[0, 0, 0], castshadow=False)  # fmt: skip
    headlight = builder.spec.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = [0.42, 0.44, 0.48], [0.06] * 3, [0, 0, 0]


def _car(builder: SpecBuilder, body: Any, actor: Actor, instance: int) -> None:
    for name, mesh in car_parts(actor.kind, actor.size_m).items():
        tint = actor.colour if name == "paint" else (1, 1, 1)
        builder.place(body, mesh, SurfaceClass.VEHICLE, name, instance=instance, tint=tint,
                      reflectivity=LASER_OF_PART.get(name), crease_deg=32.0)  # fmt: skip


def _person(builder: SpecBuilder, body: Any, actor: Actor, instance: int) -> tuple[str, ...]:
    """A walker from primitives; gives the names of its limb joints, leg arm leg arm."""
    scale, foot = actor.size_m[2] / 1.76, -actor.size_m[2] / 2
    shirt, trousers, kinds = actor.colour, (0.16, 0.17, 0.24), mujoco.mjtGeom

    def shape(where: Any, kind: Any, material: str, tint: tuple[float, ...], **place: Any) -> None:
        scaled = {key: [value * scale for value in values] for key, values in place.items()}
        builder.shape(where, kind, SurfaceClass.PERSON, material, instance, tint, **scaled)

    def up(z: float) -> float:
        return z + foot / scale

    shape(body, kinds.mjGEOM_ELLIPSOID, "cloth", shirt, size=[0.14, 0.21, 0.33], pos=[0, 0, up(1.14)])
    shape(body, kinds.mjGEOM_ELLIPSOID, "cloth", trousers, size=[0.13, 0.18, 0.16], pos=[0, 0, up(0.88)])
    shape(body, kinds.mjGEOM_SPHERE, "skin", (1, 1, 1), size=[0.115], pos=[0.01, 0, up(1.6)])
    shape(body, kinds.mjGEOM_ELLIPSOID, "dark", (1, 1, 1), size=[0.12, 0.12, 0.09], pos=[-0.02, 0, up(1.66)])
    joints = []
    for side in (-1, 1):
        for limb, place in (("leg", (0.0, side * 0.09, 0.86)), ("arm", (0.0, side * 0.22, 1.38))):
            part = body.add_body(pos=[place[0], place[1] * scale, up(place[2]) * scale])
            part.mass, part.inertia, part.explicitinertial = 3.0, [0.1, 0.1, 0.1], True
            joint = part.add_joint(name=f"{actor.id}_{limb}{side}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
            joints.append(joint.name)
            if limb == "leg":
                shape(part, kinds.mjGEOM_CAPSULE, "cloth", trousers, size=[0.07], fromto=[0, 0, 0, 0, 0, -0.74])
                shape(part, kinds.mjGEOM_BOX, "dark", (1, 1, 1), size=[0.12, 0.045, 0.04], pos=[0.05, 0, -0.81])
            else:
                shape(part, kinds.mjGEOM_CAPSULE, "cloth", shirt, size=[0.05], fromto=[0, 0, 0, 0, side * 0.02, -0.5])
                shape(part, kinds.mjGEOM_SPHERE, "skin", (1, 1, 1), size=[0.05], pos=[0, side * 0.02, -0.57])
    return tuple(joints)
