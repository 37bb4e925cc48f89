"""LPIPS (Zhang et al. 2018) with weights provided by the user: distances between features of AlexNet or VGG16.

Published weights are read from ``torch.save`` or safetensors files: the image network under torchvision's names
(``features.0.weight``, ...), and one positive factor per channel under the LPIPS authors' names
(``lin0.model.1.weight``, ...). This package contains no weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nurec_sim.errors import WeightsError
from nurec_sim.network.checkpoints.state_dicts import load_state_dict, non_finite

SUFFIXES = (".pth", ".pt", ".safetensors")
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""The authors' normalisation of colours in -1..1: subtracted, then divided by (ImageNet's mean and deviation)."""


@dataclass(frozen=True)
class _Conv:
    """A convolution followed by a ReLU: its number in torchvision's list, and whether its output is compared."""

    number: int
    channels: tuple[int, int]
    kernel: int = 3
    stride: int = 1
    padding: int = 1
    pooled_before: bool = False
    compared: bool = True


@dataclass(frozen=True)
class _Network:
    name: str
    pool_kernel: int
    smallest_px: int
    layers: tuple[_Conv, ...]

    def needed(self) -> dict[str, list[int]]:
        """Names and shapes of all weights."""
        shapes: dict[str, list[int]] = {}
        for layer in self.layers:
            before, after = layer.channels
            shapes[f"features.{layer.number}.weight"] = [after, before, layer.kernel, layer.kernel]
            shapes[f"features.{layer.number}.bias"] = [after]
        compared = [layer for layer in self.layers if layer.compared]
        return shapes | {_factor(k): [1, layer.channels[1], 1, 1] for k, layer in enumerate(compared)}


_ALEX = _Network(
    "AlexNet", 3, 31, (
        _Conv(0, (3, 64), 11, 4, 2), _Conv(3, (64, 192), 5, 1, 2, pooled_before=True),
        _Conv(6, (192, 384), pooled_before=True), _Conv(8, (384, 256)), _Conv(10, (256, 256)),
    ),
)  # fmt: skip
_VGG = _Network(
    "VGG16", 2, 16, (
        _Conv(0, (3, 64), compared=False), _Conv(2, (64, 64)),
        _Conv(5, (64, 128), pooled_before=True, compared=False), _Conv(7, (128, 128)),
        _Conv(10, (128, 256), pooled_before=True, compared=False), _Conv(12, (256, 256), compared=False),
        _Conv(14, (256, 256)),
        _Conv(17, (256, 512), pooled_before=True, compared=False), _Conv(19, (512, 512), compared=False),
        _Conv(21, (512, 512)),
        _Conv(24, (512, 512), pooled_before=True, compared=False), _Conv(26, (512, 512), compared=False),
        _Conv(28, (512, 512)),
    ),
)  # fmt: skip


def _factor(level: int) -> str:
    return f"lin{level}.model.1.weight"


