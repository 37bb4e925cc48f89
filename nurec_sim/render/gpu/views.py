"""Sensors as the kernels read them: one ``View`` each (``kernels/view.cuh``).

A sensor that moves during its exposure does so at constant speed and turn rate, so six numbers and an instant per ray
determine where each ray starts and points; nothing is approximated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nurec_sim.render.cpu.grid import LENS, LIDAR, Grid
from nurec_sim.render.cpu.project.charts import (
    AZIMUTH,
    LEAST_AHEAD,
    MIDDLE,
    MISFIT,
    MOST_AHEAD,
    PER_RADIAN,
    PERIOD,
    TEXELS,
)
from nurec_sim.render.lod import ray_spacing

if TYPE_CHECKING:
    import torch

TILE = 16
"""Side of a tile in cells."""

_POINTER = np.dtype(np.uint64)
VIEW = np.dtype(
    [
        ("eye", np.float64, 3),
        ("reference", np.float64),
        ("instant_us", np.int64),
        ("rays", _POINTER),
        ("table", _POINTER),
        ("sky", _POINTER),
        ("beam", _POINTER),
        ("turn", np.float32, 9),
        ("travel", np.float32, 3),
        ("swing", np.float32, 3),
        ("params", np.float32, 5),
        ("isp", np.float32, 12),
        ("end_from_reference", np.float32, 12),
        ("range_m", np.float32, 2),
        ("detail", np.float32),
        ("near_m", np.float32),
        ("field_cos", np.float32),
        *((name, np.int32) for name in (
            "kind", "columns", "rows", "tile_columns", "tile_rows", "first_tile", "first_ray", "table_size", "sky_size",
            "by_range", "intensity", "moving", "first_block", "blocks",
        )),
    ],
    align=True,
)  # fmt: skip
"""The struct ``View`` of ``kernels/view.cuh``, field by field."""


@dataclass(frozen=True, eq=False)
class GridTensors:
    """A sensor's grid of rays on the device; immutable.

    ``rays`` [h,w,4] holds unit directions in the sensor (zero where there is no ray) and the instant of each ray, in
    exposures after the reference instant. ``table`` leads from directions to places: [s,s,2] of a lens, [t] of a LiDAR.
    ``row`` are the bytes of a ``VIEW`` with all that depends on the sensor alone.
    """

    grid: Grid
    rays: torch.Tensor
    table: torch.Tensor
    beam: torch.Tensor
    row: bytes

    @classmethod
    def of(cls, grid: Grid, device: torch.device) -> GridTensors:
        """A grid's tables, copied to a device."""
        import torch

        instant = grid.line_fraction[grid.line] - grid.reference
        direction = np.where(grid.valid[..., None] != 0, grid.direction, 0)
        rays = np.concatenate([direction, instant[..., None]], axis=-1).astype(np.float32)
        beam = np.zeros(1, np.int32) if grid.beam is None else grid.beam
        table, params = np.zeros(1, np.float32), grid.intrinsics
        if grid.kind == LENS:
            table, params = grid.chart.places[..., :2], grid.chart.params[[TEXELS, MIDDLE, MISFIT]]
        elif grid.kind == LIDAR:
            table = grid.chart.places.reshape(-1)
            params = grid.chart.params[[PER_RADIAN, AZIMUTH, PERIOD, LEAST_AHEAD, MOST_AHEAD]]
        tensors = [torch.from_numpy(np.ascontiguousarray(array)).to(device) for array in (rays, table, beam)]
        row = np.zeros(1, VIEW)
        row["rays"], row["table"], row["beam"] = (tensor.data_ptr() for tensor in tensors)
        row["params"][0, : len(params)] = params
        row["isp"] = np.eye(3, 4).ravel()
        height, width = grid.valid.shape
        row["rows"], row["columns"] = height, width
        row["tile_rows"], row["tile_columns"] = -(-height // TILE), -(-width // TILE)
        row["table_size"], row["reference"], row["detail"] = len(table), grid.reference, ray_spacing(grid.direction)
        row["near_m"], row["field_cos"], row["by_range"] = grid.near_m, grid.field_cos, grid.by_range
        row["kind"], row["intensity"] = grid.kind, grid.kind == LIDAR
        # Where all rays have one instant, only the pose at that instant matters.
        row["moving"] = np.any(instant != 0)
        return cls(grid, tensors[0], tensors[1], tensors[2], row.tobytes())


def view_rows(tensors: Sequence[GridTensors]) -> np.ndarray:
    """A ``VIEW`` per sensor, [n], all but what follows from its poses (``kernels/views.cu``)."""
    rows = np.frombuffer(b"".join([sensor.row for sensor in tensors]), VIEW).copy()
    cells, tiles = rows["rows"] * rows["columns"], rows["tile_rows"] * rows["tile_columns"]
    rows["first_ray"], rows["first_tile"] = np.cumsum(cells) - cells, np.cumsum(tiles) - tiles
    return rows
