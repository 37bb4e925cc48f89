"""What the end-to-end policies share: images as the network sees them, the network in NumPy, and the plan it makes.

The network names a path and a speed profile rather than timed positions: a car that stands still has a path too (Jaeger
et al., Hidden Biases of End-to-End Driving Models, 2023). It is trained by ``nurec-sim train`` (docs/training.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from safetensors import SafetensorError
from safetensors.numpy import load_file

from nurec_sim import geometry
from nurec_sim.policies._paths import extended, make_plan, pursue
from nurec_sim.types import CameraFrame, Needs, Observation, Pinhole, Plan, Rig

VIEWS = {"front": (0.0, 76.0), "tele": (0.0, 239.0), "left": (60.0, 76.0), "right": (-60.0, 76.0)}
"""Yaw in the rig (degrees) and focal length (pixels) of what the network sees of each camera."""
WIDTH_PX, HEIGHT_PX, HORIZON_PX = 128, 64, 24.0
ROUTE_M = np.array([8.0, 16.0, 24.0, 36.0, 52.0])
"""Distances along the route at which the network is told where it goes."""
PATH_M = np.array([3.0, 6.0, 10.0, 15.0, 20.0, 28.0])
AFTER_S = np.array([0.5, 1.0, 2.0, 3.0, 4.0])
"""The network's path has points at these distances, its speed profile values after these times."""
SPEED_SCALE_MPS, LENGTH_SCALE_M = 10.0, 10.0
NUMBERS = 2 + 2 * len(ROUTE_M)
KERNELS = (5, 3, 3, 3, 3)
DIGITS = 6
"""Of the network's outputs."""
HARDEST_BRAKE_MPS2, ACCEL_MPS2 = 6.0, 2.0
STANDS_MPS = 0.3
"""A lower wanted speed means to stop."""


def view_of(frame: CameraFrame, camera: str, turn_rad: float = 0.0) -> UInt8[np.ndarray, "h w 3"]:
    """An image as the network sees it, whatever the lens, the mounting angles and the size of the camera.

    Args:
        frame: of an ideal pinhole.
        camera: a key of ``VIEWS``.
        turn_rad: the rig is turned by this much to the left first.

    Returns:
        bilinear samples [64, 128, 3] along the rays of a level pinhole at the same place; 0 where the camera saw
        nothing.
    """
    yaw_deg, focal = VIEWS[camera]
    lens = frame.camera.lens
    assert isinstance(lens, Pinhole), "policies get ideal pinhole images"
    rgb = frame.rgb
    # Larger images are averaged over blocks first, so that fine texture does not alias.
    block = max(1, int(lens.fx_px / focal + 0.25))
    rows, columns = rgb.shape[0] // block, rgb.shape[1] // block
    small = rgb[: rows * block, : columns * block].reshape(rows, block, columns, block, 3).mean(axis=(1, 3))
    x, y = np.meshgrid(np.arange(WIDTH_PX) + 0.5 - WIDTH_PX / 2, np.arange(HEIGHT_PX) + 0.5 - HORIZON_PX)
    rays = np.stack([np.full(x.shape, focal), -x, -y], axis=-1)
    turn = geometry.rotation_from_yaw(np.deg2rad(yaw_deg) + turn_rad)
    seen = rays @ (turn.T @ frame.camera.rig_from_camera[:3, :3])
    depth = np.maximum(seen[..., 2], 1e-6)
    u = (lens.fx_px * seen[..., 0] / depth + lens.cx_px) / block - 0.5
    v = (lens.fy_px * seen[..., 1] / depth + lens.cy_px) / block - 0.5
    inside = (seen[..., 2] > 0) & (u > -0.5) & (v > -0.5) & (u < columns - 0.5) & (v < rows - 0.5)
    u, v = np.clip(u, 0, columns - 1), np.clip(v, 0, rows - 1)
    left, top = np.minimum(u.astype(np.int64), columns - 2), np.minimum(v.astype(np.int64), rows - 2)
    f, g = (u - left)[..., None], (v - top)[..., None]
    above = small[top, left] * (1 - f) + small[top, left + 1] * f
    below = small[top + 1, left] * (1 - f) + small[top + 1, left + 1] * f
    return np.where(inside[..., None], np.rint(above * (1 - g) + below * g), 0).astype(np.uint8)


