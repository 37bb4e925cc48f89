"""Scenario files in YAML, strictly validated."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from nurec_sim.errors import ScenarioError

STATE_S = 0.1
"""Interval of the recorded states; every duration of a scenario is a multiple of it."""
MAX_DURATION_S = 20.0


def _whole_states(value: float) -> float:
    if abs(value / STATE_S - round(value / STATE_S)) > 1e-6:
        raise ValueError(f"must be a multiple of {STATE_S} s")
    return value


def _one_speed(speed_mps: float | None, speed_fraction: float | None) -> None:
    if speed_mps is not None and speed_fraction is not None:
        raise ValueError("give speed_mps or speed_fraction, not both")


Seconds = Annotated[float, AfterValidator(_whole_states)]
Side = Annotated[float, Field(ge=0.1, le=30)]
Shade = Annotated[float, Field(ge=0, le=1)]


class _Strict(BaseModel):
    """A part of a scenario: frozen, and unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Perturbation(_Strict):
    """Standard deviations, sampled once per scene and seed for all policies; default 0.

    The first three are of the initial ego state. ``actor_delay_s`` and ``actor_along_m`` are of every controllable
    actor: how much later it drives its recorded path, and how far ahead of its recorded place along its own axis.
    """

    lateral_m: float = Field(0.0, ge=0, le=3)
    yaw_deg: float = Field(0.0, ge=0, le=30)
    speed_fraction: float = Field(0.0, ge=0, le=0.5)
    actor_delay_s: float = Field(0.0, ge=0, le=5)
    actor_along_m: float = Field(0.0, ge=0, le=10)


class SensorSettings(_Strict):
    """Additional or modified sensor rendering.

    ``image_width_px`` overrides the policies' value. ``record_cameras`` and ``record_lidars`` are rendered at every
    planning time for ``on_frames``, independent of the policy; ``interval_s`` renders them more often than the plans.
    """

    image_width_px: int | None = Field(None, ge=16, le=4096)
    record_cameras: tuple[str, ...] = ()
    record_lidars: tuple[str, ...] = ()
    interval_s: Seconds | None = Field(None, ge=STATE_S, le=2)


class Brake(_Strict):
    """An actor brakes on its recorded path, ``at_s`` after the start of the rollout, until it stands."""

    at_s: float = Field(ge=0, le=MAX_DURATION_S)
    decel_mps2: float = Field(gt=0, le=12)


class ActorEdit(_Strict):
    """Edits a recorded actor: shifted along its own axes, delayed, braked, or hidden."""

    shift_m: tuple[float, float] = (0.0, 0.0)
    delay_s: float = Field(0.0, ge=-20, le=20)
    hide: bool = False
    brake: Brake | None = None


class Move(_Strict):
    """An added actor changes its speed or its place beside the recorded path, within ``over_s`` from ``at_s`` on.

    The speed changes linearly. Sideways it starts and ends at rest: the lateral speed rises and falls for a quarter of
    the time each.
    """

    at_s: float = Field(ge=0, le=MAX_DURATION_S)
    over_s: float = Field(gt=0, le=MAX_DURATION_S)
    lateral_m: float | None = Field(None, ge=-50, le=50)
    speed_mps: float | None = Field(None, ge=-40, le=40)
    speed_fraction: float | None = Field(None, ge=0, le=3)

    @model_validator(mode="after")
    def _moves(self) -> Move:
        _one_speed(self.speed_mps, self.speed_fraction)
        if self.lateral_m is None and self.speed_mps is None and self.speed_fraction is None:
            raise ValueError("a move needs lateral_m, speed_mps or speed_fraction")
        return self

    @property
    def changes_speed(self) -> bool:
        """Whether it changes the speed."""
        return self.speed_mps is not None or self.speed_fraction is not None


class AddedActor(_Strict):
    """An actor that the log does not have, on a path beside the recorded one (``sim.added_actors``).

    At the start of the rollout it is ``along_m`` ahead of where the recorded car is ``ego_at_s`` after the start, and
    ``lateral_m`` to the left of its path; both are of its centre, from the rear axle. It drives along the path, with a
    negative speed against it; ``speed_fraction`` is of the recorded car's speed at the same time. Without a speed it
    stands. ``asset`` is the name of an actor of the procedural towns, or an archive, ``car.usdz`` or
    ``street.usdz#track``, with the Gaussians of one. ``size_m`` and ``colour`` (0..1) replace those of the asset.
    """

    asset: str = Field(min_length=1)
    along_m: float = Field(ge=-200, le=300)
    lateral_m: float = Field(0.0, ge=-50, le=50)
    ego_at_s: float = Field(0.0, ge=0, le=MAX_DURATION_S)
    speed_mps: float | None = Field(None, ge=-40, le=40)
    speed_fraction: float | None = Field(None, ge=0, le=3)
    moves: tuple[Move, ...] = ()
    size_m: tuple[Side, Side, Side] | None = None
    colour: tuple[Shade, Shade, Shade] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> AddedActor:
        _one_speed(self.speed_mps, self.speed_fraction)
        for what, moves in (
            ("speed", [move for move in self.moves if move.changes_speed]),
            ("place", [move for move in self.moves if move.lateral_m is not None]),
        ):
            for before, after in itertools.pairwise(moves):
                if after.at_s < before.at_s + before.over_s - 1e-9:
                    raise ValueError(
                        f"the move at {after.at_s:g} s changes the {what} before that at {before.at_s:g} s has ended"
                    )
        given = [self.speed_mps, *(move.speed_mps for move in self.moves)]
        fractions = [self.speed_fraction, *(move.speed_fraction for move in self.moves)]
        signs = {speed > 0 for speed in (*given, *fractions) if speed}
        if len(signs) > 1:
            raise ValueError("an added actor cannot turn round: its speeds must have one sign")
        return self


