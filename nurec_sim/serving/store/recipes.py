"""Reconstruction recipes, and the cache key of their result: a hash of all that it depends on."""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nurec_sim
from nurec_sim.reconstruct import OptimizeSettings, load_method
from nurec_sim.types import Clip, GaussianScene, Method, Progress

_CODE = ("logs", "reconstruct", "network")


@dataclass(frozen=True)
class Recipe:
    """A reconstruction method and its settings.

    Args:
        method: a reference as ``reconstruct.load_method`` takes it.
        settings: of that method; None for its defaults.
        cameras: ids of the cameras to use; empty for what the method takes by itself.
        refine: settings of an optimisation after the method; None for none.
        hold_out_every: every N-th image, and the sweeps taken with it, are kept out; 0 for none.

    Raises:
        ReconstructError: no such method.
    """

    method: str = "lift"
    settings: Any = None
    cameras: tuple[str, ...] = ()
    refine: OptimizeSettings | None = None
    hold_out_every: int = 0

    def __post_init__(self) -> None:
        load_method(self.method)

    def reconstruct(self, clip_path: Path, progress: Progress | None) -> GaussianScene:
        """The scene of a clip, made now.

        Raises:
            ClipError, ReconstructError, WeightsError: see ``reconstruct.reconstruct``.
        """
        from nurec_sim.logs import hold_out, open_clip, without_images
        from nurec_sim.logs.alignment import with_aligned_sensors
        from nurec_sim.reconstruct import reconstruct

        chosen: dict[str, Any] = {}
        if self.settings is not None:
            chosen["settings"] = self.settings
        if self.cameras:
            chosen["cameras"] = self.cameras
        if self.refine is not None:
            # A scene that an interruption cut short must not be kept under the name of the whole.
            chosen["refine"] = dataclasses.replace(self.refine, keep_interrupted=False)
        clip: Clip = open_clip(clip_path)
        if self.hold_out_every:
            cameras = self.cameras or list(clip.rig.cameras)
            held = hold_out(clip, cameras, images_every=self.hold_out_every)
            clip = without_images(
                with_aligned_sensors(clip, held.sweeps, cameras=cameras, held_images=held.images), held
            )
            chosen["hold_out_sweeps"] = sorted(held.sweeps)
        return reconstruct(clip, self.method, progress=progress, **chosen)

    def text(self) -> str:
        """Method, settings, cameras and weights as JSON; files by content, not by path."""
        settings = None if self.settings is None else dataclasses.asdict(self.settings)
        if settings is not None:
            settings = {name: _plain(value) for name, value in settings.items()}
        method = load_method(self.method)
        files = [files_hash(path) for path in method.files(method.settings() if settings is None else self.settings)]
        said: dict[str, Any] = {"method": self.method, "settings": settings, "cameras": self.cameras, "files": files}
        said |= {"hold_out_every": self.hold_out_every} if self.hold_out_every else {}
        if self.refine is not None:
            said["refine"] = dataclasses.asdict(self.refine)
        return json.dumps(said | {"code": _foreign_code(method)}, sort_keys=True, default=str)


def _foreign_code(method: Method) -> str | None:
    """Hash of the file that holds a method which is not ours; ours are part of every key."""
    module = type(method).__module__
    return None if module.startswith("nurec_sim.") else files_hash(Path(inspect.getfile(type(method))))


def content_key(clip_path: Path, recipe: Recipe | str) -> str:
    """A name for what a reconstruction depends on: the clip's files, the recipe, our version and code."""
    from nurec_sim.logs.reader import log_files

    if isinstance(recipe, str):
        recipe = Recipe(recipe)
    package = Path(nurec_sim.__file__).parent
    code = "".join(files_hash(package / folder, "*.py") for folder in _CODE)
    facts = "\0".join([nurec_sim.__version__, code, recipe.text(), *map(files_hash, log_files(clip_path))])
    name = load_method(recipe.method).name
    return f"{clip_path.stem}-{name}-{hashlib.sha256(facts.encode()).hexdigest()[:24]}"


def files_hash(path: Path, pattern: str = "*") -> str:
    """SHA-256 of the names and contents of a folder's files, or of one file's content; hexadecimal.

    A log that is named inside of a data set is no file: its path stands for it, as published data do not change.
    """
    if not path.exists():
        return hashlib.sha256(str(path.resolve()).encode()).hexdigest()
    digest = hashlib.sha256()
    files: Iterable[Path] = sorted(p for p in path.rglob(pattern) if p.is_file()) if path.is_dir() else [path]
    for each in files:
        name = each.relative_to(path).as_posix() if path.is_dir() else ""
        with each.open("rb") as file:
            digest.update(f"{name}\0{hashlib.file_digest(file, 'sha256').hexdigest()}\0".encode())
    return digest.hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return files_hash(value) if value.exists() else str(value)
    return value
