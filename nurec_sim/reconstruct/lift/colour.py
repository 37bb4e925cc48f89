"""Colours of surfels from the views that see them, and the affine colour response of each camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, Float64

from nurec_sim import geometry
from nurec_sim.compute.kernels import kernel
from nurec_sim.reconstruct.beam_counting import MARGIN_M, MARGIN_SHARE
from nurec_sim.reconstruct.lift.splat import project_point
from nurec_sim.reconstruct.lift.views import WorkingView

SATURATED = 0.98
"""Recorded colours above this may stand for any brighter one."""
ENOUGH_SHARED = 300
"""Points that two cameras must share before their colours are compared."""


@kernel
def seen_colours(xyz, normal, packed, inverse_depth, free, pictures, present, tolerance):
    """Colour of each point as its three best views show it, and how well the best of them resolves it.

    A view counts if it sees the point: inside the picture, and the picture's inverse depth agrees within ``tolerance``
    plus 8 %. Nearer views and views that face the surface weigh more.

    Args:
        xyz: [n,3] points, metres, in the frame that ``packed`` projects from.
        normal: [n,3] unit normals in that frame.
        packed: [k,23] projections into the views (``packed_views``).
        inverse_depth: [k,h,w] of the views, 1/m; NaN where a pixel is masked.
        free: [k,h,w] whether it is not to be believed (``DepthPicture.free``); a point well behind it is then not seen.
        pictures: [k,h,w,3] colours of the views, 0..255.
        present: [k] whether the body is there at each view's time.
        tolerance: 1/m, see above.

    Returns:
        rgb [n,3] (0..255); the smallest length of a pixel along the surface in metres [n], infinite if unseen; and the
            number of views that look through the point [n].
    """
    n = len(xyz)
    rgb, pixel = np.zeros((n, 3), np.float32), np.full(n, np.inf, np.float32)
    through = np.zeros(n, np.int32)
    weights, best = np.zeros(3), np.zeros((3, 3))
    for i in range(n):
        weights[:], best[:] = 0.0, 0.0
        for k in range(len(packed)):
            if not present[k]:
                continue
            u, v, z = project_point(packed, k, xyz[i, 0], xyz[i, 1], xyz[i, 2])
            if z <= 0.3 or u < 1 or v < 1 or u >= packed[k, 3] - 1 or v >= packed[k, 4] - 1:
                continue
            row, column = int(v), int(u)
            w = inverse_depth[k, row, column]
            if free[k, row, column] and w > 0 and z - 1.0 / w > MARGIN_M + MARGIN_SHARE * z:
                continue
            # Written so that a masked pixel, NaN, neither agrees nor is looked through.
            if not abs(w - 1.0 / z) <= tolerance + 0.08 / z:
                through[i] += w < 1.0 / z
                continue
            focal = packed[k, 0]
            rx, ry = (u - packed[k, 1]) / focal, (v - packed[k, 2]) / focal
            length = np.sqrt(rx * rx + ry * ry + 1)
            facing = 0.0
            for j in range(3):
                facing += normal[i, j] * (packed[k, 5 + j] * rx + packed[k, 8 + j] * ry + packed[k, 11 + j])
            # Cosine of the incidence: a pixel covers 1 / cosine as much of a slanted surface. The floor keeps grazing
            # views finite.
            facing = max(abs(facing) / length, 0.02)
            size = z / focal / facing
            if size < pixel[i]:
                pixel[i] = size
            # Proportional to the solid angle of the surface, so to the number of pixels that measure it.
            weight = facing / (z * z)
            slot = 0
            for j in range(1, 3):
                slot = j if weights[j] < weights[slot] else slot
            if weight > weights[slot]:
                weights[slot] = weight
                for j in range(3):
                    best[slot, j] = pictures[k, row, column, j]
        total = weights[0] + weights[1] + weights[2]
        if total > 0:
            for j in range(3):
                rgb[i, j] = (weights[0] * best[0, j] + weights[1] * best[1, j] + weights[2] * best[2, j]) / total
    return rgb, pixel, through


def grey_of(intensity: Float32[np.ndarray, " n"]) -> Float32[np.ndarray, "n 3"]:
    """Colours, 0..1, of points that no image shows, by their LiDAR intensity in any unit; NaN where it is unknown."""
    known = np.isfinite(intensity)
    level = np.nanpercentile(intensity[known], 90) if known.any() else 1.0
    # LiDAR intensity tells bright paint from dark asphalt, but has no absolute scale: relative to its 90th percentile.
    grey = 0.2 + 0.4 * np.clip(np.where(known, intensity, 0.5 * level) / max(level, 1e-6), 0, 1)
    return np.repeat(grey.astype(np.float32)[:, None], 3, axis=1)


def solve_isp(
    cameras: Sequence[str], colours: dict[str, tuple[Float32[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]]
) -> tuple[dict[str, Float64[np.ndarray, "3 4"]], list[str]]:
    """Affine response of each camera relative to the first, from points that cameras share.

    ``colours`` holds each camera's colour (0..1) of every point and which points it sees. Cameras are joined one after
    the other to those already solved, by robust least squares pulled towards the identity.

    Returns:
        isp per camera (shown = M @ canonical + b), and the cameras that share too little with any other.
    """
    identity = np.concatenate([np.eye(3), np.zeros((3, 1))], axis=1)
    isp = {camera: identity.copy() for camera in cameras}
    total = np.zeros_like(next(iter(colours.values()))[0], dtype=np.float64) if colours else np.zeros((0, 3))
    count = np.zeros(len(total))
    waiting, joined = list(cameras), list[str]()
    while waiting:
        shared = {camera: int((colours[camera][1] & (count > 0)).sum()) for camera in waiting}
        camera = waiting[0] if not joined else max(waiting, key=lambda name: shared[name])
        if joined and shared[camera] < ENOUGH_SHARED:
            break
        rgb, seen = colours[camera]
        if joined:
            both = seen & (count > 0)
            isp[camera] = _affine(total[both] / count[both, None], rgb[both].astype(np.float64))
        # canonical = M^-1 (shown - b): a joined camera adds its canonical colours to the reference of the next one.
        inverse = np.linalg.inv(isp[camera][:, :3])
        total[seen] += (rgb[seen] - isp[camera][:, 3]) @ inverse.T
        count[seen] += 1
        waiting.remove(camera)
        joined.append(camera)
    return isp, waiting


def _affine(canonical: np.ndarray, shown: np.ndarray, rounds: int = 6) -> np.ndarray:
    weight = np.ones((len(canonical), 1))
    basis = np.column_stack([canonical, np.ones(len(canonical))])
    result = np.eye(3, 4)
    pull = 0.02 * len(canonical)
    for _ in range(rounds):
        # A gain per channel first, as of another exposure: points of few colours (asphalt) leave directions of the
        # matrix undetermined. With an offset instead of it a camera could not show what is darker.
        gain = (weight * canonical * shown).sum(axis=0) / np.maximum((weight * canonical**2).sum(axis=0), 1e-9)
        target = np.concatenate([np.diag(gain), np.zeros((3, 1))], axis=1)
        # Ridge towards it.
        left = (basis * weight).T @ basis + pull * np.eye(4)
        right = (basis * weight).T @ shown + pull * target.T
        result = np.linalg.solve(left, right).T
        # Cauchy weights (iteratively reweighted least squares): highlights and wrong matches count little.
        weight = 1 / (1 + (np.linalg.norm(shown - basis @ result.T, axis=1, keepdims=True) / 0.08) ** 2)
    # A camera that turned colours inside out would be a failed fit, not a camera.
    if np.linalg.det(result[:, :3]) < 0.1:
        return np.eye(3, 4)
    return result


def to_canonical(rgb: np.ndarray, isp: Float64[np.ndarray, "3 4"]) -> np.ndarray:
    """Colours 0..255 of a camera as canonical colours 0..255."""
    shown = rgb.astype(np.float64) / 255 - isp[:, 3]
    return np.clip(geometry.rotate_vectors(np.linalg.inv(isp[:, :3]), shown) * 255, 0, 255)


def packed_views(
    views: Sequence[WorkingView], body_poses: Sequence[np.ndarray] | None = None
) -> Float64[np.ndarray, "k 23"]:
    """Packed projections of views from the world, or from a body with the given ``world_from_body`` at each view."""
    if body_poses is None:
        return np.stack([view.packed for view in views])
    return np.stack(
        [
            view.packed_from(geometry.inverse(view.world_from_view) @ pose)
            for view, pose in zip(views, body_poses, strict=True)
        ]
    )
