"""Photometric augmentation: the colours of a sample change, its geometry does not.

The appearance of the world (light, saturation, hue) changes for all images alike. Each camera then has its own response
(white balance, exposure, gamma, vignette, blur), which its targets share. Noise and JPEG artefacts are added to context
images only: renderings should be free of them.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from nurec_sim.training.data.sample import TargetView, TrainingSample

Image = Float32[np.ndarray, "h w 3"]

# NTSC's luminance and two chrominance axes: hue is a rotation, saturation a scaling of the plane (I, Q).
_YIQ = np.array([[0.299, 0.587, 0.114], [0.596, -0.274, -0.322], [0.211, -0.523, 0.312]])


@dataclass(frozen=True)
class AugmentSettings:
    """Strength of the augmentation: standard deviations (of logarithms for factors), or shares of samples.

    Attributes:
        clean: share of samples that are not changed.
        brightness: target mean of all images, 0..1; the exposure is corrected halfway (in stops) towards it.
        light: brightness of the world in addition.
        tint: gain of each colour channel of the world.
        saturation: saturation of the world.
        hue_rad: hue rotation of the world.
        exposure: gain of each camera.
        white_balance: gain of each colour channel of each camera.
        gamma: exponent of each camera's tone curve.
        vignette: maximum loss of brightness in a camera's corners.
        blurred: share of cameras that are out of focus.
        blur_px: maximum standard deviation of their blur.
        noisy: share of samples with noise.
        noise: maximum standard deviation of the noise at full brightness, in 0..1.
        jpeg: share of samples with JPEG artefacts.
        jpeg_quality: range of their quality.
    """

    clean: float = 0.1
    brightness: float = 0.38
    light: float = 0.25
    tint: float = 0.05
    saturation: float = 0.25
    hue_rad: float = 0.08
    exposure: float = 0.10
    white_balance: float = 0.04
    gamma: float = 0.10
    vignette: float = 0.35
    blurred: float = 0.25
    blur_px: float = 1.0
    noisy: float = 0.5
    noise: float = 0.03
    jpeg: float = 0.2
    jpeg_quality: tuple[int, int] = (40, 95)


@dataclass(frozen=True)
class _Response:
    """Response of one camera: colour matrix, vignette, tone curve, blur, in this order."""

    matrix: Float64[np.ndarray, "3 3"]
    gamma: float
    vignette: float
    blur_px: float

    def __call__(self, image: Image) -> Image:
        height, width = image.shape[:2]
        y, x = np.mgrid[:height, :width]
        radius2 = ((x + 0.5 - width / 2) ** 2 + (y + 0.5 - height / 2) ** 2) / (width**2 + height**2) * 4
        shaded = image @ self.matrix.T.astype(np.float32) * (1 - self.vignette * radius2)[..., None]
        seen = np.clip(shaded, 0, 1).astype(np.float32) ** np.float32(self.gamma)
        return cv2.GaussianBlur(seen, (0, 0), self.blur_px) if self.blur_px > 0.2 else seen


def augmented(rng: np.random.Generator, sample: TrainingSample, settings: AugmentSettings) -> TrainingSample:
    """The sample with other colours and the same geometry."""
    if rng.random() < settings.clean:
        return sample
    cameras = sample.inputs.camera_idxs[0].tolist()
    world = _world_look(rng, float(sample.inputs.rgb.mean()), settings)
    responses = {camera: _response(rng, world, settings) for camera in sorted(set(cameras))}
    noise = float(rng.uniform(0, settings.noise)) if rng.random() < settings.noisy else 0.0
    low, high = settings.jpeg_quality
    quality = int(rng.integers(low, high + 1)) if rng.random() < settings.jpeg else None
    images = []
    for camera, image in zip(cameras, sample.inputs.rgb[0], strict=True):
        images.append(_spoilt(rng, responses[camera](image.numpy()), noise, quality))
    rgb = torch.from_numpy(np.stack(images))[None]
    targets = tuple(_seen(target, responses[target.camera_idx]) for target in sample.targets)
    return dataclasses.replace(sample, inputs=dataclasses.replace(sample.inputs, rgb=rgb), targets=targets)


def _world_look(rng: np.random.Generator, mean: float, settings: AugmentSettings) -> Float64[np.ndarray, "3 3"]:
    """Brightness, tint, saturation and hue of everything, as a matrix."""
    saturation, hue = np.exp(rng.normal(0, settings.saturation)), rng.normal(0, settings.hue_rad)
    c, s = saturation * np.cos(hue), saturation * np.sin(hue)
    colours = np.linalg.inv(_YIQ) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ _YIQ
    # The square root corrects half of the deviation in stops, so that dark scenes remain darker than bright ones.
    exposed = np.sqrt(settings.brightness / max(mean, 0.05))
    gain = exposed * np.exp(rng.normal(0, settings.light) + rng.normal(0, settings.tint, 3))
    return gain[:, None] * colours


def _response(
    rng: np.random.Generator, world: Float64[np.ndarray, "3 3"], settings: AugmentSettings
) -> _Response:  # fmt: skip
    gain = np.exp(rng.normal(0, settings.exposure) + rng.normal(0, settings.white_balance, 3))
    gamma, vignette = np.exp(rng.normal(0, settings.gamma)), rng.uniform(0, settings.vignette)
    blur_px = rng.uniform(0, settings.blur_px) if rng.random() < settings.blurred else 0.0
    return _Response(gain[:, None] * world, float(gamma), float(vignette), float(blur_px))


def _spoilt(rng: np.random.Generator, image: Image, noise: float, quality: int | None) -> Image:
    """An image with noise and JPEG artefacts; shot noise grows with the square root of the signal."""
    if noise:
        spread = noise * np.sqrt(0.1 + 0.9 * image)
        image = np.clip(image + spread * rng.standard_normal(image.shape, np.float32), 0, 1).astype(np.float32)
    if quality is None:
        return image
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    pressed = cv2.imencode(".jpg", np.rint(image[..., ::-1] * 255).astype(np.uint8), options)[1]
    unpacked = np.asarray(cv2.imdecode(pressed, cv2.IMREAD_COLOR), np.float32)
    return np.ascontiguousarray(unpacked[..., ::-1]) / 255


def _seen(target: TargetView, response: _Response) -> TargetView:
    rgb: Tensor = torch.from_numpy(response(target.rgb.numpy()))
    return dataclasses.replace(target, rgb=rgb)
