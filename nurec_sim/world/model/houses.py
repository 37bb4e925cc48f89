"""Meshes of buildings: plinth, shop front, facade, cornice, balconies, and a gable or a flat roof.

A house's front faces +y of its own frame; x is along the street.
"""

from __future__ import annotations

import numpy as np

from nurec_sim.geometry import box_corners_xy, pose_from_xyyaw
from nurec_sim.world.assets.meshes import MeshBuilder
from nurec_sim.world.assets.textures_facades import BAYS, FLOORS
from nurec_sim.world.model.chunks import Chunks
from nurec_sim.world.plan.surface import SurfaceClass
from nurec_sim.world.plan.terrain import Terrain
from nurec_sim.world.plan.town import Building

BAY_M = 3.1
OVERHANG_M = 0.45


def add_house(chunks: Chunks, house: Building, terrain: Terrain, kerb_m: float, rng: np.random.Generator) -> None:
    """One building; materials ``facade_<family><variant>``, ``shop0..1``, ``roof0..1``, ``concrete``, ``metal``.

    Args:
        chunks: collects the meshes.
        house: position, size and style.
        terrain: the ground below it.
        kerb_m: height of the ground behind kerbs above the terrain.
        rng: random generator for details.
    """
    corners = box_corners_xy(pose_from_xyyaw(house.x_m, house.y_m, house.yaw_rad), house.width_m, house.depth_m)
    # The floor lies at the highest corner; the plinth reaches below the lowest.
    heights = terrain.height_m(corners)
    floor = float(heights.max()) + kerb_m
    low = float(heights.min()) - 0.6
    mesh = _House(house)
    tall = house.floors * house.floor_height_m
    mesh.plinth(low - floor)
    facade_low = 0.0
    if house.shop:
        facade_low = house.floor_height_m
        mesh.walls(mesh.shop, 0.0, facade_low, 1.0)
        if rng.random() < 0.6:
            mesh.awning(facade_low, rng)
    mesh.walls(mesh.facade, facade_low, tall, float(house.floors - house.shop) / FLOORS)
    if house.family in ("panel", "plaster", "glass") and house.floors >= 3 and rng.random() < 0.6:
        mesh.balconies(rng, int(house.shop) + 1)
    if not house.shop:
        mesh.door(rng)
    if house.gable:
        mesh.gable(tall)
        mesh.chimney(rng, tall)
    else:
        mesh.flat_roof(tall, rng)
    here, pose = (house.x_m, house.y_m), pose_from_xyyaw(house.x_m, house.y_m, house.yaw_rad, floor)
    tint = tuple(round(0.5 + 0.5 * float(c), 2) for c in house.tint)  # only for uniformly coloured walls
    plain, kind = (1.0, 1.0, 1.0), house.facade % 2
    parts = ((mesh.facade, f"facade_{house.family}{house.facade}", tint), (mesh.shop, f"shop{kind}", plain),
             (mesh.roof, f"roof{kind}", plain), (mesh.trim, "concrete", plain),
             (mesh.dark, "metal", plain))  # fmt: skip
    for part, name, colour in parts:
        if not part.empty:
            chunks.at(here, SurfaceClass.BUILDING, name, tint=colour, crease_deg=20.0).extend(part, pose)


