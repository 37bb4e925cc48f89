"""Weather: sun, fill and ambient light for MuJoCo's classic renderer, and fog.

The classic renderer adds light without any gamma: colours are those of the final image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float32, UInt8

from nurec_sim.world.model.sky import Colour, Sky, sun_direction
from nurec_sim.world.plan.town import Weather


@dataclass(frozen=True)
class Illumination:
    """Diffuse light 0..1 of the sun, ambient light of the sky, and fill light opposite to the sun."""

    sun: Colour
    ambient: Colour
    fill: Colour
    highlight: float


_PRESETS: dict[str, Illumination] = {
    "clear": Illumination((0.80, 0.76, 0.68), (0.36, 0.39, 0.44), (0.13, 0.14, 0.17), 0.40),
    "hazy": Illumination((0.56, 0.54, 0.49), (0.50, 0.51, 0.52), (0.14, 0.14, 0.15), 0.28),
    "overcast": Illumination((0.24, 0.25, 0.26), (0.66, 0.67, 0.70), (0.15, 0.15, 0.16), 0.16),
    "wet": Illumination((0.18, 0.19, 0.20), (0.56, 0.58, 0.61), (0.13, 0.13, 0.14), 0.20),
    "foggy": Illumination((0.14, 0.14, 0.14), (0.70, 0.71, 0.72), (0.12, 0.12, 0.12), 0.05),
    "sunset": Illumination((0.78, 0.56, 0.34), (0.37, 0.35, 0.39), (0.12, 0.11, 0.13), 0.45),
    "dusk": Illumination((0.16, 0.14, 0.16), (0.36, 0.36, 0.45), (0.10, 0.10, 0.13), 0.10),
}


def illumination(weather: Weather) -> Illumination:
    """The lights of a weather's preset.

    Raises:
        ValueError: the preset has no lights.
    """
    if weather.preset not in _PRESETS:
        raise ValueError(f"no lights for weather preset {weather.preset!r}; have {sorted(_PRESETS)}")
    return _PRESETS[weather.preset]


def add_lights(spec: Any, weather: Weather) -> None:
    """Sun, a weak fill light from the opposite side so that shaded walls keep contrast, and ambient light."""
    light, sun = illumination(weather), sun_direction(weather)
    directional = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    # From the opposite side, but always from above.
    fill = np.array([-sun[0], -sun[1], 0.8])
    spec.worldbody.add_light(name="sun", type=directional, pos=(sun * 120).tolist(), dir=(-sun).tolist(),
                             ambient=[0, 0, 0], diffuse=list(light.sun), specular=[light.highlight] * 3,
                             castshadow=True)  # fmt: skip
    away = -fill / np.linalg.norm(fill)
    spec.worldbody.add_light(name="fill", type=directional, dir=away.tolist(), ambient=[0, 0, 0],
                             diffuse=list(light.fill), specular=[0, 0, 0], castshadow=False)  # fmt: skip
    headlight = spec.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = list(light.ambient), [0.05] * 3, [0, 0, 0]


def add_fog(
    rgb: UInt8[np.ndarray, "h w 3"], distance_m: Float32[np.ndarray, "h w"], sky: Sky, fog_per_m: float
) -> UInt8[np.ndarray, "h w 3"]:
    """Applies fog of the horizon's colour; the sky is unchanged.

    Fog leaves ``exp(-fog_per_m * distance)`` of the light (Beer-Lambert).

    Args:
        rgb: image without fog.
        distance_m: distance of each pixel's surface, 0 for the sky.
        sky: for the colour of the horizon.
        fog_per_m: extinction coefficient; 0 is clear air.
    """
    if fog_per_m <= 0:
        return rgb
    left = np.exp(-np.float32(fog_per_m) * distance_m)[..., None]
    horizon = sky.horizon.astype(np.float32)
    return (rgb * left + horizon * (1 - left) + np.float32(0.5)).astype(np.uint8)
