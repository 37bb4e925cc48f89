"""Meshes of cars, in the frame of their box: x forward, y left, z up, origin at the box centre."""

from __future__ import annotations

import numpy as np

from nurec_sim.world.meshes import MeshBuilder

# Fractions of the half length at which the greenhouse stands: (rear bottom, rear top, front top, front bottom).
GREENHOUSE = {
    "hatch": (-0.93, -0.72, 0.12, 0.46),
    "sedan": (-0.66, -0.30, 0.08, 0.44),
    "wagon": (-0.94, -0.82, 0.10, 0.44),
    "suv": (-0.93, -0.80, 0.12, 0.42),
    "van": (-0.97, -0.93, 0.36, 0.68),
}
BELT = {"hatch": 0.62, "sedan": 0.63, "wagon": 0.61, "suv": 0.62, "van": 0.53}
PARTS = ("paint", "glass", "dark", "rim", "headlight", "taillight")


def car_parts(kind: str, size_m: tuple[float, float, float]) -> dict[str, MeshBuilder]:
    """The parts of a car that together fill its box exactly.

    Raises:
        ValueError: no such kind of car.
    """
    if kind not in GREENHOUSE:
        raise ValueError(f"no car of kind {kind!r}; have {sorted(GREENHOUSE)}")
    parts = {name: MeshBuilder() for name in PARTS}
    half_l, half_w, high = size_m[0] / 2, size_m[1] / 2, size_m[2]
    floor, wheel = (0.26, 0.37) if kind == "suv" else (0.19, 0.33)
    belt = BELT[kind] * high
    front, rear = _body(parts["paint"], kind, half_l, half_w, floor, belt)
    _greenhouse(parts["paint"], parts["glass"], kind, half_l, half_w, belt - 0.02, high)
    dark, rim = parts["dark"], parts["rim"]
    dark.box([0, 0, floor + 0.02], [half_l * 0.95, half_w * 0.93, 0.06])
    for x in (front, rear):
        dark.box([x, 0, floor + 0.16], [0.05, half_w * 0.74, 0.09])
        rim.box([x + np.sign(x) * 0.045, 0, floor + 0.2], [0.02, 0.26, 0.06])
    for x in (-0.6 * half_l, 0.62 * half_l):
        for side in (-1, 1):
            dark.cylinder([x, side * (half_w - 0.24), wheel], [x, side * (half_w - 0.01), wheel], wheel, sides=18)
            dark.cylinder([x, side * (half_w - 0.02), wheel + 0.02], [x, side * (half_w + 0.004), wheel + 0.02],
                          wheel * 1.13, sides=18)  # fmt: skip
            rim.cylinder(
                [x, side * (half_w - 0.05), wheel], [x, side * (half_w + 0.014), wheel], wheel * 0.62, sides=14
            )
    lamp = floor + (belt - floor) * 0.62
    for side in (-1, 1):
        parts["headlight"].box([front - 0.07, side * half_w * 0.66, lamp], [0.09, 0.17, 0.07])
        parts["taillight"].box([rear + 0.03, side * half_w * 0.74, lamp + 0.06], [0.06, 0.15, 0.09])
    _fit(parts, size_m)
    return parts


def _body(
    paint: MeshBuilder, kind: str, half_l: float, half_w: float, floor: float, belt: float
) -> tuple[float, float]:
    """Lofts cross-sections (x, top, half width) into the lower body; gives the x of its front and rear end."""
    if kind == "van":
        stations = [(-1, 1, 0.96), (-0.95, 1, 1), (0.45, 1, 1), (0.66, 0.98, 0.98), (0.9, 0.82, 0.93), (1, 0.6, 0.82)]
    else:
        stations = [(-1, 0.72, 0.86), (-0.97, 0.95, 0.93), (-0.8, 0.99, 0.985), (-0.3, 1, 1), (0.25, 1, 1),
                    (0.42, 0.99, 0.995), (0.8, 0.88, 0.96), (0.96, 0.78, 0.86), (1, 0.58, 0.76)]  # fmt: skip
    sections = []
    for x, top, width in stations:
        top, width = top * belt, width * half_w
        right = [(-0.9 * width, floor), (-0.985 * width, floor + 0.12), (-width, floor + (top - floor) * 0.55),
                 (-0.97 * width, top - 0.06), (-0.87 * width, top), (-0.4 * width, top + 0.015),
                 (0.0, top + 0.02)]  # fmt: skip
        profile = right + [(-y, z) for y, z in right[-2::-1]]
        sections.append([(x * half_l, y, z) for y, z in profile])
    lattice = np.array(sections)
    paint.grid(lattice)
    for section, order in ((lattice[0], -1), (lattice[-1], 1)):
        count = len(section)
        fan = [[0, (i + 1) % count + 1, i + 1][::order] for i in range(count)]
        paint.add(np.concatenate([[section.mean(axis=0)], section]), fan, np.zeros((count + 1, 2)))
    return half_l * 0.985, -half_l * 0.985


def _greenhouse(
    paint: MeshBuilder, glass: MeshBuilder, kind: str, half_l: float, half_w: float, low: float, high: float
) -> None:
    rear_low, rear_high, front_high, front_low = (f * half_l for f in GREENHOUSE[kind])
    top_w = half_w * (0.92 if kind == "van" else 0.76)
    low_w = half_w * (0.985 if kind == "van" else 0.95)
    roof = high - 0.06
    bottom = np.array([[rear_low, low_w * 0.96, low], [rear_low, -low_w * 0.96, low],
                       [front_low, -low_w * 0.9, low], [front_low, low_w * 0.9, low]])  # fmt: skip
    top = np.array([[rear_high, top_w, roof], [rear_high, -top_w, roof], [front_high, -top_w, roof],
                    [front_high, top_w, roof]])  # fmt: skip
    crown = top * [0.94, 0.8, 1] + [0.03 * (rear_high + front_high), 0, 0.06]
    paint.quad(*crown)
    for i in range(4):  # rear, right, front, left
        j = (i + 1) % 4
        paint.quad(bottom[i], bottom[j], top[j], top[i])
        paint.quad(top[i], top[j], crown[j], crown[i])
        normal = np.cross(bottom[j] - bottom[i], top[i] - bottom[i])
        lift = normal / np.linalg.norm(normal) * 0.012
        if i in (0, 2):
            panes = [(0.06, 0.94)]
        elif kind == "van":
            panes = [(0.68, 0.96)] if i == 1 else [(0.04, 0.32)]
        else:
            panes = [(0.04, 0.47), (0.53, 0.96)]
        for start, end in panes:

            def place(s: float, t: float, i: int = i, j: int = j, lift: np.ndarray = lift) -> np.ndarray:
                return (bottom[i] * (1 - s) + bottom[j] * s) * (1 - t) + (top[i] * (1 - s) + top[j] * s) * t + lift

            glass.quad(place(start, 0.1), place(end, 0.1), place(end, 0.9), place(start, 0.9))


def _fit(parts: dict[str, MeshBuilder], size_m: tuple[float, float, float]) -> None:
    """Scales all parts together so that they touch every side of the box."""
    points = np.concatenate([part.points for part in parts.values()])
    low, high = points.min(axis=0), points.max(axis=0)
    scale = np.asarray(size_m) / (high - low)
    for part in parts.values():
        part.transform(scale, -scale * (low + high) / 2)
