"""Command-line compatibility with NVIDIA's renderer: supported, ignored and unknown flags.

Flag names are those of NRE 25.x to 26.10 and of AlpaSim's launch command, in old and new spellings.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from nurec_sim.errors import NurecSimError

IGNORED_SWITCHES = (
    "enable-timing",
    "enable-nrend",
    "use-gsplat",
    "enable-difix",
    "enable-harmonizer",
    "enable-difix-temporal",
    "enable-harmonizer-temporal",
)
"""Flags without a value; each may also be given as ``--no-...`` or with ``=true`` or ``=false``."""
IGNORED_VALUES = ("renderer", "ray-chunk-size", "metrics-output-dir", "multiproc-workers")
IGNORED_FAMILIES = ("difix-", "harmonizer-")
"""Prefixes of flags of the image-to-image networks; they take a value if the next word is not a flag."""
_TRUTH = {"true": True, "1": True, "yes": True, "on": True, "false": False, "0": False, "no": False, "off": False}


@dataclass(frozen=True)
class Sorted:
    """A command line split into applicable and ignored flags."""

    arguments: list[str]
    """Applicable arguments, switches as ``--flag`` or ``--no-flag``."""
    ignored: list[str]
    """Ignored flags, as given."""


def sort_flags(
    arguments: Sequence[str], switches: Iterable[str], values: Iterable[str], lists: Iterable[str] = ()
) -> Sorted:
    """Removes flags that do not apply to this renderer.

    Args:
        arguments: the words after the command.
        switches: applicable flags without a value, with hyphens.
        values: applicable flags with one value.
        lists: applicable flags with one or more values.

    Raises:
        NurecSimError: a word is not a flag, or an unknown one; the text suggests the nearest known flag.
    """
    ours, with_several = set(switches) | {"help"}, set(lists)
    with_value = set(values) | with_several
    known = [*ours, *with_value, *IGNORED_SWITCHES, *IGNORED_VALUES, *IGNORED_FAMILIES]
    kept: list[str] = []
    ignored: list[str] = []
    words = list(arguments)
    while words:
        word = words.pop(0)
        if word == "-h":
            kept.append(word)
            continue
        if not word.startswith("--"):
            raise NurecSimError(
                f"unexpected {word!r}: serve-grpc takes flags only, such as --artifact-glob=DIR/**/*.usdz"
            )
        name, equals, value = word[2:].partition("=")
        name = name.replace("_", "-")
        plain, negated = name.removeprefix("no-"), name.startswith("no-")
        if name in with_value:
            if not equals and not words:
                raise NurecSimError(f"--{name} needs a value")
            kept += [f"--{name}", value if equals else words.pop(0)]
            while name in with_several and words and not words[0].startswith("-"):
                kept.append(words.pop(0))
        elif plain in ours:
            kept.append(_switch(plain, negated, value if equals else "true"))
        elif plain in IGNORED_SWITCHES:
            ignored.append(f"--{name}")
        elif name in IGNORED_VALUES or name.startswith(IGNORED_FAMILIES):
            ignored.append(f"--{name}")
            if not equals and words and not words[0].startswith("--"):
                words.pop(0)
        else:
            near = difflib.get_close_matches(plain, known, n=1, cutoff=0.0)[0].rstrip("-")
            raise NurecSimError(
                f"unknown flag --{name}; the nearest known one is --{near} (serve-grpc --help lists all)"
            )
    return Sorted(kept, ignored)


def _switch(name: str, negated: bool, value: str) -> str:
    if value.lower() not in _TRUTH:
        raise NurecSimError(f"--{name} is a switch: true or false, got {value!r}")
    return f"--{name}" if _TRUTH[value.lower()] != negated else f"--no-{name}"
