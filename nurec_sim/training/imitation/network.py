"""The network of the end-to-end policies in PyTorch, for training; policies run the same weights in NumPy."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

DROPOUT = 0.3
"""Of the features of every camera, in training only: towns are few."""


class DrivingNetwork(nn.Module):
    """Strided convolutions and a layer per camera, shared; then layers for all cameras together.

    Args:
        shapes: name and shape of every weight, as the policy has them.
        seed: of the initial weights.
    """

    def __init__(self, shapes: Mapping[str, tuple[int, ...]], seed: int = 0) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            kernels = [shape for name, shape in shapes.items() if len(shape) == 4]
            self.convolutions = nn.ModuleList(
                nn.Conv2d(inputs, outputs, k, stride=2, padding=k // 2) for outputs, inputs, k, _ in kernels
            )
            self.camera = _linear(shapes["camera.weight"])
            layers = sum(name.startswith("head.") and name.endswith(".weight") for name in shapes)
            self.head = nn.ModuleList(_linear(shapes[f"head.{layer}.weight"]) for layer in range(layers))
            for module in [*self.convolutions, self.camera, *self.head]:
                # He et al. 2015: keeps the variance through layers with ReLU.
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(module.bias)
            last = self.head[-1]
            assert isinstance(last, nn.Linear)
            with torch.no_grad():
                last.weight.mul_(0.1)  # the first answer is about straight on

    def forward(self, images: Tensor, numbers: Tensor) -> Tensor:
        """Outputs [batch, outputs] of images uint8 [batch, cameras, h, w, 3] and numbers [batch, n]."""
        batch, cameras = images.shape[:2]
        x = images.flatten(0, 1).permute(0, 3, 1, 2).float() / 127.5 - 1
        for convolution in self.convolutions:
            x = functional.relu(convolution(x))
        x = functional.dropout(x.flatten(1), DROPOUT, self.training)
        x = functional.relu(self.camera(x)).reshape(batch, cameras * self.camera.out_features)
        x = functional.dropout(x, DROPOUT, self.training)
        x = torch.cat([x, numbers], dim=1)
        for layer in self.head[:-1]:
            x = functional.relu(layer(x))
        result: Tensor = self.head[-1](x)
        return result


def _linear(shape: tuple[int, ...]) -> nn.Linear:
    return nn.Linear(shape[1], shape[0])
