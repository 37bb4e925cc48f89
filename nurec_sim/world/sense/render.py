"""OpenGL rendering: colours with shadows in one pass, geom ids and depth in a second one.

All calls must come from the thread that created the painter, since a GL context belongs to its thread.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float64, Int32, UInt8

from nurec_sim.types import Matrix4, Pinhole
from nurec_sim.world.model.assemble import Town
from nurec_sim.world.model.builder import DECAL_GROUP
from nurec_sim.world.sense.backend import gl_context
from nurec_sim.world.sense.faces import Face, FaceImage

SHADOW_RADIUS_M = 28.0
SHADOW_AHEAD_M = 22.0
HIDDEN_GROUP = 5
TEXTURE_LOD_BIAS = -0.7
HORIZON = -0.03
FAINT_SUN = 0.3
"""A weaker sun casts no visible shadows; skipping them saves a third of the time."""


class GlRenderer:
    """Renders a town with MuJoCo's classic renderer. Call ``close`` in the same thread when done.

    Args:
        town: what to render.
        backend: ``egl`` or ``osmesa``.
        samples: colour samples per pixel, 0, 2 or 4: more samples give smoother edges and take longer.
        shadow_px: side of the shadow map, 0 for no shadows.
    """

    def __init__(self, town: Town, backend: str, samples: int = 4, shadow_px: int = 2048):
        self.town, self.model = town, town.model
        quality = self.model.vis.quality
        quality.offsamples, quality.shadowsize = samples, shadow_px
        self._context = gl_context(backend)
        self._context.make_current()
        self._scene = mujoco.MjvScene(self.model, maxgeom=self.model.ngeom + 50)
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = [1, 1, 1, 0, 0, 0]
        self._gl = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._gl)
        # Reversed depth (far is 0) keeps its precision at long range.
        self._gl.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        _sharpen_textures()
        self._groups = self.model.geom_group.copy()
        depth_map, extent = self.model.vis.map, self.model.stat.extent
        self._near_m, self._far_m = depth_map.znear * extent, depth_map.zfar * extent
        suns = self.model.light_diffuse[self.model.light_castshadow.astype(bool)]
        self._shadows = shadow_px > 0 and suns.max(initial=0.0) > FAINT_SUN

    def close(self) -> None:
        """Frees the context; nothing can be rendered afterwards."""
        self._context.make_current()
        self._gl.free()
        self._context.free()

    def render(self, data: Any, face: Face, world_from_sensor: Matrix4, colours: bool = True) -> FaceImage:
        """Renders one face of a sensor.

        Args:
            data: MuJoCo state with the poses of the instant.
            face: the pinhole image to render.
            world_from_sensor: pose of the sensor that the face belongs to.
            colours: if False only ids and depth are rendered, at a fraction of the cost.
        """
        width, height = face.width_px, face.height_px
        if self._gl.offWidth < width or self._gl.offHeight < height:
            # Rendering beyond the buffer leaves garbage without any error.
            size = max(width, self._gl.offWidth), max(height, self._gl.offHeight)
            mujoco.mjr_resizeOffscreen(*size, self._gl)
        eye, axes = world_from_sensor[:3, 3], world_from_sensor[:3, :3] @ face.sensor_from_face
        viewport, flags = mujoco.MjrRect(0, 0, width, height), self._scene.flags
        # Leaves and other open surfaces are visible from both sides, as they are for rays.
        flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = False
        offset = data.geom_xpos - eye
        seen = self._in_view(offset @ axes, face)
        rgb = None
        if colours:
            # Decals are blended into colours but have neither id nor depth.
            self._options.geomgroup[DECAL_GROUP] = 1
            self._gather(data, seen | self._throws_shadows(offset, axes) if self._shadows else seen)
            self._options.geomgroup[DECAL_GROUP] = 0
            self._aim(face, eye, axes)
            flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._shadows
            flags[mujoco.mjtRndFlag.mjRND_HAZE] = False
            flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = False
            rgb = np.empty((height, width, 3), np.uint8)
            mujoco.mjr_render(viewport, self._scene, self._gl)
            mujoco.mjr_readPixels(rgb, None, viewport, self._gl)
            # OpenGL images start at the lower left.
            rgb = np.ascontiguousarray(rgb[::-1])
        self._gather(data, seen)
        self._aim(face, eye, axes)
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = True
        ids, depth = np.empty((height, width, 3), np.uint8), np.empty((height, width), np.float32)
        mujoco.mjr_render(viewport, self._scene, self._gl)
        mujoco.mjr_readPixels(ids, depth, viewport, self._gl)
        geom = np.ascontiguousarray(self._geom_ids(ids)[::-1])
        # Depth is stored reversed, as a linear function of 1 / z: 1 at the near plane, 0 at the far plane.
        nearness = depth[::-1] * np.float32(1 / self._near_m - 1 / self._far_m) + np.float32(1 / self._far_m)
        image = FaceImage(rgb, geom, np.where(geom < 0, np.float32(0), nearness))
        _close_cracks(image, face.lens, axes[2])
        return image

    def _gather(self, data: Any, shown: Bool[np.ndarray, " g"]) -> None:
        """Adds the chosen geoms to the scene, since the renderer itself does not cull."""
        self.model.geom_group[:] = np.where(shown, self._groups, HIDDEN_GROUP)
        mujoco.mjv_updateScene(self.model, data, self._options, None, mujoco.MjvCamera(),
                               mujoco.mjtCatBit.mjCAT_ALL.value, self._scene)  # fmt: skip
        self.model.geom_group[:] = self._groups

    def _aim(self, face: Face, eye: Float64[np.ndarray, " 3"], axes: Float64[np.ndarray, "3 3"]) -> None:
        """Sets both GL cameras to the exact frustum, and centres the shadow map on the area in front of them."""
        left, right, top, bottom = _tangents(face.lens, face.width_px, face.height_px)
        # Mono rendering uses the mean of both stereo cameras, so both get the same frustum, given at the near plane.
        for camera in self._scene.camera:
            camera.pos, camera.forward, camera.up = eye, axes[:, 2], -axes[:, 1]
            camera.frustum_near, camera.frustum_far = self._near_m, self._far_m
            camera.frustum_width = (right - left) / 2 * self._near_m
            camera.frustum_center = (left + right) / 2 * self._near_m
            camera.frustum_top, camera.frustum_bottom = -top * self._near_m, -bottom * self._near_m
        middle = _shadow_middle(eye, axes)
        for light in self._scene.lights[: self._scene.nlight]:
            if light.castshadow:
                light.pos = middle + 120.0 * self.town.sun

    def _in_view(self, local: Float64[np.ndarray, "g 3"], face: Face) -> Bool[np.ndarray, " g"]:
        """Geoms whose bounding sphere intersects the frustum; geoms without a size, such as planes, always."""
        x, y, z = local.T
        radius = self.model.geom_rbound
        left, right, top, bottom = _tangents(face.lens, face.width_px, face.height_px)
        seen = z > -radius
        # Signed distance of the sphere's centre from each side plane x = z tan, whose normal has length hypot(1, tan).
        for place, tangent, side in ((x, left, -1), (x, right, 1), (y, top, -1), (y, bottom, 1)):
            seen &= side * (place - z * tangent) < radius * np.hypot(1, tangent)
        return seen | (radius <= 0)

    def _throws_shadows(
        self, offset: Float64[np.ndarray, "g 3"], axes: Float64[np.ndarray, "3 3"]
    ) -> Bool[np.ndarray, " g"]:
        """Geoms that may cast shadows on the visible ground near by."""
        apart = offset - _shadow_middle(np.zeros(3), axes)
        # Distance from the line towards the sun through the middle of the shadowed area, plus the bounding sphere.
        across = apart - np.outer(apart @ self.town.sun, self.town.sun)
        return np.linalg.norm(across, axis=1) < SHADOW_RADIUS_M * np.sqrt(2) + self.model.geom_rbound

    def _geom_ids(self, colours: UInt8[np.ndarray, "h w 3"]) -> Int32[np.ndarray, "h w"]:
        """Geom ids from the colours of the segmentation pass, which index the geoms of this scene, not of the model."""
        table = np.full(self._scene.ngeom + 2, -1, np.int32)
        for i in range(self._scene.ngeom):
            geom = self._scene.geoms[i]
            if geom.segid >= 0 and geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                table[geom.segid + 1] = geom.objid
        # A colour is the index plus one in 24 bits, red lowest; 0 is the background.
        index = colours.astype(np.int32) @ np.array([1, 256, 65536], np.int32)
        return table[np.minimum(index, len(table) - 1)]


def _sharpen_textures() -> None:
    """Biases mipmaps of the current context to finer levels; otherwise roads are blurred from ten metres on."""
    from OpenGL import GL  # imported late: PyOpenGL binds to the back end named in the environment

    GL.glTexEnvf(GL.GL_TEXTURE_FILTER_CONTROL, GL.GL_TEXTURE_LOD_BIAS, TEXTURE_LOD_BIAS)


def _tangents(lens: Pinhole, width: int, height: int) -> tuple[float, float, float, float]:
    """Left, right, top and bottom edge of an image on the plane z = 1."""
    return -lens.cx_px / lens.fx_px, (width - lens.cx_px) / lens.fx_px, \
           -lens.cy_px / lens.fy_px, (height - lens.cy_px) / lens.fy_px  # fmt: skip


def _shadow_middle(eye: Float64[np.ndarray, " 3"], axes: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, " 3"]:
    forward = axes[:, 2] * [1, 1, 0]
    return eye + SHADOW_AHEAD_M * forward / (np.linalg.norm(forward) + 1e-9)


def _close_cracks(image: FaceImage, lens: Pinhole, up: Float64[np.ndarray, " 3"]) -> None:
    """Fills isolated sky pixels below the horizon from their left neighbours.

    Where the edge of one mesh lies along an edge of another, rounding leaves about two in a million pixels open.
    ``up`` is the world's z in the face.
    """
    empty = image.geom < 0
    height, width = empty.shape
    x = (np.arange(1, width - 1) + 0.5 - lens.cx_px) / lens.fx_px
    y = (np.arange(1, height - 1) + 0.5 - lens.cy_px) / lens.fy_px
    beside = empty[1:-1, :-2] | empty[1:-1, 2:] | empty[:-2, 1:-1] | empty[2:, 1:-1]
    lone = empty[1:-1, 1:-1] & ~beside
    rows, columns = np.nonzero(lone)
    below = up[0] * x[columns] + up[1] * y[rows] + up[2] < HORIZON
    rows, columns = rows[below] + 1, columns[below] + 1
    for plane in (image.rgb, image.geom, image.nearness):
        if plane is not None:
            plane[rows, columns] = plane[rows, columns - 1]
