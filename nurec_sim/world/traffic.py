"""Who drives where and how fast: the recorded ego, the slower lead car, oncoming cars, parked cars and pedestrians.

Cars keep right. Speeds follow the intelligent driver model (Treiber, Hennecke, Helbing 2000) at 20 Hz.
"""

from __future__ import annotations

import numpy as np

from nurec_sim.world.plan import Actor
from nurec_sim.world.road import RoadLine

STEP_US = 50_000
REAR_AXLE_TO_BOX = 0.29  # of the length: how far a car's box centre lies ahead of its rear axle
EGO_FRONT_M = 3.85  # rear axle to front bumper of types.Rig.body
CAR_SIZES_M = {
    "hatch": (4.05, 1.76, 1.48),
    "sedan": (4.70, 1.83, 1.44),
    "wagon": (4.75, 1.84, 1.49),
    "suv": (4.65, 1.90, 1.70),
    "van": (5.20, 2.00, 2.15),
}
COLOURS = (
    (0.86, 0.86, 0.87), (0.10, 0.10, 0.11), (0.55, 0.56, 0.58), (0.62, 0.07, 0.07), (0.09, 0.20, 0.48),
    (0.20, 0.34, 0.24), (0.76, 0.70, 0.58), (0.85, 0.55, 0.10), (0.14, 0.45, 0.60), (0.30, 0.31, 0.34),
)  # fmt: skip


def follow(speed: float, wanted: float, gap_m: float | None, lead_speed: float) -> float:
    """Acceleration (m/s^2) by the intelligent driver model; ``gap_m`` None for a free road."""
    free = 1.5 * (1 - (speed / wanted) ** 4)
    if gap_m is None:
        return float(np.clip(free, -3.0, 1.5))
    desired = 4.0 + max(0.0, speed * 1.1 + speed * (speed - lead_speed) / (2 * np.sqrt(1.5 * 2.0)))
    return float(np.clip(free - 1.5 * (desired / max(gap_m, 0.1)) ** 2, -4.0, 1.5))


def comfortable_speed(road: RoadLine, station_m: float, wanted: float) -> float:
    """The wanted speed, lowered so that the next 12 m of road need at most 2.2 m/s^2 sideways."""
    ahead = np.abs([road.curvature_at(station_m + d) for d in (0.0, 4.0, 8.0, 12.0)])
    return float(min(wanted, np.sqrt(2.2 / max(float(ahead.max()), 1e-6))))


def drive_ego_and_lead(
    road: RoadLine, steps: int, ego_station_m: float, lead_station_m: float, speed: float, lead_length_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rear-axle stations of the ego and of the lead car in front of it, ``steps + 1`` each.

    The lead slows to about 0.7 of the ego's first speed; the ego keeps its distance.
    """
    dt = STEP_US * 1e-6
    ego, lead = [ego_station_m], [lead_station_m]
    ego_speed, lead_speed = speed, speed * 0.87
    for step in range(steps):
        slow = speed * (0.87 if step * dt < 2.0 else 0.72)
        lead_accel = follow(lead_speed, comfortable_speed(road, lead[-1], slow), None, 0.0)
        gap = lead[-1] - lead_length_m * (0.5 - REAR_AXLE_TO_BOX) - ego[-1] - EGO_FRONT_M
        ego_accel = follow(ego_speed, comfortable_speed(road, ego[-1], speed * 1.05), gap, lead_speed)
        for stations, now, accel in ((ego, ego_speed, ego_accel), (lead, lead_speed, lead_accel)):
            stations.append(stations[-1] + max(now + accel * dt / 2, 0.0) * dt)
        ego_speed, lead_speed = max(ego_speed + ego_accel * dt, 0.0), max(lead_speed + lead_accel * dt, 0.0)
    return np.array(ego), np.array(lead)


def car(
    name: str, kind: str, colour: int, road: RoadLine, t_us: np.ndarray, axle_station_m: np.ndarray, backwards: bool
) -> Actor:
    """A moving car whose rear axle follows its lane; ``backwards`` drives against the stations (oncoming)."""
    lane = road.road.lane_width_m / 2 * (1 if backwards else -1)
    xy, yaw = road.at(axle_station_m, lane)
    yaw = yaw + np.pi if backwards else yaw
    size = CAR_SIZES_M[kind]
    ahead = size[0] * REAR_AXLE_TO_BOX
    xy = xy + ahead * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    path = tuple(
        (int(t), float(x), float(y), size[2] / 2, float(a)) for t, (x, y), a in zip(t_us, xy, yaw, strict=True)
    )
    return Actor(name, kind, size, COLOURS[colour % len(COLOURS)], True, path)


def parked_car(name: str, kind: str, colour: int, road: RoadLine, span_us: tuple[int, int], station_m: float, side: int,
               slack: tuple[float, float]) -> Actor:  # fmt: skip
    """A car that stands in a parking strip (``side`` -1 right, 1 left), a little off the ideal (metres, radians)."""
    size = CAR_SIZES_M[kind]
    offset = side * (road.road.half_width_m - 0.12 - size[1] / 2 - abs(slack[0]))
    xy, yaw = road.at(station_m, offset)
    heading = float(yaw) + (np.pi if side > 0 else 0.0) + slack[1]
    path = tuple((t, float(xy[0]), float(xy[1]), size[2] / 2, heading) for t in span_us)
    return Actor(name, kind, size, COLOURS[colour % len(COLOURS)], False, path)


def pedestrian(
    name: str, colour: int, road: RoadLine, t_us: np.ndarray, station_m: np.ndarray, offset_m: float
) -> Actor:
    """Somebody who walks along a sidewalk, towards growing or falling stations."""
    xy, yaw = road.at(station_m, offset_m)
    yaw = yaw + np.pi if station_m[-1] < station_m[0] else yaw
    size = (0.9, 0.62, 1.76)
    z = road.road.kerb_height_m + size[2] / 2
    path = tuple((int(t), float(x), float(y), z, float(a)) for t, (x, y), a in zip(t_us, xy, yaw, strict=True))
    return Actor(name, "pedestrian", size, COLOURS[colour % len(COLOURS)], True, path)
