"""Bodies of vehicles, cyclists and pedestrians in the MuJoCo model, and their limb animation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float64

from nurec_sim.world.assets import people, textures_ground, textures_people, textures_vehicles
from nurec_sim.world.assets.meshes import Corners, MeshBuilder
from nurec_sim.world.assets.vehicle_families import FAMILIES
from nurec_sim.world.assets.vehicle_meshes import LASER_OF_PART, vehicle_parts
from nurec_sim.world.model.builder import SpecBuilder
from nurec_sim.world.plan.surface import SurfaceClass
from nurec_sim.world.plan.town import Actor, TownPlan

STRIDE_M, BRISK_MPS = 1.45, 1.4
PEDAL_TURN_M = 5.0
SMOOTH_DEG = 70.0


@dataclass(frozen=True, eq=False)
class Gait:
    """Limb animation: joint names, and the arc length at each time of the recorded path."""

    kind: str
    joints: dict[str, str]
    t_us: Float64[np.ndarray, " n"]
    distance_m: Float64[np.ndarray, " n"]
    phase_rad: float

    def angles(self, t_us: float) -> dict[str, float]:
        """Angle of every joint at a time."""
        # The phase follows the distance walked, so that feet do not slide; the stride follows the speed over 0.2 s.
        here, before = np.interp([t_us, t_us - 200_000], self.t_us, self.distance_m)
        if self.kind == "cyclist":
            angles = people.cycling_angles(self.phase_rad + 2 * np.pi * here / PEDAL_TURN_M)
        else:
            stride = min((here - before) / 0.2 / BRISK_MPS, 1.15) if len(self.t_us) > 1 else 0.0
            angles = people.walking_angles(self.phase_rad + 2 * np.pi * here / STRIDE_M, stride)
        return {joint: angles[limb] for limb, joint in self.joints.items()}


class ActorBuilder:
    """Adds actors to a town. The first of a family is modelled, the others are scaled copies."""

    def __init__(self, builder: SpecBuilder, plan: TownPlan):
        self.builder, self.plan = builder, plan
        self._vehicles: dict[str, tuple[tuple[float, float, float], dict[str, Corners]]] = {}
        self._shadows: set[str] = set()
        self._limbs: dict[tuple[str, bool], Corners] = {}

    def add(self, actor: Actor, instance: int) -> Gait | None:
        """One actor as a mocap body; pedestrians and cyclists get a gait."""
        body = self.builder.spec.worldbody.add_body(name=actor.id, mocap=True)
        rng = np.random.default_rng([self.plan.style.texture_seed, 7, instance])
        if actor.kind in ("pedestrian", "cyclist"):
            return self._person(body, actor, instance, rng)
        self._vehicle(body, actor, instance, rng)
        return None

    # ----------------------------------------------------------------------------------------------------- vehicles

    def _vehicle(self, body: Any, actor: Actor, instance: int, rng: np.random.Generator) -> None:
        if actor.kind not in self._vehicles:
            parts = vehicle_parts(actor.kind, actor.size_m)
            self._vehicles[actor.kind] = actor.size_m, {name: mesh.corners(34.0) for name, mesh in parts.items()}
            self._paint(actor)
        made_for, shapes = self._vehicles[actor.kind]
        # The mesh fills the box of the first vehicle of its kind; scaled copies fill their own.
        stretch = np.array(actor.size_m) / made_for
        looks = {"paint": f"paint_{actor.kind}", "wheel": f"wheel{rng.integers(3)}", "plate": f"plate{rng.integers(4)}",
                 "cargo": f"cargo{rng.integers(4)}"}  # fmt: skip
        for name, corners in shapes.items():
            tint = actor.colour if name == "paint" else (1.0, 1.0, 1.0)
            mesh = self.builder.shared_mesh(corners, stretch.tolist())
            self.builder.place(body, mesh, SurfaceClass.VEHICLE, looks.get(name, name), instance=instance, tint=tint,
                               reflectivity=LASER_OF_PART.get(name))  # fmt: skip
        self._shadow(body, actor, *actor.size_m[:2])

    def _shadow(self, body: Any, actor: Actor, length_m: float, width_m: float) -> None:
        """The dark ground below something of this size."""
        material = f"shadow_{actor.kind}"
        if material not in self._shadows:
            self._shadows.add(material)
            self.builder.material(material, textures_ground.contact_shadow(length_m, width_m))
        # In the box frame: 2 cm above the ground, half a metre beyond the body, as `contact_shadow` expects.
        half_l, half_w, ground = length_m / 2 + 0.5, width_m / 2 + 0.5, 0.02 - actor.size_m[2] / 2
        mesh = MeshBuilder()
        mesh.quad([-half_l, -half_w, ground], [half_l, -half_w, ground], [half_l, half_w, ground],
                  [-half_l, half_w, ground], ((0, 0), (0, 1), (1, 1), (1, 0)))  # fmt: skip
        self.builder.place(body, mesh, SurfaceClass.ROAD, material, decal=True)

    def _paint(self, actor: Actor) -> None:
        """The family's paint texture, generated for its first vehicle."""
        rng = np.random.default_rng([self.plan.style.texture_seed, 8, *actor.kind.encode()])
        atlas = textures_vehicles.body_atlas(rng, FAMILIES[actor.kind], actor.size_m)
        self.builder.material(f"paint_{actor.kind}", atlas, shine=0.8)

    # ------------------------------------------------------------------------------------------------------- people

    def _person(self, body: Any, actor: Actor, instance: int, rng: np.random.Generator) -> Gait:
        rides = actor.kind == "cyclist"
        surface = SurfaceClass.CYCLIST if rides else SurfaceClass.PERSON
        cloth = f"person{instance}"
        self.builder.material(cloth, textures_people.person(rng, actor.colour))
        scale = actor.size_m[2] / people.HEIGHT_M
        foot, bare, lean = -actor.size_m[2] / 2, rng.random() < 0.3, people.LEAN_RAD if rides else 0.0

        def place(where: Any, corners: Corners, material: str, tint: tuple[float, ...] = (1.0, 1.0, 1.0)) -> None:
            """Adds a part of the person, scaled to their height.

            Args:
                where: body that carries it.
                corners: triangle corners in the frame of that body, for a person of ``people.HEIGHT_M``.
                material: name of its material.
                tint: colour factor 0..1.
            """
            mesh = self.builder.shared_mesh(corners, [scale] * 3)
            self.builder.place(where, mesh, surface, material, instance=instance, tint=tint)

        trunk = _rigid(body, [-0.2 * scale if rides else 0.0, 0.0, foot + (0.02 * scale if rides else 0.0)])
        upper = people.trunk(rng, helmet=rides, skirt=not rides and rng.random() < 0.15, lean_rad=lean)
        place(trunk, upper.corners(SMOOTH_DEG), cloth)
        bodies, joints = {"": trunk}, {}
        for limb in people.LIMBS:
            x, y, z = people.leaning_joint(limb, lean)
            part = _rigid(bodies[limb.parent], [x * scale, y * scale, z * scale])
            hinge = part.add_joint(name=f"{actor.id}_{limb.name}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
            # All people share the meshes of limbs, with long or short clothes.
            if (limb.name, bare) not in self._limbs:
                self._limbs[limb.name, bare] = people.limb(limb.name, bare=bare).corners(SMOOTH_DEG)
            place(part, self._limbs[limb.name, bare], cloth)
            bodies[limb.name], joints[limb.name] = part, hinge.name
        if rides:
            wheels = _rigid(body, [0.0, 0.0, foot])
            bicycle = people.bicycle()
            colour = tuple(float(c) for c in rng.uniform(0.08, 0.85, 3))
            place(wheels, bicycle["frame"].corners(SMOOTH_DEG), "cycle", colour)
            place(wheels, bicycle["tyres"].corners(SMOOTH_DEG), "trim")
        self._shadow(body, actor, 1.5 if rides else 0.45, 0.4)
        path = np.array(actor.path, np.float64)
        step = np.linalg.norm(np.diff(path[:, 1:3], axis=0), axis=1)
        return Gait(actor.kind, joints, path[:, 0], np.concatenate([[0.0], np.cumsum(step)]),
                    float(rng.uniform(0, 2 * np.pi)))  # fmt: skip


def _rigid(parent: Any, place: list[float]) -> Any:
    """A child body with some inertia, which MuJoCo requires for bodies with joints."""
    part = parent.add_body(pos=place)
    part.mass, part.inertia, part.explicitinertial = 3.0, [0.1, 0.1, 0.1], True
    return part
