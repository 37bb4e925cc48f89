"""Renders requests for one Gaussian scene on a GPU; images are defined in ``render.spec``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from nurec_sim.compute.turns import rest
from nurec_sim.errors import TooLargeError
from nurec_sim.render.cpu.pack import BLOCK, pack
from nurec_sim.render.cpu.sensor_tables import SensorCache
from nurec_sim.render.ego import EgoOverlays
from nurec_sim.render.gpu.batch import Batch, make_batch
from nurec_sim.render.gpu.launcher import THREADS, CudaLauncher, Launcher
from nurec_sim.render.gpu.moving import MovingLayer
from nurec_sim.render.gpu.pipeline import Blocks, Drawn, Room, Rooms, draw
from nurec_sim.render.gpu.views import GridTensors, view_rows
from nurec_sim.render.lod import Detail, check_detail
from nurec_sim.render.requests import (
    CAMERA_OUTPUTS,
    SENSED_OUTPUTS,
    check_outputs,
    check_requests,
    ray_count,
)
from nurec_sim.render.single import SingleFrames
from nurec_sim.types import (
    CameraFrame,
    CameraModel,
    GaussianScene,
    LidarFilter,
    LidarFrame,
    LidarModel,
    SensorFrame,
    SensorRequest,
)

if TYPE_CHECKING:
    import torch

_Places = dict[str, tuple[int, int]]

GROUP_RAYS = 1 << 24
"""Pixels and beams that are rendered together, or of a single larger frame; some hundred bytes each."""


TOTALS_BYTES = 16
PLANES_OF: Mapping[str, tuple[str, int]] = {
    "returns": ("float32", 6),
    "depth": ("float32", 1),
    "alpha": ("float32", 1),
    "normal": ("float32", 3),
    "rgb": ("uint8", 3),
    "label": ("uint8", 1),
}
"""Type and columns of finished planes, in the order in which they lie in the memory that a batch's results share."""


@dataclass(frozen=True, eq=False)
class Images:
    """Finished rays of a batch on the device; those of sensor k begin at ``first_ray[k]``.

    Of cameras: ``rgb`` [rays,3] uint8, ``depth`` and ``alpha`` [rays], ``label`` [rays] uint8, ``normal`` [rays,3]. Of
    LiDARs, in the order of the beams: ``returns`` [rays,6] with x, y, z in the sensor at the end of the sweep, range,
    intensity, and 1 where the beam returns. Rays of the other kind of sensor are not initialised. None where it was
    not requested, or a batch has no sensor of the kind.
    """

    first_ray: np.ndarray
    rgb: torch.Tensor | None = None
    depth: torch.Tensor | None = None
    alpha: torch.Tensor | None = None
    label: torch.Tensor | None = None
    normal: torch.Tensor | None = None
    returns: torch.Tensor | None = None


