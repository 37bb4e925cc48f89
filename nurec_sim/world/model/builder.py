"""A thin layer over MjSpec: named materials, meshes and visual geoms with class, instance and reflectivity.

There are no colliders: collisions are measured between boxes by ``metrics``, and ``mj_multiRay`` silently loses visual
geoms of bodies that also carry a collider (MuJoCo 4.0).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from nurec_sim.world.assets.meshes import Corners, MeshBuilder
from nurec_sim.world.plan.surface import REFLECTIVITY, SurfaceClass

DECAL_GROUP = 3
"""Geoms visible in colour images only: no depth, label or laser return."""
DECAL_ALPHA = 0.99
"""The classic renderer blends only materials with alpha below 1."""
STATIC = 0
"""Instance id of static geoms; actor i of the plan is instance i + 1."""


class SpecBuilder:
    """Builds a world in ``spec``; keeps each material's mean colour for images without OpenGL."""

    def __init__(self) -> None:
        self.spec = mujoco.MjSpec()
        self.spec.nuser_geom = 6  # class, instance, reflectivity, mean colour [3]
        self._colour: dict[str, np.ndarray] = {}
        self._mean_colour: dict[str, np.ndarray] = {}
        self._meshes = 0

    @property
    def world(self) -> Any:
        """The static world body."""
        return self.spec.worldbody

    def material(
        self,
        name: str,
        image: np.ndarray | None = None,
        colour: Sequence[float] = (1, 1, 1),
        shine: float = 0.05,
        glow: float = 0.0,
    ) -> None:
        """Adds a material.

        Args:
            name: of the material; its texture is called ``<name>_texture``.
            image: texture, uint8 [h,w,3] or [h,w,4] with alpha, or None for a plain colour.
            colour: red, green and blue 0..1; tints the texture.
            shine: strength 0..1 of highlights.
            glow: emission 0..1, independent of light.
        """
        material = self.spec.add_material(name=name, rgba=[*colour, 1], specular=shine, shininess=0.1 + 0.7 * shine,
                                          reflectance=0.0, emission=glow)  # fmt: skip
        self._colour[name] = mean = np.asarray(colour, np.float64)
        if image is not None:
            self.texture(f"{name}_texture", image, mujoco.mjtTexture.mjTEXTURE_2D)
            material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = f"{name}_texture"
            mean = mean * image[..., :3].reshape(-1, 3).mean(axis=0) / 255
        self._mean_colour[name] = mean

    def texture(self, name: str, image: np.ndarray, kind: Any) -> None:
        """A texture; linear, because the classic renderer has no gamma and would darken sRGB."""
        height, width, channels = image.shape
        texture = self.spec.add_texture(name=name, type=kind, width=width, height=height, nchannel=channels)
        texture.data = np.ascontiguousarray(image).tobytes()
        texture.colorspace = mujoco.mjtColorSpace.mjCOLORSPACE_LINEAR

    def mesh(self, builder: MeshBuilder, crease_deg: float = 38.0) -> str:
        """Registers a mesh and returns its name."""
        return self.shared_mesh(builder.corners(crease_deg))

    def shared_mesh(self, corners: Corners, scale: Sequence[float] = (1.0, 1.0, 1.0)) -> str:
        """Registers the result of ``MeshBuilder.corners``, scaled along the axes, and returns its name."""
        points, normals, uv = corners
        if len(points) == 3:  # MuJoCo requires at least four vertices
            points, normals, uv = (np.concatenate([values, values]) for values in (points, normals, uv))
        self._meshes += 1
        mesh = self.spec.add_mesh(name=f"mesh{self._meshes}")
        mesh.uservert = (points * np.asarray(scale)).ravel().tolist()
        mesh.usernormal = normals.ravel().tolist()
        # Texture rows run downwards in MuJoCo, v runs upwards here.
        mesh.usertexcoord = np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1).ravel().tolist()
        mesh.userface = list(range(len(points)))
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # flat and open meshes have no volume
        return mesh.name

    def place(
        self,
        body: Any,
        mesh: str | MeshBuilder,
        surface: SurfaceClass,
        material: str,
        *,
        instance: int = STATIC,
        xyz: Sequence[float] = (0, 0, 0),
        yaw: float = 0.0,
        tint: Sequence[float] = (1, 1, 1),
        reflectivity: float | None = None,
        shadow: bool = True,
        crease_deg: float = 38.0,
        decal: bool = False,
    ) -> None:
        """Adds a mesh to a body.

        Args:
            body: of the spec, ``world`` for static geoms.
            mesh: name of a registered mesh, or a builder to register.
            surface: class in the ground truth.
            material: name of its material.
            instance: ``STATIC``, or i + 1 for actor i of the plan.
            xyz: position in the body's frame (m).
            yaw: rotation about z in the body's frame (rad).
            tint: factor 0..1 on the material's colour.
            reflectivity: for lasers, 0..1; by class if None.
            shadow: whether it casts a shadow.
            crease_deg: edges sharper than this stay sharp (only for a builder).
            decal: alpha-blended, in colour images only, without a shadow.
        """
        name = mesh if isinstance(mesh, str) else self.mesh(mesh, crease_deg)
        geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=xyz, quat=_yaw_quat(yaw))
        self._dress(geom, surface, material, instance, tint, reflectivity, shadow and not decal)
        if decal:
            geom.group, geom.rgba = DECAL_GROUP, [*geom.rgba[:3], DECAL_ALPHA]

    def _dress(self, geom: Any, surface: SurfaceClass, material: str, instance: int, tint: Sequence[float],
               reflectivity: float | None, shadow: bool) -> None:  # fmt: skip
        # A geom's colour replaces its material's, so the tint combines both.
        geom.material, geom.rgba, geom.castshadow = material, [*(self._colour[material] * np.asarray(tint)), 1], shadow
        # No contacts and no mass: geoms are only seen.
        geom.contype = geom.conaffinity = 0
        geom.group, geom.mass = 1, 0
        colour = self._mean_colour[material] * np.asarray(tint)
        laser = REFLECTIVITY[surface] if reflectivity is None else reflectivity
        geom.userdata = [int(surface), instance, laser, *colour]


def _yaw_quat(yaw: float) -> list[float]:
    return [float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))]
