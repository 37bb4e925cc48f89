"""The parts of a plan: frozen dataclasses that pydantic reads strictly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar, dataclass_transform

from pydantic import ConfigDict

T = TypeVar("T")


@dataclass_transform(frozen_default=True)
def plan_part(cls: type[T]) -> type[T]:
    """A frozen dataclass; where it is read from JSON, unknown keys, NaN and infinity are errors."""
    cls.__pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)  # type: ignore[attr-defined]
    return dataclass(frozen=True)(cls)
