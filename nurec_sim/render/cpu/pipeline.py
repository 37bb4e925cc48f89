"""The stages of frames on the CPU: cull, project, bin, sort and blend; identical for cameras and LiDARs.

Several frames go through each stage together, so that all threads have work until the last tile. Kernels release the
interpreter lock. Every stage splits its work into ranges whose results do not depend on how many there are, so frames
are the same bytes at any thread count.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, Int64

from nurec_sim.render.cpu.blend.beams import draw_beams
from nurec_sim.render.cpu.blend.binning import TileLists, count_tiles, fill_tiles
from nurec_sim.render.cpu.blend.draw import draw_tiles, record_normals
from nurec_sim.render.cpu.blend.rays import RayTiles, SensorRays
from nurec_sim.render.cpu.blend.responses import LIDAR, NORMALS
from nurec_sim.render.cpu.blend.tiles import AFFINE, ROLLING
from nurec_sim.render.cpu.grid import LIDAR as LIDAR_GRID
from nurec_sim.render.cpu.pack import BLOCK, LayerBlocks, PackedGaussians
from nurec_sim.render.cpu.project.general import project_general
from nurec_sim.render.cpu.project.motion import LinePath
from nurec_sim.render.cpu.project.pinhole import project_pinhole
from nurec_sim.render.cpu.records import MACRO, RECORD, Projected
from nurec_sim.render.cpu.simd import LANES
from nurec_sim.render.cpu.view import ExposureView
from nurec_sim.render.cpu.workers import SPLIT, Scratch, Workers

SLICE_PAIRS, SLICE_BLOCKS = 8192, 512
"""Pairs of records and macro tiles, and blocks of Gaussians, in one call of a kernel, at most about; a few
milliseconds of work: the machine is shared out between calls (``turns``)."""
NO_TABLE = RayTiles(np.zeros((1, 1, 1, 1), np.float32), np.zeros((1, 1, 1), np.int16), np.zeros((1, 1, 1), np.float32))
"""What a pinhole has instead of a table of rays."""


@dataclass(eq=False)
class FrameStats:
    """What a frame took: Gaussians in view, pairs of them with macro tiles, responses, wall seconds per stage.

    Stages that several frames go through together count in full for each of them.
    """

    visible: int = 0
    pairs: int = 0
    evaluations: int = 0
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(eq=False)
class Picture:
    """One frame on its way through the stages.

    ``layers`` are Gaussians and the numbers of their blocks to project; ``output_kind`` is CAMERA, NORMALS or LIDAR.
    What follows ``scratch`` is filled in by ``bin_pictures``: ``runs`` are the first row and the number of records that
    each layer has written, by range.
    """

    view: ExposureView
    rays: RayTiles
    output_kind: int
    layers: Sequence[tuple[PackedGaussians, Int64[np.ndarray, " b"]]]
    scratch: Scratch
    projected: Projected = field(init=False)
    runs: list[tuple[int, int, int]] = field(init=False)
    binned: TileLists = field(init=False)
    stats: FrameStats = field(default_factory=FrameStats)

    @property
    def cells(self) -> tuple[int, int]:
        """Columns and rows of the grid."""
        height, width = self.view.grid.valid.shape
        return width, height

    @property
    def tile_columns(self) -> int:
        """Macro tiles per row of them."""
        return -(-self.cells[0] // MACRO)

    @property
    def tiles(self) -> int:
        """Macro tiles in all."""
        return self.tile_columns * -(-self.cells[1] // MACRO)

    @property
    def capacity(self) -> int:
        """Capacity in records: around the seam of a LiDAR's turn a Gaussian has two."""
        most = BLOCK * (2 if self.view.grid.kind == LIDAR_GRID else 1)
        return most * sum(len(blocks) for _, blocks in self.layers) + LANES

    @property
    def scratch_bytes(self) -> int:
        """About how much memory it takes on its way: planes, records, and what sorting them takes."""
        width, height = self.cells
        planes, normal = (9, 16) if self.output_kind == NORMALS else (6, 0)
        return 4 * planes * width * height + (4 * RECORD + 44 + normal) * self.capacity


