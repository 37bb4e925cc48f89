"""Loads the policies of a run, each in its own thread."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from nurec_sim.errors import PolicyError, ScenarioError
from nurec_sim.plugins import load_policy
from nurec_sim.runs.folder import folder_name
from nurec_sim.sim.policy_host import PLAN_TIMEOUT_S, PolicyHost
from nurec_sim.types import Policy


@dataclass(frozen=True)
class LoadedPolicy:
    """A policy in its thread, and its reference."""

    reference: str
    name: str
    host: PolicyHost


def load_policies(
    policies: Sequence[str | Policy | LoadedPolicy], plan_timeout_s: float = PLAN_TIMEOUT_S
) -> list[LoadedPolicy]:
    """Creates every policy in its own thread.

    Args:
        policies: references for ``plugins.load_policy``, or policies; loaded ones are returned unchanged.
        plan_timeout_s: time limit for creating a policy, and for each plan.

    Raises:
        ScenarioError: none, one cannot be created, or two have the same name.
    """
    if not policies:
        raise ScenarioError("no policy to run: give one, or list some under 'policies' in the scenario")
    if not 0 < plan_timeout_s < float("inf"):
        raise ScenarioError(f"the time limit of a plan must be finite and above 0 s, got {plan_timeout_s:g}")
    loaded = [each if isinstance(each, LoadedPolicy) else _load(each, plan_timeout_s) for each in policies]
    names = [folder_name(each.name) for each in loaded]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ScenarioError(f"policy names must be unique; repeated: {twice}")
    odd = [each.name for each in loaded if not re.search(r"[A-Za-z0-9]", each.name)]
    if odd:
        raise ScenarioError(f"a policy's name needs a letter or a digit, got {odd}")
    return loaded


def _load(policy: str | Policy, plan_timeout_s: float) -> LoadedPolicy:
    reference = policy if isinstance(policy, str) else policy.name
    try:
        host = PolicyHost(lambda: load_policy(policy) if isinstance(policy, str) else policy, plan_timeout_s)
    except PolicyError as error:
        raise ScenarioError(f"policy '{reference}' cannot be created: {error}") from error
    return LoadedPolicy(reference, host.name, host)
