"""Procedural textures and the sky, all from a seed; uint8 RGB images ``[h, w, 3]``."""

from __future__ import annotations

import functools

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

Image = UInt8[np.ndarray, "h w 3"]


def noise(rng: np.random.Generator, size: int, octaves: int = 5, cells: int = 4, persistence: float = 0.55):
    """Tileable fractal value noise ``[size, size]`` in 0..1."""
    total, weight = np.zeros((size, size), np.float32), 0.0
    for octave in range(octaves):
        n = min(cells * 2**octave, size)
        rows = _periodic_weights(size, n)
        total += persistence**octave * (rows @ rng.random((n, n), dtype=np.float32) @ rows.T)
        weight += persistence**octave
    return np.clip(total / weight, 0, 1)


@functools.lru_cache(maxsize=32)
def _periodic_weights(size: int, n: int) -> np.ndarray:
    """Cubic interpolation ``[size, n]`` from n values on a ring to ``size`` places between them."""
    place = (np.arange(size) + 0.5) * n / size - 0.5
    whole = np.floor(place).astype(int)
    t = place - whole
    weights = np.zeros((size, n), np.float32)
    cubic = (-0.5 * t + t**2 - 0.5 * t**3, 1 - 2.5 * t**2 + 1.5 * t**3, 0.5 * t + 2 * t**2 - 1.5 * t**3,
             -0.5 * t**2 + 0.5 * t**3)  # fmt: skip
    for shift, weight in zip((-1, 0, 1, 2), cubic, strict=True):
        np.add.at(weights, (np.arange(size), (whole + shift) % n), weight.astype(np.float32))
    return weights


def _image(values: np.ndarray, colour: tuple[float, ...] | None = None) -> Image:
    values = values if colour is None else values[..., None] * np.asarray(colour, np.float32)
    return np.ascontiguousarray(np.clip(values, 0, 255).astype(np.uint8))


def grain(rng: np.random.Generator, size: int, sigma_px: float) -> np.ndarray:
    """Tileable blurred white noise ``[size, size]`` of unit variance."""
    margin = int(np.ceil(4 * sigma_px))
    white = np.pad(rng.standard_normal((size, size), np.float32), margin, mode="wrap")
    blurred = cv2.GaussianBlur(white, (0, 0), sigma_px)[margin:-margin, margin:-margin]
    return blurred / float(blurred.std())


def as_image(values: np.ndarray, colour: tuple[float, ...] | None = None) -> Image:
    """A uint8 image of ``values [h,w]`` times a colour, or of ``values [h,w,3]``."""
    return _image(values, colour)


def asphalt(rng: np.random.Generator, size: int = 1024) -> Image:
    """Grey with grain, cracks, repair patches and stains."""
    base = 88.0
    grey = base * (1 + 0.45 * (noise(rng, size, 5, 3) - 0.5))
    grey += 13 * cv2.GaussianBlur(rng.normal(0, 1, (size, size)).astype(np.float32), (0, 0), 0.8)
    for _ in range(7):
        steps = np.cumsum(rng.normal(0, 0.35, 70)) + rng.uniform(0, 6.28)
        path = rng.random(2) * size + np.cumsum(8 * np.stack([np.cos(steps), np.sin(steps)], axis=1), axis=0)
        cv2.polylines(grey, [path.astype(np.int32)], False, base * 0.55, int(rng.integers(1, 3)), cv2.LINE_AA)
    for _ in range(4):
        (x, y), (w, h) = rng.integers(0, size, 2), rng.integers(70, 240, 2)
        grey[y : y + h, x : x + w] *= rng.uniform(0.78, 1.1)
    for _ in range(12):
        (x, y), axes = rng.integers(0, size, 2), rng.integers(6, 40, 2)
        cv2.ellipse(grey, (int(x), int(y)), (int(axes[0]), int(axes[1])), 0.0, 0, 360, base * 0.74, -1, cv2.LINE_AA)
    return _image(grey, (1.0, 1.0, 1.03))


def paving(rng: np.random.Generator, size: int = 512, slabs: int = 8) -> Image:
    """Square concrete slabs with dark joints."""
    grey = 0.8 + 0.4 * noise(rng, size, 5, 4)
    step = size // slabs
    grey *= np.kron(rng.uniform(0.87, 1.08, (slabs, slabs)), np.ones((step, step)))
    grey[::step] *= 0.6
    grey[:, ::step] *= 0.6
    return _image(grey, (172, 166, 154))


