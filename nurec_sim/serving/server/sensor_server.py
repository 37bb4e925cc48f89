"""The sensor server: the NuRec sensor interface over a ``SceneStore``.

One asyncio loop takes the calls; scenes load and frames render in threads of their own, so that health and discovery
answer while something renders. A cancelled call is not rendered.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from nurec_sim.serving import wire
from nurec_sim.serving.calls import Service
from nurec_sim.serving.scene_service import SceneOptions, SceneService
from nurec_sim.serving.sensor_service import SensorService, ServiceOptions
from nurec_sim.serving.sensor_service.scene_urls import URL_KEY
from nurec_sim.serving.server.grpc_server import GrpcServer
from nurec_sim.serving.server.options import ServerOptions
from nurec_sim.serving.store import SceneStore


class SensorServer(GrpcServer):
    """A sensor server in a background thread.

    ::

        with SensorServer(SceneStore(["scene.usdz"]), port=0) as address:
            frames = RemoteSensors(address, "scene").sense(requests)

    Args:
        store: the scenes.
        host: name or address to listen at; ``0.0.0.0`` for all.
        port: 0 picks a free one.
        options: what the service allows.
        scene_options: what the scene service allows.
        server_options: how it listens, and to whom; the limits of messages are those of ``options``.
    """

    def __init__(
        self,
        store: SceneStore,
        host: str = "127.0.0.1",
        port: int = 8080,
        *,
        options: ServiceOptions | None = None,
        scene_options: SceneOptions | None = None,
        server_options: ServerOptions | None = None,
    ) -> None:
        chosen = options or ServiceOptions()
        listening = replace(
            server_options or ServerOptions(),
            max_request_bytes=chosen.max_request_bytes,
            max_message_bytes=chosen.max_message_bytes,
        )
        super().__init__(lambda stop: _Sensors(store, chosen, scene_options, stop), host, port, options=listening)


class _Sensors:
    """The sensor services as an ``Application``."""

    def __init__(
        self,
        store: SceneStore,
        options: ServiceOptions,
        scene_options: SceneOptions | None,
        request_stop: Callable[[], None],
    ) -> None:
        _load_shared_libraries()
        self._store, self._options = store, options
        self._service = SensorService(store, options, request_stop)
        self._scenes = SceneService(store, self._service, scene_options)
        on_metadata = {URL_KEY: self._service.offer_scene}
        self.services: Sequence[Service] = (
            Service(wire.SERVICE, self._service, wire.SERVICE_PATHS, on_metadata),
            Service(wire.SCENE_SERVICE, self._scenes, on_metadata=on_metadata),
        )

    async def warm_up(self) -> None:
        if self._options.warm_up and self._store.ids:
            await self._service.warm_up()

    def gauges(self) -> Mapping[str, tuple[str, float]]:
        stats, renders = self._store.stats, self._service.renders
        return {
            "scenes": ("Scenes on offer", len(self._store.ids)),
            "scenes_loaded": ("Scenes in memory", stats.loaded),
            "scene_bytes_loaded": ("Bytes of the scenes in memory", stats.loaded_bytes),
            "scenes_in_use": ("Scenes in memory that a call uses", stats.in_use),
            "scene_loads": ("Scenes loaded since the start", stats.loads),
            "scene_evictions": ("Scenes dropped for others since the start", stats.evictions),
            "renders_waiting": ("Frames that wait for their turn to be rendered", renders.waiting),
            "renders_in_flight": ("Frames that are rendered at this moment", renders.running),
        }

    def close(self) -> None:
        self._scenes.close()
        self._service.close()


def _load_shared_libraries() -> None:
    """Imports what is otherwise imported on first use, before there are threads that do so at the same time.

    While OpenUSD is imported it waits for Python's lock inside the dynamic linker; a thread that loads another library
    then holds Python's lock and waits for the linker, and both wait for ever.
    """
    import cv2  # noqa: F401
    from pxr import Ar, Gf, Sdf, Tf, Usd, UsdGeom, UsdSemantics, UsdVol, Vt  # noqa: F401
