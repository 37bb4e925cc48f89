"""Packages that only some readers need: imported when they open a log; their errors become ours."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator
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


@contextlib.contextmanager
def clip_errors(what: str, advice: str = "") -> Iterator[None]:
    """Turns whatever a package raises into a ``ClipError`` that begins with ``what`` and ends with ``advice``."""
    try:
        yield
    except ClipError:
        raise
    except Exception as error:
        text = str(error) or "a check of the package failed"
        raise ClipError(f"{what}: {type(error).__name__}: {text}{advice}") from error
