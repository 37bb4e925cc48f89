"""Ground meshes: roads, kerbs, sidewalks, paint, grass, wear, and hills at the horizon."""

from __future__ import annotations

import numpy as np
import shapely
from jaxtyping import Float64

from nurec_sim.world.assets.meshes import MeshBuilder
from nurec_sim.world.assets.textures import noise
from nurec_sim.world.assets.textures_ground import ASPHALT_TILE_M, GRASS_TILE_M, PAVING_TILE_M
from nurec_sim.world.model.chunks import Chunks
from nurec_sim.world.model.triangles import STEP_M, ground_triangles, on_ground
from nurec_sim.world.plan.network import TownNetwork
from nurec_sim.world.plan.surface import SurfaceClass

MARKING_LIFT_M = 0.006
DECAL_LIFT_M = 0.004
GRASS_STEP_M, FAR_STEP_M = 5.0, 40.0
GRASS_BELOW_M, FAR_BELOW_M = 0.04, 1.4
"""Coarser ground is lowered by this, so that it never penetrates overlapping finer ground."""
EDGE_M = 0.3
NEAR_MARGIN_M = 60.0
FAR_REACH_M, HILLS_M, HILLS_END_M = 640.0, 540.0, 900.0


def add_ground(chunks: Chunks, network: TownNetwork, rng: np.random.Generator, wetness: float) -> None:
    """All ground of a town; materials are ``asphalt``, ``kerb``, ``paving``, ``grass``, ``white``, ``yellow``.

    Args:
        chunks: collects the meshes.
        network: areas, lanes and terrain of the town.
        rng: random generator for wear.
        wetness: 0..1; puddles above 0.
    """
    high = network.plan.kerb.height_m
    _lay(chunks, network, network.surface, 0.0, SurfaceClass.ROAD, "asphalt", ASPHALT_TILE_M)
    _lay(chunks, network, network.kerb, high, SurfaceClass.KERB, "kerb", 2.0)
    _walls(chunks, network, network.surface, 0.0, high, SurfaceClass.KERB, "kerb", inwards=True)
    # Grass is slightly lower than paving, so paving needs a side face towards it.
    _walls(chunks, network, network.paved, high - EDGE_M, high, SurfaceClass.SIDEWALK, "paving", inwards=False)
    # Sidewalk within the outer outline of a surface lies on a traffic island.
    outside = shapely.union_all([shapely.Polygon(part.exterior) for part in network.surface.geoms])
    for area, surface in ((network.sidewalk.difference(outside), SurfaceClass.SIDEWALK),
                          (network.sidewalk.intersection(outside), SurfaceClass.ISLAND)):  # fmt: skip
        _lay(chunks, network, area, high, surface, "paving", PAVING_TILE_M)
    for colour in ("white", "yellow"):
        painted = [marking.area for marking in network.markings if marking.colour == colour]
        if painted:
            _lay(chunks, network, shapely.union_all(painted), MARKING_LIFT_M, SurfaceClass.MARKING, colour, 1.6)
    _green(chunks, network)
    _wear(chunks, network, rng, wetness)


def _lay(chunks: Chunks, network: TownNetwork, area: shapely.Geometry, lift_m: float, surface: SurfaceClass,
         material: str, tile_m: float, step_m: float = STEP_M) -> None:  # fmt: skip
    """An area as triangles on the terrain, textured in world axes."""
    if area.is_empty:
        return
    flat = ground_triangles(area, step_m)
    chunks.triangles(on_ground(flat, network.plan.terrain, lift_m), _normals(network, flat), flat / tile_m, surface,
                     material)  # fmt: skip


