"""How clips become scenes, and the name under which the result is kept: a hash of all that it depends on."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nurec_sim
from nurec_sim.errors import ReconstructError, WeightsError
from nurec_sim.reconstruct import METHODS, FeedForwardSettings, LiftSettings
from nurec_sim.types import GaussianScene

Progress = Callable[[str, float], None]
_CODE = ("reconstruct", "network")


@dataclass(frozen=True)
class Recipe:
    """A reconstruction method and its settings.

    Args:
        method: one of ``reconstruct.METHODS``.
        settings: of that method; None for its defaults.
        cameras: ids of the cameras to use; empty for what the method takes by itself.

    Raises:
        ReconstructError: no such method.
    """

    method: str = "lift"
    settings: LiftSettings | FeedForwardSettings | None = None
    cameras: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ReconstructError(f"no reconstruction method {self.method!r}; have {list(METHODS)}")

    def reconstruct(self, clip_path: Path, progress: Progress | None) -> GaussianScene:
        """The scene of a clip, made now.

        Raises:
            ClipError, ReconstructError, WeightsError: see ``reconstruct.reconstruct``.
        """
        from nurec_sim.logs import open_clip
        from nurec_sim.reconstruct import reconstruct

        chosen: dict[str, Any] = {}
        if self.settings is not None:
            chosen["settings"] = self.settings
        if self.cameras:
            chosen["cameras"] = self.cameras
        return reconstruct(open_clip(clip_path), self.method, progress=progress, **chosen)

    def text(self) -> str:
        """Everything that the choice says, as JSON; of files their content, wherever they lie."""
        settings = None if self.settings is None else dataclasses.asdict(self.settings)
        if settings is not None:
            settings = {name: _plain(value) for name, value in settings.items()}
        said = {"method": self.method, "settings": settings, "cameras": self.cameras, "weights": self._weights()}
        return json.dumps(said, sort_keys=True, default=str)

    def _weights(self) -> str | None:
        """Hash of the file that the network's weights come from; None where none is read, or none is there."""
        if self.method in ("lift", "optimized"):
            return None
        settings = self.settings if isinstance(self.settings, FeedForwardSettings) else FeedForwardSettings()
        if settings.random_weights is not None:
            return None
        from nurec_sim.network.checkpoints.download import find_weights
        from nurec_sim.reconstruct.feedforward.method import profile_name

        try:
            return files_hash(find_weights(profile_name(self.method, settings.profile), settings.checkpoint))
        except WeightsError:  # says more when the clip is reconstructed
            return None


def content_key(clip_path: Path, recipe: Recipe | str) -> str:
    """A name for what a reconstruction depends on: the clip's files, the recipe, the weights, our version and code."""
    if isinstance(recipe, str):
        recipe = Recipe(recipe)
    package = Path(nurec_sim.__file__).parent
    code = "".join(files_hash(package / folder, "*.py") for folder in _CODE)
    facts = "\0".join([nurec_sim.__version__, code, recipe.text(), files_hash(clip_path)])
    return f"{clip_path.stem}-{recipe.method}-{hashlib.sha256(facts.encode()).hexdigest()[:24]}"


def files_hash(path: Path, pattern: str = "*") -> str:
    """SHA-256 of the names and contents of a folder's files, or of one file's content; hexadecimal."""
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
