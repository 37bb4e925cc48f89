"""Meshes of vehicles, in the frame of their box: x forward, y left, z up, origin at the box centre."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nurec_sim.world.assets.meshes import MeshBuilder
from nurec_sim.world.assets.textures_vehicles import atlas_uv
from nurec_sim.world.assets.vehicle_families import FAMILIES, Family

PARTS = ("paint", "glass", "wheel", "headlight", "taillight", "plate", "cargo")
"""``wheel`` also contains trim and bumpers, which share the dark material."""
LASER_OF_PART = {"taillight": 0.9, "headlight": 0.8, "plate": 0.95, "glass": 0.1, "wheel": 0.2}
"""Fraction of a laser's light that a part reflects; the others reflect as ``SurfaceClass.VEHICLE`` does."""
RUBBER = 0.02
"""The first corner of the wheel texture is uniform."""
MIRROR_M = 0.075
"""Extent of the mirrors beyond each side of the body; included in the box."""

Surface = Callable[[int, float, float], np.ndarray]


def vehicle_parts(kind: str, size_m: tuple[float, float, float]) -> dict[str, MeshBuilder]:
    """The parts of a vehicle that together fill its box exactly; the paint's texture is ``body_atlas``.

    Raises:
        ValueError: no such family of vehicles.
    """
    if kind not in FAMILIES:
        raise ValueError(f"no vehicle family {kind!r}; have {sorted(FAMILIES)}")
    family, parts = FAMILIES[kind], {name: MeshBuilder() for name in (*PARTS, "trim")}
    half_l, half_w, high = size_m[0] / 2, size_m[1] / 2 - MIRROR_M, size_m[2]
    body = _lower_body(parts["paint"], family, half_l, half_w, high)
    surface = _cabin(parts["paint"], family, half_l, half_w, high)
    _windows(parts["glass"], family, surface)
    _wheels(parts, family, half_l, half_w)
    _lamps(parts, family, half_l, half_w, high)
    _trim(parts, family, half_l, half_w, high, body)
    if family.cargo is not None:
        rear, front = (x * half_l for x in family.cargo)
        floor, wide = family.wheel_m * 2 + 0.12, size_m[1] / 2
        parts["cargo"].block([rear, -wide, floor], [front, wide, high])
        parts["trim"].box([(rear + front) / 2, 0, floor - 0.14], [(front - rear) / 2 * 0.98, 0.45, 0.14])
    trim = parts.pop("trim")
    trim.shrink_texture(RUBBER)
    parts["wheel"].extend(trim)
    used = {name: part for name, part in parts.items() if not part.empty}
    _fit(used, size_m)
    used["paint"] = _with_atlas(used["paint"], size_m)
    return used


def _lower_body(paint: MeshBuilder, family: Family, half_l: float, half_w: float, high: float) -> np.ndarray:
    """Lofts cross-sections from tail to nose below the windows; returns the x of tail and nose."""
    knots = np.array(family.top)
    tail, nose = knots[0, 0], knots[-1, 0]
    inner = np.linspace(tail + 0.10, nose - 0.10, 9)
    # Dense near both ends, where the section is rounded.
    stations = np.concatenate([[tail, tail + 0.012, tail + 0.045], inner, [nose - 0.045, nose - 0.012, nose]])
    boxy = family.roof_width > 0.88
    rounding = 0.035 if boxy else 0.11
    sections = []
    for x in stations:
        from_end = min(x - tail, nose - x) / 0.30
        width = half_w * (1 - rounding * np.clip(1 - from_end, 0, 1) ** 2.2)
        width *= 1 - (0.03 if boxy else 0.09) * np.clip(1 - from_end * 7, 0, 1)
        top = np.interp(x, knots[:, 0], knots[:, 1]) * high
        low = family.floor_m + (0.0 if boxy else 0.10 * np.clip(1 - from_end * 2.5, 0, 1))
        tall = top - low
        # Right half of the section from the sill up to the middle of the hood; the left half mirrors it.
        right = [(-0.84 * width, low), (-0.955 * width, low + 0.05), (-0.992 * width, low + 0.30 * tall),
                 (-width, low + 0.58 * tall), (-0.985 * width, low + 0.80 * tall), (-0.95 * width, top - 0.035),
                 (-0.86 * width, top), (-0.5 * width, top + 0.018), (0.0, top + 0.028)]  # fmt: skip
        profile = right + [(-y, z) for y, z in right[-2::-1]]
        sections.append([(x * half_l, y, z) for y, z in profile])
    lattice = np.array(sections)
    paint.grid(lattice)
    for section, order in ((lattice[0], -1), (lattice[-1], 1)):
        count = len(section)
        fan = [[0, (i + 1) % count + 1, i + 1][::order] for i in range(count)]
        paint.add(np.concatenate([[section.mean(axis=0)], section]), fan, np.zeros((count + 1, 2)))
    return np.array([tail, nose]) * half_l


