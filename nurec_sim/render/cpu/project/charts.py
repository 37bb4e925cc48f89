"""Charts: tables from the direction of a point to its place on a sensor's grid, with bounds on their error.

A place is (column, row) with cell centres at +0.5. Charts only bound where a Gaussian can be seen; they never enter
its response.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64
from scipy.ndimage import maximum_filter

from nurec_sim import sensors
from nurec_sim.types import CameraModel, LidarModel, Spin

# Parameters of a lens chart: texels per unit of the stereographic plane, texel of its origin, cosine and sine of the
# largest angle of a ray off the axis, cells by which the chart misses the pixel of a ray.
TEXELS, MIDDLE, COS_FIELD, SIN_FIELD, MISFIT = 0, 1, 2, 3, 4
# Parameters of a LiDAR chart: columns per radian (negative for a clockwise spin), azimuth of column 0, columns of a
# full turn, least and most that a beam's place lies ahead of its column, entries per unit of sine, and the most
# columns that a beam fires away from its grid column.
PER_RADIAN, AZIMUTH, PERIOD, LEAST_AHEAD, MOST_AHEAD, SINES, SHIFTED = 0, 1, 2, 3, 4, 5, 6
PARAMETERS = 7

LENS_SIZE = 129
LIDAR_SIZE = 8193
FIELD_MARGIN_RAD = 0.6
"""How far a lens chart extends beyond its field, so that Gaussians across the edge are bounded well."""
IMAGE_MARGIN_RAD = 0.05
WINDOWS = 6
"""Sizes of the neighbourhoods for which a lens chart knows its largest bend: 2, 4, .. 64 texels to each side."""
CHECKED_RAYS = 256
"""Rows and columns of an image whose rays a lens chart is checked with."""


class Chart(NamedTuple):
    """Tables of a sensor.

    Lens: ``places`` [s,s,6] by stereographic direction (x, y) / (1 + z) holds column, row, and the derivatives of the
    column and of the row by both coordinates. ``bends`` [6,s,s] holds the largest second derivative of a place, in
    cells per squared radian of direction, within 2, 4, .. 64 texels.

    LiDAR: ``places`` [1,t,1] holds the row by sine of elevation, in decreasing order; ``bends`` is empty.
    """

    params: Float32[np.ndarray, " p"]
    places: Float32[np.ndarray, "a b c"]
    bends: Float32[np.ndarray, "w s t"]


def lens_chart(
    camera: CameraModel, field_cos: float, direction: Float32[np.ndarray, "h w 3"], valid: np.ndarray
) -> Chart:
    """Chart of a camera.

    Args:
        camera: any lens.
        field_cos: cosine of the largest angle between a valid ray and the optical axis.
        direction: unit rays of the pixels in the camera's frame.
        valid: [h,w] whether a pixel has a ray.
    """
    # The stereographic plane is conformal and finite for every direction but -z, so one table serves fisheyes as well
    # as narrow lenses. 0.97 pi keeps its half width finite.
    field = float(np.arccos(np.clip(np.float32(field_cos), -1, 1)))
    half_width = np.tan(min(field + FIELD_MARGIN_RAD, 0.97 * np.pi) / 2)
    place = _lens_places(camera, half_width, field + IMAGE_MARGIN_RAD)
    texel = 2 * half_width / (LENS_SIZE - 1)
    # Differences of the table itself, not of the lens: the linear continuation outside the field is part of the chart.
    by_t, by_s = np.gradient(place, texel, axis=(0, 1), edge_order=2)
    places = np.concatenate([place, np.stack([by_s[..., 0], by_t[..., 0], by_s[..., 1], by_t[..., 1]], axis=-1)], -1)
    bend = _bend(by_s, by_t, half_width, texel)
    # A running maximum over squares of 2^(k + 2) + 1 texels: one lookup then bounds the bend of a whole neighbourhood.
    bends = np.stack([maximum_filter(bend, size=2 ** (k + 2) + 1, mode="nearest") for k in range(WINDOWS)])
    params = np.zeros(PARAMETERS)
    params[[TEXELS, MIDDLE]] = 1 / texel, (LENS_SIZE - 1) / 2
    # 1e-4 rad: the rays are float32.
    params[[COS_FIELD, SIN_FIELD]] = np.cos(field + 1e-4), np.sin(field + 1e-4)
    chart = Chart(params.astype(np.float32), places.astype(np.float32), bends.astype(np.float32))
    chart.params[MISFIT] = _misfit(chart, direction, valid)
    return chart


def _lens_places(camera: CameraModel, half_width: float, field_rad: float) -> Float64[np.ndarray, "s s 2"]:
    """Pixels by stereographic direction, continued linearly outside of ``field_rad`` and of the lens.

    Distortion polynomials may diverge outside of the image, where they were not fitted.
    """
    # Stereographic radius r = tan(angle / 2).
    p = np.linspace(-half_width, half_width, LENS_SIZE)
    x, y = np.tile(p, LENS_SIZE), np.repeat(p, LENS_SIZE)
    angle, azimuth = 2 * np.arctan(np.hypot(x, y)), np.arctan2(y, x)

    def look(angle_rad: np.ndarray, azimuth_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        flat = np.sin(angle_rad)
        xyz = np.stack([flat * np.cos(azimuth_rad), flat * np.sin(azimuth_rad), np.cos(angle_rad)], axis=-1)
        uv, valid = sensors.project(camera, xyz)
        return uv, valid & (angle_rad <= field_rad)

    uv, valid = look(angle, azimuth)
    # The first invalid angle along each outward line, by bisection; beyond it the image is continued with its last
    # slope.
    outside = np.flatnonzero(~valid)
    low, high = np.zeros(len(outside)), angle[outside].copy()
    for _ in range(24):
        middle = (low + high) / 2
        inside = look(middle, azimuth[outside])[1]
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    step = 1e-3
    rim_uv, _ = look(low, azimuth[outside])
    inner_uv, _ = look(np.maximum(low - step, 0), azimuth[outside])
    uv[outside] = rim_uv + (rim_uv - inner_uv) * ((angle[outside] - low) / step)[:, None]
    # A lens may give NaN where it is undefined; a place far outside the image keeps such Gaussians out of sight.
    return np.nan_to_num(uv, nan=-1e6).reshape(LENS_SIZE, LENS_SIZE, 2)


def _bend(
    by_s: Float64[np.ndarray, "n n 2"], by_t: Float64[np.ndarray, "n n 2"], half_width: float, texel: float
) -> Float64[np.ndarray, "n n"]:
    """Largest second derivative of a place, along great circles and in the stereographic plane (cells per rad^2).

    The plane is conformal: a small angle is ``scale`` = (1 + |p|^2) / 2 times as long there. A great circle through p
    with direction e bends by scale (2 (p.e) e - p) per squared radian.
    """
    p = np.linspace(-half_width, half_width, len(by_s))
    s, t = np.meshgrid(p, p)
    scale = (1 + s * s + t * t) / 2
    largest = np.zeros_like(s)
    for k in range(2):
        gs, gt = by_s[..., k], by_t[..., k]
        st, ss = np.gradient(gs, texel, axis=(0, 1), edge_order=2)
        tt = np.gradient(gt, texel, axis=0, edge_order=2)
        inward = s * gs + t * gt
        on_sphere = (scale**2 * ss + scale * (2 * s * gs - inward), scale**2 * st + scale * (s * gt + t * gs),
                     scale**2 * tt + scale * (2 * t * gt - inward))  # fmt: skip
        for a, b, c in (on_sphere, (scale**2 * ss, scale**2 * st, scale**2 * tt)):
            # The larger magnitude of the eigenvalues of the symmetric matrix [[a, b], [b, c]].
            largest = np.maximum(largest, np.abs(a + c) / 2 + np.hypot((a - c) / 2, b))
    # A tenth more for what finite differences between texels miss.
    return 1.1 * largest


def _misfit(chart: Chart, direction: Float32[np.ndarray, "h w 3"], valid: np.ndarray) -> float:
    """Cells by which the chart misses pixel centres, beyond what its bends explain."""
    rows, columns = (np.unique(np.linspace(0, n - 1, CHECKED_RAYS).astype(int)) for n in valid.shape)
    row, column = (part.ravel() for part in np.meshgrid(rows, columns, indexing="ij"))
    row, column = row[valid[row, column]], column[valid[row, column]]
    ray = direction[row, column].astype(np.float64)
    # The kernels' own lookup (``outlines.Texels``): nearest texel plus its gradient.
    texels = ray[:, :2] / (1 + ray[:, 2:]) * chart.params[TEXELS] + chart.params[MIDDLE]
    nearest = np.clip(np.rint(texels).astype(int), 0, LENS_SIZE - 1)
    entry = chart.places[nearest[:, 1], nearest[:, 0]].astype(np.float64)
    step = (texels - nearest) / chart.params[TEXELS]
    place = entry[:, :2] + np.einsum("nij,nj->ni", entry[:, 2:].reshape(-1, 2, 2), step)
    miss = np.abs(place - np.stack([column, row], axis=-1) - 0.5).max(axis=1, initial=0)
    # A step in the plane is (1 + |p|^2) / 2 = 1 / (1 + z) times as long as its angle.
    angle = np.linalg.norm(step, axis=1) * (1 + ray[:, 2])
    explained = 0.5 * chart.bends[0][nearest[:, 1], nearest[:, 0]] * angle**2
    # Only some rays are checked, hence half as much again; 0.02 cells for float32.
    return 0.02 + 1.5 * float(np.maximum(miss - explained, 0).max(initial=0))


def lidar_chart(lidar: LidarModel, direction: Float32[np.ndarray, "h w 3"], shift: np.ndarray) -> Chart:
    """Chart of a LiDAR whose grid cells look along ``direction``; row r is rolled by ``shift[r]`` columns."""
    columns = direction.shape[1]
    sign = -1.0 if lidar.spin is Spin.CLOCKWISE else 1.0
    turned = sign * (np.asarray(lidar.azimuth_rad, np.float64) - lidar.azimuth_rad[0])
    step = (turned[-1] - turned[0]) / (columns - 1) if columns > 1 else np.radians(0.2)
    # A full turn: the gap between last and first column counts as a step, so that a period is exactly the columns.
    if 2 * np.pi - turned[-1] < 1.5 * step:
        step = 2 * np.pi / columns
    x, y = (direction[..., k].astype(np.float64) for k in range(2))
    # How far each beam's azimuth lies ahead of its grid column (per-row offsets, what rolling by whole columns leaves),
    # reduced to within half a turn.
    ahead = sign * (np.arctan2(y, x) - lidar.azimuth_rad[0]) / step - np.arange(columns)
    ahead -= 2 * np.pi / step * np.rint(ahead * step / (2 * np.pi))
    # By the sine of elevation, which kernels have without a trigonometric function.
    sine = np.linspace(-1, 1, LIDAR_SIZE)
    row = extrapolated(-np.arcsin(sine), -np.asarray(lidar.elevation_rad, np.float64), step) + 0.5
    params = [sign / step, lidar.azimuth_rad[0], 2 * np.pi / step, ahead.min() - 0.02, ahead.max() + 0.02,
              (LIDAR_SIZE - 1) / 2, np.abs(shift).max(initial=0) + 1]  # fmt: skip
    return Chart(np.array(params, np.float32), row.astype(np.float32)[None, :, None], np.zeros((0, 0, 0), np.float32))


def extrapolated(value: np.ndarray, grid: np.ndarray, default_step: float) -> np.ndarray:
    """Fractional index of values in a rising grid, extrapolated linearly past its ends."""
    if len(grid) == 1:
        return (value - grid[0]) / default_step
    low = np.clip(np.searchsorted(grid, value, side="right") - 1, 0, len(grid) - 2)
    return low + (value - grid[low]) / (grid[low + 1] - grid[low])
