"""A kit for authors of reconstruction methods: does a method keep the contract, on a log?

::

    from nurec_sim.logs import open_clip
    from nurec_sim.reconstruct.conformance import check_method
    print(check_method(MyMethod(), open_clip("scenarios/demo_clip.zip")))      # [] when all is well
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nurec_sim import plugins
from nurec_sim.errors import ArchiveError, NurecSimError
from nurec_sim.reconstruct import reconstruct
from nurec_sim.scene import check_scene, scene_hash
from nurec_sim.types import Clip, GaussianScene, Method


def check_method(method: Method, clip: Clip, settings: Any = None) -> list[str]:
    """Reconstruct a log twice and list what the author of the method should mend; empty when it conforms.

    Checked: the method has all its parts; its settings are a documented frozen dataclass with defaults; the scene is
    sound (``scene.check_scene``), not empty, and of this log (id, cameras, path); only the images of the cameras that
    it was given and the sweeps that are not held out are read; progress rises within 0..1; a
    second run gives the same bytes.

    Args:
        method: the method.
        clip: a log that has what the method needs; a short one, as it is reconstructed twice. If it has two cameras or
            sweeps, one of each is withheld.
        settings: for the method; its defaults if None.
    """
    faults = [f"it lacks {text}" for text in plugins.lacking(plugins.METHODS, method)] or list(_settings_faults(method))
    if faults:
        return faults
    settings = method.settings() if settings is None else settings
    if not all(isinstance(path, Path) for path in method.files(settings)):
        faults.append(f"files() must give pathlib.Path objects, got {method.files(settings)!r}")
    cameras = list(clip.rig.cameras)[:-1] or list(clip.rig.cameras)
    held = [0] if max((len(clip.sweep_times_us(name)) for name in clip.rig.lidars), default=0) > 1 else []
    steps: list[tuple[str, float]] = []
    watched = _Watched(clip, cameras, held)
    try:
        scenes = [
            reconstruct(watched, method, cameras=cameras, hold_out_sweeps=held, settings=settings,
                        progress=lambda stage, done: steps.append((stage, done)))
            for _ in range(2)
        ]  # fmt: skip
    except NurecSimError as error:
        return [*faults, f"the log cannot be reconstructed: {error}"]
    except Exception as error:
        return [
            *faults,
            f"it fails with {type(error).__name__}: {error}; raise a ReconstructError that says what lacks",
        ]
    faults += [*dict.fromkeys(watched.faults), *_scene_faults(scenes[0], clip), *_progress_faults(steps)]
    if not faults and scene_hash(scenes[0]) != scene_hash(scenes[1]):
        faults.append("a second run gave another scene; keep no state, seed all noise")
    return faults


def _settings_faults(method: Method) -> Iterator[str]:
    kind = method.settings
    if not dataclasses.is_dataclass(kind) or not kind.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        yield f"settings must be a frozen dataclass, got {kind!r}"
        return
    if not method.name.strip():
        yield "name must not be empty"
    if (kind.__doc__ or "").startswith(f"{kind.__name__}("):  # what dataclass writes by itself
        yield f"settings {kind.__name__} needs a docstring that explains its fields"
    lacking = dataclasses.MISSING
    for field in dataclasses.fields(kind):
        if field.default is lacking and field.default_factory is lacking:
            yield f"setting {field.name!r} needs a default"


def _scene_faults(scene: GaussianScene, clip: Clip) -> Iterator[str]:
    if not isinstance(scene, GaussianScene):
        yield f"reconstruct() must return a nurec_sim.types.GaussianScene, got {type(scene).__name__}"
        return
    try:
        check_scene(scene)
    except ArchiveError as error:
        yield f"the scene is not sound: {error}"
        return
    if len(scene.static) + len(scene.dynamic) == 0:
        yield "the scene has no Gaussians"
    if scene.id != clip.id:
        yield f"the scene's id must be that of the log, {clip.id!r}, got {scene.id!r}"
    if missing := set(clip.rig.cameras) - set(scene.rig.cameras):
        yield f"the scene's rig lacks cameras of the log: {sorted(missing)}"
    if not np.array_equal(scene.ego.world_from_body, clip.ego.world_from_body):
        yield "the scene's ego path is not that of the log"


def _progress_faults(steps: Sequence[tuple[str, float]]) -> Iterator[str]:
    """Of two runs, one after the other."""
    shares = [share for _, share in steps]
    if not shares:
        yield "progress was never called"
    elif not all(0 <= share <= 1 for share in shares):
        yield f"progress must lie in 0..1, got {min(shares):g} to {max(shares):g}"
    elif sum(later < earlier for earlier, later in zip(shares, shares[1:], strict=False)) > 1:
        yield "progress must not fall within a run"


class _Watched:
    """A log that notes which images and sweeps are read although they must not be."""

    def __init__(self, clip: Clip, cameras: Sequence[str], held: Sequence[int]) -> None:
        self._clip, self._cameras, self._held = clip, cameras, held
        self.faults: list[str] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._clip, name)

    def image(self, camera_id: str, index: int) -> np.ndarray:
        if camera_id not in self._cameras:
            self.faults.append(f"an image of camera {camera_id!r} was read, which is not among the cameras given")
        return self._clip.image(camera_id, index)

    def sweep(self, lidar_id: str, index: int) -> Any:
        if index in self._held:
            self.faults.append(f"sweep {index} of LiDAR {lidar_id!r} was read, which is held out")
        return self._clip.sweep(lidar_id, index)
