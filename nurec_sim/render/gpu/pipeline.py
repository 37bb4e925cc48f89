"""The stages of a batch on the device: cones of rays, projection, tile lists, blending; and the way back.

Blocks of Gaussians that a sensor cannot see are dropped; the others become records, counted first so that each lands
in a place of its own. Records are sorted by depth and handed out to tiles of 16 x 16 rays, these pairs are sorted by
tile, which keeps their order, and each tile is blended front to back. No kernel adds up in an order that may vary, so
the same input gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from nurec_sim.render.cpu.pack import BLOCK, PackedGaussians
from nurec_sim.render.gpu.batch import Batch
from nurec_sim.render.gpu.launcher import THREADS, Launcher
from nurec_sim.render.merging import GROUP

T = TypeVar("T")

if TYPE_CHECKING:
    import torch

# Sizes of structs in kernels/view.cuh, in 4-byte words, and what else the kernels agree on.
RECORD, SPAN, CONE, CONES = 24, 8, 8, 9
SPHERE = 6
PLANES = 10
FEATURES, DISTANCE, ALPHA, HALF = 0, 3, 4, 5
SUMS, GRADIENTS = 16, 14
WARPS = 8
MOST_NARROW = 0xFFFF
"""Maximum number of tiles for which pairs are sorted by 16 bits."""
MOST_KINDS = 64
FIRST_RECORDS, PAIRS_PER_RECORD = 1 << 18, 4
"""Room for records at first, at most, and for how many pairs per record."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """Packed Gaussians on the device: ``fields`` [b,21,256], ``sh_rest`` [b,3k,256] or [0,0,0], ``spheres`` [b,6].

    A sphere is centre, radius, error and parent (``Sphere`` of ``kernels/view.cuh``).
    """

    fields: torch.Tensor
    sh_rest: torch.Tensor
    spheres: torch.Tensor

    def __len__(self) -> int:
        return len(self.fields)

    @classmethod
    def of(cls, levels: Sequence[tuple[PackedGaussians, np.ndarray]], device: torch.device) -> Blocks:
        """Packed Gaussians, copied to a device.

        Args:
            levels: of detail from fine to coarse, and the errors in metres of their blocks: block k of a level stands
                for blocks 4 k to 4 k + 3 of the level before (``render.lod``).
            device: where to.
        """
        import torch

        spheres = np.zeros((sum(len(packed.fields) for packed, _ in levels), SPHERE), np.float32)
        first = 0
        for number, (packed, error_m) in enumerate(levels):
            count = len(packed.fields)
            centre, radius = packed.block_centre, packed.block_radius
            # Room for what float32 loses of large coordinates.
            radius = radius + 1e-3 * radius + 1e-6 * np.abs(centre).sum(axis=1) + 1e-3
            rows = spheres[first : first + count]
            rows[:, :3], rows[:, 3], rows[:, 4] = centre, radius, error_m
            above = first + count + np.arange(count) // GROUP if number + 1 < len(levels) else np.full(count, -1)
            rows[:, 5] = above.astype(np.int32).view(np.float32)
            first += count
        fields, sh_rest = (np.concatenate([getattr(p, name) for p, _ in levels]) for name in ("fields", "sh_rest"))
        return cls(*(torch.from_numpy(np.ascontiguousarray(a)).to(device) for a in (fields, sh_rest, spheres)))

    @classmethod
    def none(cls, device: torch.device) -> Blocks:
        """No Gaussians."""
        import torch

        empty = torch.zeros((0, 0, 0), device=device)
        return cls(empty, empty, empty)


@dataclass(frozen=True)
class Room:
    """For how many records and pairs of a record and a tile a batch has memory.

    The host does not wait for the numbers: what does not fit is left out, and the batch is then rendered again.
    """

    records: int
    pairs: int

    @classmethod
    def first(cls, gaussians: int) -> Room:
        """Of a batch of which nothing is known but the number of Gaussians, over all views."""
        records = max(min(gaussians, FIRST_RECORDS), 1)
        return cls(records, PAIRS_PER_RECORD * records)

    def holds(self, totals: np.ndarray) -> bool:
        """Whether as many records and pairs fit."""
        return bool(totals[0] <= self.records and totals[1] <= self.pairs)

    def grown(self, totals: np.ndarray) -> Room:
        """A quarter more than was needed, where the room did not suffice."""
        records, pairs = (int(total) * 5 // 4 + 1024 for total in totals)
        return Room(max(self.records, records) if totals[0] > self.records else self.records,
                    max(self.pairs, pairs) if totals[1] > self.pairs else self.pairs)  # fmt: skip


class Rooms:
    """The room that batches of each kind needed so far; safe to use from many threads."""

    def __init__(self) -> None:
        self._known: dict[Hashable, Room] = {}

    def until_it_fits(self, kind: Hashable, first: Room, attempt: Callable[[Room], tuple[np.ndarray, T]]) -> T:
        """The result of the first attempt that fits.

        Args:
            kind: what batches of about the same needs have in common.
            first: room for the first batch of its kind.
            attempt: takes the room, and returns the numbers of records and pairs beside its result.
        """
        room = self._known.get(kind, first)
        while True:
            totals, result = attempt(room)
            if room.holds(totals):
                return result
            if len(self._known) >= MOST_KINDS:
                self._known.clear()
            room = self._known[kind] = room.grown(totals)


@dataclass(frozen=True, eq=False)
class Drawn:
    """The results of a batch and its intermediate arrays.

    ``planes`` [10,rays] are features, distance, alpha, half, normal and label. ``row_records``
    [views,rows] (with ``keep_rows``) is the record of each Gaussian in each view, -1 where it has none. ``order`` lists
    the records front to back; ``tile_counts`` and ``tile_ends`` are, in that order, their numbers of tiles and the
    running sum; ``slots`` is the number of the pair in that order for each entry of ``lists``. The list of tile k
    begins at ``starts[k]``. ``totals`` are the numbers of records and of pairs.
    """

    planes: torch.Tensor
    cones: torch.Tensor
    records: torch.Tensor
    order: torch.Tensor
    tile_counts: torch.Tensor
    tile_ends: torch.Tensor
    lists: torch.Tensor
    starts: torch.Tensor
    slots: torch.Tensor
    row_records: torch.Tensor | None
    totals: torch.Tensor
    tile_view: torch.Tensor


def draw(
    launcher: Launcher, batch: Batch, static: Blocks, moving: Blocks, room: Room, keep_rows: bool = False
) -> Drawn:
    """Blend what the sensors of a batch see, without waiting for the device.

    Args:
        launcher: runs the kernels.
        batch: the sensors.
        static: Gaussians that all of them see.
        moving: those of each, ``batch.moving_blocks`` per sensor.
        room: for how many records and pairs there is memory.
        keep_rows: whether to keep what ``draw_backward`` needs.
    """
    import torch

    device, tiles, views = launcher.device, batch.tile_count, batch.view_count

    def empty(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.empty(shape, dtype=dtype, device=device)

    tile_view, cones = empty(tiles, dtype=torch.int32), empty(tiles * CONES, CONE)
    launcher.launch("gather_cones", (tiles, 1), batch.views, views, tile_view, cones)

    # Records of what can be seen.
    blocks = len(static) + batch.moving_blocks
    slots = views * blocks
    layers = (batch.views, len(static), static.fields, moving.fields, static.spheres)
    counts = empty(slots, dtype=torch.int32)
    launcher.launch("count_visible", (blocks, views), *layers, counts)
    # Counting first gives every block a fixed range of rows: no atomics, and the same bytes every time.
    ends = launcher.running_sum(counts)
    records, spans = empty(room.records, RECORD), empty(room.records, SPAN, dtype=torch.int32)
    depths = empty(room.records, dtype=torch.int32)
    row_records = torch.full((views, blocks * BLOCK), -1, dtype=torch.int32, device=device) if keep_rows else None
    launcher.launch(
        "project", (blocks, views), *layers, static.sh_rest, static.sh_rest.shape[1] // 3, ends, counts, room.records,
        records, spans, depths, row_records,
    )  # fmt: skip
    launcher.launch("pad_depths", (-(-room.records // THREADS), 1), ends, slots, room.records, depths)

    # Pairs of a tile and a record: made front to back, then sorted by tile, which keeps that order.
    _, order = launcher.sort(depths)
    tile_counts = empty(room.records, dtype=torch.int32)
    found = (batch.views, records, spans, cones, order, ends, slots, room.records, tile_counts)
    grid = (-(-room.records // WARPS), 1)
    launcher.launch("count_tiles", grid, *found)
    tile_ends = launcher.running_sum(tile_counts)
    # Radix sorts cost by the bits of their keys.
    narrow = int(tiles <= MOST_NARROW)
    keys = empty(room.pairs, dtype=torch.int16 if narrow else torch.int32)
    owners = empty(room.pairs, dtype=torch.int32)
    launcher.launch("fill_tiles", grid, *found, tile_ends, room.pairs, narrow, keys, owners)
    pairs_grid = (-(-room.pairs // THREADS), 1)
    launcher.launch("pad_pairs", pairs_grid, tile_ends, room.records, room.pairs, narrow, tiles, keys)
    keys, places = launcher.sort(keys)
    lists, starts = empty(room.pairs, dtype=torch.int32), empty(tiles + 1, dtype=torch.int64)
    totals = empty(2, dtype=torch.int64)
    launcher.launch(
        "list_tiles", (-(-max(room.pairs, tiles + 1) // THREADS), 1), keys, narrow, places, owners, tiles, ends, slots,
        tile_ends, room.records, room.pairs, lists, starts, totals,
    )  # fmt: skip

    planes = empty(PLANES, batch.ray_count)
    launcher.launch(
        "blend", (tiles, 1), batch.views, tile_view, cones, records, lists, starts, np.int64(batch.ray_count), planes
    )
    return Drawn(
        planes, cones, records, order, tile_counts, tile_ends, lists, starts, places, row_records, totals, tile_view
    )


def draw_backward(
    launcher: Launcher, batch: Batch, static: Blocks, drawn: Drawn, plane_grads: torch.Tensor, each_view: bool = False
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Gradients of the packed Gaussians.

    Args:
        launcher: of the forward pass.
        batch: of the forward pass.
        static: of the forward pass.
        drawn: what it left, with ``keep_rows``.
        plane_grads: [6,rays], the loss' gradients of features, distance, alpha and half.
        each_view: whether to return the share of each view, too.

    Returns:
        [14,rows]: of mean (world), unit quaternion, scale, log opacity and the three features. Then the same of each
        view alone, with ``each_view``.
    """
    import torch

    device, tiles, views = launcher.device, batch.tile_count, batch.view_count
    assert drawn.row_records is not None
    sums = torch.zeros((len(drawn.lists), SUMS), device=device)
    launcher.launch(
        "blend_backward", (tiles, 1), batch.views, drawn.tile_view, drawn.cones, drawn.records, drawn.lists,
        drawn.starts, drawn.slots, np.int64(batch.ray_count), drawn.planes, plane_grads.contiguous(), sums,
    )  # fmt: skip

    place_of_record = torch.empty_like(drawn.order)
    # Inverse of the permutation by depth.
    place_of_record[drawn.order] = torch.arange(len(drawn.order), device=device)

    def of_views(first: int, last: int) -> torch.Tensor:
        gradients = torch.empty((GRADIENTS, len(static) * BLOCK), device=device)
        launcher.launch(
            "project_backward", (len(static), 1), batch.views, first, last, static.fields, drawn.row_records,
            place_of_record, drawn.tile_counts, drawn.tile_ends, sums, gradients,
        )  # fmt: skip
        return gradients

    # Pose gradients need each view's share; with a single view it is also the total.
    by_view = [of_views(k, k + 1) for k in range(views)] if each_view else []
    return by_view[0] if each_view and views == 1 else of_views(0, views), by_view
