"""How many processor cores this process may use, and work spread over them."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def usable_cores() -> int:
    """Cores that this process may run on: fewer than the machine has where a container or ``taskset`` limits it."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_order(function: Callable[[Item], Result], items: Iterable[Item], ahead: int | None = None) -> Iterator[Result]:
    """Results of a function for each item, in the order of the items, computed by as many threads as there are cores.

    Only a few items are begun before their results are taken, which bounds memory: ``ahead``, or two per core. An
    exception of the function is raised where its result is due; items that have not begun by then are left out.
    """
    rest, cores = iter(items), usable_cores()
    with ThreadPoolExecutor(cores) as pool:
        begun = deque(pool.submit(function, item) for item in islice(rest, 2 * cores if ahead is None else ahead))
        try:
            while begun:
                result = begun.popleft().result()
                begun.extend(pool.submit(function, item) for item in islice(rest, 1))
                yield result
        finally:
            for future in begun:
                future.cancel()
