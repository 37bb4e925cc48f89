"""The sensors of a batch as the kernels read them: one ``View`` each (``kernels/view.cuh``), one list of tiles for all.

A sensor that moves during its exposure does so at constant speed and turn rate, so six numbers and an instant per ray
determine where each ray starts and points; nothing is approximated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry
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
    timed: bool
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
        return cls(grid, tensors[0], tensors[1], tensors[2], bool(np.any(instant != 0)), row.tobytes())


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


def view_rows(tensors: Sequence[GridTensors], world_from_sensor: Float64[np.ndarray, "n 2 4 4"]) -> np.ndarray:
    """A ``VIEW`` per sensor at its poses at both ends of the exposure, [n]."""
    rows = np.frombuffer(b"".join([sensor.row for sensor in tensors]), VIEW).copy()
    start, end = world_from_sensor[:, 0], world_from_sensor[:, 1]
    reference = geometry.interpolate_pose_pairs(world_from_sensor, rows["reference"])
    turn = reference[:, :3, :3].transpose(0, 2, 1)
    rows["eye"], rows["turn"] = reference[:, :3, 3], turn.reshape(-1, 9)
    # Sweeps report points in the sensor's frame at the end of the exposure.
    rows["end_from_reference"] = (geometry.inverse(end) @ reference)[:, :3].reshape(-1, 12)
    moving = np.array([sensor.timed for sensor in tensors]) & (start != end).any(axis=(1, 2))
    rows["moving"] = moving
    if moving.any():
        shift = (end - start)[moving, :3, 3]
        rows["travel"][moving] = (turn[moving] @ shift[:, :, None])[:, :, 0]
        # In the sensor's own frame, in which the axis of a constant turn is fixed.
        rows["swing"][moving] = rotation_vector(start[moving, :3, :3].transpose(0, 2, 1) @ end[moving, :3, :3])
    cells, tiles = rows["rows"] * rows["columns"], rows["tile_rows"] * rows["tile_columns"]
    rows["first_ray"], rows["first_tile"] = np.cumsum(cells) - cells, np.cumsum(tiles) - tiles
    return rows


def make_batch(
    tensors: Sequence[GridTensors], rows: np.ndarray, views: torch.Tensor, sky: torch.Tensor, moving_blocks: int = 0
) -> Batch:
    """Put sensors together.

    Args:
        tensors: their tables.
        rows: their views, ``view_rows``, with the sky's address.
        views: the bytes of these on the device.
        sky: [6,s,s,3] float32 on their device.
        moving_blocks: of the moving layer, per sensor.
    """
    cells = rows["rows"] * rows["columns"]
    first_ray = np.append(rows["first_ray"], cells[-1] + rows["first_ray"][-1]).astype(np.int64)
    tile_count = int(rows["first_tile"][-1] + rows["tile_rows"][-1] * rows["tile_columns"][-1])
    return Batch(views, first_ray, len(rows), int(first_ray[-1]), tile_count, int(cells.max()), moving_blocks,
                 (*tensors, sky))  # fmt: skip


def rotation_vector(rotation: Float64[np.ndarray, "*n 3 3"]) -> Float64[np.ndarray, "*n 3"]:
    """Axis times angle (at most pi) of rotation matrices."""
    quat = geometry.quat_from_matrix(rotation)
    sine = np.linalg.norm(quat[..., 1:], axis=-1, keepdims=True)
    small = sine <= 1e-12
    angle = 2 * np.arctan2(sine, quat[..., :1])
    return quat[..., 1:] * np.where(small, 2.0, angle / np.where(small, 1.0, sine))