def draw(pictures: Sequence[Picture], workers: Workers) -> list[Float32[np.ndarray, "p h w"]]:
    """Blended planes of each picture, see ``draw.draw_tiles``; their sides are rounded up to whole blocks."""
    bin_pictures(pictures, workers)
    results, counts = [], []
    calls: list[tuple] = []
    with _timed("blend", pictures):
        for picture in pictures:
            planes, rays, normals = _empty_planes(picture), sensor_rays(picture), _record_normals(picture)
            results.append(planes)
            for tiles in tile_ranges(picture, workers.threads):
                done = np.zeros(1, np.int64)
                counts.append((picture, done))
                if picture.output_kind == LIDAR:
                    calls.append((draw_beams, rays, picture.projected, picture.binned, tiles, planes, done))
                    continue
                calls.append((draw_tiles, rays.mode, picture.output_kind, rays, picture.projected, picture.binned,
                              normals, tiles, planes, done))  # fmt: skip
        workers.run_calls(calls)
    for picture, done in counts:
        picture.stats.evaluations += int(done[0])
    return results


def bin_pictures(pictures: Sequence[Picture], workers: Workers) -> None:
    """All stages before blending: fill in the pictures' records and the lists of their macro tiles."""
    with _timed("project", pictures):
        _project(pictures, workers)
    with _timed("bin", pictures):
        _bin(pictures, workers)