def grass(rng: np.random.Generator, size: int = 512) -> Image:
    """Green blades with dry patches."""
    fine, dry = noise(rng, size, 7, 4, 0.75), (0.55 * noise(rng, size, 3, 3))[..., None]
    return _image(
        (0.4 + 1.1 * fine)[..., None] * (np.array([78, 118, 48]) * (1 - dry) + np.array([140, 128, 78]) * dry)
    )


def _wall(rng: np.random.Generator, size: int) -> np.ndarray:
    if rng.random() < 0.4:
        image = np.full((size, size, 3), 165.0, np.float32)
        colour = np.array([rng.uniform(125, 170), rng.uniform(70, 100), rng.uniform(55, 80)])
        high, wide = size // 80, size // 28
        for row in range(size // (size // 80) + 1):
            for column in range(-1, size // wide + 1):
                x = column * wide + (row % 2) * wide // 2
                shade = (colour * rng.uniform(0.8, 1.18)).tolist()
                cv2.rectangle(image, (x + 1, row * high + 1), (x + wide - 1, (row + 1) * high - 1), shade, -1)
        return image * (0.86 + 0.28 * noise(rng, size, 4, 8))[..., None]
    palette = ((208, 198, 178), (186, 164, 142), (192, 192, 190), (156, 166, 176), (214, 186, 144), (176, 138, 118),
               (222, 216, 206), (150, 158, 140))  # fmt: skip
    streaks = cv2.resize(rng.random((1, size // 6), dtype=np.float32), (size, size))
    plain = (0.86 + 0.24 * noise(rng, size, 5, 4)) * (0.93 + 0.1 * streaks)
    return plain[..., None] * np.asarray(palette[rng.integers(len(palette))], np.float32)


def facade(rng: np.random.Generator, size: int = 448) -> Image:
    """Four floors of four windows, with frames, sills, blinds and glass that darkens downwards."""
    image, cell = _wall(rng, size), size // 4
    frame = ((232, 232, 226), (62, 56, 52), (112, 84, 64), (202, 202, 206))[rng.integers(4)]
    width, height = rng.uniform(0.4, 0.72) * cell, rng.uniform(0.5, 0.72) * cell
    glass = np.array([0.66, 0.82, 1.0]) * rng.uniform(72, 118)
    band, bars = rng.random() < 0.4, int(rng.integers(3))
    for floor in range(4):
        if band:
            image[floor * cell : floor * cell + 5] *= 0.72
        for bay in range(4):
            cx, cy = int((bay + 0.5) * cell), int((floor + 0.5) * cell)
            x0, x1, y0, y1 = int(cx - width / 2), int(cx + width / 2), int(cy - height / 2), int(cy + height / 2)
            image[y0:y1, x0:x1] = glass * rng.uniform(0.7, 1.3) * np.linspace(1.4, 0.7, y1 - y0)[:, None, None]
            if rng.random() < 0.45:
                blind = y0 + int((y1 - y0) * rng.uniform(0.15, 0.7))
                image[y0:blind, x0:x1] = np.array([206, 201, 190]) * rng.uniform(0.75, 1)
            cv2.rectangle(image, (x0, y0), (x1, y1), frame, 3)
            if bars > 0:
                cv2.line(image, (cx, y0), (cx, y1), frame, 2)
            if bars > 1:
                cv2.line(image, (x0, cy - 8), (x1, cy - 8), frame, 2)
            image[y1 + 2 : y1 + 6, x0 - 3 : x1 + 3] = 190
            image[y1 + 6 : y1 + 9, x0 - 3 : x1 + 3] *= 0.6
    return _image(image)


def shopfront(rng: np.random.Generator, size: int = 512) -> Image:
    """Four shop windows under coloured, lettered signs; one floor high, a quarter as high as wide."""
    high = size // 4
    image, names = (
        _image(_wall(rng, size)[:high]),
        "CAFE BAKERY BOOKS MARKET PIZZA BANK HOTEL FLOWERS SUSHI BAR".split(),
    )
    for bay in range(4):
        x0, x1 = bay * high + 8, (bay + 1) * high - 8
        sign = rng.uniform(30, 200, 3)
        image[int(0.05 * high) : int(0.27 * high), x0:x1] = sign
        ink = (245, 240, 225) if sign.mean() < 130 else (20, 20, 20)
        cv2.putText(image, names[rng.integers(len(names))], (x0 + 5, int(0.22 * high)), cv2.FONT_HERSHEY_DUPLEX,
                    high / 200, ink, 1, cv2.LINE_AA)  # fmt: skip
        top, bottom = int(0.3 * high), int(0.93 * high)
        shade = np.array([75, 86, 96]) * rng.uniform(0.6, 1.2) * np.linspace(1.25, 0.6, bottom - top)[:, None, None]
        image[top:bottom, x0:x1] = np.clip(shade, 0, 255)
        for _ in range(5):
            x, y = int(rng.integers(x0, x1 - 16)), int(rng.integers(int(0.55 * high), int(0.85 * high)))
            colour = rng.uniform(40, 230, 3).tolist()
            cv2.rectangle(image, (x, y), (x + int(rng.integers(4, 16)), bottom), colour, -1)
        cv2.rectangle(image, (x0, top), (x1, bottom), (50, 50, 50), 2)
    return image


def roof(rng: np.random.Generator, size: int = 256) -> Image:
    """Rows of tiles."""
    colour = ((98, 93, 90), (142, 78, 62), (112, 107, 102), (84, 88, 95))[rng.integers(4)]
    grey = 0.8 + 0.4 * noise(rng, size, 6, 4)
    grey[::16] *= 0.72
    return _image(grey, colour)


def foliage(rng: np.random.Generator, size: int = 256) -> Image:
    """Leaves: strong fine noise in a green."""
    colour = ((72, 108, 46), (94, 122, 50), (58, 94, 56), (112, 122, 48))[rng.integers(4)]
    fine = noise(rng, size, 7, 6, 0.9)
    return _image(np.clip(0.9 + 0.5 * (fine - fine.mean()) / fine.std(), 0.2, 2.0), colour)


def bark(rng: np.random.Generator, size: int = 128) -> Image:
    """Upright streaks."""
    streaks = cv2.resize(rng.random((12, 64), dtype=np.float32), (size, size), interpolation=cv2.INTER_CUBIC)
    return _image(0.5 + 0.8 * streaks, (108, 88, 68))


def speed_sign(rng: np.random.Generator, size: int = 128) -> Image:
    """A round speed limit on a white board."""
    image = np.full((size, size, 3), 238, np.uint8)
    cv2.circle(image, (size // 2, size // 2), int(0.44 * size), (196, 28, 32), size // 10, cv2.LINE_AA)
    text = ("30", "40", "50")[rng.integers(3)]
    cv2.putText(image, text, (22, size // 2 + 20), cv2.FONT_HERSHEY_DUPLEX, size / 62, (20, 20, 20), 5, cv2.LINE_AA)
    return image


class Sky:
    """A clear sky with clouds and a sun, as a function of the viewing direction, so that any projection agrees."""

    def __init__(self, rng: np.random.Generator, sun: Float64[np.ndarray, " 3"], cover: float):
        self.sun, self.cover = sun / np.linalg.norm(sun), cover
        clouds = noise(rng, 1024, 7, 4, 0.55)
        self.clouds = (clouds - clouds.min()) / np.ptp(clouds)

    def colour(self, direction: Float64[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Colours of unit world directions."""
        up = direction[..., 2]
        blend = np.sqrt(np.clip(up, 0, 1))[..., None]
        colour = np.array([198, 214, 230]) * (1 - blend) + np.array([78, 128, 198]) * blend
        towards_sun = np.clip(direction @ self.sun, -1, 1)[..., None]
        colour = colour + np.exp((towards_sun - 1) * 60) * [90, 75, 45] + np.exp((towards_sun - 1) * 6) * [35, 25, 10]
        place = direction[..., :2] / np.maximum(up, 0.04)[..., None] * 120 + [300, 500]
        place = (place % 1024).astype(np.float32)
        thick = cv2.remap(self.clouds, np.ascontiguousarray(place[..., 0]), np.ascontiguousarray(place[..., 1]),
                          cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)  # fmt: skip
        cloud = (np.clip((thick - (1 - self.cover) * 0.8) / 0.35, 0, 1) * np.clip(up * 7, 0, 1))[..., None]
        white = np.array([255, 251, 240]) * (0.72 + 0.35 * np.clip(1.3 - thick, 0, 1))[..., None]
        colour = colour * (1 - cloud) + white * cloud
        colour = np.where((up < 0)[..., None], [148, 160, 172], colour)
        return _image(colour)

    def skybox(self, size: int = 512) -> UInt8[np.ndarray, "six_h w 3"]:
        """The six faces stacked as MuJoCo wants them: right left up down front back of OpenGL's cube, y up."""
        t = (np.arange(size) + 0.5) / size * 2 - 1
        u, v = np.meshgrid(t, t)
        one = np.ones_like(u)
        faces = ((one, -v, -u), (-one, -v, u), (u, one, v), (u, -one, -v), (u, -v, one), (-u, -v, -one))
        images = []
        for x, y, z in faces:
            direction = np.stack([x, -z, y], axis=-1)  # OpenGL's y is the world's z
            images.append(self.colour(direction / np.linalg.norm(direction, axis=-1, keepdims=True)))
        return np.concatenate(images)
