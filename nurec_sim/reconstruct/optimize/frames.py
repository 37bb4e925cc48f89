"""Where an optimisation draws its frames: on the CPU, or on a GPU by the same interface."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float64

from nurec_sim.render.cpu.backward.frame import SENSORS, Frame
from nurec_sim.types import CameraModel

Frames = Callable[[CameraModel, Float64[np.ndarray, "2 4 4"]], Frame]
"""Makes a frame of a camera from its poses at the start and the end of the exposure."""


def cpu_frames(camera: CameraModel, pair: Float64[np.ndarray, "2 4 4"]) -> Frame:
    """A frame on the CPU."""
    return Frame(SENSORS.tables(camera), pair, False)


def frames_on(device: str) -> Frames:
    """Makes frames on a device, ``cpu`` or such as ``cuda:0``.

    Raises:
        GpuError: the GPU cannot be used.
    """
    if device == "cpu":
        return cpu_frames
    from nurec_sim.render.gpu.frame import GpuFrames
    from nurec_sim.render.gpu.launcher import shared_launcher

    return GpuFrames(shared_launcher(device))
