"""Drawings of a log as SVG: the timeline of its sensors, and the drive and its coverage from above."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from nurec_sim import geometry, sensors
from nurec_sim.errors import ClipError
from nurec_sim.logs import Clip
from nurec_sim.logs.checks.sampling import spread
from nurec_sim.render.images.encode import encode_image
from nurec_sim.report.cells import escape
from nurec_sim.report.figure import ACTOR, ALARM, EGO, PARKED

WIDTH = 1000
ROW, LEFT, RIGHT = 22, 190, 70
"""Height of a row of the timeline, and what its names and counts take; in units of which the page is 1000 wide."""
GAP_FACTOR = 1.8
"""Frames that follow each other after more than so many usual intervals leave a gap."""
BORDER_M = 15.0
REACH_M = 50.0
CELL_M = 0.5
MOST_CELLS = 1200
MAP_SWEEPS, MAP_POINTS = 12, 20_000
"""Sweeps of each LiDAR on the map, and points of each."""
SEEN_RGB, UNSEEN_RGB = np.array([14, 116, 144]), np.array([217, 119, 6])
MARK_S = 1.0

Points2 = Float64[np.ndarray, "n 2"]


def timeline(clip: Clip) -> tuple[str, list[str]]:
    """When each sensor measured and the car's pose is known, one row each; and the gaps, one line each."""
    rows = [("car's pose", np.stack([clip.ego.t_us, clip.ego.t_us], axis=1))]
    rows += [(name, clip.camera_times_us(name)) for name in clip.rig.cameras]
    rows += [(name, clip.sweep_times_us(name)) for name in clip.rig.lidars]
    boxes = np.unique(
        np.concatenate([np.zeros(0, np.int64), *(track.path.t_us for track in clip.tracks if track.labelled)])
    )
    if len(boxes):
        rows.append(("boxes", np.stack([boxes, boxes], axis=1)))
    start_us, end_us = clip.span_us
    seconds = max((end_us - start_us) / 1e6, 1e-3)
    scale = (WIDTH - LEFT - RIGHT) / seconds
    height = ROW * len(rows) + 30
    parts, gaps = [], []
    for index, (name, times) in enumerate(rows):
        y = ROW * index + 4
        parts.append(f'<text x="{LEFT - 8}" y="{y + 12}" text-anchor="end">{escape(name)}</text>')
        parts.append(f'<text x="{WIDTH - RIGHT + 8}" y="{y + 12}">{len(times)}</text>')
        for first_us, last_us in times:
            x, wide = LEFT + (first_us - start_us) / 1e6 * scale, max((last_us - first_us) / 1e6 * scale, 1.2)
            parts.append(
                f'<rect x="{x:.1f}" y="{y}" width="{wide:.1f}" height="{ROW - 8}" fill="{EGO}" opacity="0.7"/>'
            )
        for first_us, last_us in _gaps(times):
            x, wide = LEFT + (first_us - start_us) / 1e6 * scale, (last_us - first_us) / 1e6 * scale
            parts.append(
                f'<rect x="{x:.1f}" y="{y}" width="{wide:.1f}" height="{ROW - 8}" fill="{ALARM}" opacity="0.35"/>'
            )
            gaps.append(f"{name}: nothing from {(first_us - start_us) / 1e6:.2f} to {(last_us - start_us) / 1e6:.2f} s")
    for second in _ticks(seconds):
        x = LEFT + second * scale
        parts.append(f'<line x1="{x:.1f}" y1="0" x2="{x:.1f}" y2="{height - 24}" stroke="#cbd5e1"/>')
        parts.append(f'<text x="{x:.1f}" y="{height - 8}" text-anchor="middle">{second:g} s</text>')
    return _svg(WIDTH, height, parts), gaps


def _gaps(times: Int64[np.ndarray, "n 2"]) -> list[tuple[int, int]]:
    """Times between frames that are much farther apart than usual."""
    starts = times[:, 0]
    steps = np.diff(starts)
    if len(steps) < 2:
        return []
    long = np.flatnonzero(steps > GAP_FACTOR * np.median(steps))
    return [(int(max(times[i, 1], starts[i])), int(starts[i + 1])) for i in long]


def _ticks(seconds: float) -> list[float]:
    """About ten round times."""
    step = 10 ** np.floor(np.log10(seconds / 5))
    step *= next(factor for factor in (1, 2, 5, 10) if seconds / (step * factor) <= 10)
    return [float(round(value, 6)) for value in np.arange(0, seconds + step / 1e3, step)]


