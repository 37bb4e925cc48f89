"""Textures of vehicles: an atlas for painted bodies, wheels, windows, number plates and cargo boxes.

The body atlas holds the side (upper half; rear left, front right), the top (third quarter), and in the last quarter
front and rear. It is grey, because the geom's colour tints it; seams, grille and wheel arches stay dark.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float64

from nurec_sim.world.assets.textures import Image, as_image, grain, noise
from nurec_sim.world.assets.vehicle_families import Family

ATLAS_PX = 512
SIDE_PX, TOP_PX = 256, 128


def body_atlas(rng: np.random.Generator, family: Family, size_m: tuple[float, float, float]) -> Image:
    """Paint with door seams, handles, wheel arches, grille and the reflections of sky and ground."""
    grey = np.full((ATLAS_PX, ATLAS_PX), 236.0, np.float32)
    side, top = grey[:SIDE_PX], grey[SIDE_PX : SIDE_PX + TOP_PX]
    front, rear = grey[SIDE_PX + TOP_PX :, :SIDE_PX], grey[SIDE_PX + TOP_PX :, SIDE_PX:]
    _side(side, family, size_m)
    top[:] = np.linspace(232, 255, ATLAS_PX)[None]
    hood, tail = (int((x + 1) / 2 * ATLAS_PX) for x in (family.cabin[3] - 0.04, family.cabin[0] + 0.02))
    if family.cargo is None and family.bed is None:
        for column in (hood, tail):
            cv2.line(top, (column, 10), (column, TOP_PX - 10), 70, 2, cv2.LINE_AA)
        for row in (10, TOP_PX - 10):
            cv2.line(top, (hood, row), (ATLAS_PX - 16, row), 90, 1, cv2.LINE_AA)
    _nose(rng, front, family)
    _tail(rear, family)
    return as_image(grey * (1 + 0.012 * grain(rng, ATLAS_PX, 1.2)), (1.0, 1.0, 1.0))


def _side(side: np.ndarray, family: Family, size_m: tuple[float, float, float]) -> None:
    length, _, high = size_m

    def at(x: float, height: float) -> tuple[int, int]:
        return int((x + 1) / 2 * ATLAS_PX), int((1 - height) * SIDE_PX)

    heights = (1 - (np.arange(SIDE_PX) + 0.5) / SIDE_PX) / family.belt
    # Upper door halves reflect the sky, lower halves the ground, with a crease along the shoulder line.
    steps = ((0.0, 0.42), (0.3, 0.60), (0.5, 0.74), (0.72, 0.80), (0.86, 1.0), (0.90, 0.88), (1.0, 0.97), (1.05, 0.93),
             (1.7, 1.0))  # fmt: skip
    side *= np.interp(heights, *np.array(steps).T)[:, None].astype(np.float32)
    sill = at(0, family.floor_m / high + 0.035)[1]
    side[sill:] *= 0.45
    floor, belt = family.floor_m / high + 0.04, family.belt
    for x in family.doors:
        cv2.line(side, at(x, floor), at(x, belt - 0.01), 58, 2, cv2.LINE_AA)
    for x in family.doors[:-1]:
        column, row = at(x + 0.05, belt * 0.88)
        cv2.rectangle(side, (column, row), (column + 13, row + 3), 90, -1)
        cv2.line(side, (column, row), (column + 13, row), 250, 1)
    if len(family.doors) > 1:
        cv2.line(side, at(family.doors[0], floor), at(family.doors[-1], floor), 60, 2, cv2.LINE_AA)
    for x in family.axles:
        axes = (int(1.17 * family.wheel_m / length * ATLAS_PX), int(1.17 * family.wheel_m / high * SIDE_PX))
        cv2.ellipse(side, at(x, family.wheel_m / high), axes, 0, 0, 360, 14, -1, cv2.LINE_AA)


def _nose(rng: np.random.Generator, front: np.ndarray, family: Family) -> None:
    rows, columns = front.shape

    def band(low: float, high: float, half: float, shade: float) -> None:
        """A horizontal band across the middle of the nose.

        Args:
            low: lower edge, as a fraction of the vehicle's height.
            high: upper edge.
            half: width, as a fraction of the vehicle's.
            shade: grey value 0..255.
        """
        x0, x1 = int((0.5 - half / 2) * columns), int((0.5 + half / 2) * columns)
        cv2.rectangle(front, (x0, int((1 - high) * rows)), (x1, int((1 - low) * rows)), shade, -1)

    low, high = family.lamp
    front *= 0.86
    band(0.0, family.floor_m / 1.5 + 0.05, 1.0, 40)
    band(low - 0.02, high, 0.52 + 0.1 * rng.random(), 26)
    for step in np.linspace(low, high, 5):
        band(step - 0.004, step + 0.004, 0.5, float(rng.choice([70, 120, 150])))
    band(low - 0.18, low - 0.09, 0.66, 30)
    cv2.circle(front, (columns // 2, int((1 - (low + high) / 2) * rows)), 6, 190, -1, cv2.LINE_AA)


def _tail(rear: np.ndarray, family: Family) -> None:
    rows, columns = rear.shape

    def row(height: float) -> int:
        return int((1 - height) * rows)

    rear *= np.interp(np.arange(rows), [0, rows * 0.5, rows], [1.0, 0.9, 0.55])[:, None].astype(np.float32)
    low = family.tail_lamp[0]
    cv2.rectangle(rear, (int(0.08 * columns), row(low - 0.14)), (int(0.92 * columns), row(0.12)), 46, -1)
    cv2.rectangle(rear, (int(0.1 * columns), row(family.belt)), (int(0.9 * columns), row(low - 0.12)), 110, 1)


def wheel(rng: np.random.Generator, size: int = 128) -> Image:
    """A tyre around a rim with spokes, as seen from its side; the corners are plain rubber."""
    image = np.full((size, size), 26.0, np.float32) * (1 + 0.1 * grain(rng, size, 0.8))
    middle, spokes = size // 2, int(rng.choice([5, 5, 6, 7, 10]))
    cv2.circle(image, (middle, middle), int(0.47 * size), 34, 3, cv2.LINE_AA)
    cv2.circle(image, (middle, middle), int(0.36 * size), 150, -1, cv2.LINE_AA)
    cv2.circle(image, (middle, middle), int(0.325 * size), 40, -1, cv2.LINE_AA)
    for angle in np.arange(spokes) * 2 * np.pi / spokes:
        end = (int(middle + 0.34 * size * np.cos(angle)), int(middle + 0.34 * size * np.sin(angle)))
        cv2.line(image, (middle, middle), end, 168, max(3, size // (4 * spokes)), cv2.LINE_AA)
    cv2.circle(image, (middle, middle), int(0.08 * size), 175, -1, cv2.LINE_AA)
    return as_image(image, (1.0, 1.0, 1.02))


def window(rng: np.random.Generator, size: int = 128) -> Image:
    """Dark glass with a sky reflection at its upper edge and head-rests behind it."""
    up = np.linspace(1, 0, size, dtype=np.float32)[:, None]
    grey = 30 + 58 * up**1.6 + np.zeros((size, size), np.float32)
    for x in (0.28, 0.72):
        cv2.ellipse(grey, (int(x * size), int(0.62 * size)), (size // 11, size // 7), 0, 0, 360, 14, -1, cv2.LINE_AA)
        cv2.ellipse(grey, (int(x * size), size), (size // 7, size // 4), 0, 0, 360, 16, -1, cv2.LINE_AA)
    shine = np.zeros((size, size), np.float32)
    streak = np.array([[0.1, 1], [0.35, 0], [0.5, 0], [0.22, 1]]) * size
    cv2.fillPoly(shine, [streak.astype(np.int32)], 20.0)
    grey += cv2.GaussianBlur(shine, (0, 0), 3) + 22 * (noise(rng, size, 3, 3) - 0.5) * up
    return as_image(grey, (0.90, 0.98, 1.06))


def lamp(rng: np.random.Generator, colour: tuple[float, float, float], size: int = 64) -> Image:
    """A lamp's cover: bulbs behind ribbed glass in a dark frame."""
    level = 0.62 + 0.12 * np.sin(np.linspace(0, 60, size, dtype=np.float32))[None] + np.zeros((size, 1), np.float32)
    for x in (0.3, 0.68):
        cv2.circle(level, (int(x * size), size // 2), size // 5, 1.15, -1, cv2.LINE_AA)
    level[:5] = level[-5:] = 0.16
    level[:, :3] = level[:, -3:] = 0.2
    return as_image(level * (1 + 0.03 * grain(rng, size, 0.8)), colour)


def plate(rng: np.random.Generator) -> Image:
    """A number plate."""
    yellow = rng.random() < 0.2
    image = np.full((32, 128, 3), (236, 208, 90) if yellow else (236, 236, 232), np.uint8)
    image[:, :10] = (30, 60, 150)
    letters = "".join("ABCDEFGHJKLMNPRSTUVWXYZ"[i] for i in rng.integers(0, 23, 3))
    cv2.putText(image, f"{letters} {rng.integers(100, 999)}", (14, 25), cv2.FONT_HERSHEY_SIMPLEX, 0.68, (24, 24, 30), 2,
                cv2.LINE_AA)  # fmt: skip
    return image


def cargo_box(rng: np.random.Generator, size: int = 256) -> Image:
    """A corrugated box with a stripe and a name."""
    ribs = 1 - 0.10 * (np.arange(size) % 8 < 2)
    image = np.full((size, size, 3), 226.0, np.float32) * ribs[None, :, None]
    colour = np.array([(170, 40, 40), (40, 80, 150), (40, 120, 70), (210, 140, 30), (60, 60, 66)][rng.integers(5)])
    kind = int(rng.integers(3))
    if kind == 0:
        image[int(0.62 * size) : int(0.8 * size)] = colour
    elif kind == 1:
        image[:, : size // 3] = colour
    image = np.clip(image * (0.9 + 0.14 * noise(rng, size, 4, 3))[..., None], 0, 255).astype(np.uint8)
    name = ("CARGO", "FRESH", "MOVE", "PARCEL", "LOGIX", "FROST")[rng.integers(6)]
    cv2.putText(image, name, (24, size // 2), cv2.FONT_HERSHEY_DUPLEX, 1.9, (0.8 * colour).tolist(), 4, cv2.LINE_AA)
    return image


def atlas_uv(
    corner: Float64[np.ndarray, "n 3"], normal: Float64[np.ndarray, "n 3"], size_m: tuple[float, float, float]
) -> Float64[np.ndarray, "n 2"]:
    """Texture coordinates in the body atlas of vehicle points (box frame) with these normals."""
    along = corner[:, 0] / size_m[0] + 0.5
    across = corner[:, 1] / size_m[1] + 0.5
    high = corner[:, 2] / size_m[2] + 0.5
    # Slanted flanks belong to the side, hence its larger weight.
    weight = np.abs(normal) * [1.0, 1.15, 1.0]
    facing = weight.argmax(axis=1)
    side = np.stack([along, 0.5 + 0.5 * high], axis=1)
    top = np.stack([along, 0.25 + 0.25 * across], axis=1)
    end = np.stack([0.5 * across + 0.5 * (normal[:, 0] < 0), 0.25 * high], axis=1)
    # Keeps filtering from reading across the border of a region.
    margin = 0.004
    end = np.clip(end, [0.0, margin], [1.0, 0.25 - margin])
    side[:, 1] = np.clip(side[:, 1], 0.5 + margin, 1 - margin)
    top[:, 1] = np.clip(top[:, 1], 0.25 + margin, 0.5 - margin)
    return np.select([facing[:, None] == 0, facing[:, None] == 1], [end, side], top)
