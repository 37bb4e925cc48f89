"""Imports packages that only some readers need, when they open a log."""

from __future__ import annotations

import importlib
from types import ModuleType

from nurec_sim.errors import ClipError


def package(name: str, extra: str, format: str) -> ModuleType:
    """A module of a package that comes with an extra of this project.

    Args:
        name: the module.
        extra: the extra that installs its package.
        format: what it reads, for the message.

    Raises:
        ClipError: it is not installed, or cannot be imported; the text names the extra.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ClipError(f"{format} needs the extra {extra!r}: pip install 'nurec-sim[{extra}]' ({error})") from None
