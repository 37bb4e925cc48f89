"""How far frames are from ``render.spec``, at rays spread over the frame: the whole scene at the full resolution.

The float64 reference takes some milliseconds per ray, so it renders a stratified, seeded sample of the pixels or beams.
It is given only those Gaussians that a sampled ray passes within their reach; all others weigh nothing on these rays.
PSNR is over 8-bit colours (peak 255), alpha (peak 1), depth where both see a surface (peak 100 m), and LiDAR ranges of
beams that both return (peak: the sensor's own maximum); identical samples count as 100 dB.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from cases import sensor_size
from numba import njit

from nurec_sim.render import spec
from nurec_sim.render.rays import ray_grid, world_rays
from nurec_sim.types import CameraFrame, Gaussians, GaussianScene, LidarFrame, SensorFrame, SensorRequest

BEST_DB = 100.0
DEPTH_PEAK_M = 100.0
SAME_NORMAL_DEG = 1.0
NOTHING: dict[str, float | None] = dict.fromkeys(
    ("psnr_vs_spec_db", "depth_psnr_db", "alpha_psnr_db", "label_agreement", "normal_agreement",
     "intensity_psnr_db", "return_agreement", "lidar_range_error_m_median", "lidar_range_error_m_p99")
)  # fmt: skip


def against_spec(
    scene: GaussianScene, requests: list[SensorRequest], frames: list[SensorFrame], rays: int, seed: int = 11
) -> dict[str, float | None]:
    """The worst of every measure over the frames of a tick, None where a sensor has no such output."""
    share = max(rays // len(frames), 16)
    figures = [_one(scene, asked, frame, share, seed) for asked, frame in zip(requests, frames, strict=True)]
    result = dict(NOTHING)
    for name in NOTHING:
        known = [value for figure in figures if (value := figure.get(name)) is not None]
        worst = max if "error" in name else min
        result[name] = worst(known) if known else None
    return result


def _one(scene: GaussianScene, asked: SensorRequest, frame: SensorFrame, rays: int, seed: int) -> dict:
    chosen = spread_rays(*sensor_size(asked.sensor), rays, seed)
    near = reached_scene(scene, asked, chosen)
    if isinstance(frame, LidarFrame):
        return _sweeps(frame, spec.render_lidar(near, asked, beams=chosen), chosen)
    return _images(frame, spec.render_camera(near, asked, pixels=chosen), chosen)


def spread_rays(width: int, height: int, count: int, seed: int) -> np.ndarray:
    """Flat indices of about ``count`` pixels: one at a random place in each of a grid of equal cells, sorted."""
    columns = max(1, min(width, round(np.sqrt(count * width / height))))
    rows = max(1, min(height, round(count / columns)))
    place = np.random.default_rng(seed).random((2, rows, columns))
    x = ((np.arange(columns) + place[0]) / columns * width).astype(np.int64)
    y = ((np.arange(rows)[:, None] + place[1]) / rows * height).astype(np.int64)
    return np.unique(y * width + x)


def reached_scene(scene: GaussianScene, asked: SensorRequest, chosen: np.ndarray) -> GaussianScene:
    """The scene without the static Gaussians that none of the chosen rays can meet."""
    origin, direction = world_rays(asked, ray_grid(asked.sensor))
    keep = passed_by(scene.static, origin.reshape(-1, 3)[chosen], direction.reshape(-1, 3)[chosen])
    return dataclasses.replace(scene, static=scene.static[keep])


def passed_by(gaussians: Gaussians, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Rows of Gaussians that some ray passes within the distance at which their largest axis has faded to 1/255."""
    with np.errstate(divide="ignore", invalid="ignore"):
        fading = np.sqrt(np.maximum(2 * np.log(255 * gaussians.opacity.astype(np.float64)), 0))
    reach = 1.001 * fading * np.maximum(gaussians.scale_m.max(axis=1), spec.MIN_SCALE_M) + 1e-3
    return np.flatnonzero(_passed_by(gaussians.mean_m.astype(np.float64), reach, origin, direction))


