"""The command line of NVIDIA's renderer: which of its flags are taken, which are passed over, which are none.

Names of flags are those of NRE 25.x to 26.10 and of AlpaSim's launch line; old spellings and new ones.
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
"""How flags of the image-to-image networks begin; they take a value, if the next word is not a flag."""
_TRUTH = {"true": True, "1": True, "yes": True, "on": True, "false": False, "0": False, "no": False, "off": False}


@dataclass(frozen=True)
class Sorted:
    """A command line without the flags that do not apply."""

    arguments: list[str]
    """What is left, switches spelt ``--flag`` or ``--no-flag``."""
    ignored: list[str]
    """Flags that were passed over, as they were given."""


def sort_flags(
    arguments: Sequence[str], switches: Iterable[str], values: Iterable[str], lists: Iterable[str] = ()
) -> Sorted:
    """Takes out of a command line what this renderer has no use for.

    Args:
        arguments: the words after the verb.
        switches: names of the flags without a value that apply, with hyphens.
        values: names of those with one.
        lists: names of those with one or more.

    Raises:
        NurecSimError: a word is no flag, or none that is known; the text names the nearest one.
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
