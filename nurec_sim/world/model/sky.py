"""The sky as a function of the viewing direction, consistent for all projections, and as MuJoCo skybox."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8
from numpy.typing import ArrayLike

from nurec_sim.world.assets.textures import noise
from nurec_sim.world.plan.town import Weather

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class SkyColours:
    """Colours (0..255) of a preset. ``glow`` is the strength of the halo around the sun, 0 without a visible sun."""

    zenith: Colour
    horizon: Colour
    cloud_lit: Colour
    cloud_dark: Colour
    glow: float
    sun: Colour = (255.0, 253.0, 244.0)


PRESETS: dict[str, SkyColours] = {
    "clear": SkyColours((62, 116, 192), (196, 213, 228), (252, 250, 245), (176, 186, 198), 1.0),
    "hazy": SkyColours((132, 160, 192), (214, 216, 213), (238, 236, 230), (196, 198, 200), 1.5),
    "overcast": SkyColours((168, 175, 184), (206, 209, 212), (214, 216, 219), (146, 152, 160), 0.12),
    "wet": SkyColours((134, 142, 152), (184, 189, 194), (192, 196, 200), (108, 115, 124), 0.0),
    "foggy": SkyColours((186, 190, 194), (202, 205, 207), (204, 206, 208), (194, 197, 200), 0.08),
    "sunset": SkyColours((72, 96, 152), (240, 176, 122), (255, 206, 160), (140, 108, 120), 1.9, (255.0, 226.0, 168.0)),
    "dusk": SkyColours((26, 36, 72), (126, 112, 132), (128, 108, 126), (44, 46, 70), 0.6, (255.0, 200.0, 150.0)),
}
CLOUD_CELLS_PX = 150.0
"""Pixels of the cloud texture per cloud height."""


class Sky:
    """A sky with clouds and a sun; directions are unit world vectors.

    Raises:
        ValueError: the weather's preset has no colours.
    """

    def __init__(self, rng: np.random.Generator, weather: Weather):
        if weather.preset not in PRESETS:
            raise ValueError(f"no sky preset {weather.preset!r}; have {sorted(PRESETS)}")
        self.colours, self.cover = PRESETS[weather.preset], weather.cloud_cover
        self.sun = sun_direction(weather)
        self.sun_seen = self.colours.glow > 0.3
        clouds = noise(rng, 1024, 8, 4, 0.56)
        # Normalised by its deviation, the noise exceeds a limit on about the same share of every sky.
        ranks = (clouds - clouds.mean()) / clouds.std()
        self._clouds = np.clip(0.5 + ranks / 4.4, 0, 1).astype(np.float32)
        self._tone = np.float32(rng.uniform(0.94, 1.04))

    @property
    def horizon(self) -> Float64[np.ndarray, " 3"]:
        """The horizon colour (0..255), into which distant objects fade."""
        return np.asarray(self.colours.horizon) * float(self._tone)

    def colour(self, direction: Float64[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Colours of unit world directions; below the horizon a little darker than the horizon."""
        direction = np.asarray(direction, np.float32)
        up = direction[..., 2:]
        flat = np.clip(up, 0, 1)
        # Air is thickest at the horizon, so the gradient is steepest there.
        blend = 1 - np.exp(-3.2 * flat)
        colour = _single(self.colours.horizon) * (1 - blend) + _single(self.colours.zenith) * blend
        towards = direction @ _single(self.sun)
        # A narrow and a wide halo around the sun, by the cosine to it.
        glow = np.exp((towards - 1) * 40)[..., None] * _single([70, 62, 46])
        glow = glow + np.exp((towards - 1) * 5)[..., None] * _single([34, 27, 14])
        colour = colour + self.colours.glow * glow
        cover, light = self._cloud(direction)
        lit = _single(self.colours.cloud_lit) + 0.35 * self.colours.glow * glow
        colour = colour + cover * (lit * light + _single(self.colours.cloud_dark) * (1 - light) - colour)
        if self.sun_seen:
            # A disc of 0.75 degrees radius with a soft edge, dimmed by clouds.
            disc = np.clip((towards - np.cos(np.deg2rad(0.75))) / 4e-5, 0, 1)[..., None] * (1 - 0.85 * cover)
            colour = colour + disc * (_single(self.colours.sun) - colour)
        colour = np.where(up < 0, _single(self.colours.horizon) * (1 + 0.35 * np.clip(up, -0.6, 0)), colour)
        return np.clip(colour * self._tone, 0, 255).astype(np.uint8)

    def _cloud(self, direction: np.ndarray) -> tuple[Float32[np.ndarray, "h w 1"], Float32[np.ndarray, "h w 1"]]:
        """Cloud opacity and brightness, 0..1."""
        up = np.maximum(direction[..., 2], 0.045)
        # Clouds lie on a plane at unit height; the bound on `up` limits their stretch near the horizon.
        plane = direction[..., :2] / up[..., None]
        # Clouds are lit from the sun, so the second look-up is a step towards it.
        here = self._thickness(plane)
        nearer = self._thickness(plane + np.float32(0.09) * _single(self.sun[:2]))
        limit = 0.5 + 0.75 * (0.5 - self.cover)
        cover = np.clip((here - limit) / 0.22, 0, 1) * np.clip((direction[..., 2] - 0.005) * 9, 0, 1)
        light = np.clip(0.72 + 2.6 * (here - nearer) - 0.75 * (here - limit), 0.0, 1.0)
        # Smoothstep: soft edges of clouds.
        return (cover * cover * (3 - 2 * cover))[..., None], light[..., None]

    def _thickness(self, plane: np.ndarray) -> np.ndarray:
        place = np.mod(plane * np.float32(CLOUD_CELLS_PX) + _single([310, 530]), 1024).astype(np.float32)
        return cv2.remap(self._clouds, np.ascontiguousarray(place[..., 0]), np.ascontiguousarray(place[..., 1]),
                         cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)  # fmt: skip

    def skybox(self, size: int = 512) -> UInt8[np.ndarray, "six_h w 3"]:
        """The six faces stacked for MuJoCo: right left up down front back of OpenGL's cube, y up."""
        t = ((np.arange(size) + 0.5) / size * 2 - 1).astype(np.float32)
        u, v = np.meshgrid(t, t)
        one = np.ones_like(u)
        faces = ((one, -v, -u), (-one, -v, u), (u, one, v), (u, -one, -v), (u, -v, one), (-u, -v, -one))
        # From OpenGL's axes (y up) to the world's (z up).
        return np.concatenate([self._face(np.stack([x, -z, y], axis=-1)) for x, y, z in faces])

    def _face(self, direction: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
        """One face; ``direction`` need not be normalised. Pixels below the horizon are skipped."""
        rows = int((direction[:, :, 2] > 0).any(axis=1).sum())
        width, image = direction.shape[1], np.empty(direction.shape, np.uint8)
        if rows < len(image):
            # Ground hides nearly all of it, so a few columns are enough.
            step = direction[rows:, :: max(1, len(image) // 8)]
            below = self.colour(step / np.linalg.norm(step, axis=-1, keepdims=True))
            image[rows:] = cv2.resize(below, (width, len(below)), interpolation=cv2.INTER_LINEAR)
        if rows:
            seen = direction[:rows]
            image[:rows] = self.colour(seen / np.linalg.norm(seen, axis=-1, keepdims=True))
        return image


def _single(values: ArrayLike) -> np.ndarray:
    return np.asarray(values, np.float32)


def sun_direction(weather: Weather) -> Float64[np.ndarray, " 3"]:
    """Unit vector towards the sun."""
    high, around = weather.sun_elevation_rad, weather.sun_azimuth_rad
    return np.array([np.cos(high) * np.cos(around), np.cos(high) * np.sin(around), np.sin(high)])