class Scenario(_Strict):
    """One scenario. Every key except ``name`` has a default; durations are multiples of 0.1 s.

    ``clip`` is a clip or scene (path or name), optional if given on the command line. ``warm_up_s`` of
    ``duration_s`` follow the log before the policy drives. ``actors`` are edits by track id; ``lead`` is the nearest
    actor ahead in the lane of the recorded drive when it brakes, or at the start if it does not. ``added_actors`` are
    actors that the log does not have, by their track id.
    """

    name: str = Field(min_length=1, pattern=r"^[A-Za-z0-9_.\-]+$")
    clip: str | None = None
    start_s: Seconds = Field(0.0, ge=0)
    duration_s: Seconds = Field(MAX_DURATION_S, gt=0, le=MAX_DURATION_S)
    warm_up_s: Seconds = Field(0.5, ge=0, le=MAX_DURATION_S)
    replan_s: Seconds = Field(0.5, ge=STATE_S, le=2.0)
    controller: Literal["pursuit_pi", "perfect"] = "pursuit_pi"
    seeds: tuple[Annotated[int, Field(ge=0, lt=2**32)], ...] = Field((0,), min_length=1)
    policies: tuple[str, ...] = ()
    sensors: SensorSettings = SensorSettings()
    perturbation: Perturbation = Perturbation()
    actors: dict[str, ActorEdit] = {}
    added_actors: dict[Annotated[str, Field(pattern=r"^[A-Za-z0-9_.\-]+$")], AddedActor] = {}

    @field_validator("seeds")
    @classmethod
    def _distinct(cls, value: tuple[int, ...]) -> tuple[int, ...]:
        if len(set(value)) != len(value):
            raise ValueError("seeds must differ from each other")
        return value


def load_scenario(path: str | Path) -> Scenario:
    """Reads a scenario file; a bare name such as ``demo`` is a bundled one.

    Raises:
        ScenarioError: the file cannot be read, is no YAML mapping, or a key is unknown or wrong; the text names the
            file, every wrong key, and what is allowed there.
    """
    path = scenario_file(path)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ScenarioError(f"scenario file '{path}' does not exist") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"scenario file '{path}' cannot be read: {error}") from error
    except yaml.YAMLError as error:
        raise ScenarioError(f"scenario file '{path}' is not YAML: {error}") from error
    if not isinstance(content, dict):
        raise ScenarioError(f"scenario file '{path}' must hold keys and values, got {type(content).__name__}")
    return make_scenario(content, source=f"scenario file '{path}'")


def scenario_file(name: str | Path) -> Path:
    """The file of a bundled scenario, or ``name`` itself if it is a path; ``clip`` is relative to it.

    Raises:
        ScenarioError: no bundled scenario of that name.
    """
    path = Path(name)
    if path.suffix or path.exists():
        return path
    shipped = resources.files("nurec_sim.scenarios")
    if not (shipped / f"{path}.yaml").is_file():
        raise ScenarioError(f"no scenario named '{path}'; have {shipped_scenarios()}, or give a YAML file")
    return Path(str(shipped / f"{path}.yaml"))


def shipped_scenarios() -> list[str]:
    """Names of the bundled scenarios, sorted."""
    names = (entry.name for entry in resources.files("nurec_sim.scenarios").iterdir())
    return sorted(name.removesuffix(".yaml") for name in names if name.endswith(".yaml"))


def make_scenario(content: dict, source: str = "scenario") -> Scenario:
    """A scenario from plain values; ``source`` prefixes error texts.

    Raises:
        ScenarioError: a key is unknown or its value wrong.
    """
    try:
        return Scenario.model_validate(content)
    except ValidationError as error:
        raise ScenarioError(f"{source}: " + "; ".join(_fault(item) for item in error.errors())) from None


def _fault(item: Mapping[str, Any]) -> str:
    """A pydantic error as one sentence: key, allowed values, given value."""
    location = [str(part) for part in item["loc"]]
    key = ".".join(location) or "(top level)"
    if item["type"] == "extra_forbidden":
        allowed = ", ".join(_fields_at(location[:-1]))
        return f"unknown key '{key}'; allowed: {allowed}"
    if item["type"] == "missing":
        return f"key '{key}' is missing"
    text = item["msg"].removeprefix("Value error, ").removeprefix("Input ")
    return f"key '{key}': {text}" + ("" if isinstance(item["input"], dict) else f", got {item['input']!r}")


def _fields_at(location: list[str]) -> list[str]:
    """Allowed keys at a location in the file."""
    parts: dict[str, type[BaseModel]] = {
        "sensors": SensorSettings, "perturbation": Perturbation, "actors": ActorEdit, "added_actors": AddedActor,
    }  # fmt: skip
    model = parts.get(location[0], Scenario) if location else Scenario
    model = Brake if location[-1:] == ["brake"] else model
    model = Move if "moves" in location else model
    return sorted(model.model_fields)
