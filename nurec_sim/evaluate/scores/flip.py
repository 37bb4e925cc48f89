"""FLIP: perceived difference when alternating between two images, 0 (equal) to 1.

Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020, for low dynamic range images:
colours are filtered with the contrast sensitivity functions of the eye, compared in L*a*b* with the Hunt effect, and
the difference is amplified where edges or points appear in one image only.
"""

from __future__ import annotations

import functools

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

PIXELS_PER_DEGREE = 67.0206
"""A 0.7 m wide screen of 3840 pixels, 0.7 m away: the paper's default."""

# The paper's constants: exponent and knee of the colour difference, exponent and width of the feature difference.
_COLOUR_EXPONENT, _KNEE, _KNEE_VALUE = 0.7, 0.4, 0.95
_FEATURE_EXPONENT, _FEATURE_WIDTH_DEG = 0.5, 0.082
# Contrast sensitivity as sums of Gaussians a sqrt(pi / b) exp(-pi^2 x^2 / b), x in degrees: (a, b) pairs of the
# achromatic, the red-green and the blue-yellow channel.
_SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
_XYZ_FROM_RGB = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
"""sRGB's primaries and D65."""
_WHITE = _XYZ_FROM_RGB.sum(axis=1)

Image = UInt8[np.ndarray, "h w 3"]
Planes = Float32[np.ndarray, "h w 3"]


def flip_map(
    image: Image, reference: Image, pixels_per_degree: float = PIXELS_PER_DEGREE
) -> Float32[np.ndarray, "h w"]:
    """The difference at every pixel.

    Args:
        image: sRGB.
        reference: sRGB of the same size.
        pixels_per_degree: pixels per degree of visual angle of the observer.

    Raises:
        ValueError: the images differ in shape or are not 8-bit RGB.
    """
    if image.shape != reference.shape or image.ndim != 3 or image.dtype != np.uint8 or reference.dtype != np.uint8:
        raise ValueError(
            f"two 8-bit RGB images of one size are needed, got {image.shape} {image.dtype} and "
            f"{reference.shape} {reference.dtype}"
        )
    first, second = _opponent(_linear(image)), _opponent(_linear(reference))
    colour = _colour_difference(_seen(first, pixels_per_degree), _seen(second, pixels_per_degree))
    feature = _feature_difference(first[..., 0], second[..., 0], pixels_per_degree)
    # The paper's combination: a feature difference of 1 makes any colour difference maximal, one of 0 leaves it as is.
    return colour ** (1 - feature)


def flip(image: Image, reference: Image, pixels_per_degree: float = PIXELS_PER_DEGREE) -> float:
    """The mean of ``flip_map``."""
    return float(flip_map(image, reference, pixels_per_degree).mean(dtype=np.float64))


def _linear(rgb: Image) -> Planes:
    # Inverse sRGB transfer function; a table, since 8-bit images have only 256 levels.
    levels = np.arange(256) / 255.0
    table = np.where(levels > 0.04045, ((levels + 0.055) / 1.055) ** 2.4, levels / 12.92).astype(np.float32)
    return table[rgb]


