"""One frame forwards and backwards: what ``gradients`` runs on the CPU, on NumPy arrays instead of tensors."""

from __future__ import annotations

import functools
import weakref
from contextlib import ExitStack
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Float64, Int32

from nurec_sim.compute.cores import usable_cores
from nurec_sim.render.cpu.backward.blend import COLOUR_SUMS, COLOURS, IMAGE_PLANES, SUMS
from nurec_sim.render.cpu.backward.project import project_back
from nurec_sim.render.cpu.backward.repack import RawGaussians, repack
from nurec_sim.render.cpu.backward.tiles import RecordSlots, draw_tiles_back, number_slots
from nurec_sim.render.cpu.blend.background import draw_sky, draw_sky_back
from nurec_sim.render.cpu.blend.responses import CAMERA, LIDAR
from nurec_sim.render.cpu.blend.tiles import AFFINE, MOVING, ROLLING
from nurec_sim.render.cpu.pack import BLOCK, FIELDS, PackedGaussians
from nurec_sim.render.cpu.pipeline import NO_TABLE, Picture, draw, sensor_rays, tile_ranges
from nurec_sim.render.cpu.sensor_tables import SensorCache, SensorTables
from nurec_sim.render.cpu.view import ExposureView
from nurec_sim.render.cpu.workers import Buffers, Workers

SENSORS = SensorCache(SensorTables)
"""Shared by all frames of the process: an optimisation renders the same few cameras again and again."""
_BUFFERS = Buffers()


@functools.cache
def shared_workers(threads: int | None) -> Workers:
    """Threads shared by all frames with the same ``threads``; as many as the process may use if None."""
    if threads is not None and threads < 1:
        raise ValueError(f"rendering needs at least 1 thread, got {threads}")
    return Workers(threads or usable_cores())


class ExactView(ExposureView):
    """A view whose rays start exactly where they do; a rolling shutter is not rendered to first order."""

    @cached_property
    def projection_mode(self) -> int:
        """AFFINE, TABLE or MOVING."""
        return MOVING if super().projection_mode == ROLLING else super().projection_mode


