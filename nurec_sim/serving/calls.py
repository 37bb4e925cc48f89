"""What a procedure may know of the call that it answers: whose it is, what came beside the request, how long it has."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field

from nurec_sim.errors import DeadlinePassedError


@dataclass
class Call:
    """One call in progress."""

    method: str
    """Last part of the service's name, and the procedure: ``SensorsimService/render_rgb``."""
    peer: str = ""
    """Address and port of the client, as gRPC spells it: ``ipv4:127.0.0.1:50123``."""
    metadata: Mapping[str, str] = field(default_factory=dict)
    """Texts that came beside the request, by lower-case name; without the token."""
    deadline_s: float = math.inf
    """When the client stops waiting, on the clock of ``time.monotonic``."""
    scene: str = ""
    """The scene that the request names, for the log; whoever reads the request sets it."""

    @property
    def client(self) -> tuple[str, str]:
        """Whose call it is: the address, and the connection, for several programs may share an address."""
        return address_of(self.peer), self.peer

    def check_deadline(self) -> None:
        """Ends work that nobody waits for.

        Raises:
            DeadlinePassedError: the client has stopped waiting.
        """
        late_s = time.monotonic() - self.deadline_s
        if late_s >= 0:
            raise DeadlinePassedError(f"the deadline passed {1e3 * late_s:.0f} ms before the work was done")


def address_of(peer: str) -> str:
    """The address of a client without its port, which every connection has anew: ``ipv4:127.0.0.1``."""
    return peer.rsplit(":", 1)[0] if peer.startswith(("ipv4:", "ipv6:")) else peer


_current: ContextVar[Call] = ContextVar("call")


def current_call() -> Call:
    """The call that the running task answers; one without a client outside of any."""
    return _current.get(Call(""))


def enter_call(call: Call) -> None:
    """Makes ``call`` the one that the running task, and the tasks that it starts from now on, answer."""
    _current.set(call)
