"""Fair scheduling: deficit round robin over client addresses, and over the connections of each; small jobs first.

A turn lasts ``turn_s`` of one worker's time. It is charged when it starts; the difference to the time used is settled
when the job stops. A client with negative credit is skipped until it is positive again. After M. Shreedhar and G.
Varghese, Efficient Fair Queueing Using Deficit Round Robin (1995), with time instead of bytes, because the duration of
a job is not known in advance. New clients come first, once, like new flows in FQ-CoDel (RFC 8290).
"""

from __future__ import annotations

import bisect
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(eq=False)
class Job:
    """One piece of work.

    Attributes:
        client: address and connection, or any other names from the largest group to the smallest.
        rays: pixels and beams; of one client's jobs, those with fewest come first.
        number: place in the order in which jobs came.
    """

    client: tuple[str, ...]
    rays: int
    number: int = 0


class _Member:
    """A client, or a group of clients, with the jobs that wait for a turn."""

    def __init__(self, name: str = "") -> None:
        self.name = name
        self.credit_s = 0.0
        self.users = 0
        """Jobs of it that have not ended."""
        self.jobs: list[Job] = []
        self.members: dict[str, _Member] = {}
        self.ring: deque[_Member] = deque()
        self.fresh = 0
        """How many at the front of the ring have not had a turn since they came."""
        self.has_paid = False
        """Whether the first in the ring has got its share of this round."""

    def member(self, name: str) -> _Member:
        if name not in self.members:
            self.members[name] = _Member(name)
            self.ring.insert(self.fresh + self.has_paid, self.members[name])
            self.fresh += 1
        return self.members[name]

    def first(self, may_run: Callable[[Job], bool]) -> Job | None:
        """Some job that may run."""
        own = (job for job in self.jobs if may_run(job))
        others = (job for member in self.ring if (job := member.first(may_run)))
        return next(own, None) or next(others, None)

    def take(self, may_run: Callable[[Job], bool], turn_s: float) -> Job | None:
        """The job whose turn it is, charged for that and taken out."""
        job = next((job for job in self.jobs if may_run(job)), None)
        if job is not None:
            self.jobs.remove(job)
            return job
        passed = 0
        while passed < len(self.ring):
            member = self.ring[0]
            if not member.users:  # removed only now: a client that reconnects must not always count as new
                self._go_on()
                del self.members[self.ring.pop().name]
                continue
            if member.first(may_run) is None:
                member.credit_s = min(member.credit_s, 0.0)
                self._go_on()
                passed += 1
                continue
            passed = 0
            if not self.has_paid:
                member.credit_s += turn_s
                self.has_paid = True
            if member.credit_s > 0:
                member.credit_s -= turn_s
                if member.credit_s <= 0:
                    self._go_on()
                return member.take(may_run, turn_s)
            self._go_on()
        return None

    def _go_on(self) -> None:
        """Ends the visit of the first in the ring."""
        self.ring.rotate(-1)
        self.fresh, self.has_paid = max(self.fresh - 1, 0), False


class FairShares:
    """The jobs of all clients that wait for their turn.

    Args:
        turn_s: time of a turn.
    """

    def __init__(self, turn_s: float) -> None:
        self._turn_s = turn_s
        self._all = _Member()
        self._count = 0

    def join(self, job: Job) -> None:
        """Adds a new job."""
        self._count += 1
        job.number = self._count
        for member in self._members(job):
            member.users += 1
        self.offer(job)

    def offer(self, job: Job) -> None:
        """Makes a job wait for another turn."""
        bisect.insort(self._members(job)[-1].jobs, job, key=lambda other: (other.rays, other.number))

    def take(self, may_run: Callable[[Job], bool]) -> Job | None:
        """The next job that may run, charged for a turn; None if there is none."""
        return self._all.take(may_run, self._turn_s)

    def settle(self, job: Job, used_s: float) -> None:
        """Replaces the charge for a turn by the time that was used."""
        self.charge(job, used_s - self._turn_s)

    def charge(self, job: Job, seconds: float) -> None:
        """Charges time used outside of turns."""
        for member in self._members(job):
            member.credit_s -= seconds

    def withdraw(self, job: Job) -> None:
        """Removes a waiting job."""
        self._members(job)[-1].jobs.remove(job)

    def leave(self, job: Job) -> None:
        """Removes a job that has ended."""
        for member in self._members(job):
            member.users -= 1

    def _members(self, job: Job) -> list[_Member]:
        members = [self._all]
        for name in job.client:
            members.append(members[-1].member(name))
        return members[1:]
