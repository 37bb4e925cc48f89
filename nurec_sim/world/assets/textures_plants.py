"""Textures of plants: one image per species with leaves above and bark below, so that a tree is one mesh."""

from __future__ import annotations

import cv2
import numpy as np

from nurec_sim.world.assets.textures import Image, as_image, grain, noise

BARK_SHARE = 0.125
"""The lowest part of a plant's texture is bark; leaves fill the rest."""

_LEAVES = {
    "broadleaf": ((72, 104, 44), (90, 116, 50), (60, 92, 48)),
    "conifer": ((46, 76, 50), (54, 84, 58), (64, 88, 52)),
    "birch": ((104, 130, 62), (120, 138, 70)),
    "autumn": ((176, 118, 44), (166, 84, 40), (190, 146, 58)),
}
_BARK = {"broadleaf": (104, 88, 70), "conifer": (96, 74, 58), "birch": (206, 204, 198), "autumn": (98, 82, 68)}


def plant(rng: np.random.Generator, family: str, size: int = 256) -> Image:
    """Leaves and bark of one family.

    Raises:
        ValueError: no such family.
    """
    if family not in _LEAVES:
        raise ValueError(f"no foliage family {family!r}; have {sorted(_LEAVES)}")
    colour = np.array(_LEAVES[family][rng.integers(len(_LEAVES[family]))], np.float32) * rng.uniform(0.88, 1.12)
    image = _leaves(rng, size, colour, needles=family == "conifer")
    high = int(size * BARK_SHARE)
    streaks = cv2.resize(rng.random((8, 48), dtype=np.float32), (size, high), interpolation=cv2.INTER_CUBIC)
    bark = (0.55 + 0.6 * streaks)[..., None] * np.array(_BARK[family], np.float32)
    if family == "birch":
        for _ in range(26):
            x, y = int(rng.integers(0, size)), int(rng.integers(0, high))
            cv2.line(bark, (x, y), (x + int(rng.integers(6, 18)), y), (52, 48, 46), 2)
    image[-high:] = bark
    return as_image(image)


def _leaves(rng: np.random.Generator, size: int, colour: np.ndarray, needles: bool) -> np.ndarray:
    """Many small leaves over dark gaps, lighter ones on top."""
    image = np.empty((size, size, 3), np.float32)
    image[:] = colour * 0.30
    count = 1500
    places = rng.integers(0, size, (count, 2))
    angles, tones = rng.uniform(0, 180, count), np.sort(rng.normal(0.95, 0.26, count))
    hues = 1 + rng.normal(0, 0.07, (count, 3))
    axes = (7, 1) if needles else (5, 3)
    for (x, y), angle, tone, hue in zip(places, angles, tones, hues, strict=True):
        shade = (colour * np.clip(tone, 0.35, 1.7) * hue).tolist()
        # Leaves over the left or right border are repeated on the other side, so that u tiles.
        for shift in ((0, 0), (size if x < 8 else -size, 0)) if x < 8 or x > size - 8 else ((0, 0),):
            cv2.ellipse(image, (int(x) + shift[0], int(y) + shift[1]), axes, float(angle), 0, 360, shade, -1)
    return image * (1 + 0.10 * grain(rng, size, 0.7) + 0.30 * (noise(rng, size, 3, 5) - 0.5))[..., None]
