"""The methods that are compared: each turns a log into something that shows views."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nurec_sim.errors import ReconstructError, WeightsError
from nurec_sim.evaluate.windows import Window
from nurec_sim.reconstruct import FeedForwardSettings, LiftSettings, OptimizeSettings, load_method
from nurec_sim.render import make_renderer
from nurec_sim.types import CameraFrame, CameraModel, Clip, GaussianScene, SensorRequest

Show = Callable[[SensorRequest], CameraFrame]
"""Answers a request for a camera image; without ``depth_m`` where a method knows none."""

CHOICES: Mapping[str, str] = {
    "dense": "the network, one Gaussian per pixel",
    "selective": "the network, clusters around chosen points",
    "dense-lidar": "dense, its depth fitted to the LiDAR that lift sees, from place to place",
    "dense-concatenated": "dense, all Gaussians of all chunks kept instead of merged by ownership",
    "lift": "coloured LiDAR and stereo, no learning",
    "optimized": "lift, then fitted to the seen images and sweeps (400 steps)",
    "copy": "the input image nearest in time, as it is; knows no depth",
}

LIFT = LiftSettings(sky_px=256)
"""A finer sky would not be seen at the size at which views are compared."""
OPTIMIZED = OptimizeSettings(seconds=None, steps=400)
"""Steps, not seconds: figures must not depend on the machine."""


@dataclass(frozen=True)
class Contender:
    """A method under the name that tables call it; ``settings`` are those of ``reconstruct``, None for a copy.

    ``method`` is a reference as ``reconstruct.load_method`` takes it, or ``copy``.
    """

    name: str
    method: str
    settings: Any = None


@dataclass(frozen=True)
class Built:
    """What a method made of a log: views on demand, the scene behind them if there is one, the seconds it took."""

    show: Show
    scene: GaussianScene | None
    seconds: float

    @property
    def gaussians(self) -> int | None:
        """How many there are."""
        return None if self.scene is None else len(self.scene.static) + len(self.scene.dynamic)


def contenders(
    names: Sequence[str],
    network: FeedForwardSettings | None = None,
    selective_checkpoint: Path | None = None,
    lift: LiftSettings | None = None,
) -> tuple[Contender, ...]:
    """The methods of these names.

    Args:
        names: of ``CHOICES``, or references to other methods as ``reconstruct.load_method`` takes them, which get their
            default settings; in the order of the tables, none twice.
        network: how logs go through the network; profile and checkpoint are for ``dense``, or for ``selective`` if the
            profile is one of its. Both share the rest.
        selective_checkpoint: weights of ``selective``.
        lift: settings of ``lift``; ``LIFT`` if None.

    Raises:
        ReconstructError: an unknown name, one given twice, or none.
    """
    settings = network or FeedForwardSettings()
    found = tuple(_contender(name, settings, selective_checkpoint, lift or LIFT) for name in names)
    if not found or len({contender.name for contender in found}) < len(found):
        raise ReconstructError(f"methods must be named, each once, as {list(CHOICES)} are; got {list(names)}")
    return found


def _contender(name: str, network: FeedForwardSettings, selective: Path | None, lift: LiftSettings) -> Contender:
    if name == "copy":
        return Contender(name, "copy")
    if name == "lift":
        return Contender(name, "lift", lift)
    if name == "optimized":
        return Contender(name, "optimized", OPTIMIZED)
    if name not in CHOICES:
        try:
            made = load_method(name)
        except ReconstructError as error:
            raise ReconstructError(f"{error}; or one of {list(CHOICES)}") from error
        return Contender(made.name, name, made.settings())
    method = "selective" if name == "selective" else "dense"
    if name == "dense-concatenated":
        network = dataclasses.replace(network, merge="concatenate")
    if name == "dense-lidar":
        network = dataclasses.replace(network, lidar_depth="local")
    owner = "dense" if network.profile is None else _decoder(network.profile)
    given = network.checkpoint if owner == method else None
    checkpoint = selective if method == "selective" and selective is not None else given
    profile = network.profile if owner == method else None
    return Contender(name, method, dataclasses.replace(network, profile=profile, checkpoint=checkpoint))


def _decoder(profile: str) -> str:
    from nurec_sim.network import PROFILES

    if profile not in PROFILES:
        raise ReconstructError(f"no network profile {profile!r}; have {list(PROFILES)}")
    return PROFILES[profile].decoder


def without_weights(contender: Contender) -> str | None:
    """Why a method cannot run here: nobody named weights for it, and there are none. None if it can."""
    settings = contender.settings
    if not isinstance(settings, FeedForwardSettings) or settings.checkpoint is not None:
        return None
    try:
        describe(contender)
    except WeightsError as error:
        return str(error)
    return None


def describe(contender: Contender) -> dict[str, Any]:
    """Everything that a method's results depend on, as plain JSON; files by the digest of their bytes.

    Raises:
        WeightsError: the network's weights are not there.
    """
    said: dict[str, Any] = {"method": contender.method}
    settings = contender.settings
    if settings is None:
        return said
    values = dataclasses.asdict(settings)
    if isinstance(settings, FeedForwardSettings):
        from nurec_sim.network.checkpoints.download import find_weights, sha256
        from nurec_sim.reconstruct.feedforward.method import profile_name

        profile = values["profile"] = profile_name(contender.method, settings.profile)
        values["ego_masks"] = None if settings.ego_masks is None else str(settings.ego_masks)
        values["checkpoint"] = None
        if settings.random_weights is None:
            values["checkpoint"] = sha256(find_weights(profile, settings.checkpoint))
    return said | {"settings": values}


def build(contender: Contender, window: Window, device: str = "auto") -> Built:
    """Let a method see a window's log; ``device`` renders what it made of it (``render.choose_device``).

    Raises:
        ReconstructError: the log lacks what the method needs.
        WeightsError: the network's weights are not there or cannot be used.
    """
    if contender.method == "copy":
        return Built(lambda request: _nearest(window.clip, request), None, 0.0)
    from nurec_sim.reconstruct import reconstruct

    _look(window, sweeps=_sees_lidar(contender))
    started = time.perf_counter()
    scene = reconstruct(window.clip, contender.method, cameras=window.cameras, settings=contender.settings)
    renderer, spent = make_renderer(scene, device), time.perf_counter() - started
    return Built(lambda request: renderer.render_camera(request, ("rgb", "depth")), scene, spent)


def _sees_lidar(contender: Contender) -> bool:
    settings = contender.settings
    return settings.lidar_depth != "off" if isinstance(settings, FeedForwardSettings) else settings is not None


def _look(window: Window, sweeps: bool) -> None:
    """Ask for all that a method reads, so that drawing it is not counted as the method's time."""
    clip = window.clip
    for camera in window.cameras:
        for index in range(len(clip.camera_times_us(camera))):
            clip.image(camera, index)
    for lidar in clip.rig.lidars if sweeps else ():
        for index in range(len(clip.sweep_times_us(lidar))):
            clip.sweep(lidar, index)


def _nearest(clip: Clip, request: SensorRequest) -> CameraFrame:
    """The frame of the requested camera that was taken nearest in time."""
    camera = request.sensor
    assert isinstance(camera, CameraModel)
    middle = clip.camera_times_us(camera.id).sum(axis=1) // 2
    if not len(middle):
        raise ReconstructError(f"clip {clip.id!r}: camera {camera.id!r} has no seen frame that could be copied")
    index = int(np.argmin(np.abs(middle - (request.start_us + request.end_us) // 2)))
    return CameraFrame(camera, request.start_us, request.end_us, clip.image(camera.id, index))
