"""Conversion of a lens's parameters, the fields of its dataclass, to plain JSON and back.

Works for any frozen dataclass of floats, tuples of floats and enumerations, such as the windshield's.
"""

from __future__ import annotations

import dataclasses
import enum
import typing
from collections.abc import Mapping
from typing import Any

import numpy as np

LARGEST = 1e60
"""Larger numbers are meaningless here, and their powers would overflow."""

T = typing.TypeVar("T")


def parameter_types(cls: type[Any]) -> dict[str, type[Any] | int | None]:
    """The types of the parameters, in the order of the fields.

    Returns:
        For each field ``float``, the class of an enumeration, or for a tuple of floats its length, None if any.

    Raises:
        TypeError: a field is of another type.
    """
    hints = typing.get_type_hints(cls)
    return {field.name: _parameter_type(cls, field.name, hints[field.name]) for field in dataclasses.fields(cls)}


def _parameter_type(cls: type[Any], name: str, hint: Any) -> type[Any] | int | None:
    items = typing.get_args(hint)
    if hint is float or (isinstance(hint, type) and issubclass(hint, enum.Enum)):
        return hint
    if typing.get_origin(hint) is tuple and set(items) <= {float, Ellipsis}:
        return None if Ellipsis in items else len(items)
    raise TypeError(f"{cls.__name__}.{name}: a parameter is a float, a tuple of floats or an enumeration, not {hint}")


def encode_parameters(value: Any) -> dict[str, Any]:
    """The parameters of a lens or windshield as plain JSON values; enumerations by value."""
    return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, enum.Enum):
        return value.value
    return value.item() if isinstance(value, np.generic) else value


def decode_parameters(cls: type[T], row: Any, complete: bool = False) -> T:
    """A lens or windshield from its parameters; ``check`` validates them.

    Args:
        cls: its class, see ``lens_class``.
        row: output of ``encode_parameters``.
        complete: whether fields with a default are required as well.

    Raises:
        ValueError: a parameter is missing, unknown or of the wrong kind; the text names it.
    """
    types = parameter_types(cls)
    if not isinstance(row, Mapping):
        raise ValueError(f"must be a JSON object, got {type(row).__name__}")
    if unknown := sorted(set(row) - set(types)):
        raise ValueError(f"unknown field {unknown[0]!r:.60}; known are {list(types)}")
    values = {}
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        if field.name in row:
            values[field.name] = _decoded(field.name, types[field.name], row[field.name])
        elif complete or field.default is dataclasses.MISSING:
            raise ValueError(f"{field.name!r} is missing; have {sorted(row)}")
    return cls(**values)


def _decoded(name: str, kind: type[Any] | int | None, value: Any) -> Any:
    if kind is float:
        return _number(name, value)
    if isinstance(kind, type):
        allowed = [member.value for member in kind]
        if value not in allowed:
            raise ValueError(f"{name} {value!r:.60} is unknown; known are {allowed}")
        return kind(value)
    if not isinstance(value, list) or (kind is not None and len(value) != kind):
        raise ValueError(f"{name!r} must be a list of {'' if kind is None else f'{kind} '}numbers, got {value!r:.60}")
    return tuple(_number(name, item) for item in value)


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < LARGEST:
        raise ValueError(f"{name!r} must be a finite number, got {value!r:.60}")
    return float(value)
