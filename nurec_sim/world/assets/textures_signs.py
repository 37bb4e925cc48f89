"""Textures of traffic signs, lights and billboards."""

from __future__ import annotations

import cv2
import numpy as np

from nurec_sim.world.assets.textures import Image, noise
from nurec_sim.world.plan.town import SIGNS

_RED, _WHITE, _BLACK, _BLUE, _YELLOW = (196, 28, 32), (240, 240, 238), (22, 22, 24), (20, 82, 170), (246, 196, 40)
SIGN_SHAPES = {"stop": 8, "yield": -3, "priority": 4, "speed": 0, "narrow": 3, "crossing": -4, "no_parking": 0,
               "roundabout": 0}  # fmt: skip
"""Corners of each sign's board: 0 is round, 3 a triangle, -3 one upside down, 4 a square on its corner, -4 upright."""


def sign(rng: np.random.Generator, picture: str, size: int = 128) -> Image:
    """The face of a traffic sign; the border colour extends beyond its outline.

    Raises:
        ValueError: no such sign.
    """
    if picture not in SIGNS:
        raise ValueError(f"no sign {picture!r}; have {list(SIGNS)}")
    image = np.empty((size, size, 3), np.uint8)
    middle, font = (size // 2, size // 2), cv2.FONT_HERSHEY_DUPLEX

    def text(word: str, scale: float, colour: tuple[int, int, int]) -> None:
        (wide, high), _ = cv2.getTextSize(word, font, scale, 5)
        cv2.putText(image, word, (middle[0] - wide // 2, middle[1] + high // 2), font, scale, colour, 5, cv2.LINE_AA)

    def board(inner: float, outer: tuple[int, int, int], colour: tuple[int, int, int]) -> None:
        image[:] = outer
        # Image rows run downwards. OpenCV reads coordinates with 4 fractional bits, hence the factor 16.
        points = outline(SIGN_SHAPES[picture]) * inner * [1, -1] + 0.5
        cv2.fillPoly(image, [(points * size * 16).astype(np.int32)], colour, cv2.LINE_AA, 4)

    if picture == "stop":
        board(0.92, _WHITE, _RED)
        text("STOP", size / 82, _WHITE)
    elif picture == "yield":
        board(0.72, _RED, _WHITE)
    elif picture == "priority":
        board(0.90, _BLACK, _WHITE)
        points = outline(4) * 0.62 * [1, -1] + 0.5
        cv2.fillPoly(image, [(points * size * 16).astype(np.int32)], _YELLOW, cv2.LINE_AA, 4)
    elif picture == "speed":
        board(0.74, _RED, _WHITE)
        text(("30", "40", "50", "60")[rng.integers(4)], size / 58, _BLACK)
    elif picture == "narrow":
        board(0.76, _RED, _WHITE)
        for side in (-1, 1):
            line = np.array([[side * 0.13, 0.15], [side * 0.06, 0.04], [side * 0.06, -0.14]]) + [0.5, 0.58]
            cv2.polylines(image, [(line * size).astype(np.int32)], False, _BLACK, 6, cv2.LINE_AA)
    elif picture == "crossing":
        board(0.97, _WHITE, _BLUE)
        triangle = (np.array([[0.5, 0.16], [0.86, 0.82], [0.14, 0.82]]) * size).astype(np.int32)
        cv2.fillPoly(image, [triangle], _WHITE, cv2.LINE_AA)
        cv2.circle(image, (size // 2, int(0.42 * size)), 6, _BLACK, -1, cv2.LINE_AA)
        for step in ((-0.1, 0.76), (0.1, 0.76)):
            end = (int((0.5 + step[0]) * size), int(step[1] * size))
            cv2.line(image, (size // 2, int(0.5 * size)), end, _BLACK, 6, cv2.LINE_AA)
    elif picture == "roundabout":
        board(0.97, _WHITE, _BLUE)
        for turn in (0, 120, 240):
            cv2.ellipse(image, middle, (int(0.26 * size),) * 2, turn, 10, 90, _WHITE, 11, cv2.LINE_AA)
            tip = np.deg2rad(turn + 100)
            place = (int(middle[0] + 0.26 * size * np.cos(tip)), int(middle[1] + 0.26 * size * np.sin(tip)))
            cv2.circle(image, place, 11, _WHITE, -1, cv2.LINE_AA)
    else:
        board(0.80, _RED, _BLUE)
        cv2.line(
            image, (int(0.22 * size), int(0.22 * size)), (int(0.78 * size), int(0.78 * size)), _RED, 13, cv2.LINE_AA
        )
    return image


def outline(corners: int) -> np.ndarray:
    """A sign's outline ``[n, 2]``, x right and y up, within -0.5..0.5, counter-clockwise; see ``SIGN_SHAPES``."""
    if corners == 0:
        angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    elif corners == 8:
        angle = np.pi / 8 + np.arange(8) * np.pi / 4
    elif corners in (3, -3):
        points = np.array([[-0.5, -0.43], [0.5, -0.43], [0.0, 0.43]])
        return points if corners > 0 else points[::-1] * [1, -1]
    elif corners == 4:
        angle = np.arange(4) * np.pi / 2
    else:
        return np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    return 0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def billboard(rng: np.random.Generator, high: int = 128, wide: int = 256) -> Image:
    """An advertisement: a wash of two colours, shapes and a word."""
    first, second = rng.uniform(20, 245, 3), rng.uniform(20, 245, 3)
    blend = np.linspace(0, 1, wide)[None] * rng.uniform(-1, 1) + np.linspace(0, 1, high)[:, None] * rng.uniform(-1, 1)
    blend = ((blend - blend.min()) / (np.ptp(blend) + 1e-6))[..., None]
    image = np.ascontiguousarray((first * (1 - blend) + second * blend).astype(np.uint8))
    for _ in range(int(rng.integers(2, 7))):
        x, y = (int(v) for v in rng.integers(0, [wide, high]))
        cv2.circle(image, (x, y), int(rng.integers(8, 46)), rng.uniform(0, 255, 3).tolist(), -1, cv2.LINE_AA)
    word = ("COLA", "TRAVEL", "RADIO 9", "SALE", "MUSIC", "BANK", "JUICE", "MOTORS")[rng.integers(8)]
    cv2.putText(image, word, (12, int(rng.integers(high // 3, high - 14))), cv2.FONT_HERSHEY_TRIPLEX, 1.5,
                (250, 250, 250), 3, cv2.LINE_AA)  # fmt: skip
    image[:4] = image[-4:] = image[:, :4] = image[:, -4:] = 40
    weathered = 0.88 + 0.16 * cv2.resize(noise(rng, 64, 3, 3), (wide, high))
    return np.clip(image * weathered[..., None], 0, 255).astype(np.uint8)
