"""Static meshes merged by location and material: few geoms, and those out of view can be culled."""

from __future__ import annotations

import numpy as np

from nurec_sim.world.assets.meshes import MeshBuilder
from nurec_sim.world.model.builder import SpecBuilder
from nurec_sim.world.plan.surface import SurfaceClass

CHUNK_M = 40.0

Key = tuple[int, int, SurfaceClass, str, tuple[float, ...], bool, bool, float]


class Chunks:
    """Meshes in world coordinates, merged per square of ``size_m``, class and material; ``place`` creates the geoms."""

    def __init__(self, size_m: float = CHUNK_M):
        self.size_m = size_m
        self._meshes: dict[Key, MeshBuilder] = {}

    def at(
        self,
        xy: np.ndarray | tuple[float, float],
        surface: SurfaceClass,
        material: str,
        *,
        tint: tuple[float, ...] = (1.0, 1.0, 1.0),
        shadow: bool = True,
        decal: bool = False,
        crease_deg: float = 38.0,
    ) -> MeshBuilder:
        """The mesh that collects this kind of surface at a location.

        Args:
            xy: location in the world (m).
            surface: class in the ground truth.
            material: name of the material.
            tint: factor 0..1 on the material's colour.
            shadow: whether it casts a shadow.
            decal: whether it is a decal (``SpecBuilder.place``).
            crease_deg: edges sharper than this stay sharp.
        """
        column, row = (int(np.floor(v / self.size_m)) for v in xy[:2])
        key = (column, row, surface, material, tint, shadow, decal, crease_deg)
        return self._meshes.setdefault(key, MeshBuilder())

    def triangles(
        self,
        corners: np.ndarray,
        normals: np.ndarray,
        uv: np.ndarray,
        surface: SurfaceClass,
        material: str,
        *,
        decal: bool = False,
    ) -> None:
        """Adds triangles without shadows, each to the square of its first corner.

        Args:
            corners: [n,3,3] positions in the world (m).
            normals: [n,3,3] unit normals of the corners.
            uv: [n,3,2] texture coordinates.
            surface: class in the ground truth.
            material: name of the material.
            decal: whether they are a decal.
        """
        squares = np.floor(corners[:, 0, :2] / self.size_m).astype(np.int64)
        unique, index = np.unique(squares, axis=0, return_inverse=True)
        for number, square in enumerate(unique):
            chosen = np.flatnonzero(index.ravel() == number)
            mesh = self.at((square + 0.5) * self.size_m, surface, material, shadow=False, decal=decal, crease_deg=0.0)
            count = 3 * len(chosen)
            mesh.add(corners[chosen].reshape(-1, 3), np.arange(count).reshape(-1, 3), uv[chosen].reshape(-1, 2),
                     normals[chosen].reshape(-1, 3))  # fmt: skip

    def join(self, other: Chunks) -> None:
        """Adds the meshes of another collection, keeping its squares."""
        for key, mesh in other._meshes.items():
            # A column far outside of any town, unique per mesh: squares of another size must not be merged with ours.
            self._meshes[(-(10**6) - len(self._meshes), *key[1:])] = mesh

    def place(self, builder: SpecBuilder) -> None:
        """Creates one geom per square, class and material."""
        for (_, _, surface, material, tint, shadow, decal, crease_deg), mesh in self._meshes.items():
            if not mesh.empty:
                builder.place(builder.world, mesh, surface, material, tint=tint, shadow=shadow, decal=decal,
                              crease_deg=crease_deg)  # fmt: skip
