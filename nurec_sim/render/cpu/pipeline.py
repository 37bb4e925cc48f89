"""The stages of one frame on the CPU: cull, project, sort, bin, blend; the same for cameras and LiDARs.

Kernels release the interpreter lock and run on the renderer's own threads. Every stage splits its work into ranges
whose results do not depend on how many there are, so frames are the same bytes at any thread count.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim import geometry
from nurec_sim.render.cpu.binning import count_tiles, fill_tiles, sort_by_depth
from nurec_sim.render.cpu.blend import PLANES, blend
from nurec_sim.render.cpu.grid import LIDAR, Grid
from nurec_sim.render.cpu.pack import BLOCK, PackedGaussians
from nurec_sim.render.cpu.projection import RECORD, TILE, project

SPLIT = 6
"""Ranges per thread: enough to even out tiles of very different cost."""


class Workers:
    """Threads that run kernel calls; safe to use from many threads at once."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="render") if threads > 1 else None

    def run(self, function: Callable, arguments: Sequence[tuple]) -> list:
        """``function`` of each tuple of arguments, in order."""
        if self._pool is None or len(arguments) <= 1:
            return [function(*each) for each in arguments]
        return [future.result() for future in [self._pool.submit(function, *each) for each in arguments]]

    def ranges(self, count: int, least: int) -> list[tuple[int, int]]:
        """0..count cut into about ``SPLIT`` ranges per thread of at least ``least``."""
        parts = max(1, min(self.threads * SPLIT if self.threads > 1 else 1, count // max(least, 1)))
        edges = np.linspace(0, count, parts + 1).astype(np.int64)
        return list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))


class Buffers:
    """Large scratch arrays, kept between frames; each frame has a set of its own."""

    def __init__(self) -> None:
        self._free: list[dict[str, np.ndarray]] = []
        self._lock = threading.Lock()

    @contextlib.contextmanager
    def lend(self) -> Iterator[Callable[[str, tuple[int, ...], type], np.ndarray]]:
        """A function that gives an uninitialised array of a name, a shape and a type."""
        with self._lock:
            arrays = self._free.pop() if self._free else {}

        def array(name: str, shape: tuple[int, ...], dtype: type) -> np.ndarray:
            size = int(np.prod(shape))
            if name not in arrays or arrays[name].size < size:
                arrays[name] = np.empty(int(size * 1.2) + 64, dtype)
            return arrays[name][:size].reshape(shape)

        try:
            yield array
        finally:
            with self._lock:
                if len(self._free) < 4:
                    self._free.append(arrays)


@dataclass(frozen=True)
class View:
    """Where a grid looks from: poses of its lines, and their middle as the frame that everything is computed in."""

    world_from_reference: Float64[np.ndarray, "4 4"]
    world_from_line: Float64[np.ndarray, "l 4 4"]
    lines: Float32[np.ndarray, "l 24"]

    @classmethod
    def of(cls, grid: Grid, pair: Float64[np.ndarray, "2 4 4"]) -> View:
        """The view of a grid whose sensor moves from the first to the second pose; one line where it does not move."""
        pair = np.asarray(pair, np.float64)
        reference = geometry.interpolate_pose_pair(pair, np.array(grid.reference))
        still = len(grid.line_fraction) == 1 or np.array_equal(pair[0], pair[1])
        poses = reference[None] if still else geometry.interpolate_pose_pair(pair, grid.line_fraction)
        reference_from_line = geometry.inverse(reference) @ poses
        line_from_reference = geometry.inverse(reference_from_line)
        parts = [m for pose in (reference_from_line, line_from_reference)
                 for m in (pose[:, :3, :3].reshape(-1, 9), pose[:, :3, 3])]  # fmt: skip
        return cls(reference, poses, np.concatenate(parts, axis=1).astype(np.float32))


