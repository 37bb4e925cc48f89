"""The sensors of a batch as the kernels read them: one ``View`` each (``kernels/view.cuh``), one list of tiles for all.

A sensor that moves during its exposure does so at constant speed and turn rate, so six numbers and an instant per ray
say where each ray starts and points; nothing is approximated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, Float64

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

if TYPE_CHECKING:
    import torch

TILE = 16
"""Side of a tile in cells."""

_POINTER = np.dtype(np.uint64)
VIEW = np.dtype(
    [
        ("eye", np.float64, 3),
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
    exposures after the reference instant. ``table`` leads from directions to places: [s,s,2] of a lens, [t] of a LiDAR;
    ``params`` are its parameters (``kernels/bounds.cuh``).
    """

    grid: Grid
    rays: torch.Tensor
    table: torch.Tensor
    params: Float32[np.ndarray, " p"]
    beam: torch.Tensor
    timed: bool

    @classmethod
    def of(cls, grid: Grid, device: torch.device) -> GridTensors:
        """A grid's tables, copied to a device."""
        import torch

        instant = grid.line_fraction[grid.line] - grid.reference
        direction = np.where(grid.valid[..., None] != 0, grid.direction, 0)
        rays = np.concatenate([direction, instant[..., None]], axis=-1).astype(np.float32)
        beam = np.zeros(1, np.int32) if grid.beam is None else grid.beam

        def on_device(array: np.ndarray) -> torch.Tensor:
            return torch.from_numpy(np.ascontiguousarray(array)).to(device)

        table, params = np.zeros(1, np.float32), grid.intrinsics
        if grid.kind == LENS:
            table, params = grid.chart.places[..., :2], grid.chart.params[[TEXELS, MIDDLE, MISFIT]]
        elif grid.kind == LIDAR:
            table = grid.chart.places.reshape(-1)
            params = grid.chart.params[[PER_RADIAN, AZIMUTH, PERIOD, LEAST_AHEAD, MOST_AHEAD]]
        timed = bool(np.any(instant != 0))
        return cls(grid, on_device(rays), on_device(table), params, on_device(beam), timed)


@dataclass(frozen=True, eq=False)
class SensorView:
    """One sensor of a batch: its grid, its poses at both ends of the exposure, and its share of the moving layer."""

    tensors: GridTensors
    world_from_sensor: Float64[np.ndarray, "2 4 4"]
    isp: Float32[np.ndarray, "3 4"] | None = None
    first_block: int = 0
    blocks: int = 0


@dataclass(frozen=True, eq=False)
class Batch:
    """Sensors that are drawn together; their rays and tiles are numbered on.

    ``views`` holds the bytes of one ``VIEW`` each, ``tile_view`` the sensor of each tile; the rays of sensor k begin at
    ``first_ray[k]``, the last entry is ``ray_count``. Each sensor has at most ``moving_blocks`` of the moving layer.
    """

    sensors: Sequence[SensorView]
    views: torch.Tensor
    tile_view: torch.Tensor
    first_ray: np.ndarray
    ray_count: int
    moving_blocks: int
    keep: tuple[torch.Tensor, ...]
    """Tensors whose addresses ``views`` holds."""

    @property
    def largest_grid(self) -> int:
        """Cells of the largest sensor."""
        return int(np.diff(self.first_ray).max())


def make_batch(sensors: Sequence[SensorView], sky: torch.Tensor) -> Batch:
    """Put sensors together; ``sky`` [6,s,s,3] float32 lies on their device."""
    import torch

    rows = np.zeros(len(sensors), VIEW)
    cells: list[int] = []
    tiles: list[int] = []
    for row, sensor in zip(rows, sensors, strict=True):
        row["first_ray"], row["first_tile"] = sum(cells), sum(tiles)
        _fill(row, sensor)
        row["sky"], row["sky_size"] = sky.data_ptr(), sky.shape[1]
        cells.append(int(row["rows"]) * int(row["columns"]))
        tiles.append(int(row["tile_rows"]) * int(row["tile_columns"]))
    device = sky.device
    return Batch(
        sensors=sensors,
        views=torch.from_numpy(rows.view(np.uint8).copy()).to(device),
        tile_view=torch.from_numpy(np.repeat(np.arange(len(sensors), dtype=np.int32), tiles)).to(device),
        first_ray=np.concatenate([[0], np.cumsum(cells)]),
        ray_count=sum(cells),
        moving_blocks=max(sensor.blocks for sensor in sensors),
        keep=(sky, *(t for s in sensors for t in (s.tensors.rays, s.tensors.table, s.tensors.beam))),
    )


def _fill(row: np.void, sensor: SensorView) -> None:
    """Everything of a view that depends on its sensor alone."""
    tensors, grid = sensor.tensors, sensor.tensors.grid
    pair = np.asarray(sensor.world_from_sensor, np.float64)
    world_from_reference = geometry.interpolate_pose_pair(pair, np.array(grid.reference))
    rotation = world_from_reference[:3, :3]
    row["moving"] = tensors.timed and not np.array_equal(pair[0], pair[1])
    if row["moving"]:
        row["travel"] = rotation.T @ (pair[1, :3, 3] - pair[0, :3, 3])
        row["swing"] = rotation_vector(pair[0, :3, :3].T @ pair[1, :3, :3])
    row["eye"], row["turn"] = world_from_reference[:3, 3], rotation.T.ravel()
    row["end_from_reference"] = (geometry.inverse(pair[1]) @ world_from_reference)[:3].ravel()
    row["rays"], row["table"], row["beam"] = (t.data_ptr() for t in (tensors.rays, tensors.table, tensors.beam))
    row["params"][: len(tensors.params)] = tensors.params
    row["isp"] = (np.eye(3, 4) if sensor.isp is None else sensor.isp).ravel()
    height, width = grid.valid.shape
    row["rows"], row["columns"] = height, width
    row["tile_rows"], row["tile_columns"] = -(-height // TILE), -(-width // TILE)
    row["table_size"] = len(tensors.table)
    row["near_m"], row["field_cos"], row["by_range"] = grid.near_m, grid.field_cos, grid.by_range
    row["kind"], row["intensity"] = grid.kind, grid.kind == LIDAR
    row["first_block"], row["blocks"] = sensor.first_block, sensor.blocks


def rotation_vector(rotation: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, " 3"]:
    """Axis times angle (at most pi) of a rotation matrix."""
    quat = geometry.quat_from_matrix(rotation)
    sine = np.linalg.norm(quat[1:])
    return quat[1:] * (2 * np.arctan2(sine, quat[0]) / sine if sine > 1e-12 else 2.0)