def numbers_of(
    speed_mps: float, route_m: Float64[np.ndarray, "k 2"], route_speed_mps: Float64[np.ndarray, " k"]
) -> Float32[np.ndarray, " 12"]:
    """Speed, the highest recorded speed ahead (a speed limit, which tells no stops), and five points of the route."""
    line = extended(route_m)
    arc = geometry.arc_length(line)
    points = np.column_stack([np.interp(ROUTE_M, arc, line[:, i]) for i in range(2)])
    # Only the deviation from straight on is news.
    points = (points - np.column_stack([ROUTE_M, np.zeros(len(ROUTE_M))])) / LENGTH_SCALE_M
    cruise = float(np.max(route_speed_mps, initial=0.0))
    return np.concatenate([[speed_mps / SPEED_SCALE_MPS, cruise / SPEED_SCALE_MPS], points.ravel()]).astype(np.float32)


def answer(
    outputs: Float64[np.ndarray, " 17"],
) -> tuple[Float64[np.ndarray, "p 2"], Float64[np.ndarray, " s"]]:
    """Path (metres, in the rig frame) and speeds (m/s) from the network's outputs."""
    count = 2 * len(PATH_M)
    path = outputs[:count].astype(np.float64).reshape(-1, 2) * LENGTH_SCALE_M
    path[:, 0] += PATH_M
    return path, np.maximum(0.0, outputs[count:].astype(np.float64) * SPEED_SCALE_MPS)


def targets_of(path_m: np.ndarray, speeds_mps: np.ndarray) -> np.ndarray:
    """Outputs [..., 17] that ``answer`` turns into a path [..., 6, 2] and speeds [..., 5]."""
    off = (path_m - np.column_stack([PATH_M, np.zeros(len(PATH_M))])) / LENGTH_SCALE_M
    return np.concatenate([off.reshape(*off.shape[:-2], -1), speeds_mps / SPEED_SCALE_MPS], axis=-1)


def forward(
    weights: Mapping[str, np.ndarray], images: UInt8[np.ndarray, "cameras h w 3"], numbers: Float32[np.ndarray, " 12"]
) -> Float64[np.ndarray, " 17"]:
    """The network: five strided convolutions and a layer per camera, shared; then three layers for all.

    ``training.imitation.network`` is the same in PyTorch.
    """
    x = images / 127.5 - 1
    for layer, kernel in enumerate(KERNELS):
        x = np.maximum(_convolved(x, weights[f"convolutions.{layer}.weight"], kernel)
                       + weights[f"convolutions.{layer}.bias"], 0)  # fmt: skip
    # PyTorch flattens channels first.
    x = x.transpose(0, 3, 1, 2).reshape(len(images), -1)
    x = np.maximum(x @ weights["camera.weight"].T + weights["camera.bias"], 0)
    x = np.concatenate([x.ravel(), numbers])
    for layer in range(3):
        x = weights[f"head.{layer}.weight"] @ x + weights[f"head.{layer}.bias"]
        x = np.maximum(x, 0) if layer < 2 else x
    # Libraries sum in an order that depends on the number of threads; that is far below the last digit kept.
    return np.round(x, DIGITS)