def _cabin(paint: MeshBuilder, family: Family, half_l: float, half_w: float, high: float) -> Surface:
    """The cabin; returns its walls as ``surface(side, s, t)``: side 0 rear, 1 right, 2 front, 3 left."""
    rear_low, rear_high, front_high, front_low = (f * half_l for f in family.cabin)
    boxy = family.roof_width > 0.88
    top_w, low_w = family.roof_width * half_w, half_w * (0.985 if boxy else 0.945)
    low, roof = family.belt * high - 0.02, high - 0.045
    if family.cargo is not None:
        roof = min(roof, 2.75 * high / 3.3)
    end = 0.99 if boxy else 0.93
    bottom = np.array([[rear_low, low_w * end, low], [rear_low, -low_w * end, low],
                       [front_low, -low_w * end, low], [front_low, low_w * end, low]])  # fmt: skip
    top_w *= 0.97
    top = np.array([[rear_high, top_w, roof], [rear_high, -top_w, roof], [front_high, -top_w, roof],
                    [front_high, top_w, roof]])  # fmt: skip
    outward = np.array([[-1, 0, 0], [0, -1, 0], [1, 0, 0], [0, 1, 0]], np.float64)
    bulge = (0.05, 0.028, 0.05 if boxy else 0.12, 0.028)

    def surface(side: int, s: float, t: float) -> np.ndarray:
        a, b = side, (side + 1) % 4
        # Bilinear between bottom and roof edge, bulging outwards by a parabola along the side.
        point = (bottom[a] * (1 - s) + bottom[b] * s) * (1 - t) + (top[a] * (1 - s) + top[b] * s) * t
        return point + outward[side] * bulge[side] * 4 * s * (1 - s)

    steps = np.linspace(0, 1, 7)
    ring = [(side, s) for side in range(4) for s in steps[:-1]] + [(0, 0.0)]
    walls = np.array([[surface(side, s, t) for t in (0.0, 0.5, 1.0)] for side, s in ring])
    paint.grid(walls)
    edge = walls[:, -1]
    middle = np.array([(rear_high + front_high) / 2, 0, 0])
    crown = (edge - middle) * [0.93, 0.86, 1] + middle + [0, 0, 0.034]
    paint.grid(np.stack([edge, crown], axis=1))
    peak = middle + [0, 0, roof + 0.045]
    count = len(crown) - 1
    paint.add(np.concatenate([crown[:-1], [peak]]), [[i, (i + 1) % count, count] for i in range(count)],
              np.zeros((count + 1, 2)))  # fmt: skip
    return surface


def _windows(glass: MeshBuilder, family: Family, surface: Surface) -> None:
    panes = [(2, 0.05, 0.95, 0.10, 0.93)]
    if family.rear_pane:
        panes.append((0, 0.08, 0.92, 0.16, 0.90))
    for start, end in family.panes:
        panes += [(1, start, end, 0.10, 0.88), (3, 1 - end, 1 - start, 0.10, 0.88)]
    for side, s0, s1, t0, t1 in panes:
        s, t = np.linspace(s0, s1, 6), np.linspace(t0, t1, 3)
        lattice = np.array([[surface(side, a, b) for b in t] for a in s])
        normal = np.cross(lattice[-1, 0] - lattice[0, 0], lattice[0, -1] - lattice[0, 0])
        # 12 mm in front of the body, so that glass and paint do not intersect.
        glass.grid(lattice + normal / np.linalg.norm(normal) * 0.012)


def _wheels(parts: dict[str, MeshBuilder], family: Family, half_l: float, half_w: float) -> None:
    radius = family.wheel_m
    for x in family.axles:
        for side in (-1, 1):
            inner, outer = side * (half_w - 0.24), side * (half_w + 0.012)
            # The caps show the whole wheel texture, the tread its corner, which is rubber.
            parts["wheel"].cylinder([x * half_l, inner, radius], [x * half_l, outer, radius], radius, sides=20,
                                    side_uv=RUBBER)  # fmt: skip