class Lpips:
    """The distance between two images [h, w, 3] in 0..1; only the first one receives gradients.

    Args:
        state: weights of the image network and the channel factors; others are ignored.
        name: origin of the weights, for error texts.

    Raises:
        WeightsError: weights of neither network, missing, of wrong shape, or not finite.
    """

    def __init__(self, state: Mapping[str, Tensor], name: str = "LPIPS weights") -> None:
        self.network = _recognised(state, name)
        needed = self.network.needed()
        if missing := [each for each in needed if each not in state]:
            raise WeightsError(
                f"{name} lacks {len(missing)} weights of LPIPS over {self.network.name}: {', '.join(missing)}; give a "
                "file, or a folder of files, with torchvision's features.N.weight and features.N.bias and the LPIPS "
                "authors' linK.model.1.weight"
            )
        if wrong := [
            f"{each} {list(state[each].shape)} instead of {shape}"
            for each, shape in needed.items()
            if list(state[each].shape) != shape
        ]:
            raise WeightsError(f"{name} is not of LPIPS over {self.network.name}: {', '.join(wrong)}")
        self.state = {each: state[each].detach().float() for each in needed}
        if bad := non_finite(self.state):
            raise WeightsError(f"{name} holds values that are not finite: {', '.join(bad)}")

    def __call__(self, image: Float[Tensor, "h w 3"], reference: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
        """Perceived difference, 0 if equal.

        Raises:
            ValueError: the images differ in shape, are not [h, w, 3], or are too small for the network.
        """
        least = self.network.smallest_px
        if image.shape != reference.shape or image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < least:
            raise ValueError(
                f"LPIPS over {self.network.name} needs two images of one shape [h, w, 3] and at least {least} px, "
                f"got {list(image.shape)}, {list(reference.shape)}"
            )
        self.state = {name: value.to(image.device) for name, value in self.state.items()}
        seen = self._features(image)
        with torch.no_grad():
            true = self._features(reference)
        # Paper, eq. 1: squared differences of unit-length features, weighted per channel, averaged over the image.
        total = image.new_zeros(())
        for level, (a, b) in enumerate(zip(seen, true, strict=True)):
            total = total + functional.conv2d((_unit(a) - _unit(b)).square(), self.state[_factor(level)]).mean()
        return total

    def _features(self, image: Float[Tensor, "h w 3"]) -> list[Float[Tensor, "1 c y x"]]:
        """Compared features of each level."""
        shift, scale = (torch.tensor(each, device=image.device) for each in (SHIFT, SCALE))
        x = ((2 * image.float() - 1 - shift) / scale).permute(2, 0, 1)[None]
        levels = []
        for layer in self.network.layers:
            if layer.pooled_before:
                x = functional.max_pool2d(x, self.network.pool_kernel, 2)
            weight, bias = (self.state[f"features.{layer.number}.{each}"] for each in ("weight", "bias"))
            x = functional.relu(functional.conv2d(x, weight, bias, layer.stride, layer.padding))
            if layer.compared:
                levels.append(x)
        return levels


def load_lpips(path: Path) -> Lpips:
    """LPIPS from a file that holds all its weights, or from a folder whose files hold them together.

    Raises:
        WeightsError: a file cannot be read, two files hold the same weight, or ``Lpips`` refuses them.
    """
    path = Path(path)
    files = sorted(each for each in path.iterdir() if each.suffix in SUFFIXES) if path.is_dir() else [path]
    if not files:
        raise WeightsError(f"no weights in {path}; it must hold files that end in {', '.join(SUFFIXES)}")
    state: dict[str, Tensor] = {}
    for file in files:
        part = {name: value for name, value in load_state_dict(file).items() if name.startswith(("features.", "lin"))}
        if twice := sorted(state.keys() & part.keys()):
            raise WeightsError(f"two files in {path} hold {twice[0]}; leave the files of one network there")
        state |= part
    return Lpips(state, str(path))


def _recognised(state: Mapping[str, Tensor], name: str) -> _Network:
    """Identifies the network by the shape of the first kernel."""
    first = state.get("features.0.weight")
    for network in (_ALEX, _VGG):
        if first is not None and list(first.shape) == network.needed()["features.0.weight"]:
            return network
    found = "no features.0.weight" if first is None else f"features.0.weight {list(first.shape)}"
    raise WeightsError(
        f"{name} holds no weights of AlexNet (features.0.weight [64, 3, 11, 11]) or VGG16 ([64, 3, 3, 3]); "
        f"it has {found}"
    )


def _unit(x: Float[Tensor, "1 c y x"]) -> Float[Tensor, "1 c y x"]:
    """Features scaled to unit length at every pixel; zero vectors stay zero."""
    # The square root has an infinite gradient at 0, hence the clamp; 1e-10 is the authors' epsilon.
    length = x.square().sum(dim=1, keepdim=True).clamp(min=1e-20).sqrt()
    return x / (length + 1e-10)
