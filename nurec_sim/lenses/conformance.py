"""Conformance test of the ``Lens`` interface, for authors of lenses.

::

    from nurec_sim.lenses import check_lens
    print(check_lens(MyLens(500.0, 500.0, 640.0, 360.0), 1280, 720))      # [] when all is well
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from nurec_sim.lenses.base import Mask, Points2, Points3, missing_members
from nurec_sim.lenses.parameters import decode_parameters, encode_parameters
from nurec_sim.lenses.registry import lens_class

PIXEL_TOLERANCE = 1e-6
RAY_TOLERANCE = 1e-6
RIM = 0.01
"""Fraction of the points that may leave the field by rounding: those at its rim."""


def check_lens(lens: Any, width_px: int = 1280, height_px: int = 720) -> list[str]:
    """Tests a lens and lists its faults; empty if it conforms to ``Lens``.

    Checks, over an image of ``width_px`` x ``height_px`` and over the whole sphere: shapes and types of results; that
    inputs are not modified and no warnings are raised; that ``project`` and ``unproject`` are inverse to each other, so
    that no two rays map to one pixel; independence of a point's distance; that the axis projects to the principal
    point; that the field ends at ``max_angle_rad``; ``scaled``, ``cropped``, ``mirrored``, ``ideal_pinhole``,
    ``perspective``; that the class is registered, and parameters survive a JSON round trip.
    """
    try:
        if missing := missing_members(type(lens)):
            return [f"{type(lens).__name__} lacks {', '.join(missing)}"]
        if lens_class(lens.kind) is not type(lens):
            return [f"kind {lens.kind!r} is that of {lens_class(lens.kind)}; register_lens adds a class"]
        lens.check()
    except (TypeError, ValueError) as error:
        return [str(error)]
    faults = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for step in (_json, _results, _round_trips, _field, _resized):
            try:
                faults += list(step(lens, width_px, height_px))
            except Exception as error:  # reported beside the other faults
                faults.append(f"{step.__name__.strip('_').replace('_', ' ')}: {type(error).__name__}: {error}")
    return faults


def _json(lens: Any, width_px: int, height_px: int) -> Iterator[str]:
    back = decode_parameters(lens_class(lens.kind), json.loads(json.dumps(encode_parameters(lens))), complete=True)
    if back != lens or hash(back) != hash(lens):
        yield f"its parameters come back from JSON as {back}, not {lens}"


def _results(lens: Any, width_px: int, height_px: int) -> Iterator[str]:
    for call, values, wide in (
        (lens.project, _directions(200), 2), (lens.project, np.zeros((0, 3)), 2),
        (lens.unproject, _pixels(width_px, height_px), 3), (lens.unproject, np.zeros((0, 2)), 3),
    ):  # fmt: skip
        before = values.copy()
        result, valid = call(values)
        name, count = f"{call.__name__} of {len(values)}", len(values)
        if not np.array_equal(values, before):
            yield f"{name}: the input was written to"
        for what, array, shape, dtype in (
            ("result", result, (count, wide), np.float64),
            ("mask", valid, (count,), bool),
        ):
            if not isinstance(array, np.ndarray) or array.shape != shape or array.dtype != dtype:
                given = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
                yield f"{name}: the {what} must be {np.dtype(dtype)} {shape}, got {given}"
        if np.shares_memory(result, values) or not result.flags.writeable:
            yield f"{name}: the result must be an array of its own"


def _round_trips(lens: Any, width_px: int, height_px: int) -> Iterator[str]:
    pixels = _pixels(width_px, height_px)
    rays, seen = lens.unproject(pixels)
    if not seen.any():
        yield f"no pixel of an image of {width_px} x {height_px} has a ray"
        return
    pixels, rays = pixels[seen], rays[seen]
    if np.abs(np.linalg.norm(rays, axis=1) - 1).max() > RAY_TOLERANCE:
        yield "unproject: rays must have length 1"
    for length in (1.0, 7.0):
        again, valid = lens.project(length * rays)
        yield from _differ(f"project(unproject(pixel) * {length:g})", pixels, again, valid, "px", PIXEL_TOLERANCE)
    points = _directions(2000)
    uv, valid = lens.project(points)
    back, seen = lens.unproject(uv[valid])
    yield from _differ("unproject(project(ray))", points[valid], back, seen, "", RAY_TOLERANCE)


def _differ(what: str, wanted: Any, given: Any, valid: Mask, unit: str, tolerance: float) -> Iterator[str]:
    if len(valid) and np.mean(~valid) > RIM:
        yield f"{what}: {np.mean(~valid):.0%} are not valid, though the way there was"
    off = np.abs(given - wanted).max(axis=1)[valid]
    if off.max(initial=0.0) > tolerance:
        worst = wanted[valid][off.argmax()].tolist()
        yield f"{what} is off by {off.max():.3g}{unit} at {worst}; allowed is {tolerance:g}"


def _field(lens: Any, width_px: int, height_px: int) -> Iterator[str]:
    uv, valid = lens.project(np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 0.0]]))
    if not valid[0] or np.abs(uv[0] - (lens.cx_px, lens.cy_px)).max() > PIXEL_TOLERANCE:
        yield f"the axis must meet the pixel (cx_px, cy_px) = ({lens.cx_px}, {lens.cy_px}), got {uv[0].tolist()}"
    if valid[1]:
        yield "project: a point at the camera itself must not be valid"
    points = _directions(2000)
    seen = points[lens.project(points)[1]]
    widest = float(np.arccos(seen[:, 2].min(initial=1.0)))
    if widest > lens.max_angle_rad + RAY_TOLERANCE:
        yield f"a ray {widest:.4f} rad off the axis is valid, but max_angle_rad is {lens.max_angle_rad:.4f}"
    if lens.perspective and widest >= np.pi / 2:
        yield "a perspective lens sees nothing beside or behind the camera"
    if (ideal := lens.ideal_pinhole) is not None:
        yield from _same_image("ideal_pinhole", lens, ideal, lambda uv: uv, np.ones(3))


def _resized(lens: Any, width_px: int, height_px: int) -> Iterator[str]:
    mirror = np.array([-1.0, 1.0, 1.0])
    for name, other, moved, turned in (
        ("scaled(1.5, 0.75)", lens.scaled(1.5, 0.75), lambda uv: uv * (1.5, 0.75), np.ones(3)),
        ("cropped(30, 20)", lens.cropped(30.0, 20.0), lambda uv: uv - (30.0, 20.0), np.ones(3)),
        (f"mirrored({width_px})", lens.mirrored(width_px), lambda uv: (width_px, 0) + uv * (-1, 1), mirror),
    ):
        other.check()
        if type(other) is not type(lens):
            yield f"{name} must be a {type(lens).__name__}, got {type(other).__name__}"
        yield from _same_image(name, lens, other, moved, turned)


def _same_image(
    name: str, lens: Any, other: Any, moved: Callable[[Points2], Points2], turned: np.ndarray
) -> Iterator[str]:
    """Checks that ``other`` projects points times ``turned`` to the pixels of ``lens`` mapped by ``moved``."""
    points = _directions(500)
    (uv, valid), (theirs, seen) = lens.project(points), other.project(points * turned)
    yield from _differ(f"project of {name}", moved(uv[valid]), theirs[valid], seen[valid], "px", 10 * PIXEL_TOLERANCE)


def _pixels(width_px: int, height_px: int) -> Points2:
    columns, rows = np.meshgrid(np.linspace(0.5, width_px - 0.5, 41), np.linspace(0.5, height_px - 0.5, 31))
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def _directions(count: int) -> Points3:
    """Points distributed evenly over the unit sphere: a Fibonacci lattice (equal areas in z, golden-angle azimuths)."""
    number = np.arange(count) + 0.5
    z, azimuth = 1 - 2 * number / count, np.pi * (1 + np.sqrt(5)) * number
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=1)
