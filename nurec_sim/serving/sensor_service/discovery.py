"""Discovery: the procedures that describe the server and its scenes."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

import nurec_sim
from nurec_sim.errors import NotAllowedError
from nurec_sim.sensors import fill_ftheta
from nurec_sim.serving import wire
from nurec_sim.serving.sensor_service.core import ServiceCore
from nurec_sim.serving.wire import common, sensorsim
from nurec_sim.types import CameraModel

API_VERSION = (0, 54, 0)
"""The version of AlpaSim's interface whose messages ``protos/`` holds."""


class Discovery(ServiceCore):
    """Describes the server and its scenes."""

    async def get_version(self, request):
        """Version of this package and of the interface."""
        reply = common.VersionId(version_id=nurec_sim.__version__)
        api = reply.grpc_api_version
        api.major, api.minor, api.patch = API_VERSION
        return reply

    async def get_available_scenes(self, request):
        """Ids of all scenes."""
        return common.AvailableScenesReturn(scene_ids=self._store.ids)

    async def get_loaded_scenes(self, request):
        """Ids of the scenes in memory, and how many fit."""
        reply = sensorsim.LoadedScenesReturn(loaded_instance_capacity=self._store.capacity)
        for scene_id in self._store.loaded_ids:
            reply.scenes.add(scene_id=scene_id, loaded_instance_count=1, reusable_instance_count=1)
        return reply

    async def get_available_cameras(self, request):
        """Cameras of the rig at their native size, both F-theta polynomials filled in."""
        reply = sensorsim.AvailableCamerasReturn()
        for camera in (await self._scene(request.scene_id)).rig.cameras.values():
            wire.write_available_camera(_with_both_polynomials(camera), reply.available_cameras.add())
        return reply

    async def get_available_lidars(self, request):
        """LiDARs of the rig."""
        reply = sensorsim.AvailableLidarsReturn()
        for lidar in (await self._scene(request.scene_id)).rig.lidars.values():
            wire.write_available_lidar(lidar, reply.available_lidars.add())
        return reply

    async def get_available_trajectories(self, request):
        """The recorded path of the rig."""
        scene = await self._scene(request.scene_id)
        reply = sensorsim.AvailableTrajectoriesReturn()
        wire.write_trajectory(scene.ego, reply.available_trajectories.add().trajectory)
        return reply

    async def get_available_ego_masks(self, request):
        """Masks of the ego mask folder."""
        reply = sensorsim.AvailableEgoMasksReturn()
        for rig, camera in self._masks.ids:
            entry = reply.ego_mask_metadata.add().ego_mask_id
            entry.rig_config_id, entry.camera_logical_id = rig, camera
        return reply

    async def get_server_config(self, request):
        """The options of this server as text."""
        options = {field.name: str(getattr(self._options, field.name)) for field in fields(self._options)}
        formats = ", ".join(kind.name for kind in wire.offered_formats())
        scenes = {"scenes": str(len(self._store.ids)), "scene_capacity": str(self._store.capacity)}
        return sensorsim.ServerConfigReturn(config=options | scenes | {"image_formats": formats})

    async def shut_down(self, request):
        """Stops the server, if it was started so that clients may."""
        if not self._options.allow_shut_down:
            raise NotAllowedError("this server was not started with permission to be shut down by clients")
        self._request_stop()
        return common.Empty()


def _with_both_polynomials(camera: CameraModel) -> CameraModel:
    far_x = max(camera.lens.cx_px, camera.width_px - camera.lens.cx_px)
    far_y = max(camera.lens.cy_px, camera.height_px - camera.lens.cy_px)
    return replace(camera, lens=fill_ftheta(camera.lens, float(np.hypot(far_x, far_y))))
