"""The sensors of a batch on the device: their views, placed by a kernel, and one list of tiles for all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from nurec_sim.render.gpu.launcher import THREADS, Launcher
from nurec_sim.render.gpu.views import GridTensors

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, eq=False)
class Batch:
    """Sensors that are rendered together; their rays and tiles are numbered consecutively.

    ``views`` holds the bytes of one ``VIEW`` each; the rays of sensor k begin at ``first_ray[k]``, the last entry is
    ``ray_count``. Each sensor has ``moving_blocks`` of the moving layer. ``largest_grid`` are the cells of the largest
    sensor.
    """

    views: torch.Tensor
    first_ray: np.ndarray
    view_count: int
    ray_count: int
    tile_count: int
    largest_grid: int
    moving_blocks: int
    keep: tuple[Any, ...]
    """What owns the tensors whose addresses ``views`` holds."""


def make_batch(
    launcher: Launcher,
    tensors: Sequence[GridTensors],
    rows: np.ndarray,
    views: torch.Tensor,
    pairs: torch.Tensor,
    sky: torch.Tensor,
    moving_blocks: int = 0,
) -> Batch:
    """Put sensors together, at their poses.

    Args:
        launcher: runs the kernel that fills in the poses.
        tensors: tables of the sensors.
        rows: their views, ``view_rows``, with the sky's address.
        views: the bytes of these on the device.
        pairs: [n,2,4,4] float64 on the device, ``world_from_sensor`` at both ends of each exposure.
        sky: [6,s,s,3] float32 on their device.
        moving_blocks: of the moving layer, per sensor.
    """
    launcher.launch("place_views", (-(-len(rows) // THREADS), 1), pairs, len(rows), views)
    cells = rows["rows"] * rows["columns"]
    first_ray = np.append(rows["first_ray"], cells[-1] + rows["first_ray"][-1]).astype(np.int64)
    tile_count = int(rows["first_tile"][-1] + rows["tile_rows"][-1] * rows["tile_columns"][-1])
    return Batch(views, first_ray, len(rows), int(first_ray[-1]), tile_count, int(cells.max()), moving_blocks,
                 (*tensors, sky))  # fmt: skip
