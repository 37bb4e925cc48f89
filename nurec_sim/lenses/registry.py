"""Registry of lens classes by name, for decoding the parameters in files and messages."""

from __future__ import annotations

import functools
import re
from importlib.metadata import entry_points
from typing import Any, TypeVar

from nurec_sim.lenses.base import missing_members
from nurec_sim.lenses.parameters import parameter_types

ENTRY_POINT_GROUP = "nurec_sim.lenses"

LensClass = TypeVar("LensClass", bound=type[Any])

_classes: dict[str, type[Any]] = {}


def register_lens(cls: LensClass) -> LensClass:
    """Registers a lens class for files and messages in this process; usable as a decorator.

    Other processes (workers, servers) know the lenses that installed packages declare in the entry-point group
    ``nurec_sim.lenses``. A class that is redefined, as in a notebook, replaces the old one.

    Raises:
        TypeError: it is not a frozen dataclass, lacks a member of ``Lens``, or has fields of unsupported types.
        ValueError: its ``kind`` is not a plain name, or its ``kind`` or class name is that of another lens.
    """
    name = cls.__name__
    params = getattr(cls, "__dataclass_params__", None)
    if params is None or not (params.frozen and params.eq):
        raise TypeError(f"lens {name} must be a frozen dataclass: @dataclass(frozen=True)")
    if missing := missing_members(cls):
        raise TypeError(f"lens {name} lacks {', '.join(missing)}; see nurec_sim.lenses.Lens")
    parameter_types(cls)
    if not isinstance(cls.kind, str) or not re.fullmatch("[a-z][a-z0-9_]*", cls.kind):
        raise ValueError(f"lens {name}: kind must be lower-case letters, digits and underscores, got {cls.kind!r}")
    for other in _classes.values():
        same = (other.__module__, other.__qualname__) == (cls.__module__, cls.__qualname__)
        if not same and (other.kind == cls.kind or other.__name__ == name):
            raise ValueError(
                f"lens {name} of kind {cls.kind!r}: there is already {other.__name__} of kind {other.kind!r}"
            )
    _classes[cls.kind] = cls
    return cls


def lens_kinds() -> list[str]:
    """The registered kinds of lenses, sorted."""
    return sorted(_classes)


def lens_class(name: str) -> type[Any]:
    """The class of a kind of lens, by its ``kind`` or by the name of the class.

    Raises:
        ValueError: unknown; the text lists the known ones.
    """
    found = _find(name)
    if found is None:
        _register_installed()
        found = _find(name)
    if found is None:
        raise ValueError(f"unknown lens model {name!r:.60}; known are {lens_kinds()}, others must be registered")
    return found


def _find(name: str) -> type[Any] | None:
    return next((cls for kind, cls in _classes.items() if name in (kind, cls.__name__)), None)


@functools.cache
def _register_installed() -> None:
    for point in entry_points(group=ENTRY_POINT_GROUP):
        try:
            register_lens(point.load())
        except (ImportError, AttributeError, TypeError, ValueError) as error:
            raise ValueError(f"lens {point.name!r} is installed but cannot be used: {error}") from error
