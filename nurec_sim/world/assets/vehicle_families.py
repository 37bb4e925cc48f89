"""Shape parameters of vehicle families. Lengths along x are fractions of the half length.

Heights are fractions of the vehicle's height above the ground, widths fractions of its half width.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Family:
    """One family of vehicles.

    Attributes:
        top: the upper edge of the lower body, as (x, height) from tail to nose.
        belt: height at which the windows begin.
        cabin: x of the cabin's rear bottom, rear top, front top and front bottom.
        roof_width: of the roof's edge.
        panes: windows of one side, as (start, end) from the cabin's rear to its front.
        rear_pane: whether the tail has a window.
        floor_m: ground clearance.
        wheel_m: wheel radius.
        axles: x of the axles.
        lamp: lower and upper edge of the headlights.
        tail_lamp: lower and upper edge of the tail lights.
        cargo: x where a separate box begins (from the tail) and ends, or None.
        bed: x where an open bed begins and ends, or None.
        rails: whether the roof carries rails.
        doors: x of door seams on the side.
    """

    top: tuple[tuple[float, float], ...]
    belt: float
    cabin: tuple[float, float, float, float]
    roof_width: float
    panes: tuple[tuple[float, float], ...]
    lamp: tuple[float, float]
    tail_lamp: tuple[float, float]
    axles: tuple[float, ...]
    doors: tuple[float, ...]
    rear_pane: bool = True
    floor_m: float = 0.19
    wheel_m: float = 0.32
    cargo: tuple[float, float] | None = None
    bed: tuple[float, float] | None = None
    rails: bool = False


_TWO_PANES = ((0.07, 0.46), (0.51, 0.93))
_THREE_PANES = ((0.05, 0.27), (0.31, 0.60), (0.64, 0.94))

FAMILIES: dict[str, Family] = {
    "hatch": Family(
        top=((-1, 0.60), (-0.9, 0.63), (0.4, 0.62), (0.62, 0.585), (0.86, 0.53), (1, 0.45)), belt=0.62,
        cabin=(-0.95, -0.70, 0.10, 0.50), roof_width=0.74, panes=_TWO_PANES, lamp=(0.40, 0.50),
        tail_lamp=(0.47, 0.61), axles=(-0.62, 0.64), doors=(-0.42, 0.04, 0.44), wheel_m=0.31,
    ),
    "sedan": Family(
        top=((-1, 0.58), (-0.93, 0.655), (-0.6, 0.665), (0.35, 0.635), (0.6, 0.60), (0.88, 0.54), (1, 0.44)), belt=0.64,
        cabin=(-0.70, -0.36, 0.06, 0.46), roof_width=0.72, panes=_TWO_PANES, lamp=(0.41, 0.51),
        tail_lamp=(0.47, 0.60), axles=(-0.60, 0.62), doors=(-0.44, -0.02, 0.40),
    ),
    "wagon": Family(
        top=((-1, 0.58), (-0.92, 0.62), (0.36, 0.62), (0.62, 0.585), (0.88, 0.53), (1, 0.43)), belt=0.625,
        cabin=(-0.96, -0.82, 0.08, 0.46), roof_width=0.74, panes=_THREE_PANES, lamp=(0.40, 0.50),
        tail_lamp=(0.46, 0.60), axles=(-0.60, 0.62), doors=(-0.46, -0.03, 0.40), rails=True,
    ),
    "suv": Family(
        top=((-1, 0.57), (-0.93, 0.62), (0.4, 0.625), (0.64, 0.60), (0.9, 0.56), (1, 0.46)), belt=0.62,
        cabin=(-0.96, -0.83, 0.12, 0.46), roof_width=0.78, panes=_THREE_PANES, lamp=(0.44, 0.53),
        tail_lamp=(0.45, 0.60), axles=(-0.60, 0.64), doors=(-0.46, -0.02, 0.42), floor_m=0.25, wheel_m=0.37, rails=True,
    ),
    "van": Family(
        top=((-1, 0.50), (-0.97, 0.53), (0.55, 0.53), (0.72, 0.50), (0.9, 0.43), (1, 0.33)), belt=0.53,
        cabin=(-0.985, -0.965, 0.40, 0.76), roof_width=0.90, panes=((0.70, 0.95),), lamp=(0.30, 0.39),
        tail_lamp=(0.28, 0.46), axles=(-0.56, 0.66), doors=(-0.10, 0.28, 0.60), rear_pane=True, wheel_m=0.34,
    ),
    "minivan": Family(
        top=((-1, 0.53), (-0.95, 0.57), (0.46, 0.57), (0.7, 0.535), (0.9, 0.48), (1, 0.39)), belt=0.57,
        cabin=(-0.97, -0.86, 0.20, 0.68), roof_width=0.80, panes=((0.04, 0.26), (0.29, 0.57), (0.60, 0.88)),
        lamp=(0.36, 0.45), tail_lamp=(0.42, 0.58), axles=(-0.60, 0.64), doors=(-0.44, 0.06, 0.46),
    ),
    "pickup": Family(
        top=((-1, 0.55), (-0.97, 0.575), (0.42, 0.58), (0.64, 0.565), (0.92, 0.54), (1, 0.45)), belt=0.58,
        cabin=(-0.20, -0.13, 0.16, 0.44), roof_width=0.80, panes=((0.06, 0.42), (0.48, 0.92)), lamp=(0.43, 0.52),
        tail_lamp=(0.40, 0.56), axles=(-0.58, 0.62), doors=(-0.16, 0.12, 0.42), floor_m=0.30, wheel_m=0.39,
        bed=(-0.95, -0.24),
    ),
    "sports": Family(
        top=((-1, 0.62), (-0.92, 0.69), (-0.55, 0.70), (0.25, 0.66), (0.55, 0.60), (0.85, 0.51), (1, 0.38)), belt=0.665,
        cabin=(-0.74, -0.22, -0.04, 0.36), roof_width=0.68, panes=((0.22, 0.90),), lamp=(0.40, 0.50),
        tail_lamp=(0.54, 0.64), axles=(-0.60, 0.60), doors=(-0.24, 0.28), floor_m=0.14, wheel_m=0.33,
    ),
    "truck": Family(
        top=((0.40, 0.40), (0.42, 0.42), (0.97, 0.42), (1, 0.36)), belt=0.42,
        cabin=(0.41, 0.42, 0.88, 0.975), roof_width=0.93, panes=((0.30, 0.92),), lamp=(0.19, 0.25),
        tail_lamp=(0.20, 0.27), axles=(-0.66, -0.42, 0.72), doors=(0.52, 0.88), rear_pane=False, floor_m=0.42,
        wheel_m=0.48, cargo=(-1.0, 0.38),
    ),
    "bus": Family(
        top=((-1, 0.36), (-0.985, 0.37), (0.975, 0.37), (1, 0.33)), belt=0.37,
        cabin=(-0.985, -0.975, 0.965, 0.985), roof_width=0.96,
        panes=tuple((0.02 + 0.162 * i, 0.168 + 0.162 * i) for i in range(6)), lamp=(0.17, 0.225),
        tail_lamp=(0.20, 0.32), axles=(-0.52, 0.60), doors=(0.05, 0.20, 0.80, 0.93), floor_m=0.28, wheel_m=0.48,
    ),
}  # fmt: skip
