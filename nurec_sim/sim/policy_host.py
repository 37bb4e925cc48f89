"""Isolates policies from the loop: own thread, copied data, and a time limit."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import TypeVar

from nurec_sim.errors import NurecSimError, PlanError, PolicyError
from nurec_sim.sim.plans import check_plan
from nurec_sim.sim.policy_thread import PolicyThread
from nurec_sim.sim.sealed import sealed
from nurec_sim.types import Needs, Observation, Plan, Policy, Rig

T = TypeVar("T")

PLAN_TIMEOUT_S = 60.0
WAKE_S = 0.5
"""Waiting is done in such pieces: a Ctrl-C that another thread receives is seen only when this one wakes up."""


class PolicyHost:
    """Creates and calls a policy in its own thread; is itself a policy.

    Any exception of the policy, including ``SystemExit`` and ``KeyboardInterrupt``, becomes a ``PolicyError``, so only
    a real Ctrl-C interrupts the caller. The policy gets read-only copies, and its plans are copied. After ``timeout_s``
    a call is cancelled: its thread is abandoned, and the next ``reset`` creates the policy again in a new one. Process
    exits, crashes and libraries that hold the GIL cannot be handled here: run such policies through ``grpc://``.

    Args:
        make: creates the policy, or returns an existing one.
        timeout_s: time limit for creation and for each ``reset`` and ``plan``.

    Raises:
        NurecSimError: raised by ``make``.
        PolicyError: any other exception of ``make``, or a timeout.
        ValueError: ``timeout_s`` is not a finite number above 0.
    """

    def __init__(self, make: Callable[[], Policy], timeout_s: float = PLAN_TIMEOUT_S) -> None:
        if not 0 < timeout_s < float("inf"):
            raise ValueError(f"timeout_s must be finite and above 0, got {timeout_s}")
        self._make, self._timeout_s = make, timeout_s
        self._usable = False
        self._thread, self._policy, self.name, self.needs = self._made()

    def reset(self, rig: Rig, seed: int) -> None:
        """Begin a new rollout.

        Raises:
            NurecSimError: the policy could not be created again.
            PolicyError: the policy raised, timed out, or is still busy with a cancelled call.
        """
        if not self._usable:
            self._make_anew()
        policy, seen = self._policy, sealed(rig)
        self._ask(self._thread, "reset()", lambda: _own(lambda: policy.reset(seen, seed)))

    def plan(self, observation: Observation) -> Plan:
        """The policy's plan, copied and validated.

        Raises:
            PolicyError: the policy raised or timed out.
            PlanError: the plan cannot be driven.
        """
        policy, seen, t_us = self._policy, sealed(observation), observation.t_us

        def answer() -> Plan:
            plan = _own(lambda: policy.plan(seen))
            return _own(lambda: check_plan(plan, t_us), PlanError)  # reading a plan may execute code of the policy

        return self._ask(self._thread, "plan()", answer)

    def close(self) -> None:
        """Ends the thread; does not wait for it."""
        self._thread.stop()

    def _make_anew(self) -> None:
        # ``make`` may return one and the same object each time. If the abandoned call still runs in it, a second thread
        # must not enter it.
        busy, before = self._thread.alive, self._policy
        thread, policy, _, needs = self._made()
        if busy and policy is before:
            thread.stop()
            self._usable = False
            raise PolicyError("it is still busy with a call that timed out")
        self._thread, self._policy, self.needs = thread, policy, needs

    def _made(self) -> tuple[PolicyThread, Policy, str, Needs]:
        thread = PolicyThread("policy")

        def make() -> tuple[Policy, str, Needs]:
            policy = _own(self._make, NurecSimError)
            return policy, *_own(lambda: (str(policy.name), policy.needs))

        try:
            made = self._ask(thread, "creating the policy", make)
        except BaseException:
            thread.stop()
            raise
        self._usable = True
        return thread, *made

    def _ask(self, thread: PolicyThread, what: str, function: Callable[[], T]) -> T:
        future = thread.submit(function)
        until = time.monotonic() + self._timeout_s
        while (left_s := until - time.monotonic()) > 0:
            with contextlib.suppress(TimeoutError):
                return future.result(min(left_s, WAKE_S))
        self._usable = False
        thread.abandon()
        raise PolicyError(
            f"{what} did not finish within {self._timeout_s:g} s; --plan-timeout (plan_timeout_s) sets the limit"
        )


def described(error: BaseException) -> str:
    """Class and text of an exception, even if its ``__str__`` fails."""
    try:
        return f"{type(error).__name__}: {error}"
    except BaseException:
        return type(error).__name__


def _own(function: Callable[[], T], passing: type[BaseException] | tuple[()] = ()) -> T:
    """Calls policy code; exceptions other than ``passing`` become ``PolicyError``."""
    try:
        return function()
    except passing:
        raise
    except BaseException as error:
        raise PolicyError(described(error)) from None
