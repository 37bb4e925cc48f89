"""How far apart two cameras show the same LiDAR points: the error of their calibrations relative to each other.

A patch around a point in the image of one camera is looked for in the image of the other, which is resampled as if it
were taken by the first one, at the depth of the point. With exact calibrations it is found at its place. Where both
cameras see a surface that LiDAR has measured this finds errors that are far too small for its borders to show, such
as a twentieth of a degree between the cameras of a stereo pair.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim import sensors
from nurec_sim.errors import ClipError
from nurec_sim.logs.checks.measure import Measure
from nurec_sim.logs.checks.sampling import SampledSweep
from nurec_sim.logs.clip import Clip
from nurec_sim.types import CameraModel

Points = Float64[np.ndarray, "n 3"]
Grey = Float32[np.ndarray, "h w"]

HALF_PX, REACH_PX = 5, 8
"""Half of the width of a patch, and how far from its place it is looked for."""
MOST_POINTS = 1500
"""Points of a sweep that are tried, evenly over all that both cameras may see."""
FEWEST_POINTS = 40
"""With fewer patches found nothing is said."""
FURTHEST_US = 100_000
"""Images further away in time than this from the sweep are not compared."""
CORRELATION = 0.9
"""Normalised cross-correlation from which a patch counts as found."""
TEXTURE = 20.0
"""Smaller eigenvalue of a patch's mean squared gradients, in grey levels squared: it has corners, not only edges."""
NEAREST_M = 3.0
MUCH_PX = 1.0
"""From here on cameras disagree by more than published logs of one make and time do (0.4 px at most)."""


def check_camera_pairs(clip: Clip, sweeps: Sequence[SampledSweep]) -> list[Measure]:
    """One row per pair of cameras that see the same surfaces: by how many pixels of the first one they disagree.

    Never a fault: a few tenths of a pixel are common in published logs, and cost sharpness only; what more comes from
    (mounting poses, times, poses of frames) cannot be told.
    """
    rows = []
    for first, second in combinations(clip.rig.cameras, 2):
        found = [np.zeros((0, 2)), *(_apart(clip, first, second, each) for each in sweeps)]
        shifts = np.concatenate(found)
        if len(shifts) < FEWEST_POINTS:
            continue
        across, down = np.median(shifts, axis=0)
        spread = np.median(np.abs(shifts - (across, down)), axis=0)
        much = "cannot tell why " if np.hypot(across, down) > MUCH_PX else ""
        rows.append(
            Measure(
                f"cameras {first!r} and {second!r}",
                f"{much}the same points lie {across:+.2f} px across and {down:+.2f} px down apart in the median of "
                f"{len(shifts)}, half of them within {spread[0]:.2f} and {spread[1]:.2f} px of it",
            )
        )
    return rows