class Frame:
    """A frame from its forward pass until its gradients are no longer needed; it owns its scratch memory.

    Args:
        sensor: tables of the sensor.
        pair: ``world_from_sensor`` at the start and the end of the exposure.
        lidar: whether the features are those of a LiDAR: intensity, whether it is known, drop probability.
        threads: as many as the process may use if None.
    """

    def __init__(
        self, sensor: SensorTables, pair: Float64[np.ndarray, "2 4 4"], lidar: bool, threads: int | None = None
    ) -> None:
        self.sensor, self.lidar = sensor, lidar
        self.view = ExactView.of(sensor.grid, pair)
        self._workers = shared_workers(threads)
        # Scratch memory is returned when the frame is collected: autograd decides how long a frame is needed.
        loan = ExitStack()
        weakref.finalize(self, loan.close)
        self._scratch = loan.enter_context(_BUFFERS.lend())

    @property
    def ray_z(self) -> Float32[np.ndarray, "h w"] | None:
        """Depth per distance along each ray; None where distances are depths already."""
        return None if self.view.projection_mode == AFFINE else self.sensor.grid.direction[..., 2]

    def draw_sky(
        self, sky: Float32[np.ndarray, "6 s s 3"], clear: Float32[np.ndarray, "h w"] | None = None
    ) -> Float32[np.ndarray, "3 h w"]:
        """Colours of a cubemap behind every ray, or only behind those that let something through (``clear``)."""
        return draw_sky(self.view.directions, self.view.world_from_reference[:3, :3], sky, self._workers, clear)

    def draw_sky_back(
        self, sky: Float32[np.ndarray, "6 s s 3"], by_behind: Float32[np.ndarray, "3 h w"]
    ) -> tuple[Float64[np.ndarray, "6 s s 3"], Float64[np.ndarray, "4 4"]]:
        """Gradients by the sky and by the reference pose."""
        pose = self.view.world_from_reference
        by_sky, torque = draw_sky_back(self.view.directions, pose[:3, :3], sky, by_behind, self._workers)
        return by_sky, pose_gradient(np.zeros(3), torque, pose)

    def draw(
        self,
        mean: Float32[np.ndarray, "n 3"],
        quat: Float32[np.ndarray, "n 4"],
        scale: Float32[np.ndarray, "n 3"],
        opacity: Float32[np.ndarray, " n"],
        features: Float32[np.ndarray, "n 3"],
    ) -> Float32[np.ndarray, "6 h w"]:
        """Render Gaussians.

        Args:
            mean: centres in the world (m).
            quat: rotations (wxyz), of any norm.
            scale: standard deviations (m).
            opacity: 0..1.
            features: colours, or of LiDARs intensity, whether it is known, and drop probability.

        Returns:
            Blended planes: alpha, three features, distance, half distance; sides are rounded up to whole macro tiles.
        """
        gaussians = RawGaussians(mean, quat, scale, opacity, features)
        blocks = -(-len(mean) // BLOCK)
        packed = self._scratch("fields", (blocks, FIELDS, BLOCK), np.float32)
        self._workers.run(
            repack,
            [(first, last, gaussians, self.lidar, packed) for first, last in self._workers.ranges(blocks, 8)],
        )
        return self.draw_packed(packed)

    def draw_packed(self, packed: Float32[np.ndarray, "blocks 22 256"]) -> Float32[np.ndarray, "6 h w"]:
        """Render Gaussians that are packed already (``pack``), like ``draw``; row i of them is packed row i."""
        blocks = len(packed)
        nothing = np.zeros((0, 0, 0), np.float32)
        layer = PackedGaussians(packed, nothing, np.zeros(0, np.int32), np.zeros((0, 3)), np.zeros(0))
        rays = NO_TABLE if self.view.projection_mode == AFFINE else self.sensor.rays
        output_kind = LIDAR if self.lidar else CAMERA
        self._picture = Picture(self.view, rays, output_kind, [(layer, np.arange(blocks))], self._scratch)
        self.planes = draw([self._picture], self._workers)[0]
        return self.planes

    @property
    def drawn_rows(self) -> Int32[np.ndarray, " k"]:
        """Rows of the Gaussians that can be seen in the frame, rising; others have no gradient."""
        # Every run takes its blocks in their order, and the runs follow each other.
        picture = self._picture
        return np.concatenate([picture.projected.sources[first : first + many] for _, first, many in picture.runs])

    def empty_planes(self) -> Float32[np.ndarray, "6 h w"]:
        """Zeros, in memory that the frame owns, to be filled with gradients by the planes of ``draw``."""
        gradients = self._scratch("gradients", self.planes.shape, np.float32)
        assert len(gradients) == IMAGE_PLANES
        gradients[:] = 0
        return gradients

    def draw_back(
        self,
        mean: Float32[np.ndarray, "n 3"],
        quat: Float32[np.ndarray, "n 4"],
        scale: Float32[np.ndarray, "n 3"],
        opacity: Float32[np.ndarray, " n"],
        by_planes: Float32[np.ndarray, "6 h w"],
        into: RawGaussians | None = None,
    ) -> tuple[Float32[np.ndarray, "n c"], ...]:
        """Gradients by mean, quaternion, scale, opacity, features and ``world_from_sensor`` [4,4] at the reference.

        Args:
            mean: what has been rendered, like the following three.
            quat: see mean.
            scale: see mean.
            opacity: see mean.
            by_planes: gradients of the loss by the planes of ``draw``, 0 where there is no ray; see ``empty_planes``.
            into: arrays to which the gradients by the Gaussians are added; None: new ones.
        """
        picture = self._picture
        slots = carry_back(picture, picture.output_kind, self.planes, by_planes, self._workers)
        pose, count = self.view.world_from_reference, len(mean)
        shares = zeros_by_gaussian(count) if into is None else into
        # The features are not needed: the image is linear in them.
        gaussians = RawGaussians(mean, quat, scale, opacity, shares.features)
        forces = np.zeros((-(-count // BLOCK), 6))
        self._workers.run(
            project_back,
            [(first, many, picture.projected, slots, gaussians, pose, shares, forces)
             for _, first, many in picture.runs],
        )  # fmt: skip
        return *shares, pose_gradient(forces[:, :3].sum(axis=0), forces[:, 3:].sum(axis=0), pose)


def zeros_by_gaussian(count: int) -> RawGaussians:
    """Gradients of 0 for some Gaussians."""
    return RawGaussians(*(np.zeros((count, *width), np.float32) for width in ((3,), (4,), (3,), (), (3,))))


def carry_back(
    picture: Picture,
    output_kind: int,
    planes: Float32[np.ndarray, "6 h w"],
    gradients: Float32[np.ndarray, "6 h w"],
    workers: Workers,
) -> RecordSlots:
    """Sums of a drawn picture's records, a slot per record and macro tile; valid as long as its scratch memory.

    Args:
        picture: what has been drawn.
        output_kind: CAMERA, LIDAR, or COLOURS.
        planes: what ``draw`` returned.
        gradients: by ``planes``; 0 where there is no valid ray.
        workers: threads to run on.
    """
    assert len(gradients) == IMAGE_PLANES
    # A slot per record and tile: each is written by one tile only, whatever the number of threads.
    starts = np.array([first for _, first, _ in picture.runs], np.int64)
    counts = np.array([count for _, _, count in picture.runs], np.int64)
    first_slot = picture.scratch("first slot", (picture.capacity,), np.int64)
    pairs = number_slots(picture.projected.spans, starts, counts, first_slot)
    width = COLOUR_SUMS if output_kind == COLOURS else SUMS
    slots = RecordSlots(first_slot, picture.scratch("slots", (pairs, width), np.float32))
    rays = sensor_rays(picture)
    workers.run(
        draw_tiles_back,
        [(rays.mode, output_kind, rays, picture.projected, picture.binned, tiles, planes, gradients, slots)
         for tiles in tile_ranges(picture, workers.threads)],
    )  # fmt: skip
    return slots


def pose_gradient(
    force: Float64[np.ndarray, " 3"], torque: Float64[np.ndarray, " 3"], pose: Float64[np.ndarray, "4 4"]
) -> Float64[np.ndarray, "4 4"]:
    """The gradient by a pose's matrix, from those by a shift and by a small turn about its origin, both in the world.

    Of all matrices with this torque it is the one along rotations; a change that is no rigid motion has no meaning.
    """
    # A turn w changes R by [w] R, so the gradient 0.5 [torque] R has the inner product torque . w with it.
    x, y, z = torque
    gradient = np.zeros((4, 4))
    gradient[:3, :3] = 0.5 * np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ pose[:3, :3]
    gradient[:3, 3] = force
    return gradient
