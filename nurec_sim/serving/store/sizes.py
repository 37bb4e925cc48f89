"""How much memory a scene takes, and how much there is."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")


def array_bytes(*things: Any) -> int:
    """Bytes of the arrays and tensors that objects of ours hold, at any depth; each buffer counts once."""
    total, seen, stack = 0, set(), list(things)
    while stack:
        thing = stack.pop()
        while getattr(thing, "base", None) is not None and hasattr(thing.base, "nbytes"):
            thing = thing.base  # a view keeps all of what it looks at
        if id(thing) in seen:
            continue
        seen.add(id(thing))
        if isinstance(getattr(thing, "nbytes", None), int):
            total += thing.nbytes
        elif isinstance(thing, Mapping):
            stack += list(thing.values())
        elif isinstance(thing, (list, tuple)):
            stack += thing
        elif type(thing).__module__.startswith("nurec_sim.") and hasattr(thing, "__dict__"):
            stack += list(vars(thing).values())
    return total


def half_of_memory() -> int:
    """Half of the memory that this process may use, in bytes: of the machine, or of its container if that is less."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        total = min(total, int(_CGROUP_LIMIT.read_text()))
    except (OSError, ValueError):  # no container, or one without a limit ("max")
        pass
    return total // 2
