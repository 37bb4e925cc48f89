"""Frames of an optimisation drawn on a GPU: forwards and backwards as ``render.cpu.backward.frame`` does on the CPU.

Gaussians and the planes of their image cross to the device and back; the sky, losses and steps stay on the host. What
comes back are the gradients of the Gaussians in view alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, Float64, Int32

from nurec_sim.render.cpu.backward.frame import SENSORS, Frame, zeros_by_gaussian
from nurec_sim.render.cpu.backward.repack import RawGaussians
from nurec_sim.render.cpu.pack import BLOCK, MAX_OPACITY, MEAN, MIN_SCALE_M, QUAT
from nurec_sim.render.cpu.sensor_tables import SensorCache
from nurec_sim.render.gpu.batch import make_batch
from nurec_sim.render.gpu.gradients import DIFFERENTIABLE, pose_gradient
from nurec_sim.render.gpu.launcher import Launcher
from nurec_sim.render.gpu.pipeline import (
    ALPHA,
    DISTANCE,
    FEATURES,
    HALF,
    Blocks,
    Drawn,
    Room,
    Rooms,
    draw,
    draw_backward,
)
from nurec_sim.render.gpu.tensors import unbounded_spheres
from nurec_sim.render.gpu.views import GridTensors, view_rows
from nurec_sim.types import CameraModel

if TYPE_CHECKING:
    import torch

PLANES = [ALPHA, FEATURES, FEATURES + 1, FEATURES + 2, DISTANCE, HALF]
"""The kernels' planes in the order of ``Frame.draw_packed``."""


class GpuFrames:
    """Makes frames of cameras on one device, whose tables and room for records they share.

    Args:
        launcher: runs the kernels.
    """

    def __init__(self, launcher: Launcher) -> None:
        import torch

        self.launcher, self.rooms = launcher, Rooms()
        self.grids = SensorCache(lambda grid: GridTensors.of(grid, launcher.device))
        self.no_sky = torch.zeros((6, 1, 1, 3), device=launcher.device)

    def __call__(self, camera: CameraModel, pair: Float64[np.ndarray, "2 4 4"]) -> GpuFrame:
        """A frame of a camera, with its poses at the start and the end of the exposure."""
        return GpuFrame(self, camera, pair)


class GpuFrame(Frame):
    """A ``Frame`` of a camera whose Gaussians are drawn on a GPU.

    Args:
        frames: what it shares with others.
        camera: the camera.
        pair: ``world_from_camera`` at the start and the end of the exposure.
    """

    def __init__(self, frames: GpuFrames, camera: CameraModel, pair: Float64[np.ndarray, "2 4 4"]) -> None:
        super().__init__(SENSORS.tables(camera), pair, False)
        self._frames, launcher = frames, frames.launcher
        grid = frames.grids.tables(camera)
        rows = view_rows([grid])
        rows["sky"], rows["sky_size"] = frames.no_sky.data_ptr(), 1
        views, poses = (launcher.upload(each) for each in (rows.view(np.uint8), np.asarray(pair, np.float64)[None]))
        self._batch = make_batch(launcher, [grid], rows, views, poses, frames.no_sky)
        self._blocks: Blocks
        self._drawn: Drawn
        self._seen: torch.Tensor
        """Rows of the Gaussians that have a record."""

    @property
    def ray_z(self) -> Float32[np.ndarray, "h w"]:
        """Depth per distance along each ray: the kernels' distances are along rays for every lens."""
        return self.sensor.ray_z

    def draw_packed(self, packed: Float32[np.ndarray, "blocks 22 256"]) -> Float32[np.ndarray, "6 h w"]:
        """See ``Frame``; there are no rows and columns beside those of the image."""
        import torch

        launcher = self._frames.launcher
        none, spheres = Blocks.none(launcher.device), unbounded_spheres(len(packed), launcher.device)
        self._blocks = Blocks(launcher.upload(packed), none.sh_rest, spheres)

        def attempt(room: Room) -> tuple[np.ndarray, Drawn]:
            drawn = draw(launcher, self._batch, self._blocks, none, room, keep_rows=True)
            return launcher.read(drawn.totals), drawn

        first = Room.first(len(packed) * BLOCK)
        self._drawn = self._frames.rooms.until_it_fits(self._batch.ray_count, first, attempt)
        assert self._drawn.row_records is not None
        self._seen = torch.nonzero(self._drawn.row_records[0] >= 0)[:, 0]
        valid = self.sensor.grid.valid
        self.planes = launcher.read(self._drawn.planes[PLANES]).reshape(len(PLANES), *valid.shape)
        # As on the CPU: where there is no ray, nothing can be seen behind.
        self.planes[0][valid == 0] = 1
        return self.planes

    @property
    def drawn_rows(self) -> Int32[np.ndarray, " k"]:
        """See ``Frame``."""
        return self._frames.launcher.read(self._seen).astype(np.int32)

    def draw_back(
        self,
        mean: Float32[np.ndarray, "n 3"],
        quat: Float32[np.ndarray, "n 4"],
        scale: Float32[np.ndarray, "n 3"],
        opacity: Float32[np.ndarray, " n"],
        by_planes: Float32[np.ndarray, "6 h w"],
        into: RawGaussians | None = None,
    ) -> tuple[Float32[np.ndarray, "n c"], ...]:
        """See ``Frame``; ``mean`` and ``quat`` are those that were packed."""
        import torch

        launcher = self._frames.launcher
        given = np.empty((DIFFERENTIABLE, by_planes[0].size), np.float32)
        given[PLANES] = by_planes.reshape(len(PLANES), -1)
        every, _ = draw_backward(launcher, self._batch, self._blocks, self._drawn, launcher.upload(given))
        # Rows that no pixel shows may hold anything.
        some = self._seen[every[10, self._seen] != 0]
        rows, fields = (
            every[:, some],
            self._blocks.fields.transpose(1, 2).reshape(-1, self._blocks.fields.shape[1])[some],
        )
        unit = fields[:, QUAT : QUAT + 4]
        pose = pose_gradient(fields[:, MEAN : MEAN + 3], unit, rows, torch.from_numpy(self.view.world_from_reference))
        # A quaternion of unit length has no gradient along itself.
        rows[3:7] -= unit.T * (unit.T * rows[3:7]).sum(dim=0)
        index, values = launcher.read(some), launcher.read(rows)
        shares = zeros_by_gaussian(len(mean)) if into is None else into
        shares.mean[index] += values[0:3].T
        shares.quat[index] += values[3:7].T / np.linalg.norm(quat[index], axis=1, keepdims=True)
        shares.scale[index] += np.where(scale[index] > MIN_SCALE_M, values[7:10].T, 0)
        # The kernels' gradient is by the logarithm; the cap has none.
        shares.opacity[index] += np.where(opacity[index] <= MAX_OPACITY, values[10] / opacity[index], 0)
        shares.features[index] += values[11:14].T
        return *shares, pose.numpy()
