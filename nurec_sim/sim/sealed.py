"""Read-only copies for policies, which cannot affect the loop."""

from __future__ import annotations

import copy
import dataclasses
import enum
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

import numpy as np

Key = TypeVar("Key")
Value = TypeVar("Value")
T = TypeVar("T")

_IMMUTABLE = (str, bytes, int, float, complex, bool, type(None), enum.Enum, np.generic)


class ReadOnlyMapping(Mapping[Key, Value]):
    """An immutable mapping; unlike ``types.MappingProxyType`` it can be copied and pickled."""

    __slots__ = ("_items",)

    def __init__(self, items: Mapping[Key, Value]) -> None:
        self._items = dict(items)

    def __getitem__(self, key: Key) -> Value:
        return self._items[key]

    def __iter__(self) -> Iterator[Key]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)

    def __repr__(self) -> str:
        return f"ReadOnlyMapping({self._items!r})"


def sealed(value: T) -> T:
    """A read-only deep copy of dataclasses, arrays, sequences and mappings that shares no memory.

    Arrays are backed by ``bytes``, so not even ``flags.writeable = True`` makes them writable. Sequences become tuples,
    mappings ``ReadOnlyMapping``; objects of other classes are copied by ``copy.deepcopy``.
    """
    return _sealed(value)


def _sealed(value: Any) -> Any:
    if isinstance(value, _IMMUTABLE):
        return value
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        return np.ndarray(value.shape, value.dtype, buffer=value.tobytes())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        result = object.__new__(type(value))  # without __post_init__: the fields are already validated
        for field in dataclasses.fields(value):
            object.__setattr__(result, field.name, _sealed(getattr(value, field.name)))
        return result
    if isinstance(value, Mapping):
        return ReadOnlyMapping({key: _sealed(item) for key, item in value.items()})
    if isinstance(value, (list, tuple)):
        return tuple(_sealed(item) for item in value)
    return copy.deepcopy(value)
