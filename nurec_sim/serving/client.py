"""Client of the sensor service: the same ``sense`` as a local renderer, bit for bit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Unpack

import grpc

from nurec_sim.errors import RequestError, ServerError
from nurec_sim.serving import wire
from nurec_sim.serving.connection import Connection, ConnectionOptions, malformed_reply
from nurec_sim.serving.wire import common, sensorsim
from nurec_sim.types import CameraModel, LidarModel, SensorFrame, SensorRequest, Track, Trajectory

MAX_BATCH_ITEMS = 64
_BATCH_REPLY_BYTES = 60 << 20


class RemoteSensors(Connection):
    """One scene of a sensor server.

    Args:
        address: ``host:port``.
        scene_id: id or alias of the scene; the ids inside requests are not looked at.
        apply_isp: whether images get the camera's colour correction.
        **options: time limit, token and TLS, see ``ConnectionOptions``; a server may first have to reconstruct the
            scene, which counts.

    Raises:
        ServerError: see ``Connection``.
    """

    def __init__(
        self, address: str, scene_id: str = "", *, apply_isp: bool = True, **options: Unpack[ConnectionOptions]
    ) -> None:
        super().__init__(address, wire.SERVICE, **options)
        self.scene_id, self._apply_isp = scene_id, apply_isp

    # ------------------------------------------------------------------------------------------------------- rendering

    def sense(self, requests: Sequence[SensorRequest]) -> list[SensorFrame]:
        """Renders requests, one frame each, in order; ``types.Sense``.

        Cameras travel together, LiDARs beside them. Camera frames hold ``rgb`` only.

        Raises:
            RequestError: a request is malformed or beyond the server's scene or limits.
            ServerError: the server cannot be reached in time, failed, or sent a malformed reply.
        """
        calls = []
        for indices in _batches(requests):
            batch = sensorsim.BatchRGBRenderRequest()
            for i in indices:
                item = batch.items.add(camera_name=requests[i].sensor.id)
                request = requests[i] if self._apply_isp else replace(requests[i], apply_isp=False)
                wire.write_camera_request(request, item.request, scene_id=self.scene_id)
            calls.append((indices, self._begin("batch_render_rgb", batch)))
        for i, request in enumerate(requests):
            if isinstance(request.sensor, LidarModel):
                message = sensorsim.LidarRenderRequest()
                wire.write_lidar_request(request, message, scene_id=self.scene_id)
                calls.append(([i], self._begin("render_lidar", message)))
        frames: dict[int, SensorFrame] = {}
        try:
            for indices, call in calls:
                reply = self._outcome(call)
                if isinstance(reply, sensorsim.LidarRenderReturn):
                    with malformed_reply(self.address, "render_lidar"):
                        frames[indices[0]] = wire.read_lidar_frame(reply, requests[indices[0]])
                else:
                    frames |= self._read_batch(reply, requests, indices)
        finally:
            for _, call in calls:
                call.cancel()  # without effect on those that are done
        return [frames[i] for i in range(len(requests))]

    # ------------------------------------------------------------------------------------------------------- discovery

    def scenes(self) -> list[str]:
        """Ids of all scenes of the server."""
        return list(self._call("get_available_scenes", common.Empty()).scene_ids)

    def cameras(self) -> dict[str, CameraModel]:
        """Cameras of the scene by id, at their native size."""
        reply = self._call("get_available_cameras", sensorsim.AvailableCamerasRequest(scene_id=self.scene_id))
        result = {}
        for entry in reply.available_cameras:
            with malformed_reply(self.address, f"get_available_cameras: camera {entry.logical_id!r}"):
                result[entry.logical_id] = wire.read_available_camera(entry)
        return result

    def lidars(self) -> dict[str, LidarModel]:
        """LiDARs of the scene by id; only servers of ours tell."""
        reply = self._call("get_available_lidars", sensorsim.AvailableLidarsRequest(scene_id=self.scene_id))
        result = {}
        for entry in reply.available_lidars:
            with malformed_reply(self.address, f"get_available_lidars: LiDAR {entry.logical_id!r}"):
                result[entry.logical_id] = wire.read_available_lidar(entry)
        return result

    def trajectory(self) -> Trajectory:
        """Recorded path of the rig in the world."""
        request = sensorsim.AvailableTrajectoriesRequest(scene_id=self.scene_id)
        found = self._call("get_available_trajectories", request).available_trajectories
        if not found:
            raise ServerError(f"{self.address}: scene {self.scene_id!r} has no trajectory")
        with malformed_reply(self.address, "get_available_trajectories"):
            return wire.read_trajectory(found[0].trajectory, "available_trajectories[0]")

    def tracks(self) -> list[Track]:
        """Tracks of the scene."""
        reply = self._call("get_dynamic_objects", sensorsim.DynamicObjectsRequest(scene_id=self.scene_id))
        with malformed_reply(self.address, "get_dynamic_objects"):
            return [wire.read_track(track) for track in reply.dynamic_objects]

    def server_config(self) -> Mapping[str, str]:
        """Options of the server as text."""
        return dict(self._call("get_server_config", common.Empty()).config)

    def version(self) -> str:
        """Version of the server's software."""
        return self._call("get_version", common.Empty()).version_id

    # ----------------------------------------------------------------------------------------------------------- calls

    def _begin(self, name: str, request) -> grpc.Future:
        return self._procedures[name].future(request, **self._options(self._timeout_s))

    def _outcome(self, call: grpc.Future):
        with self._errors():
            return call.result()

    def _read_batch(self, reply, requests: Sequence[SensorRequest], indices: list[int]) -> dict[int, SensorFrame]:
        """Frames of a batch by index of the request; replies may come in any order."""
        items = {item.camera_name: item for item in reply.items}
        frames: dict[int, SensorFrame] = {}
        for i in indices:
            name = requests[i].sensor.id
            item = items.get(name)
            if item is not None and not item.success:
                raise wire.error_of(item.error_code, f"camera {name!r}: {item.error_message}")
            with malformed_reply(self.address, "batch_render_rgb"):
                if item is None:
                    raise RequestError(f"items lack camera {name!r}; have {sorted(items)}")
                frames[i] = wire.read_camera_frame(item.result, requests[i])
        return frames


def _batches(requests: Sequence[SensorRequest]) -> Iterator[list[int]]:
    """Indices of the camera requests, in groups whose replies fit one message and name each camera once."""
    group: list[int] = []
    names: set[str] = set()
    size = 0
    for i, request in enumerate(requests):
        if not isinstance(request.sensor, CameraModel):
            continue
        image_bytes = 3 * request.sensor.width_px * request.sensor.height_px
        full = size + image_bytes > _BATCH_REPLY_BYTES or len(group) == MAX_BATCH_ITEMS
        if group and (full or request.sensor.id in names):
            yield group
            group, names, size = [], set(), 0
        group.append(i)
        names.add(request.sensor.id)
        size += image_bytes
    if group:
        yield group