def _normals(network: TownNetwork, xy: Float64[np.ndarray, "*n 2"]) -> Float64[np.ndarray, "*n 3"]:
    slope = network.plan.terrain.gradient(xy)
    normal = np.concatenate([-slope, np.ones((*slope.shape[:-1], 1))], axis=-1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _walls(chunks: Chunks, network: TownNetwork, area: shapely.Geometry, low_m: float, high_m: float,
           surface: SurfaceClass, material: str, inwards: bool) -> None:  # fmt: skip
    """Vertical faces along the edge of an area, between two heights over the terrain."""
    for polygon in shapely.get_parts(area):
        oriented = shapely.orient_polygons(polygon)
        for ring in (oriented.exterior, *oriented.interiors):
            # The area is to the left of its rings; walls face to the right of their line.
            points = _split_at_lattice(np.asarray(ring.coords)[:: -1 if inwards else 1, :2])
            # Texture coordinates along the wall: one tile per 2 m.
            along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]) * 0.5
            ground = network.height_m(points)
            a, b = slice(None, -1), slice(1, None)
            low, top = np.column_stack([points, ground + low_m]), np.column_stack([points, ground + high_m])
            corners = np.stack([np.stack([low[a], low[b], top[b]], axis=1), np.stack([low[a], top[b], top[a]], axis=1)])
            v = np.array([[0.02, 0.02, 0.09], [0.02, 0.09, 0.09]])
            left, right = along[a], along[b]
            u = np.stack([np.stack([left, right, right], axis=1), np.stack([left, right, left], axis=1)])
            uv = np.stack([u, np.broadcast_to(v[:, None], u.shape)], axis=-1)
            side = points[b] - points[a]
            normal = np.stack([side[:, 1], -side[:, 0], np.zeros(len(side))], axis=1)
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
            normals = np.broadcast_to(normal[None, :, None], corners.shape)
            chunks.triangles(corners.reshape(-1, 3, 3), normals.reshape(-1, 3, 3), uv.reshape(-1, 3, 2), surface,
                             material)  # fmt: skip


def _split_at_lattice(points: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "m 2"]:
    """A line with additional points where it crosses the lattice of ``ground_triangles``."""
    out = [points[:1]]
    for a, b in zip(points[:-1], points[1:], strict=True):
        cuts = []
        # Crossings with the lattice lines x = k, y = k and the diagonals x - y = k of the cells.
        for start, end in ((a[0], b[0]), (a[1], b[1]), (a[0] - a[1], b[0] - b[1])):
            low, high = sorted((start, end))
            lines = np.arange(np.ceil(low / STEP_M), np.floor(high / STEP_M) + 1) * STEP_M
            if len(lines) and abs(end - start) > 1e-9:
                cuts.append((lines - start) / (end - start))
        share = np.sort(np.concatenate(cuts)) if cuts else np.zeros(0)
        share = share[(share > 1e-6) & (share < 1 - 1e-6)]
        out += [a + share[:, None] * (b - a), b[None]]
    return np.concatenate(out)


def _green(chunks: Chunks, network: TownNetwork) -> None:
    """Grass around the town, coarser far away, and wooded hills at the horizon."""
    high, bounds = network.plan.kerb.height_m, np.array(network.surface.bounds)
    low, top = bounds[:2] - NEAR_MARGIN_M, bounds[2:] + NEAR_MARGIN_M
    # Larger squares for coarser triangles keep the number of geoms low.
    near, lawns = shapely.box(*low, *top), Chunks(2 * chunks.size_m)
    _lay(lawns, network, near.difference(shapely.buffer(network.paved, -0.2)), high - GRASS_BELOW_M,
         SurfaceClass.GRASS, "grass", GRASS_TILE_M, GRASS_STEP_M)  # fmt: skip
    chunks.join(lawns)
    middle = (low + top) / 2
    far = shapely.Point(middle).buffer(FAR_REACH_M, quad_segs=8).difference(near.buffer(-25.0))
    wide = Chunks(400.0)
    _lay(wide, network, far, high - FAR_BELOW_M, SurfaceClass.GRASS, "grass", GRASS_TILE_M, FAR_STEP_M)
    chunks.join(wide)
    _hills(chunks, middle, np.random.default_rng([network.plan.seed, 0x417]))


def _hills(chunks: Chunks, middle: np.ndarray, rng: np.random.Generator) -> None:
    angle = np.linspace(0, 2 * np.pi, 97)
    profile = noise(rng, 96, 4, 6)[0]
    # Closed rings: the last column repeats the first.
    profile = np.concatenate([profile, profile[:1]])
    tops = np.concatenate([rng.normal(0, 1.2, 96), [0.0]])
    tops[-1] = tops[0]
    height = 10 + 26 * profile + tops
    rings = []
    for radius, z in ((HILLS_M, np.full(97, -12.0)), (HILLS_M + 30, 0.55 * height), (HILLS_M + 80, height),
                      (HILLS_END_M, height * 0.9)):  # fmt: skip
        rings.append(np.stack([middle[0] + radius * np.cos(angle), middle[1] + radius * np.sin(angle), z], axis=1))
    lattice = np.stack(rings, axis=1)
    u, v = np.meshgrid(angle * HILLS_M / 18, np.array([0.0, 1.0, 2.5, 9.0]), indexing="ij")
    for start in range(0, 96, 12):
        part = slice(start, start + 13)
        mesh = MeshBuilder()
        mesh.grid(lattice[part][::-1], np.stack([u, v], axis=-1)[part][::-1])
        chunks.at(lattice[start, 0], SurfaceClass.VEGETATION, "forest", shadow=False).extend(mesh)


