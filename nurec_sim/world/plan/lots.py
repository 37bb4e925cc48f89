"""Houses along the roads, at road ends to close the view, and in the skyline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from nurec_sim.geometry import box_corners_xy, pose_from_xyyaw
from nurec_sim.world.plan.network import TownNetwork
from nurec_sim.world.plan.town import Building, Style

FACADE_VARIANTS = 4
"""Variants of a facade family in a town."""
NEAR_HOUSE_M = 1.0
"""Free ground between houses."""


@dataclass(frozen=True)
class _Manner:
    """Building parameters of a district: ranges in metres, ``floors`` as [low, high).

    ``gable`` and ``shop`` are probabilities of a gable roof and a ground-floor shop, ``built`` that a lot is built on.
    """

    width: tuple[float, float]
    depth: tuple[float, float]
    setback: tuple[float, float]
    gap: tuple[float, float]
    floors: tuple[int, int]
    gable: float
    shop: float
    built: float


_URBAN = _Manner((11, 22), (10, 15), (0.4, 2.5), (0.8, 4.0), (3, 8), 0.15, 0.55, 0.93)
_SUBURB = _Manner((9, 15), (8, 12), (4.5, 9.0), (4.0, 10.0), (1, 4), 0.85, 0.06, 0.86)


def town_houses(rng: np.random.Generator, network: TownNetwork, style: Style) -> tuple[Building, ...]:
    """All houses; none touches a road, a sidewalk or another house."""
    return _Lots(rng, network, style).build()


class _Lots:
    def __init__(self, rng: np.random.Generator, network: TownNetwork, style: Style):
        self.rng, self.network, self.style = rng, network, style
        # A small margin keeps walls and roof edges off the sidewalk; prepared geometry speeds up the many tests.
        self.streets = network.paved.buffer(0.3, quad_segs=2)
        shapely.prepare(self.streets)
        self.houses: list[Building] = []
        self.footprints: list[shapely.Polygon] = []
        # In mixed towns one half-plane through the middle is urban.
        self.divide = float(rng.uniform(-np.pi, np.pi))

    def build(self) -> tuple[Building, ...]:
        for line in self.network.roads.values():
            for side in (-1, 1):
                self._row(line.plan.id, side)
        self._ends()
        self._skyline()
        return tuple(self.houses)

    def _manner(self, xy: np.ndarray) -> _Manner:
        if self.style.district == "mixed":
            return _URBAN if xy @ [np.cos(self.divide), np.sin(self.divide)] > 0 else _SUBURB
        return _URBAN if self.style.district == "urban" else _SUBURB

    def _row(self, road: str, side: int) -> None:
        rng, line, kerb = self.rng, self.network.roads[road], self.network.plan.kerb
        # Rows start before the road does and end behind it, so that corners do not look open.
        station = float(rng.uniform(-8, 4))
        while station < line.length_m + 4:
            # The district is looked up at a typical half width, since the width depends on the district.
            middle = min(max(station + 7.0, 0.0), line.length_m)
            manner = self._manner(line.at(middle)[0])
            width, depth = float(rng.uniform(*manner.width)), float(rng.uniform(*manner.depth))
            middle = min(max(station + width / 2, 0.0), line.length_m)
            edge = abs(float(line.edge_m(side, middle))) + kerb.width_m + kerb.sidewalk_width_m
            away = edge + float(rng.uniform(*manner.setback)) + depth / 2
            xy, yaw = line.at(middle, side * away)
            # A house faces +y of its own frame: on the right of a road that is towards the road, on the left away from
            # it.
            facing = float(yaw) + (np.pi if side > 0 else 0.0)
            built = rng.random() < manner.built and self._place(
                xy, facing, width, depth, int(rng.integers(*manner.floors)), manner
            )
            # Where nothing fits, try again a little further along the road.
            station += width + float(rng.uniform(*manner.gap)) if built else 3.0

    def _ends(self) -> None:
        """A wide house across every open end of a road."""
        with_mouth = {(m.arm.road, m.arm.end) for arms in self.network.junction_mouths.values() for m in arms}
        for name, line in self.network.roads.items():
            for end, station, sign in (("start", 0.0, -1), ("end", line.length_m, 1)):
                if (name, end) in with_mouth:
                    continue
                xy, yaw = line.at(station)
                # Far enough beyond the end for the sidewalk, near enough to close the view along the road.
                away = xy + sign * 16.0 * np.array([np.cos(yaw), np.sin(yaw)])
                self._place(away, float(yaw + np.pi / 2), 28.0, 12.0, int(self.rng.integers(3, 6)), _URBAN)

    def _skyline(self) -> None:
        """Blocks beyond the town."""
        for angle in self.rng.uniform(0, 2 * np.pi, 34):
            xy = self.rng.uniform(120, 280) * np.array([np.cos(angle), np.sin(angle)])
            width, depth = (float(v) for v in self.rng.uniform(14, 28, 2))
            self._place(xy, float(self.rng.uniform(0, np.pi)), width, depth, int(self.rng.integers(4, 15)), _URBAN, 7.0)

    def _place(self, xy: np.ndarray, yaw: float, width: float, depth: float, floors: int, manner: _Manner,
               clear: float = NEAR_HOUSE_M) -> bool:  # fmt: skip
        rng = self.rng
        footprint = shapely.Polygon(box_corners_xy(pose_from_xyyaw(xy[0], xy[1], yaw), width, depth))
        if self.streets.intersects(footprint):
            return False
        # dwithin on all footprints at once is faster than buffering each candidate.
        if self.footprints and shapely.dwithin(np.array(self.footprints), footprint, clear).any():
            return False
        self.footprints.append(footprint)
        # Numbers are rounded because a plan is stored as text.
        red, green, blue = (round(float(v), 3) for v in rng.uniform(0.82, 1.0, 3))
        self.houses.append(Building(
            round(float(xy[0]), 3), round(float(xy[1]), 3), round(float(yaw), 5), round(width, 3), round(depth, 3),
            floors, round(float(rng.uniform(2.9, 3.4)), 3), int(rng.integers(FACADE_VARIANTS)),
            bool(floors > 2 and rng.random() < manner.shop), bool(floors <= 3 and rng.random() < manner.gable),
            (red, green, blue), self.style.facades[int(rng.integers(len(self.style.facades)))]))  # fmt: skip
        return True