def _convolved(
    x: Float64[np.ndarray, "n h w c"], weight: Float64[np.ndarray, "out c k k"], kernel: int
) -> Float64[np.ndarray, "n h2 w2 out"]:
    """A convolution of stride 2 that halves the image, as one matrix product."""
    pad = kernel // 2
    padded = np.pad(x, ((0, 0), (pad, pad), (pad, pad), (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (kernel, kernel), axis=(1, 2))[:, ::2, ::2]
    count, height, width = windows.shape[:3]
    rows = windows.reshape(count * height * width, -1)
    return (rows @ weight.reshape(len(weight), -1).T).reshape(count, height, width, len(weight))


def read_weights(path: Path, cameras: int) -> dict[str, np.ndarray]:
    """Weights from their file, in double precision.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is damaged, or not of a network for that many cameras.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing; nurec-sim train makes it (docs/training.md)")
    try:
        found = load_file(path)
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path} is damaged or no .safetensors file: {error}") from None
    shapes = weight_shapes(cameras)
    if {name: value.shape for name, value in found.items()} != shapes:
        raise ValueError(f"{path} is not of an end-to-end policy with {cameras} cameras")
    return {name: np.ascontiguousarray(value, np.float64) for name, value in found.items()}


def weight_shapes(cameras: int) -> dict[str, tuple[int, ...]]:
    """Names and shapes of all weights."""
    channels = (3, 16, 32, 48, 64, 64)
    shapes: dict[str, tuple[int, ...]] = {}
    for layer, kernel in enumerate(KERNELS):
        shapes[f"convolutions.{layer}.weight"] = (channels[layer + 1], channels[layer], kernel, kernel)
        shapes[f"convolutions.{layer}.bias"] = (channels[layer + 1],)
    scale = 2 ** len(KERNELS)
    sizes = {"camera": (channels[-1] * (WIDTH_PX // scale) * (HEIGHT_PX // scale), 96)}
    inner = [96 * cameras + NUMBERS, 128, 128, 2 * len(PATH_M) + len(AFTER_S)]
    sizes |= {f"head.{layer}": (inner[layer], inner[layer + 1]) for layer in range(3)}
    for name, (inputs, outputs) in sizes.items():
        shapes |= {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}
    return shapes


class EndToEnd:
    """A small convolutional network drives: images, speed and a coarse route in, a path and a speed profile out.

    Subclasses name their cameras in ``needs``; each lies in ``weights/<name>.safetensors``.
    """

    name = ""
    needs = Needs()

    def __init__(self) -> None:
        self.weights: dict[str, np.ndarray] | None = None

    path_m, after_s = PATH_M, AFTER_S
    view, numbers = staticmethod(view_of), staticmethod(numbers_of)
    answer, targets = staticmethod(answer), staticmethod(targets_of)
    """The network's inputs and the meaning of its outputs, for driving and for training alike."""

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the weights."""
        return weight_shapes(len(self.needs.cameras))

    @property
    def weights_file(self) -> Path:
        """Where the weights are; subclasses with weights of their own override it."""
        return Path(__file__).parent / "weights" / f"{self.name}.safetensors"

    def reset(self, rig: Rig, seed: int) -> None:
        """Loads the weights; the network has no memory.

        Raises:
            FileNotFoundError: there are none.
            ValueError: the file is damaged, or of another network.
        """
        if self.weights is None:
            self.weights = read_weights(self.weights_file, len(self.needs.cameras))

    def outputs(
        self, images: UInt8[np.ndarray, "cameras h w 3"], numbers: Float32[np.ndarray, " 12"]
    ) -> Float64[np.ndarray, " 17"]:
        """What the network answers; ``reset`` comes first."""
        assert self.weights is not None, "reset() comes first"
        return forward(self.weights, images, numbers)

    def plan(self, observation: Observation) -> Plan:
        """Five seconds along the network's path, at its speeds."""
        images = np.stack([self.view(observation.cameras[name], name) for name in self.needs.cameras])
        numbers = self.numbers(observation.ego.speed_mps, observation.route_m, observation.route_speed_mps)
        path, speeds = self.answer(self.outputs(images, numbers))
        times = np.concatenate([[0.0], AFTER_S])
        wanted = np.concatenate([[observation.ego.speed_mps], np.where(speeds < STANDS_MPS, 0.0, speeds)])

        def accel_of(t_s: float, driven_m: float, speed: float) -> float:
            accel = (float(np.interp(t_s + 0.5, times, wanted)) - speed) / 0.5
            return min(max(accel, -HARDEST_BRAKE_MPS2), ACCEL_MPS2)

        return make_plan(observation, pursue(path, observation.ego.speed_mps, accel_of))
