"""Images by OpenGL: colours with shadows in one pass, and which geom at which depth in a second one.

All calls must come from one thread, the one that made the painter: a GL context belongs to its thread.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8

from nurec_sim.types import CameraModel, Pinhole
from nurec_sim.world.backend import gl_context
from nurec_sim.world.build import FAR_M, NEAR_M, Street

SHADOW_RADIUS_M = 28.0
SHADOW_AHEAD_M = 22.0
HIDDEN_GROUP = 5

View = tuple[UInt8[np.ndarray, "h w 3"], Int32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]


class GlPainter:
    """Draws a street with MuJoCo's classic renderer. Call ``close`` in the same thread when done."""

    def __init__(self, street: Street, backend: str):
        self.street, self.model = street, street.model
        self._context = gl_context(backend)
        self._context.make_current()
        self._scene = mujoco.MjvScene(self.model, maxgeom=self.model.ngeom + 50)
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = [1, 1, 1, 0, 0, 0]
        self._gl = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._gl)
        self._gl.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._groups = self.model.geom_group.copy()

    def close(self) -> None:
        """Frees the context; nothing can be drawn afterwards."""
        self._context.make_current()
        self._gl.free()
        self._context.free()

    def view(self, data: Any, camera: CameraModel, world_from_camera: Float64[np.ndarray, "4 4"]) -> View:
        """Colours, the geom id of every pixel (-1 sky) and the depth along the optical axis in metres (0 sky)."""
        width, height = camera.width_px, camera.height_px
        if self._gl.offWidth < width or self._gl.offHeight < height:
            # Drawing past the buffer's edge leaves garbage without any error.
            size = max(width, self._gl.offWidth), max(height, self._gl.offHeight)
            mujoco.mjr_resizeOffscreen(*size, self._gl)
        self._aim(data, camera, world_from_camera)
        viewport = mujoco.MjrRect(0, 0, width, height)
        flags = self._scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SHADOW] = True
        flags[mujoco.mjtRndFlag.mjRND_HAZE] = False
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = False
        rgb = np.empty((height, width, 3), np.uint8)
        mujoco.mjr_render(viewport, self._scene, self._gl)
        mujoco.mjr_readPixels(rgb, None, viewport, self._gl)
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = True
        ids, depth = np.empty((height, width, 3), np.uint8), np.empty((height, width), np.float32)
        mujoco.mjr_render(viewport, self._scene, self._gl)
        mujoco.mjr_readPixels(ids, depth, viewport, self._gl)
        geom = self._geom_ids(ids)
        metres = NEAR_M * FAR_M / (NEAR_M + depth.astype(np.float64) * (FAR_M - NEAR_M))
        metres = np.where(geom < 0, 0.0, metres).astype(np.float32)
        return np.ascontiguousarray(rgb[::-1]), np.ascontiguousarray(geom[::-1]), np.ascontiguousarray(metres[::-1])

    def _aim(self, data: Any, camera: CameraModel, pose: Float64[np.ndarray, "4 4"]) -> None:
        """Gathers the geoms in view and sets both GL cameras to the pinhole's exact frustum."""
        lens = camera.lens
        assert isinstance(lens, Pinhole)
        self.model.geom_group[:] = np.where(self._in_view(data, camera, pose), self._groups, HIDDEN_GROUP)
        mujoco.mjv_updateScene(self.model, data, self._options, None, mujoco.MjvCamera(),
                               mujoco.mjtCatBit.mjCAT_ALL.value, self._scene)  # fmt: skip
        self.model.geom_group[:] = self._groups
        for eye in self._scene.camera:
            eye.pos, eye.forward, eye.up = pose[:3, 3], pose[:3, 2], -pose[:3, 1]
            eye.frustum_near, eye.frustum_far = NEAR_M, FAR_M
            eye.frustum_width = camera.width_px / lens.fx_px / 2 * NEAR_M
            eye.frustum_center = (camera.width_px / 2 - lens.cx_px) / lens.fx_px * NEAR_M
            eye.frustum_top = lens.cy_px / lens.fy_px * NEAR_M
            eye.frustum_bottom = -(camera.height_px - lens.cy_px) / lens.fy_px * NEAR_M
        sun = self._scene.lights[[i for i in range(self._scene.nlight) if self._scene.lights[i].castshadow][0]]
        forward = pose[:3, 2] * [1, 1, 0]
        middle = pose[:3, 3] + SHADOW_AHEAD_M * forward / (np.linalg.norm(forward) + 1e-9)
        sun.pos = middle + 120.0 * self.street.sun

    def _in_view(self, data: Any, camera: CameraModel, pose: Float64[np.ndarray, "4 4"]) -> np.ndarray:
        """Geoms whose bounding sphere meets the frustum, or may throw a shadow into it: the renderer culls nothing."""
        lens, radius = camera.lens, self.model.geom_rbound
        assert isinstance(lens, Pinhole)
        offset = data.geom_xpos - pose[:3, 3]
        x, y, z = (offset @ pose[:3, :3]).T
        wide = max(lens.cx_px, camera.width_px - lens.cx_px) / lens.fx_px
        high = max(lens.cy_px, camera.height_px - lens.cy_px) / lens.fy_px
        seen = z > -radius
        seen &= np.abs(x) - z * wide < radius * np.hypot(1, wide)
        seen &= np.abs(y) - z * high < radius * np.hypot(1, high)
        seen |= np.linalg.norm(offset, axis=1) < SHADOW_RADIUS_M + SHADOW_AHEAD_M + radius
        return seen | (radius <= 0)

    def _geom_ids(self, colours: UInt8[np.ndarray, "h w 3"]) -> Int32[np.ndarray, "h w"]:
        """Geom ids from the colours of the segmentation pass, which count the geoms of this scene, not the model's."""
        table = np.full(self._scene.ngeom + 2, -1, np.int32)
        for i in range(self._scene.ngeom):
            geom = self._scene.geoms[i]
            if geom.segid >= 0 and geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                table[geom.segid + 1] = geom.objid
        index = colours.astype(np.int32) @ np.array([1, 256, 65536], np.int32)
        return table[np.minimum(index, len(table) - 1)]
