"""The device that renders a scene: what every renderer offers, and which one is chosen."""

from __future__ import annotations

import functools
import logging
import os
import re
from collections.abc import Sequence
from typing import NamedTuple, Protocol

from nurec_sim.errors import GpuError
from nurec_sim.types import CameraFrame, GaussianScene, LidarFilter, LidarFrame, SensorFrame, SensorRequest

log = logging.getLogger(__name__)

DEVICE_VARIABLE = "NUREC_SIM_DEVICE"
"""Environment variable that sets the device for ``auto``."""


class Renderer(Protocol):
    """Renders one scene, on any device; all methods can be called from many threads."""

    scene: GaussianScene

    def sense(self, requests: Sequence[SensorRequest], outputs: Sequence[str] = ...) -> list[SensorFrame]:
        """One frame per request, in order; cameras with ``rgb`` and what else ``outputs`` names."""
        ...

    def render_camera(self, request: SensorRequest, outputs: Sequence[str] = ...) -> CameraFrame:
        """A camera frame with ``rgb`` and those of depth, alpha, label and normal that ``outputs`` names."""
        ...

    def render_lidar(self, request: SensorRequest, filter: LidarFilter | None = ...) -> LidarFrame:
        """A sweep: the beams that return by ``filter``, ``LidarFilter()`` if None."""
        ...


class ChosenDevice(NamedTuple):
    """``name`` is ``cpu`` or such as ``cuda:0``; ``reason`` the name of the GPU, or why there is none to use."""

    name: str
    reason: str


def make_renderer(
    scene: GaussianScene,
    device: str = "auto",
    *,
    threads: int | None = None,
    apply_isp: bool = True,
    detail_px: float = 0.0,
) -> Renderer:
    """A scene prepared for rendering.

    Args:
        scene: the world.
        device: ``auto``, ``cpu``, ``cuda`` or ``cuda:N``; see ``choose_device``.
        threads: CPU threads that work on a frame; as many as the process may use if None. Of no effect on a GPU.
        apply_isp: whether ``scene.isp`` of the request's sensor id is applied to requests that ask for it.
        detail_px: level of detail: distant static Gaussians are rendered merged where that changes no more than about a
            square of this side, in pixels or beams; 0 renders all of them (``render.lod``).

    Raises:
        GpuError: the device cannot be used; the message names what is missing.
        ValueError: less than one thread, or a negative or infinite ``detail_px``.
    """
    chosen = choose_device(device).name
    if chosen == "cpu":
        from nurec_sim.render.cpu.renderer import CpuRenderer

        return CpuRenderer(scene, threads, apply_isp, detail_px)
    from nurec_sim.render.gpu.launcher import shared_launcher
    from nurec_sim.render.gpu.renderer import GpuRenderer

    return GpuRenderer(scene, shared_launcher(chosen), apply_isp, detail_px)


@functools.cache
def choose_device(device: str = "auto") -> ChosenDevice:
    """The device to use.

    Args:
        device: ``cpu``; ``cuda`` or ``cuda:N``, which must be usable; or ``auto``: what $NUREC_SIM_DEVICE names, else a
            GPU if the driver, a CUDA build of torch and the extra ``gpu`` are there, else the CPU.

    Raises:
        GpuError: an unknown name, or a GPU that cannot be used; the message names what is missing.
    """
    wanted = os.environ.get(DEVICE_VARIABLE, "auto") if device == "auto" else device
    if wanted == "cpu":
        return ChosenDevice("cpu", "")
    if wanted != "auto" and not re.fullmatch(r"cuda(:\d+)?", wanted):
        raise GpuError(f"unknown device {wanted!r}; have auto, cpu, cuda, cuda:0, cuda:1, ...")
    try:
        chosen = _cuda("cuda" if wanted == "auto" else wanted)
    except GpuError as error:
        if wanted != "auto":
            raise GpuError(f"device {wanted!r} cannot be used: {error}; see docs/gpu.md, or use cpu") from None
        chosen = ChosenDevice("cpu", str(error))
    log.info("rendering on %s: %s", *chosen)
    return chosen


def _cuda(name: str) -> ChosenDevice:
    """A CUDA device on which the kernels are loaded."""
    from nurec_sim.render.gpu.driver import check_driver

    check_driver()  # before the imports, which take seconds
    import torch

    from nurec_sim.render.gpu.launcher import shared_launcher

    device = shared_launcher(name).device
    return ChosenDevice(str(device), torch.cuda.get_device_name(device))