def _opponent(rgb: Planes) -> Planes:
    """Linear RGB as Y, Cx, Cz: achromatic, red-green, blue-yellow; linear in radiance, hence valid to filter."""
    x, y, z = np.moveaxis(rgb @ (_XYZ_FROM_RGB.T / _WHITE).astype(np.float32), -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def _seen(opponent: Planes, pixels_per_degree: float) -> Planes:
    """The image filtered by contrast sensitivity, in L*a*b* with the Hunt effect (chroma scales with lightness)."""
    blurred = np.empty_like(opponent)
    for channel, kernel in enumerate(_blur_kernels(pixels_per_degree)):
        # A sum of Gaussians is not separable, but each of its Gaussians is.
        plane = np.ascontiguousarray(opponent[..., channel])
        blurred[..., channel] = sum(
            weight * cv2.sepFilter2D(plane, -1, line, line, borderType=cv2.BORDER_REPLICATE) for weight, line in kernel
        )
    y = (blurred[..., 0] + 16) / 116
    xyz = np.stack([y + blurred[..., 1] / 500, y, y - blurred[..., 2] / 200], axis=-1)
    rgb = np.clip(xyz @ np.linalg.inv(_XYZ_FROM_RGB.T / _WHITE).astype(np.float32), 0, 1)
    return _hunt(rgb)


def _hunt(rgb: Planes) -> Planes:
    ratio = rgb @ (_XYZ_FROM_RGB.T / _WHITE).astype(np.float32)
    # CIE L*a*b*: the cube root is replaced by its tangent below (6/29)^3, where its slope would diverge.
    delta = 6 / 29
    root = np.where(ratio > delta**3, np.cbrt(ratio), ratio / (3 * delta**2) + 4 / 29)
    lightness = 116 * root[..., 1] - 16
    a, b = 500 * (root[..., 0] - root[..., 1]), 200 * (root[..., 1] - root[..., 2])
    return np.stack([lightness, 0.01 * lightness * a, 0.01 * lightness * b], axis=-1)


@functools.cache
def _blur_kernels(pixels_per_degree: float) -> tuple[tuple[tuple[float, Float32[np.ndarray, " k"]], ...], ...]:
    """Per channel: 1D Gaussians and their weights; their weighted sum of 2D Gaussians has volume 1."""
    widest = max(b for pairs in _SENSITIVITY for _, b in pairs)
    # exp(-pi^2 x^2 / b) has the standard deviation sqrt(b / (2 pi^2)); the kernel reaches three of the widest.
    radius = int(np.ceil(3 * np.sqrt(widest / (2 * np.pi**2)) * pixels_per_degree))
    x = np.arange(-radius, radius + 1) / pixels_per_degree
    channels = []
    for pairs in _SENSITIVITY:
        lines = [(a * np.sqrt(np.pi / b), np.exp(-(np.pi**2) * x**2 / b)) for a, b in pairs]
        volume = sum(height * line.sum() ** 2 for height, line in lines)
        channels.append(tuple((height / volume, line.astype(np.float32)) for height, line in lines))
    return tuple(channels)


def _distance(first: Planes, second: Planes) -> Float32[np.ndarray, "h w"]:
    """HyAB distance (Abasi et al. 2020): city-block between lightness and chroma, Euclidean within chroma."""
    apart = first - second
    return np.abs(apart[..., 0]) + np.hypot(apart[..., 1], apart[..., 2])


@functools.cache
def _greatest() -> float:
    """Distance between pure green and pure blue, the largest in sRGB."""
    green, blue = np.eye(3, dtype=np.float32)[1:, None, None]
    return float(_distance(_hunt(green), _hunt(blue))[0, 0]) ** _COLOUR_EXPONENT


def _colour_difference(first: Planes, second: Planes) -> Float32[np.ndarray, "h w"]:
    """0 to 1; the lower 40 % of differences map to 95 % of the range, since larger ones look almost alike."""
    difference = _distance(first, second) ** _COLOUR_EXPONENT
    knee, top = _KNEE * _greatest(), _greatest()
    low = _KNEE_VALUE / knee * difference
    high = _KNEE_VALUE + (difference - knee) / (top - knee) * (1 - _KNEE_VALUE)
    return np.where(difference < knee, low, high).astype(np.float32)


def _feature_difference(
    first: Float32[np.ndarray, "h w"], second: Float32[np.ndarray, "h w"], pixels_per_degree: float
) -> Float32[np.ndarray, "h w"]:
    """The larger of the differences in edge and in point strength."""
    changes = []
    for kernel in _feature_kernels(pixels_per_degree):
        strength = []
        for plane in (first, second):
            grey = (plane + 16) / 116
            along = [_filtered(grey, *lines) for lines in (kernel, kernel[::-1])]
            strength.append(np.hypot(*along))
        changes.append(np.abs(strength[0] - strength[1]))
    # Each strength is a norm over two directions, at most sqrt(2).
    return (np.maximum(*changes) / np.sqrt(2)).astype(np.float32) ** np.float32(_FEATURE_EXPONENT)


def _filtered(
    plane: Float32[np.ndarray, "h w"], along: Float64[np.ndarray, " k"], across: Float64[np.ndarray, " k"]
) -> Float32[np.ndarray, "h w"]:
    return cv2.sepFilter2D(np.ascontiguousarray(plane), -1, along, across, borderType=cv2.BORDER_REPLICATE)


@functools.cache
def _feature_kernels(
    pixels_per_degree: float,
) -> tuple[tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, " k"]], ...]:
    """First (edges) and second (points) derivative of a Gaussian, and the Gaussian across; lobes sum to 1 and -1."""
    width = 0.5 * _FEATURE_WIDTH_DEG * pixels_per_degree
    x = np.arange(-int(np.ceil(3 * width)), int(np.ceil(3 * width)) + 1)
    bell = np.exp(-(x**2) / (2 * width**2))
    across = bell / bell.sum()
    kernels = []
    for line in (-x * bell, (x**2 / width**2 - 1) * bell):
        # Normalised lobes: a unit step gives an edge response of at most 1, whatever the width of the kernel.
        lobes = np.where(line < 0, line / -line[line < 0].sum(), line / line[line > 0].sum())
        kernels.append((lobes, across))
    return tuple(kernels)
