"""Study files in YAML, strictly validated: which towns, worlds, policies and trials."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from nurec_sim.errors import RunError, ScenarioError
from nurec_sim.runs.truth import TRUTH
from nurec_sim.sim import load_scenario
from nurec_sim.study.controls import CONTROLS

Name = Annotated[str, Field(min_length=1, pattern=r"^[A-Za-z0-9_.\-]+$")]
TownSeed = Annotated[int, Field(ge=0, lt=4_000_000)]
SEEDS_PER_TOWN = 1000
"""Rollout seeds are ``SEEDS_PER_TOWN * town seed + trial``: no two towns share random numbers."""


class _Strict(BaseModel):
    """A part of a study: frozen, and unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Family(_Strict):
    """Towns of one road template, driven in under one scenario; one scene per seed, named ``<name>-<seed>``.

    ``template`` None leaves it to the seed. ``scenario`` is a bundled scenario or a file; its policies, seeds and clip
    are not used.
    """

    name: Name
    seeds: tuple[TownSeed, ...] = Field(min_length=1)
    template: str | None = None
    split: Literal["train", "test"] = "test"
    scenario: str = "short"

    @field_validator("seeds")
    @classmethod
    def _distinct(cls, value: tuple[int, ...]) -> tuple[int, ...]:
        if len(set(value)) != len(value):
            raise ValueError("seeds must differ from each other")
        return value


class Recording(_Strict):
    """The log that is recorded in every town: length, rate, and size of the sensors (``world.street_rig``)."""

    seconds: float = Field(10.0, ge=2, le=30)
    hz: float = Field(4.0, ge=0.5, le=10)
    width_px: int = Field(224, ge=64, le=1920)
    height_px: int = Field(128, ge=32, le=1080)
    lidar_rows: int = Field(32, ge=8, le=128)
    lidar_columns: int = Field(360, ge=90, le=4000)


class Controls(_Strict):
    """Corrupted copies of one reconstruction, which must rank policies worse (``controls.CONTROLS``)."""

    of: str = "lift"
    how: tuple[str, ...] = ()

    @field_validator("how")
    @classmethod
    def _known(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        unknown = [name for name in value if name not in CONTROLS]
        if unknown or len(set(value)) != len(value):
            raise ValueError(f"controls must be different ones of {sorted(CONTROLS)}")
        return value


class StudyConfig(_Strict):
    """One study. The first world is always the town itself, ``truth``; the others are reconstruction methods."""

    name: Name
    families: tuple[Family, ...] = Field(min_length=1)
    worlds: tuple[str, ...] = Field((TRUTH, "lift"), min_length=2)
    policies: tuple[str, ...] = Field(min_length=2)
    trials: int = Field(1, ge=1, le=SEEDS_PER_TOWN)
    recording: Recording = Recording()
    optimize_steps: int = Field(300, ge=1)
    controls: Controls = Controls()

    @model_validator(mode="after")
    def _consistent(self) -> StudyConfig:
        if self.worlds[0] != TRUTH or len(set(self.worlds)) != len(self.worlds):
            raise ValueError(f"worlds must be different, the first one '{TRUTH}', got {list(self.worlds)}")
        if self.controls.how and self.controls.of not in self.worlds[1:]:
            raise ValueError(f"controls are of '{self.controls.of}', which is none of {list(self.worlds[1:])}")
        names = [family.name for family in self.families]
        if len(set(names)) != len(names):
            raise ValueError(f"families need names of their own, got {names}")
        return self

    @property
    def all_worlds(self) -> tuple[str, ...]:
        """The worlds, then the controls by the names that ``control_name`` gives them."""
        return (*self.worlds, *(control_name(self.controls.of, how) for how in self.controls.how))

    @property
    def scenes(self) -> tuple[tuple[str, Family, int], ...]:
        """Id, family and town seed of every scene."""
        return tuple((f"{family.name}-{seed}", family, seed) for family in self.families for seed in family.seeds)

    @property
    def rollouts(self) -> int:
        """Number of rollouts."""
        return len(self.scenes) * len(self.all_worlds) * len(self.policies) * self.trials

    def seeds(self, town_seed: int) -> tuple[int, ...]:
        """Seeds of the trials in one town: the same for all worlds and policies (common random numbers)."""
        return tuple(SEEDS_PER_TOWN * town_seed + trial for trial in range(self.trials))


def control_name(of: str, how: str) -> str:
    """Name of the corrupted copy of a reconstruction."""
    return f"{of}-{how}"


def load_study(name: str | Path) -> StudyConfig:
    """Reads a study file; a bare name such as ``smoke`` is a bundled one.

    Scenario files that it names are relative to the current folder, or else to the study file's own.

    Raises:
        RunError: no such study, not a YAML mapping, or a key is unknown or wrong.
        ScenarioError: a scenario that it names cannot be loaded.
    """
    path = Path(name)
    if not path.suffix and not path.is_file():  # a folder of that name, such as the study's own, does not count
        bundled = resources.files("nurec_sim.study") / "tiers" / f"{path}.yaml"
        if not bundled.is_file():
            raise RunError(f"no study named '{path}'; have {shipped_studies()}, or give a YAML file")
        path = Path(str(bundled))
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise RunError(f"study file '{path}' cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise RunError(f"study file '{path}' must hold keys and values, got {type(content).__name__}")
    return make_study(_with_scenarios_beside(content, path.parent), f"study file '{path}'")


def _with_scenarios_beside(content: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The same with paths of scenario files that lie in the study file's folder and not in the current one."""

    def resolved(family: Any) -> Any:
        name = family.get("scenario") if isinstance(family, dict) else None
        if not isinstance(name, str) or not Path(name).suffix or Path(name).exists() or not (folder / name).is_file():
            return family
        return family | {"scenario": str(folder / name)}

    families = content.get("families")
    return content | {"families": [resolved(family) for family in families]} if isinstance(families, list) else content


def shipped_studies() -> list[str]:
    """Names of the bundled studies, sorted."""
    names = (entry.name for entry in (resources.files("nurec_sim.study") / "tiers").iterdir())
    return sorted(name.removesuffix(".yaml") for name in names if name.endswith(".yaml"))


def make_study(content: dict[str, Any], source: str = "study") -> StudyConfig:
    """A study from plain values; ``source`` prefixes error texts.

    Raises:
        RunError: a key is unknown or its value wrong.
        ScenarioError: a scenario that it names cannot be loaded.
    """
    try:
        config = StudyConfig.model_validate(content)
    except ValidationError as error:
        raise RunError(f"{source}: " + "; ".join(_fault(item) for item in error.errors())) from None
    for family in config.families:
        try:
            load_scenario(family.scenario)
        except ScenarioError as error:
            raise ScenarioError(f"{source}, family '{family.name}': {error}") from None
    return config


def _fault(item: Any) -> str:
    """A pydantic error as one sentence."""
    key = ".".join(map(str, item["loc"])) or "(top level)"
    if item["type"] == "extra_forbidden":
        return f"unknown key '{key}'"
    if item["type"] == "missing":
        return f"key '{key}' is missing"
    text = item["msg"].removeprefix("Value error, ").removeprefix("Input ")
    return f"key '{key}': {text}" + ("" if isinstance(item["input"], dict) else f", got {item['input']!r}")