def drive_map(clip: Clip) -> str:
    """The drive from above: road, path with a mark each second, objects, and what LiDARs and cameras cover."""
    path = clip.ego.position_m[:, :2]
    low, high = path.min(axis=0) - REACH_M, path.max(axis=0) + REACH_M
    size = high - low
    scale = WIDTH / size[0]
    height = round(size[1] * scale)

    def place(points: Points2) -> Points2:
        return np.stack([(points[:, 0] - low[0]) * scale, (high[1] - points[:, 1]) * scale], axis=1)

    parts = [_picture(_coverage(clip, low, high), WIDTH, height)]
    if clip.road_map is not None:
        parts += [_line(place(ring), "#475569", closed=True) for area in clip.road_map.drivable for ring in area]
        parts += [_line(place(lane[:, :2]), "#94a3b8", dash="4 4") for lane in clip.road_map.lanes]
    for track in clip.tracks:
        corners = geometry.box_corners_xy(track.path.world_from_body[0], *track.size_m[:2])
        moves = np.ptp(track.path.position_m[:, :2], axis=0).max() > 0.5
        parts.append(_line(place(corners), ACTOR if moves else PARKED, closed=True))
        if moves:
            parts.append(_line(place(track.path.position_m[:, :2]), ACTOR, width=1.0))
    parts.append(_line(place(path), EGO, width=3.0))
    for second in np.arange(0, (clip.ego.end_us - clip.ego.start_us) / 1e6, MARK_S):
        ((x, y),) = place(clip.ego.at(clip.ego.start_us + round(second * 1e6))[None, :2, 3])
        parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="#fff" stroke="{EGO}"><title>{second:g} s</title></circle>'
        )
    body = clip.rig.body
    centre = clip.ego.world_from_body[0] @ geometry.pose(np.eye(3), np.array(body.center_m))
    parts.append(_line(place(geometry.box_corners_xy(centre, *body.size_m[:2])), EGO, width=2.0, closed=True))
    bar = 10 * scale
    parts.append(f'<rect x="12" y="{height - 14}" width="{bar:.1f}" height="4" fill="#1e293b"/>')
    parts.append(f'<text x="12" y="{height - 20}">10 m</text>')
    return _svg(WIDTH, height, parts)


def _coverage(clip: Clip, low: np.ndarray, high: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    """An image with a pixel per cell, row 0 at the largest y: white without LiDAR points, the darker the more.

    The colour says whether a camera sees some of them at the time of their sweep.
    """
    cell = max(CELL_M, float((high - low).max()) / MOST_CELLS)
    columns, rows = np.ceil((high - low) / cell).astype(int).tolist()
    count, seen = np.zeros((rows, columns)), np.zeros((rows, columns), bool)
    for name in clip.rig.lidars:
        for index in spread(clip.sweep_count(name), MAP_SWEEPS):
            try:
                sweep = clip.sweep(name, index)
            except ClipError:  # among the faults
                continue
            points = sweep.xyz_world_m[:: max(1, len(sweep.xyz_m) // MAP_POINTS)]
            place = ((points[:, :2] - low) / cell).astype(int)
            inside = ((points[:, :2] >= low) & (place < [columns, rows])).all(axis=1)
            points, at = points[inside], (rows - 1 - place[inside, 1], place[inside, 0])
            np.add.at(count, at, 1)
            in_sight = _in_sight(clip, points, sweep.t_us)
            seen[at[0][in_sight], at[1][in_sight]] = True
    share = np.clip(np.log1p(count) / max(np.log1p(np.percentile(count[count > 0], 98)) if count.any() else 1, 1), 0, 1)
    share = np.where(count > 0, 0.25 + 0.75 * share, 0)[..., None]
    return np.rint(255 * (1 - share) + share * np.where(seen[..., None], SEEN_RGB, UNSEEN_RGB)).astype(np.uint8)


def _in_sight(clip: Clip, points: Float64[np.ndarray, "n 3"], t_us: int) -> np.ndarray:
    """Which points lie in the image of a camera, at its frame nearest in time."""
    found = np.zeros(len(points), bool)
    for name, camera in clip.rig.cameras.items():
        times = clip.camera_times_us(name)
        if len(times):
            nearest = int(np.argmin(np.abs(times.mean(axis=1) - t_us)))
            uv, valid, _ = sensors.project_rolling(camera, clip.world_from_camera(name, nearest), points)
            found |= valid & sensors.in_image(camera, uv)
    return found


def image_source(rgb: UInt8[np.ndarray, "h w 3"], image_format: str = "png", quality: int = 85) -> str:
    """An image as a data address for HTML."""
    encoded = base64.b64encode(encode_image(rgb, image_format, quality)).decode()
    return f"data:image/{image_format};base64,{encoded}"


def _picture(rgb: UInt8[np.ndarray, "h w 3"], width: float, height: float) -> str:
    return (
        f'<image href="{image_source(rgb)}" width="{width}" height="{height}" preserveAspectRatio="none" '
        'style="image-rendering:pixelated"/>'
    )


def _line(points: Points2, colour: str, width: float = 1.5, dash: str = "", closed: bool = False) -> str:
    text = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    kind = "polygon" if closed else "polyline"
    dashes = f' stroke-dasharray="{dash}"' if dash else ""
    return f'<{kind} points="{text}" fill="none" stroke="{colour}" stroke-width="{width}"{dashes}/>'


def _svg(width: float, height: float, parts: Iterable[str] | Sequence[str]) -> str:
    return f'<svg viewBox="0 0 {width} {height}" role="img">{"".join(parts)}</svg>'
