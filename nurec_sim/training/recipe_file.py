"""Recipes as YAML files: which kind one is, and reading it with every key checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from nurec_sim.errors import TrainingError

Config = TypeVar("Config", bound=BaseModel)


def recipe_profile(path: Path) -> Any:
    """What a recipe trains (its ``profile``); None where it says nothing or cannot be read."""
    try:
        raw = yaml.safe_load(Path(path).read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return None
    return raw.get("profile") if isinstance(raw, dict) else None


def read_recipe(path: Path, kind: type[Config]) -> Config:
    """A recipe from its file.

    Args:
        path: the YAML file.
        kind: its pydantic model, which forbids unknown keys.

    Raises:
        TrainingError: the file cannot be read, or a key is missing, misspelt or out of range.
    """
    try:
        return kind.model_validate(yaml.safe_load(Path(path).read_text()))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise TrainingError(f"{path} cannot be read as YAML: {error}") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the recipe"
        known = ", ".join(kind.model_fields)
        raise TrainingError(f"{path}: {where}: {first['msg']}; a recipe has the keys {known}") from None