class _House:
    """The parts of a house in its own frame, z = 0 at its floor."""

    def __init__(self, house: Building):
        self.house = house
        self.half = np.array([house.width_m, house.depth_m]) / 2
        self.facade, self.shop, self.roof, self.trim, self.dark = (MeshBuilder() for _ in range(5))
        x, y = self.half
        self.outline = np.array([[-x, -y], [x, -y], [x, y], [-x, y], [-x, -y]])

    def plinth(self, low: float) -> None:
        """A base extending below the slope, and a step around the walls."""
        out = self.outline * (1 + 0.03 / self.half)
        self.trim.wall(out, low, 0.35, 0.5, 0.0, 0.5)
        self.trim.quad(*([*corner, 0.35] for corner in out[:4]))

    def walls(self, mesh: MeshBuilder, low: float, high: float, v_span: float) -> None:
        """Walls on all four sides, with an integer number of bays and different texture offsets.

        Args:
            mesh: collects the walls.
            low: lower edge above the floor (m).
            high: upper edge (m).
            v_span: height of the walls in texture tiles.
        """
        for side in range(4):
            a, b = self.outline[side], self.outline[side + 1]
            bays = max(1, round(float(np.linalg.norm(b - a)) / BAY_M))
            u0 = (side * 3 + self.house.facade) % BAYS / BAYS
            u1 = u0 + bays / BAYS
            mesh.quad([*a, low], [*b, low], [*b, high], [*a, high], [[u0, 0], [u1, 0], [u1, v_span], [u0, v_span]])

    def awning(self, high: float, rng: np.random.Generator) -> None:
        """A canopy over the shop windows."""
        x, y = self.half * [0.94, 1.0]
        z, out = high - 0.25, float(rng.uniform(0.8, 1.3))
        a, b, c, d = [x, y, z], [-x, y, z], [-x, y + out, z - 0.45], [x, y + out, z - 0.45]
        self.dark.quad(a, b, c, d)
        # Both sides, since quads have one visible side.
        self.dark.quad(d, c, b, a)

    def balconies(self, rng: np.random.Generator, first: int) -> None:
        """Slabs with parapets in front of some bays."""
        x, y = self.half
        bays = max(1, round(2 * x / BAY_M))
        width = 2 * x / bays
        columns = [bay for bay in range(bays) if rng.random() < 0.45]
        parapet = self.trim if rng.random() < 0.5 else self.dark
        for floor in range(first, self.house.floors):
            z = floor * self.house.floor_height_m
            for bay in columns:
                middle = -x + (bay + 0.5) * width
                self.trim.box([middle, y + 0.6, z], [width * 0.44, 0.6, 0.08])
                parapet.box([middle, y + 1.17, z + 0.55], [width * 0.44, 0.03, 0.46])
                for end in (-1, 1):
                    parapet.box([middle + end * width * 0.43, y + 0.6, z + 0.55], [0.03, 0.58, 0.46])

    def door(self, rng: np.random.Generator) -> None:
        """A front door with a step and a small roof."""
        y, x = self.half[1], float(rng.uniform(-0.6, 0.6)) * self.half[0]
        self.dark.box([x, y + 0.03, 1.15], [0.55, 0.05, 1.1])
        self.trim.box([x, y + 0.45, -0.1], [0.9, 0.5, 0.22])
        self.trim.box([x, y + 0.4, 2.5], [0.9, 0.45, 0.06])

    def gable(self, eaves: float) -> None:
        """Two slopes with overhang, and the triangles below them."""
        x, y = self.half
        rise = 0.36 * 2 * y * 0.8
        over_x, over_y = x + OVERHANG_M, y + OVERHANG_M
        # The slope continues over the overhang, below the eaves.
        drop = rise * OVERHANG_M / y
        ridge, low = eaves + rise, eaves - drop
        uv = np.array([[0, 0], [2 * over_x, 0], [2 * over_x, 1.2 * over_y], [0, 1.2 * over_y]]) / 3.0
        for sign in (-1, 1):
            a, b = [-sign * -over_x, sign * -over_y, low], [-sign * over_x, sign * -over_y, low]
            c, d = [-sign * over_x, 0, ridge], [sign * over_x, 0, ridge]
            self.roof.quad(b, a, d, c, uv)
            thick = [0, 0, -0.12]
            b2, a2, c2, d2 = (np.add(p, thick) for p in (b, a, c, d))
            self.trim.quad(a2, b2, c2, d2)
            self.trim.quad(b2, a2, a, b)
            self.trim.quad(a2, d2, d, a)
            self.trim.quad(c2, b2, b, c)
        for sign in (-1, 1):
            points = [[sign * x, -sign * y, eaves - 0.02], [sign * x, sign * y, eaves - 0.02],
                      [sign * x, 0, eaves + rise - 0.1]]  # fmt: skip
            v = self.house.floors / FLOORS
            # A tiny part of the texture between two floors, so that gables are plain wall.
            self.facade.add(points, [[0, 1, 2]], [[0.02, v - 0.015], [0.02, v - 0.01], [0.025, v - 0.005]])

    def chimney(self, rng: np.random.Generator, eaves: float) -> None:
        """One or two brick stacks through the roof."""
        x, y = self.half
        for _ in range(int(rng.integers(1, 3))):
            at = [float(rng.uniform(-0.7, 0.7)) * x, float(rng.uniform(-0.3, 0.3)) * y]
            self.roof.box([*at, eaves + 0.29 * 2 * y + 0.25], [0.32, 0.32, 0.95], 0.4)

    def flat_roof(self, eaves: float, rng: np.random.Generator) -> None:
        """A parapet with a cornice, machinery and a stair house."""
        x, y = self.half
        edge = self.outline * (1 + 0.16 / self.half)
        self.trim.wall(edge, eaves - 0.12, eaves + 0.34, 0.5, 0.0, 0.3)
        inner = self.outline * (1 - 0.22 / self.half)
        self.trim.wall(inner[::-1], eaves, eaves + 0.34, 0.5, 0.0, 0.3)
        for i in range(4):
            a, b, c, d = edge[i], edge[i + 1], inner[i + 1], inner[i]
            self.trim.quad([*a, eaves + 0.34], [*b, eaves + 0.34], [*c, eaves + 0.34], [*d, eaves + 0.34])
            a, b, c, d = edge[i + 1], edge[i], self.outline[i], self.outline[i + 1]
            self.trim.quad([*a, eaves - 0.12], [*b, eaves - 0.12], [*c, eaves - 0.12], [*d, eaves - 0.12])
        self.trim.quad([-x, -y, eaves], [x, -y, eaves], [x, y, eaves], [-x, y, eaves],
                       np.array([[0, 0], [x, 0], [x, y], [0, y]]) / 2)  # fmt: skip
        for _ in range(int(rng.integers(1, 4))):
            size = rng.uniform([0.6, 0.6, 0.4], [1.8, 1.6, 1.3])
            at = rng.uniform(-0.55, 0.55, 2) * self.half
            part = self.dark if rng.random() < 0.5 else self.trim
            part.box([*at, eaves + size[2]], size)