class GpuRenderer(SingleFrames):
    """A scene prepared for rendering on a GPU, a ``render.Renderer``.

    Immutable but for caches; all methods can be called from many threads. Work is queued on torch's current stream.

    Args:
        scene: the world.
        device: a CUDA device such as ``cuda:1``, or a ``Launcher``.
        apply_isp: whether ``scene.isp`` of the request's sensor id is applied to requests that ask for it.
        detail_px: level of detail, as in ``render.make_renderer``.

    Raises:
        GpuError: there is no such device, or the extra ``gpu`` is missing.
        ValueError: a negative or infinite ``detail_px``.
    """

    def __init__(
        self,
        scene: GaussianScene,
        device: str | Launcher = "cuda",
        apply_isp: bool = True,
        detail_px: float = 0.0,
    ) -> None:
        import torch

        check_detail(detail_px)

        self.scene = scene
        self.apply_isp = apply_isp
        self._launcher: Launcher = CudaLauncher(device) if isinstance(device, str) else device
        self.device = self._launcher.device
        levels = Detail.of(scene.static, detail_px).levels if detail_px else ()
        packed = [(level.packed, level.error_m) for level in levels] or [(pack(scene.static), np.zeros(1))]
        self._static = Blocks.of(packed, self.device)
        self._detail_px = detail_px
        self._moving = MovingLayer.of(scene.dynamic, scene.tracks, self.device)
        self._ego = EgoOverlays(scene.ego_images, scene.rig)
        self._sky = torch.from_numpy(np.ascontiguousarray(scene.sky, np.float32)).to(self.device)
        self._rooms = Rooms()
        self._checked: set[tuple | None] = set()
        self._grids = SensorCache(lambda grid: GridTensors.of(grid, self.device))

    def sense(self, requests: Sequence[SensorRequest], outputs: Sequence[str] = SENSED_OUTPUTS) -> list[SensorFrame]:
        """One frame per request, in order: ``types.Sense``; cameras with ``rgb`` and what else ``outputs`` names.

        They are rendered together, in groups of up to ``GROUP_RAYS``.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``; or an unknown output.
        """
        check_outputs(outputs)
        frames: list[SensorFrame] = []
        group: list[SensorRequest] = []
        for number, request in enumerate(requests):
            group.append(request)
            if sum(map(ray_count, group)) >= GROUP_RAYS or number == len(requests) - 1:
                rest()
                frames += self._frames(group, outputs, LidarFilter())
                group = []
        return frames

    def render(self, requests: Sequence[SensorRequest], filter: LidarFilter | None = None) -> Images:
        """The frames of ``sense`` with all outputs, left on the device; at least one request.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``; or the GPU's memory is full.
        """
        return self._rendered(requests, CAMERA_OUTPUTS, filter or LidarFilter(), on_host=False)[0]

    def _rendered(
        self, requests: Sequence[SensorRequest], outputs: Sequence[str], filter: LidarFilter, on_host: bool
    ) -> tuple[Images, dict[str, np.ndarray]]:
        """The images on the device and, with ``on_host``, on the host; waits for the device once."""
        import torch

        world_from_sensor, pairs = check_requests(requests, self.scene, self._checked)
        cameras = sum(isinstance(request.sensor, CameraModel) for request in requests)
        names = ({"rgb", *outputs} if cameras else set()) | ({"returns"} if cameras < len(requests) else set())
        try:
            batch, moving = self._prepared(requests, world_from_sensor, pairs)
            places = _places(names, batch.ray_count)

            def attempt(room: Room) -> tuple[np.ndarray, tuple[torch.Tensor, np.ndarray]]:
                drawn = draw(self._launcher, batch, self._static, moving, room)
                shared = self._finish(batch, drawn, places, filter)
                # One copy carries the totals, which tell whether everything fitted, and the images.
                host = self._launcher.read(shared if on_host else shared[:TOTALS_BYTES])
                return host[:TOTALS_BYTES].view(np.int64), (shared, host)

            most = Room.first(batch.view_count * BLOCK * (len(self._static) + batch.moving_blocks))
            shared, host = self._rooms.until_it_fits((batch.view_count, batch.ray_count), most, attempt)
        except torch.OutOfMemoryError as error:
            raise TooLargeError(f"{len(requests)} sensors at once are too many for the GPU: {error}") from None
        images = Images(batch.first_ray, **{name: _plane(shared, name, places, torch) for name in places})
        return images, {name: _plane(host, name, places, np) for name in places} if on_host else {}

    def _prepared(
        self,
        requests: Sequence[SensorRequest],
        world_from_sensor: Float64[np.ndarray, "n 2 4 4"],
        pairs: Float64[np.ndarray, "m 2 4 4"],
    ) -> tuple[Batch, Blocks]:
        """The sensors of a batch, and the moving layer as each of them sees it; one copy to the device."""
        tensors = [self._grids.tables(request.sensor) for request in requests]
        rows = view_rows(tensors)
        rows["detail"] *= self._detail_px
        rows["sky"], rows["sky_size"] = self._sky.data_ptr(), self._sky.shape[1]
        start, end = np.array([(request.start_us, request.end_us) for request in requests], np.int64).T
        rows["instant_us"] = start + np.rint(rows["reference"] * (end - start)).astype(np.int64)
        blocks = len(self._moving)
        rows["first_block"], rows["blocks"] = np.arange(len(rows)) * blocks, blocks
        for number, request in enumerate(requests):
            if isinstance(request.sensor, LidarModel):
                rows["range_m"][number] = request.sensor.range_m
            elif self.apply_isp and request.apply_isp:
                response = self.scene.response(request.sensor.id, request.middle_us)
                if response is not None:
                    rows["isp"][number] = response.ravel()
        asked = self._moving.asked(requests)
        parts = [part.reshape(-1).view(np.uint8) for part in (rows, world_from_sensor, pairs, asked)]
        # One upload of everything that depends on the requests; the parts are addressed by their bytes.
        views, of_sensors, of_actors, tracks = self._launcher.upload(np.concatenate(parts)).split(list(map(len, parts)))
        batch = make_batch(self._launcher, tensors, rows, views, of_sensors, self._sky, blocks)
        return batch, self._moving.placed(self._launcher, batch, tracks, of_actors)

    def _frames(
        self, requests: Sequence[SensorRequest], outputs: Sequence[str], filter: LidarFilter
    ) -> list[SensorFrame]:
        if not requests:
            return []
        images, host = self._rendered(requests, outputs, filter, on_host=True)
        frames: list[SensorFrame] = []
        for k, request in enumerate(requests):
            part = slice(images.first_ray[k], images.first_ray[k + 1])
            if isinstance(request.sensor, CameraModel):
                frame = _camera_frame(request, request.sensor, {name: plane[part] for name, plane in host.items()})
                frames.append(self._ego.over(frame) if request.show_ego else frame)
            else:
                frames.append(_lidar_frame(request, request.sensor, host["returns"][part]))
        return frames

    def _finish(self, batch: Batch, drawn: Drawn, places: _Places, filter: LidarFilter) -> torch.Tensor:
        """The numbers of records and pairs, then the planes at their ``places``: the bytes of one tensor."""
        import torch

        size = max(last for _, last in places.values())
        shared = torch.empty(size, dtype=torch.uint8, device=self.device)
        shared[:TOTALS_BYTES] = drawn.totals.view(torch.uint8)
        plane = {name: shared[first:last] for name, (first, last) in places.items()}
        grid = (-(-batch.largest_grid // THREADS), batch.view_count)
        common = (batch.views, np.int64(batch.ray_count), drawn.planes)
        if "rgb" in places:
            shown = [plane.get(name) for name in ("rgb", "depth", "alpha", "label", "normal")]
            self._launcher.launch("finish_images", grid, *common, *shown)
        if "returns" in places:
            # Negative: no distance threshold.
            farthest = -1.0 if filter.distance_threshold_m is None else float(filter.distance_threshold_m)
            thresholds = (float(filter.opacity_threshold), float(filter.raydrop_threshold), farthest)
            self._launcher.launch("finish_beams", grid, *common, *thresholds, plane["returns"])
        return shared


def _places(names: Set[str], rays: int) -> _Places:
    """Where in a batch's shared memory each plane lies: first byte, and one behind the last."""
    places, at = {}, TOTALS_BYTES
    for name, (kind, columns) in PLANES_OF.items():
        if name in names:
            places[name] = (at, at + rays * columns * np.dtype(kind).itemsize)
            at = places[name][1]
    return places


def _plane(shared: Any, name: str, places: _Places, library: Any) -> Any:
    """A plane of a batch's shared memory, a tensor or an array: [rays], or [rays,c]."""
    kind, columns = PLANES_OF[name]
    first, last = places[name]
    plane = shared[first:last].view(getattr(library, kind))
    return plane if columns == 1 else plane.reshape(-1, columns)


def _camera_frame(request: SensorRequest, camera: CameraModel, planes: dict[str, np.ndarray]) -> CameraFrame:
    size = (camera.height_px, camera.width_px)
    image = {name: plane.reshape(*size, *plane.shape[1:]) for name, plane in planes.items() if name != "returns"}
    return CameraFrame(
        camera=camera,
        start_us=request.start_us,
        end_us=request.end_us,
        rgb=image["rgb"],
        depth_m=image.get("depth"),
        alpha=image.get("alpha"),
        label=image.get("label"),
        normal=image.get("normal"),
    )


def _lidar_frame(request: SensorRequest, lidar: LidarModel, returns: np.ndarray) -> LidarFrame:
    beam = np.flatnonzero(returns[:, 5] > 0)
    chosen = returns[beam]
    return LidarFrame(
        lidar=lidar,
        start_us=request.start_us,
        end_us=request.end_us,
        xyz_m=chosen[:, :3].copy(),
        range_m=chosen[:, 3].copy(),
        intensity=chosen[:, 4].copy(),
        beam=beam.astype(np.int32),
    )
