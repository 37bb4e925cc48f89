"""A sensor's ray grid as the kernels read it: float32 rays, lines of equal time, a chart from direction to place.

A place is (column, row) with cell centres at +0.5. A *line* is a set of rays fired at one instant (an image row or
column, a LiDAR column). Charts are only used to bound where a Gaussian can be seen, never to weigh it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32

from nurec_sim import sensors
from nurec_sim.render.cpu.project.charts import PARAMETERS, Chart, lens_chart, lidar_chart
from nurec_sim.render.rays import NEAR_M, line_fractions, ray_grid, reference_fraction
from nurec_sim.types import CameraModel, LidarModel, Shutter, Spin

PINHOLE, LENS, LIDAR = 0, 1, 2
NO_CHART = Chart(np.zeros(PARAMETERS, np.float32), np.zeros((0, 0, 0), np.float32), np.zeros((0, 0, 0), np.float32))


@dataclass(frozen=True, eq=False)
class Grid:
    """One sensor for the kernels; immutable, shared between threads.

    ``intrinsics`` are fx, fy, cx and cy of an ideal pinhole, zeros otherwise.
    LIDAR rows are rolled by whole columns so that a grid column looks in one azimuth.
    """

    kind: int
    direction: Float32[np.ndarray, "h w 3"]
    valid: np.ndarray
    line: Int32[np.ndarray, "h w"]
    line_fraction: np.ndarray
    beam: Int32[np.ndarray, "h w"] | None
    intrinsics: Float32[np.ndarray, " 4"]
    reference: float
    by_range: bool
    near_m: float
    field_cos: float
    """Cosine of the largest angle between a ray and the z axis; -1 for LiDARs."""
    line_axis: int
    """0 where a line is a row, 1 where it is a column."""
    chart: Chart
    """From directions to places; empty for an ideal pinhole with a global shutter."""


def make_grid(sensor: CameraModel | LidarModel) -> Grid:
    """Tables of a sensor (a few to some hundred milliseconds; keep them)."""
    return _lidar_grid(sensor) if isinstance(sensor, LidarModel) else _camera_grid(sensor)


def grid_key(sensor: CameraModel | LidarModel) -> tuple:
    """What a grid depends on, as something hashable."""
    if isinstance(sensor, LidarModel):
        arrays = (sensor.elevation_rad, sensor.azimuth_rad, sensor.row_azimuth_offset_rad)
        return (
            sensor.spin,
            sensor.range_m,
            sensor.blocked.tobytes(),
            *(np.asarray(a, np.float64).tobytes() for a in arrays),
        )
    return (sensor.width_px, sensor.height_px, sensor.lens, sensor.shutter, sensor.windshield)


def _camera_grid(camera: CameraModel) -> Grid:
    height, width = camera.height_px, camera.width_px
    direction, valid = np.empty((height, width, 3), np.float32), np.empty((height, width), np.uint8)
    field_cos = 1.0
    for place, rays, seen in sensors.pixel_ray_strips(camera):
        # Pixels without a ray look along z: finite values that are never shown.
        direction[place], valid[place] = np.where(seen[..., None], rays, (0.0, 0.0, 1.0)), seen
        field_cos = min(field_cos, float(direction[place][..., 2].min()))  # 1 where a pixel has no ray
    fraction, by_column = line_fractions(camera)
    if camera.shutter is Shutter.GLOBAL:
        line, fraction = np.zeros((height, width), np.int32), np.zeros(1)
    else:
        number = np.arange(len(fraction), dtype=np.int32)
        line = np.ascontiguousarray(np.broadcast_to(number if by_column else number[:, None], (height, width)))
    ideal = camera.ideal_pinhole
    # An ideal pinhole at one pose is bounded in closed form (``project.pinhole``).
    chart = NO_CHART if ideal and len(fraction) == 1 else lens_chart(camera, field_cos, direction, valid > 0)
    kind, intrinsics = LENS, np.zeros(4, np.float32)
    if ideal:
        kind, intrinsics = PINHOLE, np.array([ideal.fx_px, ideal.fy_px, ideal.cx_px, ideal.cy_px], np.float32)
    return Grid(kind, direction, valid, line, fraction, None, intrinsics, reference_fraction(fraction),
                not camera.lens.perspective, NEAR_M, field_cos, int(by_column), chart)  # fmt: skip


def _lidar_grid(lidar: LidarModel) -> Grid:
    rays = ray_grid(lidar)
    rows, columns = rays.valid.shape
    sign = -1.0 if lidar.spin is Spin.CLOCKWISE else 1.0
    azimuth = sign * (np.asarray(lidar.azimuth_rad, np.float64) - lidar.azimuth_rad[0])
    steps = np.diff(azimuth) if columns > 1 else np.array([np.radians(0.2)])
    # A full circle has about one step between its last and its first column.
    gap = max(2 * np.pi - azimuth[-1], 0.0)
    full_circle = gap < 1.5 * steps.mean() and columns > 1
    offset = sign * np.asarray(lidar.row_azimuth_offset_rad, np.float64) / steps.mean()
    # Rows fire at azimuth offsets of their own; rolling them aligns each grid column with one azimuth. Only a full
    # circle can be rolled: elsewhere beams would wrap around to the other end.
    shift = np.rint(offset).astype(np.int32) if full_circle else np.zeros(rows, np.int32)
    fired = (np.arange(columns)[None, :] - shift[:, None]) % columns
    row = np.arange(rows)[:, None]
    direction = np.ascontiguousarray(rays.direction[row, fired], np.float32)
    return Grid(
        kind=LIDAR,
        direction=direction,
        valid=np.ascontiguousarray(rays.valid[row, fired], np.uint8),
        line=fired.astype(np.int32),
        line_fraction=np.asarray(sensors.column_fraction(lidar), np.float64),
        beam=(row * columns + fired).astype(np.int32),
        intrinsics=np.zeros(4, np.float32),
        reference=rays.reference,
        by_range=rays.by_range,
        near_m=rays.near_m,
        field_cos=-1.0,
        line_axis=1,
        chart=lidar_chart(lidar, direction, shift),
    )