def _lamps(parts: dict[str, MeshBuilder], family: Family, half_l: float, half_w: float, high: float) -> None:
    """Lamps wrap around the body's corners."""
    boxy = family.roof_width > 0.88
    nose, tail = family.top[-1][0] * half_l, (family.cargo or (family.top[0][0],))[0] * half_l
    reach = 0.05 if boxy else 0.13
    for name, end, sign, (low, up) in (("headlight", nose, 1, family.lamp), ("taillight", tail, -1, family.tail_lamp)):
        inner = (0.60 if boxy else 0.50) if sign > 0 else (0.78 if boxy else 0.58)
        edge = half_w * (0.99 if boxy else 0.925)
        for side in (-1, 1):
            # From the inner end across the front to a little way along the side.
            outline = np.array([[end + sign * 0.012, side * inner * half_w], [end + sign * 0.012, side * edge * 0.93],
                                [end - sign * 0.035, side * (edge + 0.002)],
                                [end - sign * reach * half_l, side * half_w * (1.012 if boxy else 0.995)]])  # fmt: skip
            rise = np.array([0.0, 0.01, 0.02, 0.035 if not boxy else 0.0]) * high
            lower = np.column_stack([outline, low * high + rise])
            upper = np.column_stack([outline, up * high + rise * 0.5])
            lattice = np.stack([lower, upper], axis=1)
            parts[name].grid(lattice if sign * side > 0 else lattice[::-1])
    if boxy and family.rear_pane:
        for side in (-1, 1):
            parts["taillight"].box([tail, side * half_w * 0.9, high * 0.9], [0.02, 0.05, 0.04])


def _trim(
    parts: dict[str, MeshBuilder], family: Family, half_l: float, half_w: float, high: float, ends: np.ndarray
) -> None:
    trim, boxy = parts["trim"], family.roof_width > 0.88
    tail, nose = ends
    floor = family.floor_m
    trim.box([(tail + nose) / 2, 0, floor + 0.045], [(nose - tail) / 2 * 0.96, half_w * 0.90, 0.05])
    for end, sign in ((nose, 1), (tail, -1)):
        trim.box([end - sign * 0.02, 0, floor + 0.17], [0.035, half_w * 0.72, 0.055])
    rear = (family.cargo or (family.top[0][0],))[0] * half_l
    parts["plate"].box([nose + 0.012, 0, floor + 0.25], [0.010, 0.26, 0.056])
    parts["plate"].box(
        [rear - 0.004, 0, floor + (0.34 if boxy else 0.30) * high * (0.6 if boxy else 0.9)], [0.010, 0.26, 0.056]
    )
    mirror_x = (family.cabin[3] * 0.80 + family.cabin[2] * 0.20) * half_l
    mirror_z = family.belt * high + (0.35 if boxy else 0.06)
    for side in (-1, 1):
        trim.box(
            [mirror_x, side * (half_w + 0.01), mirror_z],
            [0.05, MIRROR_M - 0.01, 0.16 if boxy and high > 2.4 else 0.065],
        )
    if family.rails:
        for side in (-1, 1):
            middle, length = (family.cabin[1] + family.cabin[2]) / 2, (family.cabin[2] - family.cabin[1]) / 2
            trim.box([middle * half_l, side * family.roof_width * 0.9 * half_w, high - 0.022],
                     [length * half_l * 0.86, 0.018, 0.02])  # fmt: skip
    if family.bed is not None:
        rear, front = (x * half_l for x in family.bed)
        top = np.interp(-0.6, *np.array(family.top).T) * high
        trim.box([(rear + front) / 2, 0, top], [(front - rear) / 2, half_w * 0.80, 0.036])


def _with_atlas(paint: MeshBuilder, size_m: tuple[float, float, float]) -> MeshBuilder:
    """The same surface mapped to the body atlas by face orientation."""
    place, smooth, _ = paint.corners(36.0)
    # The atlas region follows the flat normal of a face, so that no triangle spans two regions.
    flat = np.cross(place[1::3] - place[::3], place[2::3] - place[::3])
    flat = np.repeat(flat / np.linalg.norm(flat, axis=1, keepdims=True), 3, axis=0)
    mesh = MeshBuilder()
    mesh.add(place, np.arange(len(place)).reshape(-1, 3), atlas_uv(place, flat, size_m), smooth)
    return mesh


def _fit(parts: dict[str, MeshBuilder], size_m: tuple[float, float, float]) -> None:
    """Scales all parts together so that they touch every side of the box."""
    points = np.concatenate([part.points for part in parts.values()])
    low, high = points.min(axis=0), points.max(axis=0)
    scale = np.asarray(size_m) / (high - low)
    for part in parts.values():
        part.transform(scale, -scale * (low + high) / 2)
