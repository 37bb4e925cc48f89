"""Client of the scene service: uploads, reconstruction, frames with geometry (docs/scene_service.md)."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Unpack

import numpy as np
from jaxtyping import Float32

from nurec_sim.errors import RequestError, ServerError
from nurec_sim.serving import wire
from nurec_sim.serving.connection import Connection, ConnectionOptions, malformed_reply
from nurec_sim.serving.wire import nurec_sim_v1 as v1
from nurec_sim.types import CameraFrame, LidarFrame, LidarModel, SensorRequest

CHUNK_BYTES = 1 << 20

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class ListedScene:
    """One scene of a server.

    Attributes:
        scene_id: its id.
        kind: ``memory`` (an object that the server was started with), ``archive``, ``clip`` (reconstructed when it is
            first used) or ``unknown``.
        file_bytes: size of its file; 0 for folders and objects in memory.
        loaded: whether it is in memory.
        loading: whether it is being loaded or reconstructed.
        loaded_bytes: memory that it takes; 0 if it is not loaded.
        users: calls that use it now.
        uploaded: whether it was uploaded, and can be deleted.
    """

    scene_id: str
    kind: str
    file_bytes: int
    loaded: bool
    loading: bool
    loaded_bytes: int
    users: int
    uploaded: bool


class SceneListing(NamedTuple):
    """The scenes of a server, and why its other sources cannot be opened, by file name without the ending."""

    scenes: tuple[ListedScene, ...]
    faults: Mapping[str, str]


class SceneClient(Connection):
    """The scene service of a server.

    Args:
        address: ``host:port``.
        **options: time limit, token and TLS, see ``ConnectionOptions``. Uploads and reconstructions may take any time,
            unless their own ``timeout_s`` says otherwise.

    Raises:
        ServerError: see ``Connection``.
    """

    def __init__(self, address: str, **options: Unpack[ConnectionOptions]) -> None:
        super().__init__(address, wire.SCENE_SERVICE, **options)

    # --------------------------------------------------------------------------------------------------------- scenes

    def scenes(self) -> SceneListing:
        """Available scenes, and sources that cannot be opened."""
        reply = self._call("ListScenes", v1.ListScenesRequest())
        known = {kind.value: kind.name.lower() for kind in wire.SceneKind}
        names = [field.name for field in dataclasses.fields(ListedScene)]  # those of the message
        scenes = [{name: getattr(info, name) for name in names} for info in reply.scenes]
        return SceneListing(
            tuple(ListedScene(**{**scene, "kind": known.get(scene["kind"], "unknown")}) for scene in scenes),
            {fault.name: fault.text for fault in reply.faults},
        )

    def stats(self) -> Mapping[str, float]:
        """Counters of the server by name, as in ``StatsReply``."""
        reply = self._call("Stats", v1.StatsRequest())
        return {field.name: getattr(reply, field.name) for field in reply.DESCRIPTOR.fields}

    def upload(self, path: Path, progress: Progress | None = None, *, timeout_s: float | None = None) -> str:
        """Uploads a scene archive (``.usdz``) or a zipped clip (``.zip``); returns the id of its scene.

        Args:
            path: the file.
            progress: called with the stage and the fraction done.
            timeout_s: for all of it.

        Raises:
            RequestError: the file has another ending, or the server refuses it.
            OSError: the file cannot be read.
        """
        procedure = {".usdz": "UploadScene", ".zip": "UploadClip"}.get(path.suffix)
        if procedure is None:
            raise RequestError(f"{path.name}: a scene archive ends in .usdz, a clip to upload in .zip")
        said = progress or (lambda stage, fraction: None)
        said("hashing", 0.0)
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        size = path.stat().st_size

        def parts() -> Iterator:
            yield v1.UploadPart(header=v1.UploadHeader(name=path.name, size=size, sha256=sha256))
            sent = 0
            with path.open("rb") as file:
                while data := file.read(CHUNK_BYTES):
                    yield v1.UploadPart(data=data)
                    sent += len(data)
                    said("sending", sent / size)

        with self._errors():
            return self._procedures[procedure](parts(), **self._options(timeout_s)).scene_id

    def reconstruct(
        self,
        *,
        scene_id: str = "",
        path: str = "",
        name: str = "",
        method: str = "",
        profile: str = "",
        cameras: Sequence[str] = (),
        progress: Progress | None = None,
        timeout_s: float | None = None,
    ) -> str:
        """Reconstructs a clip on the server; returns the id of the scene.

        Args:
            scene_id: an available clip, or
            path: one on the server, in a folder that it allows.
            name: id of the new scene, if not the clip's own.
            method: ``lift``, ``dense`` or ``selective``; empty for the server's choice.
            profile: size of the network.
            cameras: ids of the cameras to use.
            progress: called with the stage and the fraction done; if it raises, the server cancels the work.
            timeout_s: for all of it.
        """
        clip = {"path": path} if path else {"scene_id": scene_id}
        request = v1.ReconstructClipRequest(**clip, name=name, method=method, profile=profile, cameras=cameras)
        with self._errors():
            events = self._procedures["ReconstructClip"](request, **self._options(timeout_s))
            try:
                for event in events:
                    if event.WhichOneof("event") == "done":
                        return event.done.scene_id
                    if progress is not None:
                        progress(event.progress.stage, event.progress.fraction)
            finally:
                events.cancel()
        raise ServerError(f"{self.address}: the reconstruction ended without a scene")

    def unload(self, scene_id: str, *, delete_file: bool = False) -> int:
        """Removes a scene from the server's memory; returns the bytes freed.

        ``delete_file`` also deletes the file of an uploaded one.
        """
        request = v1.UnloadSceneRequest(scene_id=scene_id, delete_file=delete_file)
        return self._call("UnloadScene", request).freed_bytes

    # ------------------------------------------------------------------------------------------------------- rendering

    def render_camera(
        self, request: SensorRequest, outputs: Sequence[str] = ("depth", "alpha", "label", "normal")
    ) -> CameraFrame:
        """A camera frame, bit for bit as the server's renderer gives it: ``rgb`` always, and the ``outputs``."""
        message = v1.RenderCameraRequest(outputs=[wire.CameraOutput[name.upper()] for name in {"rgb", *outputs}])
        wire.write_camera_request(request, message.request, scene_id=request.scene_id)
        reply = self._call("RenderCamera", message)
        with malformed_reply(self.address, "RenderCamera"):
            frame = wire.read_camera_frame(wire.sensorsim.RGBRenderReturn(image_bytes=reply.rgb), request, "rgb")
            return CameraFrame(frame.camera, frame.start_us, frame.end_us, frame.rgb, **wire.read_outputs(reply))

    def render_lidar(self, request: SensorRequest) -> LidarFrame:
        """A sweep as points, bit for bit as the server's renderer gives it."""
        message = v1.RenderLidarRequest(form=wire.SweepForm.POINTS)
        wire.write_lidar_request(request, message.request, scene_id=request.scene_id)
        reply = self._call("RenderLidar", message)
        with malformed_reply(self.address, "RenderLidar"):
            return wire.read_lidar_frame(reply.points, request)

    def range_map(
        self, request: SensorRequest
    ) -> tuple[Float32[np.ndarray, "rows columns"], Float32[np.ndarray, "rows columns"]]:
        """Range in metres and intensity of every beam of a sweep, 0 where none came back."""
        if not isinstance(request.sensor, LidarModel):
            raise RequestError(f"the sensor must be a LidarModel, got {type(request.sensor).__name__}")
        message = v1.RenderLidarRequest(form=wire.SweepForm.RANGE_MAP)
        wire.write_lidar_request(request, message.request, scene_id=request.scene_id)
        reply = self._call("RenderLidar", message)
        with malformed_reply(self.address, "RenderLidar"):
            return wire.read_range_map(reply.range_map, request)
