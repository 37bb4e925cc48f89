"""Policies kept apart from the loop that asks them: in a thread of their own, with copies, and with a time limit."""

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
    """A policy, made and asked in one thread of its own; itself a policy.

    Whatever the policy raises, also ``SystemExit`` and ``KeyboardInterrupt``, is a ``PolicyError`` here, so that only a
    real Ctrl-C interrupts the caller. It gets copies that cannot be written to, and its plans are copied. A call that
    takes longer than ``timeout_s`` is given up: its thread is abandoned, and the next ``reset`` makes the policy anew
    in a new one. What ends the process or never lets other threads run cannot be caught here (``os._exit``, a crash, a
    library that holds Python's lock): drive such policies through ``grpc://``.

    Args:
        make: makes the policy, or gives one that is there.
        timeout_s: for making the policy, and for each ``reset`` and ``plan``.

    Raises:
        NurecSimError: what ``make`` raised of ours.
        PolicyError: it raised something else, or did not end in time.
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
            NurecSimError: the policy had to be made anew, and that failed.
            PolicyError: the policy raised, did not end in time, or is still busy with a call that was given up.
        """
        if not self._usable:
            self._make_anew()
        policy, seen = self._policy, sealed(rig)
        self._ask(self._thread, "reset()", lambda: _own(lambda: policy.reset(seen, seed)))

    def plan(self, observation: Observation) -> Plan:
        """The policy's answer, copied and checked.

        Raises:
            PolicyError: the policy raised, or did not answer in time.
            PlanError: the plan cannot be driven.
        """
        policy, seen, t_us = self._policy, sealed(observation), observation.t_us

        def answer() -> Plan:
            plan = _own(lambda: policy.plan(seen))
            return _own(lambda: check_plan(plan, t_us), PlanError)  # reading a plan may run code of the policy's too

        return self._ask(self._thread, "plan()", answer)

    def close(self) -> None:
        """Ends the thread; does not wait for it."""
        self._thread.stop()

    def _make_anew(self) -> None:
        busy, before = self._thread.alive, self._policy
        thread, policy, _, needs = self._made()
        if busy and policy is before:
            thread.stop()
            self._usable = False
            raise PolicyError("it is still busy with a call that it did not answer in time")
        self._thread, self._policy, self.needs = thread, policy, needs

    def _made(self) -> tuple[PolicyThread, Policy, str, Needs]:
        thread = PolicyThread("policy")

        def make() -> tuple[Policy, str, Needs]:
            policy = _own(self._make, NurecSimError)
            return policy, *_own(lambda: (str(policy.name), policy.needs))

        try:
            made = self._ask(thread, "making the policy", make)
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
            f"{what} did not end within {self._timeout_s:g} s; --plan-timeout (plan_timeout_s) allows more"
        )


def described(error: BaseException) -> str:
    """Class and text of an exception, even of one whose text cannot be had."""
    try:
        return f"{type(error).__name__}: {error}"
    except BaseException:
        return type(error).__name__


def _own(function: Callable[[], T], passing: type[BaseException] | tuple[()] = ()) -> T:
    """Calls code of a policy; whatever it raises becomes a ``PolicyError``, but for what may pass."""
    try:
        return function()
    except passing:
        raise
    except BaseException as error:
        raise PolicyError(described(error)) from None
