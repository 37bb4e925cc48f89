"""Every procedure of the scene service."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, aclosing
from dataclasses import dataclass
from pathlib import Path

from nurec_sim.errors import RequestError, TooLargeError, UnsupportedError
from nurec_sim.serving import wire
from nurec_sim.serving.scene_service.frames import Frames
from nurec_sim.serving.scene_service.reconstructions import Reconstructions
from nurec_sim.serving.sensor_service import SensorService
from nurec_sim.serving.sensor_service.core import run_to_end
from nurec_sim.serving.store import SceneStore, Upload, UploadFolder
from nurec_sim.serving.wire import nurec_sim_v1 as v1


@dataclass(frozen=True)
class SceneOptions:
    """What the scene service allows; limits of frames and messages are those of ``ServiceOptions``."""

    upload_dir: Path | None = None
    """Where uploaded scenes and clips are stored, also for later servers; None disables uploads."""
    max_upload_bytes: int = 4 << 30
    """Of one file; a scene archive cannot be larger."""
    max_uploaded_bytes: int = 64 << 30
    """Of all files in the folder."""
    max_uploads: int = 4
    """Uploads in progress."""
    upload_idle_s: float = 60.0
    """Timeout between parts of an upload."""
    clip_dirs: tuple[Path, ...] = ()
    """Folders whose clips clients may have reconstructed by naming their path."""


class SceneService:
    """The procedures, by their names on the wire: messages in, messages out, errors raised.

    Args:
        store: the scenes.
        sensors: renders, in its queue and with its limits.
        options: what is allowed.

    Raises:
        OSError: the upload folder cannot be made or read.
    """

    def __init__(self, store: SceneStore, sensors: SensorService, options: SceneOptions | None = None) -> None:
        self._store, self._sensors, self._options = store, sensors, options or SceneOptions()
        self._frames = Frames(sensors)
        self._reconstructions = Reconstructions(store, self._options.clip_dirs)
        self._disk = ThreadPoolExecutor(2, thread_name_prefix="upload")
        self._receiving = 0
        self._uploads: UploadFolder | None = None
        if self._options.upload_dir is not None:
            sizes = self._options.max_upload_bytes, self._options.max_uploaded_bytes
            self._uploads = UploadFolder(self._options.upload_dir, store, max_bytes=sizes[0], max_total_bytes=sizes[1])

    def close(self) -> None:
        """Cancels queued work and waits for running work; reconstructions stop at their next step."""
        self._reconstructions.close()
        self._disk.shutdown(wait=True, cancel_futures=True)

    # --------------------------------------------------------------------------------------------------------- scenes

    async def list_scenes(self, request):
        """Available scenes, and sources that cannot be opened."""
        reply = v1.ListScenesReply()
        for entry in self._store.entries:
            reply.scenes.add(
                scene_id=entry.id,
                kind=wire.SceneKind[entry.kind.upper()],
                file_bytes=entry.file_bytes,
                loaded=entry.loaded_bytes > 0,
                loading=entry.loading,
                loaded_bytes=entry.loaded_bytes,
                users=entry.users,
                uploaded=self._uploads is not None and self._uploads.holds(self._store.source(entry.id).origin),
            )
        for name, text in self._store.faults.items():
            reply.faults.add(name=name, text=text)
        return reply

    async def unload_scene(self, request):
        """Removes a scene from memory, and deletes its file on request; nothing changes if it cannot be deleted."""
        if request.delete_file:
            freed = await self._in_disk_thread(self._upload_folder().delete, request.scene_id)
        else:
            freed = self._store.unload(request.scene_id)
        return v1.UnloadSceneReply(freed_bytes=freed)

    async def stats(self, request):
        """Counters of the scene store, the render queue and the uploads."""
        memory = self._store.stats
        return v1.StatsReply(
            scenes=len(self._store.ids),
            faults=len(self._store.faults),
            loaded=memory.loaded,
            capacity=self._store.capacity,
            loaded_bytes=memory.loaded_bytes,
            max_loaded_bytes=self._store.max_bytes,
            in_use=memory.in_use,
            hits=memory.hits,
            loads=memory.loads,
            failed_loads=memory.failed_loads,
            evictions=memory.evictions,
            load_seconds=memory.load_s,
            frames_waiting=self._sensors.renders.waiting,
            frames_rendering=self._sensors.renders.running,
            uploads_in_progress=self._receiving,
            uploaded_bytes=0 if self._uploads is None else self._uploads.total_bytes,
        )

    # --------------------------------------------------------------------------------------------------------- uploads

    async def upload_scene(self, parts: AsyncIterator):
        """A scene archive from the client."""
        return await self._receive(parts, ".usdz")

    async def upload_clip(self, parts: AsyncIterator):
        """A zipped clip from the client."""
        return await self._receive(parts, ".zip")

    async def _receive(self, parts: AsyncIterator, ending: str):
        folder = self._upload_folder()
        if self._receiving >= self._options.max_uploads:
            raise TooLargeError(f"{self._receiving} uploads are in progress, no more are allowed; try again later")
        self._receiving += 1
        try:
            first = await self._next(parts)
            if first is None or first.WhichOneof("part") != "header":
                raise RequestError("an upload begins with its header: name, size and sha256")
            header = first.header
            with ExitStack() as stack:
                receiving = folder.receive(header.name, header.size, header.sha256, ending)
                upload: Upload = stack.enter_context(receiving)
                while (part := await self._next(parts)) is not None:
                    if part.WhichOneof("part") != "data":
                        raise RequestError("after the header an upload has data only")
                    await self._in_disk_thread(upload.write, part.data)
                return v1.UploadReply(scene_id=await self._in_disk_thread(upload.finish))
        finally:
            self._receiving -= 1

    async def _next(self, parts: AsyncIterator):
        """The next part; None at the end."""
        try:
            return await asyncio.wait_for(anext(parts, None), self._options.upload_idle_s)
        except TimeoutError:
            raise RequestError(f"nothing came for {self._options.upload_idle_s:g} s; the upload is dropped") from None

    def _upload_folder(self) -> UploadFolder:
        if self._uploads is None:
            raise UnsupportedError("this server has no folder for uploads")
        return self._uploads

    async def _in_disk_thread(self, function, *arguments):
        # To its end: a file must not be closed under the thread that writes it when the client leaves.
        return await run_to_end(self._disk, function, *arguments)

    # ------------------------------------------------------------------------------------- reconstruction and rendering

    async def reconstruct_clip(self, request) -> AsyncGenerator:
        """Progress, then the scene."""
        async with aclosing(self._reconstructions.run(request)) as events:
            async for event in events:
                yield event

    async def render_camera(self, request):
        """One camera frame."""
        return await self._frames.camera(request)

    async def render_lidar(self, request):
        """One sweep."""
        return await self._frames.lidar(request)
