"""How much traffic a town has, and which way the ego goes: what ``town_plan`` can be asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

Turn = Literal["left", "right", "straight"]
TURNS: tuple[Turn, ...] = get_args(Turn)
"""Ways through the first junction of the ego's route."""
Traffic = Literal["usual", "dense"]


@dataclass(frozen=True)
class Density:
    """Bounds of the random traffic around the ego.

    Attributes:
        vehicles: least and largest number of vehicles that drive.
        spacing_m: bounds of the mean distance between vehicles of a lane, before the nearest ones are taken.
        lead: probability of a lead car.
        walkers: least and largest number of pedestrians on sidewalks.
        crossers: probability of zero, one or two pedestrians at a crossing nearby.
        parked: bounds of the occupied share of a parking strip.
        lively: number of actors that move close ahead of the ego in a lively drive.
    """

    vehicles: tuple[int, int] = (8, 18)
    spacing_m: tuple[float, float] = (12.0, 40.0)
    lead: float = 0.8
    walkers: tuple[int, int] = (3, 8)
    crossers: tuple[float, float, float] = (0.5, 0.35, 0.15)
    parked: tuple[float, float] = (0.2, 0.95)
    lively: int = 2


DENSITIES: dict[Traffic, Density] = {
    "usual": Density(),
    "dense": Density(
        vehicles=(20, 30), spacing_m=(4.0, 10.0), lead=1.0, walkers=(10, 16), crossers=(0.1, 0.4, 0.5),
        parked=(0.75, 0.98), lively=5,
    ),
}  # fmt: skip
