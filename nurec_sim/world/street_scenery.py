"""Everything of a street that stands still: ground, markings, houses, trees, lamps and signs."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely

from nurec_sim.geometry import box_corners_xy, pose_from_xyyaw
from nurec_sim.world import textures
from nurec_sim.world.builder import SpecBuilder
from nurec_sim.world.layout import FACADES, TREES
from nurec_sim.world.meshes import MeshBuilder
from nurec_sim.world.plan import Building, StreetPlan
from nurec_sim.world.road import RoadLine
from nurec_sim.world.surface import SurfaceClass

MARKING_HEIGHT_M = 0.008
GROUND_REACH_M = 900.0
"""The grass ends this far out: less than a tenth of a degree below the horizon."""


def add_materials(builder: SpecBuilder, rng: np.random.Generator) -> None:
    """Every material of ``add_scenery`` and of the actors."""
    builder.material("asphalt", textures.asphalt(rng))
    builder.material("paving", textures.paving(rng))
    builder.material("kerb", textures.paving(rng, 256, 2), colour=(1.0, 1.0, 1.02))
    builder.material("grass", textures.grass(rng))
    builder.material("white", colour=(0.86, 0.86, 0.84))
    for i in range(FACADES):
        builder.material(f"facade{i}", textures.facade(rng))
    for i in range(2):
        builder.material(f"shop{i}", textures.shopfront(rng))
        builder.material(f"roof{i}", textures.roof(rng))
    for i in range(TREES):
        builder.material(f"leaves{i}", textures.foliage(rng))
    builder.material("bark", textures.bark(rng))
    builder.material("sign", textures.speed_sign(rng), glow=0.1)
    builder.material("metal", colour=(0.42, 0.43, 0.44), shine=0.4)
    builder.material("paint", shine=0.7)
    builder.material("glass", colour=(0.10, 0.12, 0.14), shine=0.9)
    builder.material("dark", colour=(0.06, 0.06, 0.065))
    builder.material("rim", colour=(0.62, 0.63, 0.65), shine=0.6)
    builder.material("headlight", colour=(0.95, 0.95, 0.9), shine=0.7, glow=0.35)
    builder.material("taillight", colour=(0.70, 0.04, 0.04), shine=0.5, glow=0.25)
    builder.material("skin", colour=(0.80, 0.60, 0.47))
    builder.material("cloth")


def add_scenery(builder: SpecBuilder, plan: StreetPlan, rng: np.random.Generator) -> None:
    """Ground, houses and street furniture of a plan."""
    line = RoadLine(plan.road)
    _ground(builder, line)
    for building in plan.buildings:
        _house(builder, building, plan.road.kerb_height_m)
    _props(builder, plan, rng)


def _ribbon(line: RoadLine, right_m: float, left_m: float, z_m: float, metres_per_tile: float, start_m: float = 0.0,
            end_m: float | None = None) -> MeshBuilder:  # fmt: skip
    """A flat strip between two offsets; its texture follows the road."""
    mesh = MeshBuilder()
    stations, across = line.stations(start_m, end_m), np.array([right_m, left_m])
    s, offset = np.meshgrid(stations, across, indexing="ij")
    xy, _ = line.at(s, offset)
    lattice = np.concatenate([xy, np.full((*s.shape, 1), z_m)], axis=2)
    mesh.grid(lattice, np.stack([s, offset], axis=2) / metres_per_tile)
    return mesh


def _ground(builder: SpecBuilder, line: RoadLine) -> None:
    road, world = line.road, builder.world
    half, high = road.half_width_m, road.kerb_height_m
    kerb = half + road.kerb_width_m
    walk = kerb + road.sidewalk_width_m
    builder.place(world, _ribbon(line, -half, half, 0.0, 9.0), SurfaceClass.ROAD, "asphalt", shadow=False)
    for mesh in _markings(line):
        builder.place(world, mesh, SurfaceClass.MARKING, "white", shadow=False)
    for right, left, side in ((-kerb, -half, -1), (half, kerb, 1)):
        mesh = _ribbon(line, right, left, high, 2.0)
        foot = line.line(side * half)
        mesh.wall(foot if side > 0 else foot[::-1], 0.0, high, 0.5, 0.0, 0.07)
        builder.place(world, mesh, SurfaceClass.KERB, "kerb", shadow=False)
    for right, left in ((-walk, -kerb), (kerb, walk)):
        builder.place(world, _ribbon(line, right, left, high, 2.6), SurfaceClass.SIDEWALK, "paving", shadow=False)
    centre, reach = line.xy_m.mean(axis=0), GROUND_REACH_M
    everywhere = shapely.box(*(centre - reach), *(centre + reach))
    near = shapely.box(*(line.xy_m.min(axis=0) - 80), *(line.xy_m.max(axis=0) + 80))
    street = shapely.Polygon(line.ring(-walk, walk))
    for area in (near.difference(street), everywhere.difference(near)):  # long thin triangles blur textures
        mesh = MeshBuilder()
        mesh.flat(area, high, 1 / 7.0)
        builder.place(world, mesh, SurfaceClass.GRASS, "grass", shadow=False)
    for station in (0.0, line.length_m):  # the asphalt ends at a kerb
        (right, left), _ = line.at(np.full(2, station), np.array([-half, half]))
        mesh = MeshBuilder()
        mesh.wall([right, left] if station == 0.0 else [left, right], 0.0, high, 0.5, 0.0, 0.07)
        mesh.wall([left, right] if station == 0.0 else [right, left], 0.0, high, 0.5, 0.0, 0.07)
        builder.place(world, mesh, SurfaceClass.KERB, "kerb", shadow=False)


def _markings(line: RoadLine) -> list[MeshBuilder]:
    """Dashed centre line, solid lane edges, parking bays and one zebra crossing, in pieces that can be culled."""
    road, z = line.road, MARKING_HEIGHT_M
    zebra = road.zebra_station_m
    clear = (np.inf, np.inf) if zebra is None else (zebra - 2.2, zebra + 2.2)
    pieces = []
    for start in np.arange(1.0, line.length_m - 4, 7.5):
        if start + 3 < clear[0] or start > clear[1]:
            pieces.append(_ribbon(line, -0.08, 0.08, z, 1.0, start, start + 3.0))
    for side in (-1, 1):
        edge, outer = side * road.lane_width_m, side * (road.lane_width_m + road.strip_width_m - 0.1)
        for start in np.arange(0.0, line.length_m - 20, 20.0):
            pieces.append(_ribbon(line, edge - 0.06, edge + 0.06, z, 1.0, start, start + 20.0))
        for station in np.arange(10.5, line.length_m - 4, 7.0):
            if station < clear[0] - 3 or station > clear[1] + 3:
                low, high = sorted((edge, outer))
                pieces.append(_ribbon(line, low, high, z, 1.0, station - 0.06, station + 0.06))
    if zebra is not None:
        for offset in np.arange(-road.lane_width_m + 0.55, road.lane_width_m - 0.3, 1.0):
            pieces.append(_ribbon(line, offset - 0.25, offset + 0.25, z + 0.002, 1.0, zebra - 1.5, zebra + 1.5))
    return pieces


def _house(builder: SpecBuilder, house: Building, ground_m: float) -> None:
    low = ground_m - 0.05
    eaves = low + house.floors * house.floor_height_m
    pose = pose_from_xyyaw(house.x_m, house.y_m, house.yaw_rad)
    outline = box_corners_xy(pose, house.width_m, house.depth_m)
    outline = np.concatenate([outline, outline[:1]])
    facade_low, bay_m = low, 3.2
    if house.shop:
        facade_low = low + house.floor_height_m
        mesh = MeshBuilder()
        mesh.wall(outline, low, facade_low, 1 / 14.0, 0.0, 1.0)
        builder.place(builder.world, mesh, SurfaceClass.BUILDING, f"shop{house.facade % 2}")
    mesh = MeshBuilder()
    floors = house.floors - house.shop
    mesh.wall(outline, facade_low, eaves, 1 / (4 * bay_m), 0.0, floors / 4)
    builder.place(builder.world, mesh, SurfaceClass.BUILDING, f"facade{house.facade}", tint=house.tint)
    roof = _gable(house, pose, eaves) if house.gable else _flat_roof(outline, eaves)
    builder.place(builder.world, roof, SurfaceClass.BUILDING, f"roof{house.facade % 2}")


def _flat_roof(outline: np.ndarray, eaves_m: float) -> MeshBuilder:
    mesh = MeshBuilder()
    mesh.flat(shapely.Polygon(outline), eaves_m, 0.25)
    mesh.wall(outline, eaves_m, eaves_m + 0.5, 0.25, 0.0, 0.15)
    mesh.wall(outline[::-1], eaves_m, eaves_m + 0.5, 0.25, 0.0, 0.15)
    return mesh


def _gable(house: Building, pose: np.ndarray, eaves_m: float) -> MeshBuilder:
    mesh, over = MeshBuilder(), 0.45
    corners = box_corners_xy(pose, house.width_m + 2 * over, house.depth_m + 2 * over)
    front_left, rear_left, rear_right, front_right = ([*xy, eaves_m] for xy in corners)
    ridge = 0.28 * house.depth_m + eaves_m
    half = pose[:2, 0] * (house.width_m / 2 + over)
    front, rear = ([*(pose[:2, 3] + sign * half), ridge] for sign in (1, -1))
    uv = np.array([[0, 0], [house.width_m, 0], [house.width_m, house.depth_m], [0, house.depth_m]]) / 4
    mesh.quad(rear_right, front_right, front, rear, uv)
    mesh.quad(front_left, rear_left, rear, front, uv)
    mesh.quad(rear_left, front_left, front_right, rear_right, uv)  # soffit, seen from below
    mesh.add([front_right, front_left, front], [[0, 1, 2]], [[0, 0], [2, 0], [1, 1]])
    mesh.add([rear_left, rear_right, rear], [[0, 1, 2]], [[0, 0], [2, 0], [1, 1]])
    return mesh


def _props(builder: SpecBuilder, plan: StreetPlan, rng: np.random.Generator) -> None:
    trees = [[_tree(rng, variant, size) for size in (0.8, 1.0, 1.3)] for variant in range(TREES)]
    tree_meshes = [[(builder.mesh(trunk), builder.mesh(crown, 180.0)) for trunk, crown in row] for row in trees]
    bush = MeshBuilder()
    for x in (-0.5, 0.1, 0.6):
        bush.blob(rng, [x, rng.normal(0, 0.1), 0.42], 0.55)
    meshes = {"bush": builder.mesh(bush, 180.0), "lamp": builder.mesh(_lamp()), "pole": builder.mesh(_sign_pole())}
    meshes["board"] = builder.mesh(_sign_board())
    for prop in plan.props:
        where: dict[str, Any] = {"xyz": (prop.x_m, prop.y_m, plan.road.kerb_height_m), "yaw": prop.yaw_rad}
        leaves, world = f"leaves{prop.variant % TREES}", builder.world
        if prop.kind == "tree":
            size = int(np.searchsorted((0.9, 1.15), prop.scale))
            trunk, crown = tree_meshes[prop.variant % TREES][size]
            builder.place(world, trunk, SurfaceClass.VEGETATION, "bark", **where)
            builder.place(world, crown, SurfaceClass.VEGETATION, leaves, **where)
        elif prop.kind == "bush":
            builder.place(world, meshes["bush"], SurfaceClass.VEGETATION, leaves, **where)
        elif prop.kind == "lamp":
            builder.place(world, meshes["lamp"], SurfaceClass.POLE, "metal", **where)
        elif prop.kind == "sign":
            builder.place(world, meshes["pole"], SurfaceClass.POLE, "metal", **where)
            builder.place(world, meshes["board"], SurfaceClass.POLE, "sign", reflectivity=0.95, **where)
        else:
            raise ValueError(f"no prop of kind {prop.kind!r}; have bush, lamp, sign, tree")


def _tree(rng: np.random.Generator, variant: int, scale: float) -> tuple[MeshBuilder, MeshBuilder]:
    """Trunk and crown; the lowest branches leave 2.3 m free."""
    trunk, crown = MeshBuilder(), MeshBuilder()
    radius = (1.35, 1.6, 1.2, 1.5)[variant] * scale
    bottom = 2.3 + 0.5 * (variant % 2)
    trunk.cylinder([0, 0, -0.1], [0, 0, bottom + radius], 0.15 * scale, 0.09 * scale, sides=8, capped=False)
    for ring, count in ((0.55, 3), (0.25, 2)):
        for i in range(count):
            angle = 2 * np.pi * (i + rng.random() * 0.6) / count
            high = bottom + radius * (0.9 if ring > 0.5 else 1.6) + rng.normal(0, 0.1)
            crown.blob(rng, [ring * radius * np.cos(angle), ring * radius * np.sin(angle), high], radius * 0.72, 0.17)
    return trunk, crown


def _lamp() -> MeshBuilder:
    """A street lamp whose arm reaches over the road (its right side, -y, once ``yaw`` follows the traffic)."""
    mesh = MeshBuilder()
    mesh.cylinder([0, 0, -0.1], [0, 0, 7.0], 0.09, 0.06, sides=8)
    mesh.cylinder([0, 0, 6.9], [0, 1.6, 7.3], 0.045, 0.04, sides=6)
    mesh.box([0, 1.85, 7.3], [0.12, 0.35, 0.06])
    return mesh


def _sign_pole() -> MeshBuilder:
    mesh = MeshBuilder()
    mesh.cylinder([0, 0, -0.1], [0, 0, 2.6], 0.035, sides=8)
    return mesh


def _sign_board() -> MeshBuilder:
    """Faces against the traffic of its side of the road (-x)."""
    mesh, half, z = MeshBuilder(), 0.32, 2.3
    mesh.quad([-0.05, half, z - half], [-0.05, -half, z - half], [-0.05, -half, z + half], [-0.05, half, z + half])
    plain = ((0.0, 0.0), (0.02, 0.0), (0.02, 0.02), (0.0, 0.02))
    mesh.quad(
        [-0.04, -half, z - half], [-0.04, half, z - half], [-0.04, half, z + half], [-0.04, -half, z + half], plain
    )
    return mesh
