"""Random appearance of a town: materials, light and weather."""

from __future__ import annotations

import numpy as np

from nurec_sim.world.plan.splits import ASPHALTS, FACADES, FOLIAGES, PAVINGS, SKIES, Choices, Split
from nurec_sim.world.plan.terrain import Terrain, Wave
from nurec_sim.world.plan.town import Style, Weather

STEEPEST = 0.06
"""Maximum slope of any town."""
SUN_ELEVATION_RAD = {"sunset": (0.12, 0.22), "dusk": (0.05, 0.14)}
CLOUD_COVER = {
    "clear": (0.1, 0.45), "hazy": (0.2, 0.5), "overcast": (0.9, 1.0), "sunset": (0.3, 0.6), "dusk": (0.2, 0.6),
    "foggy": (0.85, 1.0), "wet": (0.75, 1.0),
}  # fmt: skip
FOG_PER_M = {"hazy": (0.002, 0.005), "overcast": (0.0, 0.0015), "foggy": (0.008, 0.016), "wet": (0.0005, 0.003)}


def _pick(rng: np.random.Generator, choices: Choices, split: Split) -> str:
    """A shared name for split train, a held-out one for test."""
    names = choices.held_out if split == "test" else choices.shared
    return str(names[int(rng.integers(len(names)))])


def _several(rng: np.random.Generator, choices: Choices, split: Split, count: int) -> tuple[str, ...]:
    """Several shared names; for split test the first one is held out."""
    names = [str(name) for name in rng.permutation(choices.shared)[:count]]
    return tuple([_pick(rng, choices, split), *names[:-1]]) if split == "test" else tuple(names)


def town_style(rng: np.random.Generator, split: Split) -> Style:
    """Districts, texture families and paint."""
    district = ("urban", "suburb", "mixed")[int(rng.integers(3))]
    return Style(
        district=district,  # type: ignore[arg-type]
        facades=_several(rng, FACADES, split, 2 if district == "suburb" else 3),
        asphalt=_pick(rng, ASPHALTS, split),
        paving=_pick(rng, PAVINGS, split),
        foliages=_several(rng, FOLIAGES, split, 2),
        yellow_lines=bool(rng.random() < 0.25),
        texture_seed=int(rng.integers(2**31)),
    )


def town_weather(rng: np.random.Generator, split: Split) -> Weather:
    """A sky preset and its numbers. Every other test town has a shared preset."""
    shared = split == "train" or rng.random() < 0.5
    names = SKIES.shared if shared else SKIES.held_out
    chance = np.array([2.0 if name == "clear" else 1.0 for name in names])
    preset = str(names[int(rng.choice(len(names), p=chance / chance.sum()))])

    def within(bounds: tuple[float, float]) -> float:
        return round(float(rng.uniform(*bounds)), 4)

    return Weather(
        preset=preset,
        sun_azimuth_rad=within((-np.pi, np.pi)),
        sun_elevation_rad=within(SUN_ELEVATION_RAD.get(preset, (0.45, 1.1))),
        cloud_cover=within(CLOUD_COVER[preset]),
        fog_per_m=within(FOG_PER_M.get(preset, (0.0, 0.0))),
        wetness=within((0.6, 1.0)) if preset == "wet" else 0.0,
        dusk={"dusk": 1.0, "sunset": 0.4}.get(preset, 0.0),
    )


def town_terrain(rng: np.random.Generator) -> Terrain:
    """Flat ground with probability 0.2, else two to four long waves."""
    if rng.random() < 0.2:
        return Terrain()
    count = int(rng.integers(2, 5))
    # A Dirichlet sample divides the total slope between the waves, so that it never exceeds STEEPEST.
    steep = rng.uniform(0.015, STEEPEST) * rng.dirichlet(np.full(count, 2.0))
    waves = []
    for slope in steep:
        length = float(rng.uniform(140.0, 380.0))
        # The steepest slope of A sin(2 pi s / L) is 2 pi A / L.
        amplitude = float(slope) * length / (2 * np.pi)
        waves.append(Wave(round(amplitude, 4), round(length, 2), round(float(rng.uniform(-np.pi, np.pi)), 4),
                          round(float(rng.uniform(-np.pi, np.pi)), 4)))  # fmt: skip
    return Terrain(tuple(waves))
