"""Static parts of a town: ground, buildings, plants and street furniture."""

from __future__ import annotations

import numpy as np

from nurec_sim.geometry import pose_from_xyyaw
from nurec_sim.world.assets import trees
from nurec_sim.world.assets.fixtures import Part, fixture_parts
from nurec_sim.world.model.builder import SpecBuilder
from nurec_sim.world.model.chunks import Chunks
from nurec_sim.world.model.ground_meshes import add_ground, add_light_pools
from nurec_sim.world.model.houses import add_house
from nurec_sim.world.model.materials import LAMPS_ON
from nurec_sim.world.plan.network import TownNetwork
from nurec_sim.world.plan.surface import SurfaceClass
from nurec_sim.world.plan.town import Prop

HEDGE_HEIGHT_M = (0.9, 1.5)
DETAIL_CHUNK_M = 60.0
TREE_SIZES = (0.8, 1.0, 1.25)


def add_scenery(builder: SpecBuilder, network: TownNetwork) -> None:
    """Ground, houses, plants and furniture of a network's plan; requires their materials (``materials``)."""
    plan, chunks = network.plan, Chunks(DETAIL_CHUNK_M)
    ground = Chunks()
    add_ground(ground, network, np.random.default_rng([plan.style.texture_seed, 20]), plan.weather.wetness)
    if plan.weather.dusk > LAMPS_ON:
        add_light_pools(ground, network)
    for index, house in enumerate(plan.buildings):
        rng = np.random.default_rng([plan.style.texture_seed, 21, index])
        add_house(chunks, house, plan.terrain, plan.kerb.height_m, rng)
    plants, fixtures = _Plants(builder, network), dict[tuple[str, int, float], tuple[Part, ...]]()
    for index, prop in enumerate(plan.props):
        pose = _pose(network, prop)
        if prop.kind in ("tree", "bush"):
            plants.add(prop, pose)
        elif prop.kind == "hedge":
            rng = np.random.default_rng([plan.style.texture_seed, 22, index])
            mesh = trees.hedge(rng, prop.length_m, float(rng.uniform(*HEDGE_HEIGHT_M)))
            chunks.at(pose[:2, 3], SurfaceClass.VEGETATION, "hedge").extend(mesh, pose)
        else:
            # Equal fixtures share one set of parts, merged into the chunk at each place.
            kind = prop.kind, prop.variant, prop.length_m
            if kind not in fixtures:
                fixtures[kind] = tuple(fixture_parts(prop))
            for mesh, surface, material in fixtures[kind]:
                chunks.at(pose[:2, 3], surface, material, crease_deg=30.0).extend(mesh, pose)
    ground.place(builder)
    chunks.place(builder)


def _pose(network: TownNetwork, prop: Prop) -> np.ndarray:
    """Upright on the ground."""
    xy = np.array([prop.x_m, prop.y_m])
    height = float(network.height_m(xy)) + (0.0 if prop.on_road else network.plan.kerb.height_m)
    return pose_from_xyyaw(prop.x_m, prop.y_m, prop.yaw_rad, height)


class _Plants:
    """Trees and bushes instanced from a few shapes per family and size."""

    def __init__(self, builder: SpecBuilder, network: TownNetwork):
        self.builder, self.style = builder, network.plan.style
        self._shapes: dict[tuple[str, int, int, int], str] = {}

    def add(self, prop: Prop, pose: np.ndarray) -> None:
        """One plant as its own geom with a shared mesh."""
        family = prop.variant % len(self.style.foliages)
        shape = (prop.variant // len(self.style.foliages)) % 2
        # A few sizes are enough variety and share meshes.
        size = int(np.abs(np.array(TREE_SIZES) - prop.scale).argmin())
        key = (prop.kind, family, shape, size)
        if key not in self._shapes:
            rng = np.random.default_rng([self.style.texture_seed, 23, *map(ord, prop.kind), family, shape, size])
            name = self.style.foliages[family]
            mesh = trees.tree(rng, name, TREE_SIZES[size]) if prop.kind == "tree" else trees.bush(rng, TREE_SIZES[size])
            self._shapes[key] = self.builder.mesh(mesh, 40.0)
        self.builder.place(self.builder.world, self._shapes[key], SurfaceClass.VEGETATION, f"plant{family}",
                           xyz=pose[:3, 3].tolist(), yaw=prop.yaw_rad)  # fmt: skip
