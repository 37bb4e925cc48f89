"""Ground textures: asphalt, paving, kerbs, grass, and decals on the road.

Images are uint8 ``[h, w, 3]``, tileable, or ``[h, w, 4]`` for decals with alpha.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from nurec_sim.world.assets.textures import Image, as_image, grain, noise

ASPHALT_TILE_M = 9.0
PAVING_TILE_M = 2.4
GRASS_TILE_M = 6.0

Decal = UInt8[np.ndarray, "h w 4"]
Grey = Float32[np.ndarray, "n n"]


def asphalt(rng: np.random.Generator, family: str, size: int = 1024) -> Image:
    """A road surface of one family; grain, aggregate, cracks and repairs from millimetres to metres.

    Raises:
        ValueError: no such family.
    """
    if family not in _ASPHALTS:
        raise ValueError(f"no asphalt family {family!r}; have {sorted(_ASPHALTS)}")
    return _ASPHALTS[family](rng, size)


def _bitumen(rng: np.random.Generator, size: int, level: float, cracks: int) -> Grey:
    """Stones in bitumen: the larger ones show as light and dark specks."""
    grey = level * (1 + 0.20 * (noise(rng, size, 4, 5) - 0.5) + 0.22 * (noise(rng, size, 3, 48) - 0.5))
    grey += 0.11 * level * grain(rng, size, 0.7) + 0.05 * level * grain(rng, size, 1.6)
    # Few bright and dark stones stick out of the bitumen.
    specks = rng.random((size, size), dtype=np.float32)
    grey[specks > 0.985] *= 1.35
    grey[specks < 0.012] *= 0.62
    for _ in range(cracks):
        _crack(rng, grey, level * float(rng.uniform(0.42, 0.62)))
    return grey


def _crack(rng: np.random.Generator, grey: Grey, shade: float) -> None:
    size = len(grey)
    steps = np.cumsum(rng.normal(0, 0.34, int(rng.integers(25, 110)))) + rng.uniform(0, 6.28)
    path = rng.random(2) * size + np.cumsum(size / 130 * np.stack([np.cos(steps), np.sin(steps)], axis=1), axis=0)
    for shift_x in (-size, 0, size):  # wraps around the tile
        for shift_y in (-size, 0, size):
            # Fixed-point coordinates with 3 fractional bits, as the last argument tells OpenCV.
            moved = (path + [shift_x, shift_y]) * 8
            cv2.polylines(grey, [moved.astype(np.int32)], False, shade, 1 + int(rng.random() < 0.3), cv2.LINE_AA, 3)


def _dark(rng: np.random.Generator, size: int) -> Image:
    return as_image(_bitumen(rng, size, float(rng.uniform(58, 74)), 3), (1.0, 1.0, float(rng.uniform(1.0, 1.05))))


def _grey(rng: np.random.Generator, size: int) -> Image:
    grey = _bitumen(rng, size, float(rng.uniform(92, 122)), 9)
    warm = float(rng.uniform(0.95, 1.02))
    return as_image(grey, (1.0, 0.5 + 0.5 * warm, warm))


def _patched(rng: np.random.Generator, size: int) -> Image:
    grey = _bitumen(rng, size, float(rng.uniform(84, 104)), 16)
    for _ in range(int(rng.integers(5, 9))):
        (x, y), (w, h) = rng.integers(0, size, 2), rng.integers(size // 12, size // 3, 2)
        rows, columns = np.arange(y, y + h) % size, np.arange(x, x + w) % size
        patch = _bitumen(rng, 256, float(rng.uniform(55, 100)), 0)
        grey[np.ix_(rows, columns)] = patch[np.ix_(rows % 256, columns % 256)]
        grey[np.ix_(rows[:2], columns)] = grey[np.ix_(rows, columns[:2])] = 38
        grey[np.ix_(rows[-2:], columns)] = grey[np.ix_(rows, columns[-2:])] = 38
    return as_image(grey, (1.0, 1.0, 1.02))


def _cobbled(rng: np.random.Generator, size: int) -> Image:
    """Rows of rounded stones, half a stone shifted from row to row."""
    rows, columns = 80, 60
    y, x = np.meshgrid(np.arange(size, dtype=np.float32), np.arange(size, dtype=np.float32), indexing="ij")
    x += 2.5 * (noise(rng, size, 2, 20) - 0.5) * size / columns * 0.5
    y += 2.5 * (noise(rng, size, 2, 20) - 0.5) * size / rows * 0.5
    row = np.floor(y * rows / size).astype(np.int32) % rows
    along = x * columns / size + 0.5 * (row % 2)
    stone = np.floor(along).astype(np.int32) % columns
    u, v = 2 * (along - np.floor(along)) - 1, 2 * np.mod(y * rows / size, 1) - 1
    # Stones are rounded squares: a superellipse with a slightly domed top.
    round_off = np.clip(1.25 - np.maximum(np.abs(u) ** 4, np.abs(v) ** 4) - 0.25 * (u * u + v * v), 0, 1)
    tone = rng.normal(1.0, 0.13, (rows, columns)).astype(np.float32)[row, stone]
    grey = float(rng.uniform(98, 128)) * tone * (0.30 + 0.70 * round_off)
    grey *= 1 + 0.10 * grain(rng, size, 0.8) + 0.25 * (noise(rng, size, 4, 4) - 0.5)
    return as_image(grey, (1.0, float(rng.uniform(0.94, 1.0)), float(rng.uniform(0.86, 0.98))))


_ASPHALTS: dict[str, Callable[[np.random.Generator, int], Image]] = {
    "dark": _dark, "grey": _grey, "patched": _patched, "cobbled": _cobbled,
}  # fmt: skip


def paving(rng: np.random.Generator, family: str, size: int = 512) -> Image:
    """A sidewalk: ``slabs``, ``concrete`` or ``bricks``.

    Raises:
        ValueError: no such family.
    """
    layouts = {"slabs": (6, 6), "concrete": (2, 2), "bricks": (24, 12)}
    if family not in layouts:
        raise ValueError(f"no paving family {family!r}; have {sorted(layouts)}")
    rows, columns = layouts[family]
    colour = {"slabs": (152, 148, 140), "concrete": (148, 147, 143), "bricks": (140, 108, 95)}[family]
    y, x = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    row = y * rows // size
    shifted = (x + (row % 2) * size // columns // 2 * (family == "bricks")) % size
    column = shifted * columns // size
    spread = 0.10 if family == "bricks" else 0.06
    grey = rng.normal(1.0, spread, (rows, columns)).astype(np.float32)[row, column]
    grey = grey * (1 + 0.22 * (noise(rng, size, 5, 3) - 0.5) + 0.07 * grain(rng, size, 0.8))
    joint = (y % (size / rows) < 2.2) | (shifted % (size / columns) < 2.2)
    grey[joint] *= 0.55
    spots = noise(rng, size, 3, 20)
    grey[spots > 0.74] *= 0.82  # old chewing gum and drips
    return as_image(grey * float(rng.uniform(0.85, 1.08)), colour)


def kerb(rng: np.random.Generator, size: int = 256) -> Image:
    """Kerb stones, four to a tile."""
    grey = (1 + 0.2 * (noise(rng, size, 5, 4) - 0.5) + 0.08 * grain(rng, size, 0.8)) * float(rng.uniform(0.85, 1.05))
    grey[:, :: size // 4] *= 0.5
    grey[:, 1 :: size // 4] *= 0.7
    return as_image(grey, (168, 166, 161))


def grass(rng: np.random.Generator, size: int = 512) -> Image:
    """Blades with dry patches, clover and bare spots."""
    fine = 0.55 * noise(rng, size, 6, 8, 0.8) + 0.22 * (0.5 + 0.4 * grain(rng, size, 0.7))
    blades = cv2.blur(rng.random((size, size), dtype=np.float32), (1, 5))
    fine = fine + 0.5 * (blades - 0.5)
    dry = np.clip((noise(rng, size, 4, 3) - 0.45) * 2.2, 0, 1)[..., None] * float(rng.uniform(0.2, 0.9))
    green = np.array([rng.uniform(76, 100), rng.uniform(94, 114), rng.uniform(50, 66)])
    colour = green * (1 - dry) + np.array([142, 128, 82]) * dry
    return as_image((0.35 + 1.25 * fine)[..., None] * colour)


def worn_paint(rng: np.random.Generator, colour: tuple[float, float, float], size: int = 256) -> Image:
    """Road paint with grain, dirt and wear."""
    worn = noise(rng, size, 5, 6)
    light = 1 + 0.08 * grain(rng, size, 0.8) - 0.22 * noise(rng, size, 4, 3)
    gone = np.clip((worn - float(rng.uniform(0.62, 0.78))) * 9, 0, 1)[..., None]
    return as_image(light[..., None] * np.asarray(colour) * (1 - gone) + np.array([92, 92, 93]) * gone)


# ------------------------------------------------------------------------------------------------ decals on roads


def wheel_track(rng: np.random.Generator, size: int = 256) -> Decal:
    """A strip along a lane (v along it): darker in the tyre tracks and the oil line, with soft edges."""
    across = np.linspace(-1, 1, size, dtype=np.float32)
    band = 0.9 * np.exp(-(((np.abs(across) - 0.47) / 0.15) ** 2)) + 0.55 * np.exp(-((across / 0.12) ** 2))
    cover = band[None] * (0.25 + 1.1 * noise(rng, size, 5, 4)) * float(rng.uniform(0.10, 0.26))
    return _decal(np.full((size, size), 26.0), cover)


def stains(rng: np.random.Generator, size: int = 512) -> Decal:
    """Oil stains and tyre marks with alpha."""
    cover: np.ndarray = np.zeros((size, size), np.float32)
    for _ in range(34):
        (x, y), (a, b) = rng.integers(30, size - 30, 2), rng.integers(3, 26, 2)
        cv2.ellipse(cover, (int(x), int(y)), (int(a), int(b)), float(rng.uniform(0, 180)), 0, 360,
                    float(rng.uniform(0.15, 0.55)), -1, cv2.LINE_AA)  # fmt: skip
    cover = cv2.GaussianBlur(cover, (0, 0), 4) * (0.4 + noise(rng, size, 5, 6))
    fade = np.clip(np.minimum.outer(*(np.minimum(np.arange(size), np.arange(size)[::-1]),) * 2) / 20, 0, 1)
    return _decal(np.full((size, size), 22.0), cover * fade)


def seams(rng: np.random.Generator, size: int = 512) -> Decal:
    """Cracks that were sealed with tar."""
    cover = np.zeros((size, size), np.float32)
    for _ in range(5):
        steps = np.cumsum(rng.normal(0, 0.22, 46)) + rng.uniform(0, 6.28)
        path = rng.random(2) * size + np.cumsum(9 * np.stack([np.cos(steps), np.sin(steps)], axis=1), axis=0)
        cv2.polylines(cover, [(path * 8).astype(np.int32)], False, 0.85, int(rng.integers(2, 6)), cv2.LINE_AA, 3)
    edge = np.minimum(np.arange(size), np.arange(size)[::-1])
    return _decal(20 + 14 * noise(rng, size, 3, 30), cover * np.clip(np.minimum.outer(edge, edge) / 12, 0, 1))


def manhole(rng: np.random.Generator, size: int = 128) -> Decal:
    """A cast-iron cover in its frame."""
    y, x = np.meshgrid(np.linspace(-1, 1, size), np.linspace(-1, 1, size), indexing="ij")
    radius = np.hypot(x, y)
    ribs = 70 + 26 * (np.sin(x * 34) * np.sin(y * 34) > 0.1) + 12 * grain(rng, size, 0.8)
    ribs = np.where((radius > 0.8) & (radius < 0.86), 30, np.where(radius > 0.86, 88, ribs))
    return _decal(ribs, np.clip((0.98 - radius) * 30, 0, 1))


def contact_shadow(length_m: float, width_m: float, size: int = 64) -> Decal:
    """The dark ground below a vehicle, for a quad a metre longer and wider than the vehicle."""
    x = np.abs(np.linspace(-0.5, 0.5, size)) * (length_m + 1.0)
    y = np.abs(np.linspace(-0.5, 0.5, size)) * (width_m + 1.0)
    outside = np.hypot(*np.meshgrid(np.maximum(x - length_m / 2 + 0.35, 0), np.maximum(y - width_m / 2 + 0.3, 0),
                                    indexing="ij"))  # fmt: skip
    return _decal(np.full((size, size), 8.0), 0.78 * np.clip(1 - outside / 0.75, 0, 1) ** 1.6)


def light_pool(size: int = 64) -> Decal:
    """Warm light on the ground below a street lamp."""
    across = np.linspace(-1, 1, size, dtype=np.float32)
    cover = np.clip(1 - np.hypot(across[:, None], across[None]), 0, 1) ** 1.5 * 0.34
    image = _decal(np.full((size, size), 255.0), cover)
    image[..., :3] = (255, 206, 138)
    return image


def puddles(rng: np.random.Generator, colour: tuple[float, float, float], size: int = 512) -> Decal:
    """Puddles that reflect a sky of this colour."""
    deep = noise(rng, size, 4, 5)
    edge = np.minimum(np.arange(size), np.arange(size)[::-1])
    cover = np.clip((deep - 0.56) * 14, 0, 1) * np.clip(np.minimum.outer(edge, edge) / 60, 0, 1)
    image = _decal(np.ones((size, size)), cover * 0.62)
    image[..., :3] = np.clip(np.asarray(colour) * 0.92, 0, 255).astype(np.uint8)
    return image


def _decal(grey: np.ndarray, cover: np.ndarray) -> Decal:
    image = np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 4, axis=2)
    image[..., 3] = np.clip(cover * 255, 0, 255).astype(np.uint8)
    return image