def _wear(chunks: Chunks, network: TownNetwork, rng: np.random.Generator, wetness: float) -> None:
    """Wheel tracks along lanes, and random stains, sealed cracks, manhole covers and puddles."""
    for lane in network.lanes:
        if lane.in_junction:
            continue
        line = lane.polyline[:, :2]
        side = np.gradient(line, axis=0)
        side = np.stack([-side[:, 1], side[:, 0]], axis=1) / np.linalg.norm(side, axis=1, keepdims=True)
        station = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        # Five points across a lane let the decal follow the terrain.
        across = np.array([-0.5, -0.25, 0.0, 0.25, 0.5]) * min(lane.width_m, 3.4)
        xy = line[:, None] + across[:, None] * side[:, None]
        uv = np.stack(np.broadcast_arrays(np.linspace(0, 1, 5)[None], station[:, None] / 12.0), axis=-1)
        _decal_grid(chunks, network, xy, uv, "tracks")
    kinds = [("stains", 3.2, 90.0), ("seams", 4.5, 160.0), ("manhole", 0.68, 420.0)]
    if wetness > 0:
        kinds.append(("puddles", 5.5, 70.0 / wetness))
    for material, size, area_each in kinds:
        for polygon in network.surface.geoms:
            # Rotated squares of this size stay on the road: their half diagonal is 0.71 of the side.
            inside = shapely.buffer(polygon, -0.75 * size)
            count = int(polygon.area / area_each)
            low, high = np.array(polygon.bounds).reshape(2, 2)
            places = rng.uniform(low, high, (count * 4, 2))
            places = places[shapely.contains_xy(inside, *places.T)][:count] if not inside.is_empty else places[:0]
            for place in places:
                turn = rng.uniform(0, 2 * np.pi)
                x, y = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
                t = np.linspace(-0.5, 0.5, 2 if size < 1 else 4) * size
                lattice = place + t[:, None, None] * x + t[None, :, None] * y
                uv = np.stack(np.meshgrid(t / size + 0.5, t / size + 0.5, indexing="ij"), axis=-1)
                _decal_grid(chunks, network, lattice, uv, material)


def add_light_pools(chunks: Chunks, network: TownNetwork) -> None:
    """Light pools of street lamps on road and sidewalk."""
    for prop in network.plan.props:
        if prop.kind != "lamp":
            continue
        # A lamp's arm reaches along +y of its prop, over the road.
        towards = np.array([-np.sin(prop.yaw_rad), np.cos(prop.yaw_rad)])
        t = np.linspace(-6.5, 6.5, 8)
        lattice = np.array([prop.x_m, prop.y_m]) + 1.8 * towards + np.stack(np.meshgrid(t, t, indexing="ij"), axis=-1)
        uv = np.stack(np.meshgrid(t, t, indexing="ij"), axis=-1) / 13.0 + 0.5
        _decal_grid(chunks, network, lattice, uv, "light_pool")


def _decal_grid(chunks: Chunks, network: TownNetwork, xy: Float64[np.ndarray, "n m 2"], uv: np.ndarray,
                material: str) -> None:  # fmt: skip
    """A lattice on the road, textured with a decal."""
    high = network.plan.terrain.height_m(xy)[..., None] + DECAL_LIFT_M
    points, normals = np.concatenate([xy, high], axis=-1), _normals(network, xy)
    cut = [(slice(None, -1), slice(None, -1)), (slice(1, None), slice(None, -1)), (slice(1, None), slice(1, None)),
           (slice(None, -1), slice(1, None))]  # fmt: skip

    def triangles(values: np.ndarray) -> np.ndarray:
        a, b, c, d = (values[part].reshape(-1, values.shape[-1]) for part in cut)
        return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])

    chunks.triangles(triangles(points), triangles(normals), triangles(uv), SurfaceClass.ROAD, material, decal=True)