def _apart(clip: Clip, first: str, second: str, each: SampledSweep) -> Float64[np.ndarray, "m 2"]:
    """Where patches of the first camera are found in the second one, off their place, in pixels of the first."""
    view, other_view = (_view(clip, name, each.sweep.t_us) for name in (first, second))
    if view is None or other_view is None:
        return np.zeros((0, 2))
    (camera, pair, image), (other, other_pair, other_image) = view, other_view
    xyz = each.sweep.xyz_world_m
    xyz = xyz[np.isfinite(xyz).all(axis=1)]
    shown = np.ones(len(xyz), bool)
    for model, poses in ((camera, pair), (other, other_pair)):
        uv, seen, _ = sensors.project_rolling(model, poses, xyz)
        away = np.linalg.norm(xyz - poses[0, :3, 3], axis=1)
        margin = HALF_PX + REACH_PX
        inside = (uv > margin).all(axis=1) & (uv < np.array([model.width_px, model.height_px]) - margin).all(axis=1)
        shown &= seen & inside & (away > NEAREST_M)
    xyz = xyz[shown]
    xyz = xyz[:: max(1, len(xyz) // MOST_POINTS)]
    if not len(xyz):
        return np.zeros((0, 2))
    span = np.arange(-HALF_PX - REACH_PX, HALF_PX + REACH_PX + 1)
    offsets = np.stack(np.meshgrid(span, span), axis=-1).reshape(-1, 2).astype(np.float64)
    around, known = _around(camera, pair, xyz, offsets)
    own = _sampled(camera, pair, image, around)
    there = _sampled(other, other_pair, other_image, around)
    return np.array(
        [shift for a, b, ok in zip(own, there, known, strict=True) if ok and (shift := _shift(a, b)) is not None]
    ).reshape(-1, 2)


def _view(clip: Clip, name: str, t_us: int) -> tuple[CameraModel, Float64[np.ndarray, "2 4 4"], Grey] | None:
    """The camera, the poses and the grey image of its frame nearest in time, if there is one near."""
    import cv2

    times = clip.camera_times_us(name).mean(axis=1)
    if not len(times):
        return None
    index = int(np.argmin(np.abs(times - t_us)))
    if abs(times[index] - t_us) > FURTHEST_US:
        return None
    try:
        image = clip.image(name, index)
    except ClipError:
        return None
    poses = np.asarray(clip.world_from_camera(name, index), np.float64)
    return clip.rig.cameras[name], poses, cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)


def _around(
    camera: CameraModel, pair: Float64[np.ndarray, "2 4 4"], xyz: Points, offsets_px: Float64[np.ndarray, "k 2"]
) -> tuple[Float64[np.ndarray, "n k 3"], np.ndarray]:
    """World points that the camera shows so many pixels beside each point, on a plane parallel to its image."""
    axes = pair.mean(axis=0)[:3, :2].T
    step = 1e-3 * np.linalg.norm(xyz - pair[0, :3, 3], axis=1)
    uv = sensors.project_rolling(camera, pair, xyz)[0]
    # Pixels per metre along both axes of the image, by differences: any lens.
    moved = [sensors.project_rolling(camera, pair, xyz + step[:, None] * axis)[0] - uv for axis in axes]
    px_per_m = np.stack(moved, axis=-1) / step[:, None, None]
    known = np.abs(np.linalg.det(px_per_m)) > 1e-6
    m_per_px = np.linalg.inv(np.where(known[:, None, None], px_per_m, np.eye(2)))
    metres = np.einsum("nij,kj->nki", m_per_px, offsets_px)
    return xyz[:, None] + metres @ axes, known


def _sampled(
    camera: CameraModel, pair: Float64[np.ndarray, "2 4 4"], image: Grey, xyz: Float64[np.ndarray, "n k 3"]
) -> Float32[np.ndarray, "n width width"]:
    """What an image shows of world points; corner-origin pixels have their centres at +0.5, OpenCV's at 0."""
    import cv2

    uv = (
        sensors.project_rolling(camera, pair, xyz.reshape(-1, 3))[0].astype(np.float32).reshape(*xyz.shape[:2], 2) - 0.5
    )
    # One row per point: OpenCV's maps have at most 32,767 columns and rows.
    grey = cv2.remap(image, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    width = round(np.sqrt(xyz.shape[1]))
    return grey.reshape(len(xyz), width, width)


def _shift(own: Grey, there: Grey) -> tuple[float, float] | None:
    """Where the middle of ``own`` is found in ``there``, off its middle; None where it is plain or not found."""
    import cv2

    patch = np.ascontiguousarray(own[REACH_PX:-REACH_PX, REACH_PX:-REACH_PX])
    rows, columns = np.gradient(patch)
    a, b, c = (rows * rows).mean(), (rows * columns).mean(), (columns * columns).mean()
    if (a + c) / 2 - np.hypot((a - c) / 2, b) < TEXTURE:
        return None
    score = cv2.matchTemplate(np.ascontiguousarray(there), patch, cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(int(score.argmax()), score.shape)
    inside = 0 < row < score.shape[0] - 1 and 0 < column < score.shape[1] - 1
    if not inside or score[row, column] < CORRELATION:
        return None
    down = row + _vertex(*score[row - 1 : row + 2, column])
    across = column + _vertex(*score[row, column - 1 : column + 2])
    return float(across - REACH_PX), float(down - REACH_PX)


def _vertex(before: float, here: float, after: float) -> float:
    """Place of the maximum of the parabola through three values, off the middle one."""
    curve = before - 2 * here + after
    return 0.5 * (before - after) / curve if curve < 0 else 0.0
