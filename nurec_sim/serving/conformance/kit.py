"""Checks by name, how they are run, and how they end."""

from __future__ import annotations

import enum
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import grpc

from nurec_sim.serving.conformance.target import Failed, Skipped, Target


class Verdict(enum.StrEnum):
    """How a check ended."""

    PASS = "PASS"
    FAIL = "FAIL"
    SKIP = "SKIP"


@dataclass(frozen=True)
class Check:
    """One rule: its name, what it says, and what tests it.

    The function takes the server and returns a sentence about what it saw; it raises ``Failed`` or ``Skipped``.
    """

    name: str
    rule: str
    test: Callable[[Target], str]
    optional: bool
    """Whether a server may answer UNIMPLEMENTED."""


@dataclass(frozen=True)
class Outcome:
    """How one check ended, and why."""

    name: str
    rule: str
    verdict: Verdict
    text: str
    seconds: float


CHECKS: dict[str, Check] = {}
"""All checks by name, in the order in which they run."""


def check(name: str, *, optional: bool = False) -> Callable[[Callable[[Target], str]], Callable[[Target], str]]:
    """Adds a function to ``CHECKS``; the first line of its docstring is the rule."""

    def add(test: Callable[[Target], str]) -> Callable[[Target], str]:
        assert name not in CHECKS and test.__doc__
        CHECKS[name] = Check(name, test.__doc__.split("\n")[0], test, optional)
        return test

    return add


def run_checks(target: Target, names: Sequence[str] = ()) -> Iterator[Outcome]:
    """Runs checks one after the other, and yields each outcome at once.

    Args:
        target: the server.
        names: which; all if none.

    Raises:
        KeyError: there is no check of that name.
    """
    for one in [CHECKS[name] for name in names] or CHECKS.values():
        begin = time.perf_counter()
        verdict, text = _run(one, target)
        yield Outcome(one.name, one.rule, verdict, text, time.perf_counter() - begin)


def _run(one: Check, target: Target) -> tuple[Verdict, str]:
    try:
        return Verdict.PASS, one.test(target)
    except Skipped as reason:
        return Verdict.SKIP, str(reason)
    except Failed as fault:
        return Verdict.FAIL, str(fault)
    except grpc.RpcError as error:
        code, details = error.code(), error.details()
        if code == grpc.StatusCode.UNIMPLEMENTED and one.optional:
            return Verdict.SKIP, f"the server does not offer it: {details}"
        return Verdict.FAIL, f"a valid request was refused with {code.name}: {details}"
    except Exception as error:  # what the server sent made no sense to us: that is the server's fault, not the end
        return Verdict.FAIL, f"the reply could not be read: {type(error).__name__}: {error}"
