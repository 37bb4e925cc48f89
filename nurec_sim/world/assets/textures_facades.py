"""Textures of buildings: facades of four floors by four bays, shop fronts one floor high, and roofs.

``lit`` 0..1 is the fraction of lit windows. With ``night`` > 0 walls are darkened by (1 + night) and lit windows stay
bright, so that they shine with an emissive material of that strength.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from nurec_sim.world.assets.textures import Image, as_image, grain, noise

FLOORS = BAYS = 4
FACADE_PX = 512
_PARAPETS = ((168, 120, 92), (132, 148, 160), (176, 158, 112), (122, 142, 118), (150, 150, 148), (164, 104, 88))
_LAMP = np.array([255.0, 214.0, 150.0])
_NAMES = ("CAFE", "BAKERY", "BOOKS", "MARKET", "PIZZA", "BANK", "HOTEL", "FLOWERS", "SUSHI", "BAR", "PHARMA", "OPTIK",
          "SHOES", "DELI", "KIOSK", "RADIO", "TAILOR", "GYM", "TOYS", "WINE")  # fmt: skip


def facade(rng: np.random.Generator, family: str, lit: float, night: float) -> Image:
    """A facade of one family.

    Args:
        rng: random generator.
        family: one of ``splits.FACADES``.
        lit: fraction 0..1 of windows with light.
        night: unlit parts are darkened by 1 + ``night``; 0 by day.

    Raises:
        ValueError: no such family.
    """
    if family not in _WALLS:
        raise ValueError(f"no facade family {family!r}; have {sorted(_WALLS)}")
    if family == "glass":
        return _curtain_wall(rng, lit, night)
    wall = _WALLS[family](rng, FACADE_PX)
    streaks = cv2.resize(rng.random((1, FACADE_PX // 6), dtype=np.float32), (FACADE_PX, FACADE_PX))
    wall = wall * (0.93 + 0.10 * streaks)[..., None]
    return _with_windows(rng, wall, family, lit, night)


def _brick(rng: np.random.Generator, size: int) -> np.ndarray:
    colour = np.array([rng.uniform(122, 172), rng.uniform(76, 102), rng.uniform(60, 82)])
    rows, columns = 128, 44
    y, x = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    row = y * rows // size
    # Every other row is shifted by half a brick.
    shifted = (x + (row % 2) * size // columns // 2) % size
    tone = rng.normal(1.0, 0.13, (rows, columns)).astype(np.float32)[row, shifted * columns // size]
    # The first pixel of every brick, across and down, is mortar.
    joint = (y * rows % size < rows) | (shifted * columns % size < columns)
    image = tone[..., None] * colour
    image[joint] = rng.uniform(140, 180)
    return image * (0.88 + 0.24 * noise(rng, size, 4, 6))[..., None]


def _plaster(rng: np.random.Generator, size: int) -> np.ndarray:
    palette = ((214, 204, 184), (196, 172, 146), (198, 198, 196), (216, 190, 146), (186, 150, 128), (226, 220, 210),
               (166, 176, 160), (204, 170, 160), (176, 186, 196), (222, 204, 158))  # fmt: skip
    image = (
        np.asarray(palette[rng.integers(len(palette))], np.float32)
        * (0.86 + 0.2 * noise(rng, size, 5, 4) + 0.03 * grain(rng, size, 0.8))[..., None]
    )
    damp = np.clip((noise(rng, size, 4, 3) - 0.62) * 4, 0, 0.3)[..., None]
    return image * (1 - damp)


def _panel(rng: np.random.Generator, size: int) -> np.ndarray:
    grey = 0.84 + 0.2 * noise(rng, size, 5, 5) + 0.035 * grain(rng, size, 0.8)
    grey *= np.kron(rng.uniform(0.93, 1.05, (FLOORS, BAYS)), np.ones((size // FLOORS, size // BAYS)))
    image = grey[..., None] * np.array([rng.uniform(150, 190)] * 3) * [1, rng.uniform(0.96, 1), rng.uniform(0.9, 1)]
    if rng.random() < 0.5:  # coloured parapets
        strip = np.array(_PARAPETS[rng.integers(len(_PARAPETS))]) * rng.uniform(0.85, 1.1)
        for floor in range(FLOORS):
            y = int((floor + 0.78) * size / FLOORS)
            image[y : y + size // FLOORS // 5] = strip * grey[y : y + size // FLOORS // 5, :, None]
    for line in range(0, size, size // FLOORS):
        image[line : line + 2] *= 0.55
        image[:, line : line + 2] *= 0.6
    return image


def _stone(rng: np.random.Generator, size: int) -> np.ndarray:
    rows, columns = 32, 12
    y, x = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    row = y * rows // size
    shifted = (x + (row * 17 % 29) * size // 29 // columns) % size
    tone = rng.normal(1.0, 0.07, (rows, columns)).astype(np.float32)[row, shifted * columns // size]
    image = (tone * (0.8 + 0.34 * noise(rng, size, 6, 6, 0.7)))[..., None] * np.array(
        [rng.uniform(165, 200), rng.uniform(155, 185), rng.uniform(130, 165)]
    )
    image[(y * rows % size < 2 * rows) | (shifted * columns % size < 2 * columns)] *= 0.6
    return image


def _timber(rng: np.random.Generator, size: int) -> np.ndarray:
    """Boards, or a half-timbered wall."""
    if rng.random() < 0.5:
        boards = 64
        tone = np.repeat(rng.normal(1.0, 0.08, boards), size // boards)[:, None]
        streaks = cv2.resize(rng.random((size, 12), dtype=np.float32), (size, size), interpolation=cv2.INTER_CUBIC)
        image = (tone * (0.8 + 0.3 * streaks))[..., None] * np.array(
            [(150, 112, 80), (120, 132, 118), (168, 60, 48), (206, 202, 192), (96, 110, 130)][rng.integers(5)]
        )
        image[:: size // boards] *= 0.6
        return image
    image = _plaster(rng, size) * 0.3 + np.array([232, 224, 206]) * 0.66
    cell, beam = size // FLOORS, (86.0, 62.0, 44.0)
    for k in range(FLOORS):
        cv2.rectangle(image, (0, k * cell), (size, k * cell + 11), beam, -1)
        cv2.rectangle(image, (k * cell, 0), (k * cell + 10, size), beam, -1)
        for floor in range(FLOORS):
            x0, y0 = k * cell + (0 if (k + floor) % 2 else int(0.84 * cell)), floor * cell
            cv2.line(image, (x0, y0), (x0 + int(0.16 * cell), y0 + cell), beam, 8, cv2.LINE_AA)
    return image * (0.9 + 0.2 * noise(rng, size, 4, 8))[..., None]


_WALLS: dict[str, Callable[[np.random.Generator, int], np.ndarray]] = {
    "brick": _brick, "plaster": _plaster, "panel": _panel, "stone": _stone, "timber": _timber, "glass": _plaster,
}  # fmt: skip


def _with_windows(rng: np.random.Generator, wall: np.ndarray, family: str, lit: float, night: float) -> Image:
    image, cell = wall.astype(np.float32), FACADE_PX // FLOORS
    frame = ((234, 234, 228), (66, 58, 52), (118, 88, 66), (206, 206, 208), (52, 66, 62))[rng.integers(5)]
    width, height = rng.uniform(0.34, 0.58) * cell, rng.uniform(0.46, 0.66) * cell
    glass = np.array([0.70, 0.84, 1.0]) * rng.uniform(62, 100)
    bars, band, shutters = int(rng.integers(4)), rng.random() < 0.35, rng.random() < 0.25 and family != "panel"
    surround = np.array(frame) * 0.85 if family in ("brick", "stone", "plaster") and rng.random() < 0.5 else None
    shutter = np.array([(60, 92, 70), (120, 62, 48), (70, 84, 110), (150, 148, 140)][rng.integers(4)])
    image /= 1 + night
    dark = 1 / (1 + night)
    for floor in range(FLOORS):
        if band:
            image[floor * cell : floor * cell + 6] *= 1.12
            image[floor * cell + 6 : floor * cell + 9] *= 0.62
        for bay in range(BAYS):
            cx, cy = int((bay + 0.5) * cell), int((floor + 0.48) * cell)
            x0, x1, y0, y1 = int(cx - width / 2), int(cx + width / 2), int(cy - height / 2), int(cy + height / 2)
            if surround is not None:
                image[y0 - 7 : y1 + 7, x0 - 7 : x1 + 7] = surround * dark
            if shutters:
                for left in (x0 - int(0.45 * width), x1 + 2):
                    image[y0:y1, left : left + int(0.42 * width)] = shutter * dark
                    image[y0:y1:5, left : left + int(0.42 * width)] *= 0.7
            _pane(rng, image[y0:y1, x0:x1], glass, lit, dark)
            image[y0 : y0 + 4, x0:x1] *= 0.45  # the lintel's shadow
            cv2.rectangle(image, (x0, y0), (x1, y1), [c * dark for c in frame], 3)
            for line in range(1, bars if bars < 3 else 2):
                x = x0 + (x1 - x0) * line // max(2, bars)
                cv2.line(image, (x, y0), (x, y1), [c * dark for c in frame], 2)
            if bars == 3:
                cv2.line(image, (x0, y0 + (y1 - y0) // 3), (x1, y0 + (y1 - y0) // 3), [c * dark for c in frame], 2)
            image[y1 + 2 : y1 + 6, x0 - 4 : x1 + 4] = 196 * dark
            image[y1 + 6 : y1 + 10, x0 - 4 : x1 + 4] *= 0.62
            image[y1 + 10 : y1 + 22, x0 : x1 : max(3, int(width) // 3)] *= 0.88  # water stains below sills
    return as_image(image)


def _pane(rng: np.random.Generator, pane: np.ndarray, glass: np.ndarray, lit: float, dark: float) -> None:
    """A window pane: sky reflection, curtains, blinds or a lit room."""
    high, wide = pane.shape[:2]
    down = np.linspace(0, 1, high, dtype=np.float32)[:, None, None]
    if rng.random() < lit:
        pane[:] = _LAMP * rng.uniform(0.62, 1.0) * (1.0 - 0.35 * down)
        if rng.random() < 0.5:
            pane[:, : wide // 4] *= 0.7
            pane[:, -wide // 4 :] *= 0.7
        return
    pane[:] = glass * rng.uniform(0.55, 1.35) * (1.45 - 0.85 * down) * dark
    kind = rng.random()
    if kind < 0.25:
        pane[: int(high * rng.uniform(0.15, 0.8))] = np.array([206, 201, 190]) * rng.uniform(0.6, 0.95) * dark
    elif kind < 0.55:
        side = int(wide * rng.uniform(0.15, 0.3))
        for part in (pane[:, :side], pane[:, -side:]):
            part[:] = np.array([200, 194, 184]) * rng.uniform(0.6, 0.95) * dark
            part[:, ::4] *= 0.85
    elif kind < 0.68:
        corner = np.array([[0, 0], [wide, 0], [0, int(high * rng.uniform(0.4, 1.0))]])
        cv2.fillConvexPoly(pane_copy := np.ascontiguousarray(pane), corner, (pane[0, 0] * 1.5).tolist(), cv2.LINE_AA)
        pane[:] = pane_copy


def _curtain_wall(rng: np.random.Generator, lit: float, night: float) -> Image:
    """Glass from floor to floor behind a grid of mullions."""
    size, dark = FACADE_PX, 1 / (1 + night)
    clouds = cv2.resize(noise(rng, 128, 4, 3), (size, size))
    tone = np.array([(0.72, 0.90, 1.0), (0.80, 0.92, 0.92), (0.95, 0.90, 0.82), (0.78, 0.84, 0.95)][rng.integers(4)])
    image = ((70 + 95 * clouds)[..., None] * tone).astype(np.float32) * dark
    columns, rows = int(rng.choice([8, 12, 16])), FLOORS
    for row in range(rows):
        top, bottom = row * size // rows, (row + 1) * size // rows
        for column in range(columns):
            left, right = column * size // columns, (column + 1) * size // columns
            pane = image[top:bottom, left:right]
            pane *= rng.uniform(0.72, 1.2)
            if rng.random() < lit:
                pane[:] = _LAMP * rng.uniform(0.55, 0.95)
            elif rng.random() < 0.15:
                pane[: int(rng.uniform(0.2, 0.9) * len(pane))] = 150 * dark
        image[bottom - size // rows // 6 : bottom] = np.array([96, 104, 112]) * rng.uniform(0.6, 1.0) * dark
    mullion = float(rng.choice([60, 150, 190])) * dark
    for column in range(columns):
        image[:, column * size // columns : column * size // columns + 3] = mullion
    for row in range(rows):
        image[row * size // rows : row * size // rows + 4] = mullion
    return as_image(image)


def shopfront(rng: np.random.Generator, night: float) -> Image:
    """Four shop windows under lettered signs, one floor high, a quarter as high as wide."""
    high, dark = FACADE_PX // 4, 1 / (1 + night)
    image = as_image(_plaster(rng, FACADE_PX)[:high] * dark)
    for bay in range(4):
        x0, x1 = bay * high + 7, (bay + 1) * high - 7
        sign, word = rng.uniform(30, 200, 3), _NAMES[rng.integers(len(_NAMES))]
        glow = 1.0 if night and rng.random() < 0.7 else dark
        image[int(0.05 * high) : int(0.24 * high), x0:x1] = sign * glow
        ink = (245, 240, 225) if sign.mean() < 130 else (20, 20, 20)
        cv2.putText(image, word, (x0 + 5, int(0.205 * high)), cv2.FONT_HERSHEY_DUPLEX, high / 215,
                    [c * glow for c in ink], 1, cv2.LINE_AA)  # fmt: skip
        top, bottom = int(0.29 * high), int(0.90 * high)
        room = _LAMP * 0.75 if night and rng.random() < 0.6 else np.array([70, 80, 90]) * rng.uniform(0.5, 1.1) * dark
        image[top:bottom, x0:x1] = np.clip(room * np.linspace(1.25, 0.65, bottom - top)[:, None, None], 0, 255)
        for _ in range(9):
            x, y = int(rng.integers(x0, x1 - 14)), int(rng.integers(int(0.5 * high), int(0.85 * high)))
            colour = (rng.uniform(30, 220, 3) * (0.8 if glow == 1.0 else dark)).tolist()
            cv2.rectangle(image, (x, y), (x + int(rng.integers(3, 14)), bottom), colour, -1)
        door = x0 + int(rng.integers(4, max(5, x1 - x0 - 34)))
        cv2.rectangle(
            image, (door, top + 4), (door + 26, int(0.99 * high)), (rng.uniform(30, 110, 3) * dark).tolist(), -1
        )
        cv2.rectangle(image, (door + 4, top + 10), (door + 22, int(0.7 * high)), (90 * dark, 98 * dark, 104 * dark), -1)
        cv2.rectangle(image, (x0, top), (x1, bottom), (48 * dark, 48 * dark, 50 * dark), 2)
    return image


def roof(rng: np.random.Generator, size: int = 256) -> Image:
    """Rows of tiles, or bitumen sheets."""
    colours = ((98, 93, 90), (150, 84, 66), (128, 66, 54), (112, 107, 102), (84, 88, 95), (118, 98, 84))
    colour = colours[rng.integers(len(colours))]
    rows, columns = 24, 20
    y, x = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    row = y * rows // size
    shifted = (x + (row % 2) * size // columns // 2) % size
    tone = rng.normal(1.0, 0.09, (rows, columns)).astype(np.float32)[row, shifted * columns // size]
    grey = tone * (0.78 + 0.4 * noise(rng, size, 5, 4))
    grey *= 1.12 - 0.38 * ((y * rows % size) / size)
    return as_image(grey, colour)