def tile_ranges(picture: Picture, threads: int) -> list[Int64[np.ndarray, " t"]]:
    """Runs of neighbouring macro tiles, which share records, of about equal work."""
    # What a tile costs besides its pairs counts as 8 of them.
    work = np.cumsum(np.diff(picture.binned.starts) + 8)
    parts = max(threads * SPLIT if threads > 1 else 1, int(-(-work[-1] // SLICE_PAIRS)))
    cuts = np.searchsorted(work, np.linspace(0, work[-1], parts + 1)[1:-1])
    return [tiles for tiles in np.split(np.arange(picture.tiles), cuts) if len(tiles)]


def sensor_rays(picture: Picture) -> SensorRays:
    """A picture's rays as the blending kernels find them."""
    view, grid, rays = picture.view, picture.view.grid, picture.rays
    return SensorRays(view.projection_mode, grid.intrinsics, rays.table, rays.line, rays.basis, view.turns, view.places,
                      view.motion, np.float32(grid.near_m), *picture.cells)  # fmt: skip


def _record_normals(picture: Picture) -> Float32[np.ndarray, "n 4"]:
    """Room for a normal per record; a single one where normals are not requested."""
    if picture.output_kind == NORMALS:
        return picture.scratch("normals", (picture.capacity, 4), np.float32)
    return picture.scratch("no normals", (1, 4), np.float32)


def _empty_planes(picture: Picture) -> Float32[np.ndarray, "p h w"]:
    width, height = (-(-cells // MACRO) * MACRO for cells in picture.cells)
    return np.empty((9 if picture.output_kind == NORMALS else 6, height, width), np.float32)


def _project(pictures: Sequence[Picture], workers: Workers) -> None:
    calls: list[tuple] = []
    owners = []
    for picture in pictures:
        view, grid = picture.view, picture.view.grid
        most, capacity = BLOCK * (2 if grid.kind == LIDAR_GRID else 1), picture.capacity
        output = picture.projected = Projected(
            picture.scratch("records", (capacity, RECORD), np.float32),
            picture.scratch("keys", (capacity,), np.float32),
            picture.scratch("spans", (capacity, 4), np.int16),
            picture.scratch("sources", (capacity,), np.int32),
        )
        path = LinePath(view.lines, view.steps)
        picture.runs, base = [], 0
        for number, (layer, blocks) in enumerate(picture.layers):
            chosen = LayerBlocks(layer.fields, layer.sh_rest, blocks)
            for first, last in workers.ranges(len(blocks), 4, SLICE_BLOCKS):
                what = (chosen, first, last, view.parameters)
                if view.projection_mode in (AFFINE, ROLLING):
                    calls.append((project_pinhole, *what, view.ends, view.motion, output, base))
                else:
                    is_lidar = picture.output_kind == LIDAR
                    calls.append((project_general, *what, is_lidar, grid.chart, path, output, base))
                owners.append((picture, number, base))
                # A range writes into rows of its own, whatever it finds; ``runs`` records how many of them it used.
                base += most * (last - first)
    for (picture, number, base), count in zip(owners, workers.run_calls(calls), strict=True):
        picture.runs.append((number, base, int(count)))
    shading = [
        (record_normals, layer.fields, picture.projected.sources, first, count, view_eye(picture),
         _record_normals(picture))
        for picture in pictures if picture.output_kind == NORMALS
        for number, first, count in picture.runs for layer in [picture.layers[number][0]]
    ]  # fmt: skip
    workers.run_calls(shading)


def view_eye(picture: Picture) -> np.ndarray:
    """The reference point in the world."""
    return picture.view.world_from_reference[:3, 3].copy()


def _bin(pictures: Sequence[Picture], workers: Workers) -> None:
    counts = [np.zeros((len(picture.runs), picture.tiles), np.int64) for picture in pictures]
    workers.run_calls(
        [(count_tiles, picture.projected.spans, first, first + many, picture.tile_columns, count[k])
         for picture, count in zip(pictures, counts, strict=True)
         for k, (_, first, many) in enumerate(picture.runs)],
    )  # fmt: skip
    calls = []
    for picture, count in zip(pictures, counts, strict=True):
        # Each run fills its own part of every tile's list, so that runs can be handed out side by side.
        starts = np.zeros(picture.tiles + 1, np.int64)
        np.cumsum(count.sum(axis=0), out=starts[1:])
        position = starts[:-1] + np.cumsum(count, axis=0) - count
        picture.stats.visible, picture.stats.pairs = sum(many for _, _, many in picture.runs), int(starts[-1])
        items = picture.scratch("items", (picture.stats.pairs,), np.uint64)
        lists = picture.scratch("lists", (picture.stats.pairs + LANES,), np.int32)
        picture.binned = TileLists(starts, items, lists)
        made = picture.projected
        calls += [
            (fill_tiles, made.spans, made.keys, first, first + many, picture.tile_columns, position[k], items)
            for k, (_, first, many) in enumerate(picture.runs)
        ]
    workers.run_calls(calls)


@contextmanager
def _timed(stage: str, pictures: Sequence[Picture]) -> Iterator[None]:
    began = time.perf_counter()
    yield
    for picture in pictures:
        picture.stats.seconds[stage] = time.perf_counter() - began


def blocks_in_view(view: ExposureView, layer: PackedGaussians) -> Int64[np.ndarray, " b"]:
    """Blocks whose sphere meets the cone of the grid's rays, widened by the sensor's own motion."""
    if view.grid.field_cos <= -1.0 or len(layer) == 0:
        return np.arange(len(layer))
    axis = view.world_from_reference[:3, 2]
    offset = layer.block_centre - view.world_from_reference[:3, 3]
    distance = np.linalg.norm(offset, axis=1)
    radius = layer.block_radius + view.travel_m
    # A sphere meets the cone where its angle off the axis is at most the cone's half angle and its own angular radius;
    # 0.02 rad allow for float32 in the kernels.
    angle = np.arccos(np.clip(offset @ axis / np.maximum(distance, 1e-9), -1, 1))
    reach = np.arcsin(np.clip(radius / np.maximum(distance, 1e-9), 0, 1))
    field = np.arccos(view.grid.field_cos) + view.swing_rad + 0.02
    return np.flatnonzero((distance <= radius) | (angle <= field + reach))
