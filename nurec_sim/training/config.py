"""Training recipes in YAML, strictly validated."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import Field, ValidationError, model_validator

from nurec_sim.errors import TrainingError
from nurec_sim.network.profiles import PROFILES
from nurec_sim.training.settings import DataSettings, Strict

Part = Literal["encoder", "context", "motion", "sky", "gaussians", "isp"]


class LossWeights(Strict):
    """Weights of the loss terms; 0 disables a term.

    The paper's context losses are ``depth``, ``normal`` and ``semantic``, its motion loss is ``motion``, its render
    losses are ``colour``, ``perceptual`` and ``opacity`` (section 4.1). Additional ones of ours: ``edges`` (slopes of
    the depth), ``rgb`` (the colour head against the image), ``sky`` (the sky decoder against sky pixels) and
    ``rendered_depth``.
    """

    depth: float = Field(1.0, ge=0)
    edges: float = Field(0.5, ge=0)
    normal: float = Field(0.1, ge=0)
    semantic: float = Field(0.2, ge=0)
    rgb: float = Field(1.0, ge=0)
    sky: float = Field(0.5, ge=0)
    motion: float = Field(0.3, ge=0)
    colour: float = Field(2.0, ge=0)
    perceptual: float = Field(0.5, ge=0)
    opacity: float = Field(0.1, ge=0)
    rendered_depth: float = Field(0.1, ge=0)


class Stage(Strict):
    """One stage of the curriculum: trained parts of the network, duration and losses.

    The learning rate rises linearly over ``warm_up`` steps and decays by a cosine to ``final_rate`` of its peak.
    ``targets`` views are rendered per step. ``pixels`` is the approximate number of pixels of an input image.
    """

    name: str = Field(min_length=1, pattern=r"^[a-z0-9_]+$")
    steps: int = Field(ge=1)
    trains: tuple[Part, ...] = Field(min_length=1)
    learning_rate: float = Field(5e-4, gt=0, le=1)
    warm_up: int = Field(100, ge=0)
    final_rate: float = Field(0.02, ge=0, le=1)
    pixels: int = Field(36_652, ge=784)
    targets: int = Field(0, ge=0, le=16)
    losses: LossWeights = LossWeights()


class TrainingConfig(Strict):
    """A recipe. ``start`` is a file of initial weights; parameters missing in it are initialised randomly.

    ``lpips`` is a file with LPIPS weights, which replaces the built-in perceptual term.
    """

    profile: str = "tiny"
    seed: int = Field(0, ge=0)
    stages: tuple[Stage, ...] = Field(min_length=1)
    data: DataSettings = DataSettings()
    start: Path | None = None
    lpips: Path | None = None
    precision: Literal["float32", "bfloat16"] = "bfloat16"
    weight_decay: float = Field(0.02, ge=0)
    clip_norm: float = Field(1.0, gt=0)
    average: float = Field(0.999, ge=0, lt=1)
    log_every: int = Field(20, ge=1)
    sample_every: int = Field(500, ge=1)
    checkpoint_every: int = Field(250, ge=1)

    @model_validator(mode="after")
    def _known(self) -> TrainingConfig:
        if self.profile not in PROFILES:
            raise ValueError(f"no network profile {self.profile!r}; have {list(PROFILES)}")
        if PROFILES[self.profile].sky is None:
            able = [name for name, each in PROFILES.items() if each.sky is not None]
            raise ValueError(
                f"profile {self.profile!r} has no sky decoder to render views with; these have one: {able}"
            )
        names = [stage.name for stage in self.stages]
        if len(set(names)) != len(names):
            raise ValueError(f"stages must have different names, got {names}")
        return self

    @property
    def steps(self) -> int:
        """Steps of all stages."""
        return sum(stage.steps for stage in self.stages)

    def digest(self) -> str:
        """SHA-256 of the recipe, in hex."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()


def read_config(path: Path) -> TrainingConfig:
    """A recipe from its file; paths in it are relative to the file.

    Raises:
        TrainingError: there is no such file, it is no YAML, or a key is missing, misspelt or out of range.
    """
    try:
        raw = yaml.safe_load(Path(path).read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise TrainingError(f"{path} cannot be read as YAML: {error}") from None
    if not isinstance(raw, dict):
        raise TrainingError(f"{path} must hold keys and values; a recipe has {', '.join(TrainingConfig.model_fields)}")
    for key in ("start", "lpips"):
        if isinstance(raw.get(key), str):
            raw[key] = Path(path).parent / raw[key]
    return checked_config(raw, str(path))


def checked_config(raw: dict[str, Any], name: str) -> TrainingConfig:
    """A recipe from plain values.

    Raises:
        TrainingError: a key is missing, misspelt or out of range; the text says which and what is allowed.
    """
    try:
        return TrainingConfig.model_validate(raw)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the recipe"
        known = ", ".join(TrainingConfig.model_fields)
        raise TrainingError(f"{name}: {where}: {first['msg']}; a recipe has the keys {known}") from None
