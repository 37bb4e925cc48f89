"""The compared methods: each turns a log into a renderer of views."""

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
from nurec_sim.network.lidar.profiles import LIDAR_PROFILES
from nurec_sim.reconstruct import FeedForwardSettings, LidarSettings, LiftSettings, OptimizeSettings, load_method
from nurec_sim.render import make_renderer
from nurec_sim.render.device import Renderer
from nurec_sim.types import ActorsName, CameraFrame, CameraModel, Clip, GaussianScene, Sense, SensorRequest

Show = Callable[[SensorRequest], CameraFrame]
"""Renders a camera image; without ``depth_m`` if the method has no depth."""

CHOICES: Mapping[str, str] = {
    "dense": "the network, one Gaussian per pixel",
    "selective": "the network, clusters around chosen points",
    "dense-lidar": "dense, with depth fitted locally to the LiDAR",
    "dense-concatenated": "dense, with chunks concatenated instead of merged by ownership",
    "lidar": "the network's LiDAR branch",
    "lidar-no-floor": "the same, trained without the scale floor",
    "lift": "coloured LiDAR and stereo, no learning",
    "optimized": "lift, then optimised on the input images and sweeps (400 steps)",
    "copy": "the input image nearest in time, unchanged; no depth",
}

LIFT = LiftSettings(sky_px=256)
"""Sufficient sky resolution for the size at which views are compared."""
OPTIMIZED = OptimizeSettings(seconds=None, steps=400)
"""Steps instead of seconds, so that results do not depend on the machine."""


@dataclass(frozen=True)
class Contender:
    """A method with its name in tables; ``settings`` are those of ``reconstruct``, None for ``copy``.

    ``method`` is a reference for ``reconstruct.load_method``, or ``copy``.
    """

    name: str
    method: str
    settings: Any = None


@dataclass(frozen=True)
class Built:
    """Result of a method on a log: a view renderer, the scene and its renderer if any, and the seconds taken."""

    show: Show
    scene: GaussianScene | None
    seconds: float
    renderer: Renderer | None = None

    @property
    def sense(self) -> Sense | None:
        """Renders any sensor, if there is a scene."""
        return None if self.renderer is None else self.renderer.sense

    @property
    def gaussians(self) -> int | None:
        """Number of Gaussians."""
        return None if self.scene is None else len(self.scene.static) + len(self.scene.dynamic)


def contenders(
    names: Sequence[str],
    network: FeedForwardSettings | None = None,
    selective_checkpoint: Path | None = None,
    lift: LiftSettings | None = None,
) -> tuple[Contender, ...]:
    """The methods of these names.

    Args:
        names: of ``CHOICES``, or references for ``reconstruct.load_method`` with default settings; in the order of the
            tables, without duplicates.
        network: network settings; profile and checkpoint apply to ``dense``, or to ``selective`` or the LiDAR branch if
            the profile is theirs, all other settings to the first two.
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
    if name in LIDAR_PROFILES:
        checkpoint = network.checkpoint if network.profile == name else None
        return Contender(name, "lidar", LidarSettings(LIDAR_PROFILES[name].name, checkpoint))
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

    if profile in LIDAR_PROFILES:
        return "lidar"
    if profile not in PROFILES:
        raise ReconstructError(f"no network profile {profile!r}; have {[*PROFILES, *LIDAR_PROFILES]}")
    return PROFILES[profile].decoder


def without_weights(contender: Contender) -> str | None:
    """The reason if a method has no weights, else None."""
    settings = contender.settings
    if not isinstance(settings, (FeedForwardSettings, LidarSettings)) or settings.checkpoint is not None:
        return None
    try:
        describe(contender)
    except WeightsError as error:
        return str(error)
    return None


def describe(contender: Contender) -> dict[str, Any]:
    """All settings of a method as plain JSON; files by their digest.

    Raises:
        WeightsError: the network's weights are missing.
    """
    described: dict[str, Any] = {"method": contender.method}
    settings = contender.settings
    if settings is None:
        return described
    described["actors"] = _actors_for(contender)
    values = dataclasses.asdict(settings)
    if isinstance(settings, (FeedForwardSettings, LidarSettings)):
        from nurec_sim.network.checkpoints.download import find_weights, sha256

        if isinstance(settings, FeedForwardSettings):
            from nurec_sim.reconstruct.feedforward.method import profile_name

            values["profile"] = profile_name(contender.method, settings.profile)
            values["ego_masks"] = None if settings.ego_masks is None else str(settings.ego_masks)
        values["checkpoint"] = None
        if settings.random_weights is None:
            values["checkpoint"] = sha256(find_weights(values["profile"], settings.checkpoint))
    return described | {"settings": values}


def build(contender: Contender, window: Window, device: str = "auto") -> Built:
    """Runs a method on a window's log; ``device`` renders its result (``render.choose_device``).

    Raises:
        ReconstructError: the log lacks data that the method needs.
        WeightsError: the network's weights are missing or unusable.
    """
    if contender.method == "copy":
        return Built(lambda request: _nearest(window.clip, request), None, 0.0)
    from nurec_sim.reconstruct import reconstruct

    _look(window, sweeps=_sees_lidar(contender))
    started = time.perf_counter()
    scene = reconstruct(
        window.clip,
        contender.method,
        cameras=window.cameras,
        settings=contender.settings,
        actors=_actors_for(contender),
    )
    renderer, spent = make_renderer(scene, device), time.perf_counter() - started
    return Built(lambda request: renderer.render_camera(request, ("rgb", "depth")), scene, spent, renderer)


def _sees_lidar(contender: Contender) -> bool:
    settings = contender.settings
    return settings.lidar_depth != "off" if isinstance(settings, FeedForwardSettings) else settings is not None


def _actors_for(contender: Contender) -> ActorsName:
    """Whose objects move. Without boxes, methods that read sweeps find what moves in them, as ``reconstruct`` does."""
    return "auto" if _sees_lidar(contender) else "recorded"


def _look(window: Window, sweeps: bool) -> None:
    """Loads all inputs of a method, so that generating them does not count as the method's time."""
    clip = window.clip
    for camera in window.cameras:
        for index in range(len(clip.camera_times_us(camera))):
            clip.image(camera, index)
    for lidar in clip.rig.lidars if sweeps else ():
        for index in range(len(clip.sweep_times_us(lidar))):
            clip.sweep(lidar, index)


def _nearest(clip: Clip, request: SensorRequest) -> CameraFrame:
    """The frame of the requested camera nearest in time."""
    camera = request.sensor
    assert isinstance(camera, CameraModel)
    middle = clip.camera_times_us(camera.id).sum(axis=1) // 2
    if not len(middle):
        raise ReconstructError(f"clip {clip.id!r}: camera {camera.id!r} has no input frame to copy")
    index = int(np.argmin(np.abs(middle - (request.start_us + request.end_us) // 2)))
    return CameraFrame(camera, request.start_us, request.end_us, clip.image(camera.id, index))
