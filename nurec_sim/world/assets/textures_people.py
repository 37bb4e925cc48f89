"""One small texture per person: bands of skin, hair, shirt, trousers and shoes that all its meshes share.

The image is divided into five horizontal bands, from the top: ``BANDS``. Meshes put their v inside a band.
"""

from __future__ import annotations

import numpy as np

from nurec_sim.world.assets.textures import Image, as_image, grain, noise

BANDS = ("skin", "hair", "shirt", "trousers", "shoes")
SIZE_PX = 80
_SKINS = ((224, 184, 156), (202, 156, 124), (164, 116, 84), (112, 76, 56), (84, 58, 44))
_HAIRS = ((40, 32, 28), (74, 52, 36), (120, 88, 52), (168, 140, 92), (150, 148, 146), (28, 26, 26))
_TROUSERS = ((40, 48, 72), (34, 34, 38), (92, 86, 74), (58, 66, 84), (110, 104, 92), (64, 50, 44))
_SHOES = ((30, 28, 28), (220, 218, 214), (92, 64, 44))


def band_uv(band: str, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Texture coordinates ``[..., 2]`` of fractions (u, v) of a band."""
    row = BANDS.index(band)
    margin = 0.1
    # A margin keeps filtering from reading neighbouring bands.
    inside = margin + (1 - 2 * margin) * np.clip(v, 0, 1)
    return np.stack([u, 1 - (row + 1 - inside) / len(BANDS)], axis=-1)


def person(rng: np.random.Generator, shirt: tuple[float, float, float]) -> Image:
    """Clothes around a ``shirt`` colour (0..1): plain, striped, checked, or an open jacket."""
    image = np.empty((SIZE_PX, SIZE_PX, 3), np.float32)
    step = SIZE_PX // len(BANDS)
    trousers = np.array(_TROUSERS[rng.integers(len(_TROUSERS))], np.float32) * rng.uniform(0.8, 1.2)
    if rng.random() < 0.08:
        trousers = 255 * np.asarray(shirt, np.float32) * 0.9
    colours = (_SKINS[rng.integers(len(_SKINS))], _HAIRS[rng.integers(len(_HAIRS))], 255 * np.asarray(shirt), trousers,
               _SHOES[rng.integers(len(_SHOES))])  # fmt: skip
    for row, colour in enumerate(colours):
        image[row * step : (row + 1) * step] = np.asarray(colour, np.float32)
    wear = image[2 * step : 3 * step]
    pattern = int(rng.integers(5))
    if pattern == 1:
        wear[::4] *= 0.55
    elif pattern == 2:
        wear[:, ::10] *= 0.6
        wear[::5] *= 0.7
    elif pattern == 3:  # u = 0.5 is the breast
        wear[:, SIZE_PX // 2 - 5 : SIZE_PX // 2 + 5] = (216, 212, 204)
    image *= (1 + 0.05 * grain(rng, SIZE_PX, 0.8) + 0.22 * (noise(rng, SIZE_PX, 3, 5) - 0.5))[..., None]
    return as_image(image)