@njit(cache=True, nogil=True)
def _passed_by(mean, reach, origin, direction):
    result = np.zeros(len(mean), np.bool_)
    for i in range(len(mean)):
        limit = reach[i] * reach[i]
        for k in range(len(origin)):
            x, y, z = mean[i, 0] - origin[k, 0], mean[i, 1] - origin[k, 1], mean[i, 2] - origin[k, 2]
            along = x * direction[k, 0] + y * direction[k, 1] + z * direction[k, 2]
            if x * x + y * y + z * z - along * along <= limit and along > -reach[i]:
                result[i] = True
                break
    return result


def _images(frame: CameraFrame, expected: CameraFrame, chosen: np.ndarray) -> dict[str, float]:
    """An image against a row of its pixels."""
    figures = {"psnr_vs_spec_db": psnr_db(_picked(frame.rgb, chosen), expected.rgb[0], 255.0)}
    if frame.alpha is not None:
        figures["alpha_psnr_db"] = psnr_db(_picked(frame.alpha, chosen), expected.alpha[0], 1.0)
    if frame.depth_m is not None:
        depth = _picked(frame.depth_m, chosen)
        both = (depth > 0) & (expected.depth_m[0] > 0)
        figures["depth_psnr_db"] = psnr_db(depth[both], expected.depth_m[0][both], DEPTH_PEAK_M)
    if frame.label is not None:
        figures["label_agreement"] = float(np.mean(_picked(frame.label, chosen) == expected.label[0]))
    if frame.normal is not None:
        mine, theirs = _picked(frame.normal, chosen), expected.normal[0]
        cosine = np.sum(mine * theirs, axis=1)
        same = (cosine >= np.cos(np.radians(SAME_NORMAL_DEG))) | (~mine.any(axis=1) & ~theirs.any(axis=1))
        figures["normal_agreement"] = float(np.mean(same))
    return figures


def _sweeps(sweep: LidarFrame, expected: LidarFrame, chosen: np.ndarray) -> dict[str, float]:
    """A whole sweep against some of its beams."""
    mine = np.isin(sweep.beam, chosen)
    _, a, b = np.intersect1d(sweep.beam[mine], expected.beam, return_indices=True)
    unlike = mine.sum() + len(expected.beam) - 2 * len(a)
    figures = {"return_agreement": float(1 - unlike / max(len(chosen), 1))}
    if len(a):
        error = np.abs(sweep.range_m[mine][a].astype(np.float64) - expected.range_m[b])
        figures["psnr_vs_spec_db"] = psnr_db(error, np.zeros_like(error), sweep.lidar.range_m[1])
        figures["intensity_psnr_db"] = psnr_db(sweep.intensity[mine][a], expected.intensity[b], 1.0)
        figures["lidar_range_error_m_median"] = float(np.median(error))
        figures["lidar_range_error_m_p99"] = float(np.quantile(error, 0.99))
    return figures


def _picked(plane: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    return plane.reshape(-1, *plane.shape[2:])[chosen]


def psnr_db(a: np.ndarray, b: np.ndarray, peak: float) -> float:
    """Peak signal-to-noise ratio, at most ``BEST_DB``."""
    error = np.mean((np.asarray(a, np.float64) - np.asarray(b, np.float64)) ** 2) if len(a) else 0.0
    return float(min(BEST_DB, 10 * np.log10(peak**2 / max(error, 1e-30))))


def image_psnr_db(frames: list[SensorFrame], others: list[SensorFrame]) -> float | None:
    """The worst PSNR of whole images against each other."""
    pairs = [
        psnr_db(a.rgb.ravel(), b.rgb.ravel(), 255.0)
        for a, b in zip(frames, others, strict=True)
        if isinstance(a, CameraFrame) and isinstance(b, CameraFrame)
    ]
    return min(pairs) if pairs else None
