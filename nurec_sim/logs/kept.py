"""Values kept in memory because they are slow to make: the latest ones, or as many as fit."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

T = TypeVar("T")


class Recent(Generic[T]):
    """Keeps the values that were last used.

    Args:
        size: number of values.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._values: OrderedDict[Hashable, T] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """The value of a key, made if it is not kept."""
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
        # Without the lock: loading is slow, and a duplicate load by another thread does no harm.
        value = make()
        with self._lock:
            self._values[key] = value
            while len(self._values) > self._size:
                self._values.popitem(last=False)
        return value


class Kept(Generic[T]):
    """Keeps the values that were made first, as many as fit.

    A log is read from its beginning to its end several times: the values used last are those needed last again.

    Args:
        most_bytes: of all values.
        size: bytes of a value.
    """

    def __init__(self, most_bytes: int, size: Callable[[T], int]) -> None:
        self._left, self._size = most_bytes, size
        self._values: dict[Hashable, T] = {}
        self._lock = threading.Lock()

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """The value of a key, made if it is not kept."""
        if (kept := self._values.get(key)) is not None:
            return kept
        value = make()
        with self._lock:
            if key not in self._values and self._size(value) <= self._left:
                self._values[key] = value
                self._left -= self._size(value)
        return value