def draw(
    grid: Grid,
    view: View,
    layers: Sequence[PackedGaussians],
    use_intensity: bool,
    workers: Workers,
    buffers: Buffers,
) -> Float32[np.ndarray, "7 h w"]:
    """What ``blend`` leaves per ray; the features are colours, or intensity and whether it is known."""
    height, width = grid.valid.shape
    columns, rows = -(-width // TILE), -(-height // TILE)
    planes = np.empty((PLANES, height, width), np.float32)
    with buffers.lend() as array:
        records, spans, order = _visible(grid, view, layers, use_intensity, workers, array)
        starts, lists = _bin(spans, order, columns, rows, workers, array)
        # Neighbouring tiles share records, so a thread takes runs of them, of about equal work.
        work = np.cumsum(np.diff(starts) + 8)
        parts = max(1, workers.threads * SPLIT) if workers.threads > 1 else 1
        cuts = np.searchsorted(work, np.linspace(0, work[-1], parts + 1)[1:-1])
        tiles = np.split(np.arange(columns * rows), cuts)
        near = np.float32(grid.near_m)
        workers.run(
            blend,
            [(some, starts, lists, records, grid.direction, grid.valid, grid.line, view.lines, near, columns, planes)
             for some in tiles],
        )  # fmt: skip
    return planes


def _visible(
    grid: Grid, view: View, layers: Sequence[PackedGaussians], use_intensity: bool, workers: Workers, array: Callable
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Records of all layers, the tiles they span, and their order front to back."""
    eye = view.world_from_reference[:3, 3].copy()
    rotation = view.world_from_reference[:3, :3].T
    quat = geometry.quat_from_matrix(rotation).astype(np.float32)
    cells = np.array([grid.valid.shape[1], grid.valid.shape[0]], np.float32)
    chosen = [_blocks_in_view(grid, view, layer) for layer in layers]
    most = BLOCK * (2 if grid.kind == LIDAR else 1)  # records per block: around the seam of a turn two each
    capacity = most * sum(len(blocks) for blocks in chosen)
    records, keys = array("records", (capacity, RECORD), np.float32), array("keys", (capacity,), np.float32)
    spans = array("spans", (capacity, 4), np.int16)
    arguments, starts, base = [], [], 0
    for layer, blocks in zip(layers, chosen, strict=True):
        values = layer.intensity if use_intensity else layer.intensity[:0]
        rest = layer.sh_rest[:0] if use_intensity else layer.sh_rest
        for first, last in workers.ranges(len(blocks), 4):
            starts.append(base)
            arguments.append(
                (layer.rows, values, rest, first, last, blocks, BLOCK, eye, quat, rotation.astype(np.float32),
                 grid.kind, grid.params, grid.table, grid.row_shift, grid.line_axis, view.lines, cells, grid.by_range,
                 np.float32(grid.near_m), records, spans, keys, base)
            )  # fmt: skip
            base += most * (last - first)
    counts = np.array(workers.run(project, arguments), np.int64)
    order = array("order", (int(counts.sum()),), np.int32)
    sort_by_depth(keys, np.array(starts, np.int64), counts, order)
    return records, spans, order


def _blocks_in_view(grid: Grid, view: View, layer: PackedGaussians) -> np.ndarray:
    """Blocks whose sphere meets the cone of the grid's rays, widened by the sensor's own motion."""
    if grid.field_cos <= -1.0 or len(layer) == 0:
        return np.arange(len(layer.block_radius))
    travel = np.linalg.norm(view.world_from_line[:, :3, 3] - view.world_from_reference[:3, 3], axis=1).max()
    axes = view.world_from_line[:, :3, 2]
    axis = view.world_from_reference[:3, 2]
    swing = np.arccos(np.clip(axes @ axis, -1, 1)).max()
    offset = layer.block_centre - view.world_from_reference[:3, 3]
    distance = np.linalg.norm(offset, axis=1)
    radius = layer.block_radius + travel
    angle = np.arccos(np.clip(offset @ axis / np.maximum(distance, 1e-9), -1, 1))
    reach = np.arcsin(np.clip(radius / np.maximum(distance, 1e-9), 0, 1))
    field = np.arccos(grid.field_cos) + swing + 0.02
    return np.flatnonzero((distance <= radius) | (angle <= field + reach))


def _bin(
    spans: np.ndarray, order: np.ndarray, columns: int, rows: int, workers: Workers, array: Callable
) -> tuple[np.ndarray, np.ndarray]:
    """Lists of records per tile, front to back, as (start of each tile's list, all lists)."""
    tiles = columns * rows
    ranges = workers.ranges(len(order), 20_000)
    counts = np.zeros((len(ranges), tiles), np.int64)
    workers.run(
        count_tiles,
        [(spans, order, first, last, columns, counts[k]) for k, (first, last) in enumerate(ranges)],
    )
    starts = np.zeros(tiles + 1, np.int64)
    np.cumsum(counts.sum(axis=0), out=starts[1:])
    position = starts[:-1] + np.cumsum(counts, axis=0) - counts
    lists = array("lists", (int(starts[-1]),), np.int32)
    workers.run(
        fill_tiles,
        [(spans, order, first, last, columns, position[k], lists) for k, (first, last) in enumerate(ranges)],
    )
    return starts, lists
