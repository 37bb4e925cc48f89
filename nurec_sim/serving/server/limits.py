"""Limits that keep one client from taking what all need: calls a second, and memory of replies that nobody reads."""

from __future__ import annotations

import time
from collections import Counter, OrderedDict
from collections.abc import Callable

_MOST_PEERS = 10_000


class RateLimit:
    """A bucket of tokens for each client address: a call takes one, and they come back at a steady rate.

    Args:
        per_s: tokens that come back in a second.
        burst: tokens that fit.
        clock: seconds, never going back.
    """

    def __init__(self, per_s: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s, self._burst, self._clock = per_s, float(burst), clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()  # address: tokens, when they were counted

    def allows(self, address: str) -> bool:
        """Whether a call may begin now; takes its token if so."""
        now = self._clock()
        tokens, then = self._buckets.pop(address, (self._burst, now))
        tokens = min(self._burst, tokens + self._per_s * (now - then))
        allowed = tokens >= 1
        self._buckets[address] = (tokens - 1 if allowed else tokens, now)
        if len(self._buckets) > _MOST_PEERS:
            self._buckets.popitem(last=False)  # asked longest ago
        return allowed


class UnreadReplies:
    """Bytes of replies that were handed to the network and not taken by their clients yet.

    Args:
        most: in all; one connection may leave a quarter of it, or a single reply of any size.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._by_peer: Counter[str] = Counter()

    @property
    def total(self) -> int:
        """Bytes in all."""
        return self._by_peer.total()

    def refusal(self, peer: str, size: int = 0) -> str | None:
        """Why a reply of ``size`` bytes cannot be held for a connection; None if it can."""
        unread = self._by_peer[peer] if peer in self._by_peer else 0
        if unread and unread + size > self._most // 4:
            return f"{unread:,} bytes of replies wait to be read by this connection; read them first"
        if (total := self.total) and total + size > self._most:
            return f"{total:,} bytes of replies wait to be read by clients of this server; try again later"
        return None

    def add(self, peer: str, size: int) -> None:
        """Counts a reply that goes out."""
        self._by_peer[peer] += size

    def remove(self, peer: str, size: int) -> None:
        """Counts a reply that was taken, or whose client left."""
        self._by_peer[peer] -= size
        if self._by_peer[peer] <= 0:
            del self._by_peer[peer]
