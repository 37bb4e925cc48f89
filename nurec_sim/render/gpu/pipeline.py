"""The stages of a batch on the device: cones of rays, projection, tile lists, blending; and the way back.

Blocks of Gaussians that a sensor cannot see are dropped; the others become records, counted first so that each lands
in a place of its own. Records are sorted by depth and handed out to tiles of 16 x 16 rays, these pairs are sorted by
tile, which keeps their order, and each tile is blended front to back. No kernel adds up in an order that may vary, so
the same input gives the same bytes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nurec_sim.render.cpu.pack import BLOCK, PackedGaussians
from nurec_sim.render.gpu.launcher import Launcher
from nurec_sim.render.gpu.views import Batch

if TYPE_CHECKING:
    import torch

# Sizes of structs in kernels/view.cuh, in 4-byte words, and what else the kernels agree on.
RECORD, SPAN, CONE, CONES = 24, 8, 8, 9
PLANES = 10
FEATURES, DISTANCE, ALPHA, HALF = 0, 3, 4, 5
SUMS, GRADIENTS = 16, 14
WARPS = 8
DEPTH_BITS = 5
"""Column of a span: the depth as an integer that sorts like it."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """Packed Gaussians on the device: ``fields`` [b,21,256], ``sh_rest`` [b,3k,256] or [0,0,0], ``spheres`` [b,4]."""

    fields: torch.Tensor
    sh_rest: torch.Tensor
    spheres: torch.Tensor

    def __len__(self) -> int:
        return len(self.fields)

    @classmethod
    def of(cls, packed: PackedGaussians, device: torch.device) -> Blocks:
        """Packed Gaussians, copied to a device."""
        import torch

        spheres = np.concatenate([packed.block_centre, packed.block_radius[:, None]], axis=1)
        # Room for what float32 loses of large coordinates.
        spheres[:, 3] += 1e-3 * spheres[:, 3] + 1e-6 * np.abs(spheres[:, :3]).sum(axis=1) + 1e-3
        arrays = (packed.fields, packed.sh_rest, spheres.astype(np.float32))
        return cls(*(torch.from_numpy(np.ascontiguousarray(array)).to(device) for array in arrays))

    @classmethod
    def none(cls, device: torch.device) -> Blocks:
        """No Gaussians."""
        import torch

        empty = torch.zeros((0, 0, 0), device=device)
        return cls(empty, empty, empty)


@dataclass(frozen=True, eq=False)
class Drawn:
    """What drawing leaves: ``planes`` [10,rays] (features, distance, alpha, half, normal, label) and the way there.

    ``row_records`` [views,rows] (if asked for) is the record of each Gaussian in each view, -1 where it has none.
    ``order`` gives the records front to back; ``tile_counts`` and ``tile_ends`` are, in that order, their numbers of
    tiles and the running sum; ``slots`` says which of these pairs each entry of ``lists`` is. The list of tile k begins
    at ``starts[k]``.
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


def draw(launcher: Launcher, batch: Batch, static: Blocks, moving: Blocks, keep_rows: bool = False) -> Drawn:
    """Blend what the sensors of a batch see; ``keep_rows`` keeps what ``draw_backward`` needs."""
    import torch

    device, tiles = launcher.device, len(batch.tile_view)

    def empty(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.empty(shape, dtype=dtype, device=device)

    cones = empty(tiles * CONES, CONE)
    launcher.launch("gather_cones", (tiles, 1), batch.views, batch.tile_view, cones)

    # Records of what can be seen.
    views, blocks = len(batch.sensors), len(static) + batch.moving_blocks
    layers = (batch.views, len(static), static.fields, moving.fields, static.spheres)
    counts = torch.zeros(views * blocks, dtype=torch.int32, device=device)
    launcher.launch("count_visible", (blocks, views), *layers, counts)
    ends = torch.cumsum(counts, 0, dtype=torch.int64)
    seen = int(ends[-1]) if len(ends) else 0
    records, spans = empty(seen, RECORD), empty(seen, SPAN, dtype=torch.int32)
    row_records = torch.full((views, blocks * BLOCK), -1, dtype=torch.int32, device=device) if keep_rows else None
    launcher.launch(
        "project", (blocks, views) if seen else (0, 0), *layers, static.sh_rest, static.sh_rest.shape[1] // 3, ends,
        counts, records, spans, row_records,
    )  # fmt: skip

    # Pairs of a tile and a record: made front to back, then sorted by tile, which keeps that order.
    order = torch.sort(spans[:, DEPTH_BITS].contiguous(), stable=True)[1]
    tile_counts = empty(seen, dtype=torch.int32)
    found = (batch.views, records, spans, cones, order, seen, tile_counts)
    grid = (-(-seen // WARPS), 1)
    launcher.launch("count_tiles", grid, *found)
    tile_ends = torch.cumsum(tile_counts, 0, dtype=torch.int64)
    pairs = int(tile_ends[-1]) if seen else 0
    pair_tiles, owners = empty(pairs, dtype=torch.int32), empty(pairs, dtype=torch.int32)
    launcher.launch("fill_tiles", grid, *found, tile_ends, pair_tiles, owners)
    pair_tiles, slots = torch.sort(pair_tiles, stable=True)
    lists = owners[slots]
    starts = torch.searchsorted(pair_tiles, torch.arange(tiles + 1, dtype=torch.int32, device=device))

    planes = empty(PLANES, batch.ray_count)
    launcher.launch(
        "blend", (tiles, 1), batch.views, batch.tile_view, cones, records, lists, starts, np.int64(batch.ray_count),
        planes,
    )  # fmt: skip
    return Drawn(planes, cones, records, order, tile_counts, tile_ends, lists, starts, slots, row_records)


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
        each_view: whether to give what each view adds, too.

    Returns:
        [14,rows]: of mean (world), unit quaternion, scale, log opacity and the three features. Then the same of each
        view alone, if asked for.
    """
    import torch

    device, tiles, views = launcher.device, len(batch.tile_view), len(batch.sensors)
    assert drawn.row_records is not None
    sums = torch.zeros((len(drawn.lists), SUMS), device=device)
    launcher.launch(
        "blend_backward", (tiles, 1), batch.views, batch.tile_view, drawn.cones, drawn.records, drawn.lists,
        drawn.starts, drawn.slots, np.int64(batch.ray_count), drawn.planes, plane_grads.contiguous(), sums,
    )  # fmt: skip

    place_of_record = torch.empty_like(drawn.order)
    place_of_record[drawn.order] = torch.arange(len(drawn.order), device=device)

    def of_views(first: int, last: int) -> torch.Tensor:
        gradients = torch.empty((GRADIENTS, len(static) * BLOCK), device=device)
        launcher.launch(
            "project_backward", (len(static), 1), batch.views, first, last, static.fields, drawn.row_records,
            place_of_record, drawn.tile_counts, drawn.tile_ends, sums, gradients,
        )  # fmt: skip
        return gradients

    by_view = [of_views(k, k + 1) for k in range(views)] if each_view else []
    return by_view[0] if each_view and views == 1 else of_views(0, views), by_view
