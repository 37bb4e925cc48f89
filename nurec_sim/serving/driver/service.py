"""The procedures of the egodriver interface for one policy; ``driver.server`` serves them.

Every session has its own instance of the policy in its own thread. An exception of the policy, or an invalid plan,
fails that one call; the session stays open.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

import nurec_sim
from nurec_sim.errors import (
    DeadlinePassedError,
    NurecSimError,
    PlanError,
    RequestError,
    SessionExistsError,
    TooLargeError,
    UnknownSessionError,
    UnsupportedError,
)  # fmt: skip
from nurec_sim.serving.driver.session import Question, Session
from nurec_sim.serving.sensor_service.discovery import API_VERSION
from nurec_sim.serving.wire import MAX_MESSAGE_BYTES, common, driving, driving_paths, driving_states, egodriver
from nurec_sim.sim.plans import check_plan
from nurec_sim.sim.policy_host import described
from nurec_sim.sim.policy_thread import PolicyThread
from nurec_sim.sim.sealed import sealed
from nurec_sim.types import EgoState, Plan, Policy

log = logging.getLogger(__name__)

T = TypeVar("T")

MAX_ID_LENGTH = 256
STANDING_US = 5_000_000


@dataclass(frozen=True)
class DriverOptions:
    """What a driver server allows and fills in."""

    max_sessions: int = 8
    idle_s: float = 600.0
    """Sessions without a call for this long are closed."""
    plan_timeout_s: float = 60.0
    """A plan that takes longer has failed, whatever deadline the client has."""
    route_speed_mps: float = 8.0
    """Speed along routes that come without speeds, such as AlpaSim's."""
    max_message_bytes: int = MAX_MESSAGE_BYTES
    allow_shut_down: bool = False

    def __post_init__(self) -> None:
        for name in ("max_sessions", "idle_s", "plan_timeout_s", "route_speed_mps", "max_message_bytes"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"{name} must be finite and above 0, got {getattr(self, name)}")


@dataclass
class _Open:
    """An open session: its observations, its policy, and the time of its last call."""

    session: Session
    policy: Policy
    thread: PolicyThread
    last_call_s: float


class DriverService:
    """The procedures, one coroutine each, by their names on the wire: message in, message out, errors raised.

    Args:
        make_policy: makes one instance for every session; called in that session's thread.
        options: limits.
        request_stop: ends the server.

    Raises:
        ScenarioError: the policy cannot be made.
    """

    def __init__(
        self,
        make_policy: Callable[[], Policy],
        options: DriverOptions | None = None,
        request_stop: Callable[[], None] = lambda: None,
    ) -> None:
        self._make_policy, self._options, self._request_stop = make_policy, options or DriverOptions(), request_stop
        first = make_policy()
        self._name, self._needs = first.name, first.needs
        self._sessions: dict[str, _Open | None] = {}
        """By id; None while the policy is being made."""

    @property
    def session_ids(self) -> list[str]:
        """Ids of the open sessions."""
        return sorted(self._sessions)

    def close(self) -> None:
        """Ends all sessions; does not wait for their policies."""
        for session_id in list(self._sessions):
            self._end(session_id)

    async def expire(self) -> None:
        """Closes sessions without a call for ``idle_s``; runs until cancelled."""
        while True:
            await asyncio.sleep(min(self._options.idle_s / 4, 5.0))
            for session_id, opened in list(self._sessions.items()):
                if opened is not None and time.monotonic() - opened.last_call_s > self._options.idle_s:
                    log.warning("session %r is closed: no call for %g s", session_id, self._options.idle_s)
                    self._end(session_id)

    # ------------------------------------------------------------------------------------------------------- sessions

    async def start_session(self, request):
        """Makes a policy and resets it for the client's car."""
        start = driving.read_session_start(request)
        session_id = start.session_id
        if not 0 < len(session_id) <= MAX_ID_LENGTH:
            raise RequestError(f"session_uuid must have 1 to {MAX_ID_LENGTH} characters, got {len(session_id)}")
        if session_id in self._sessions:
            raise SessionExistsError(f"session {session_id!r} is open already; close it, or take another session_uuid")
        if len(self._sessions) >= self._options.max_sessions:
            raise TooLargeError(
                f"{self._options.max_sessions} sessions are open already, which is all this driver allows"
            )
        self._sessions[session_id] = None
        thread = PolicyThread(f"policy-{session_id[:16]}")
        try:
            policy = await self._run(thread, lambda: self._made(start))
        except BaseException:
            thread.stop()
            self._sessions.pop(session_id, None)
            raise
        session = Session(start, policy.needs, self._options.route_speed_mps)
        self._sessions[session_id] = _Open(session, policy, thread, time.monotonic())
        return common.SessionRequestStatus()

    async def close_session(self, request):
        """Forgets a session."""
        self._opened(request.session_uuid)
        self._end(request.session_uuid)
        return common.Empty()

    def _made(self, start: driving.SessionStart) -> Policy:
        with _answering_for(self._name):
            policy = self._make_policy()
            policy.reset(sealed(start.rig), start.seed)
        return policy

    def _opened(self, session_id: str) -> _Open:
        opened = self._sessions.get(session_id)
        if opened is None:
            state = "is being opened" if session_id in self._sessions else "is not open"
            raise UnknownSessionError(
                f"session {session_id[:MAX_ID_LENGTH]!r} {state}; sessions are closed after "
                f"{self._options.idle_s:g} s without a call"
            )
        opened.last_call_s = time.monotonic()
        return opened

    def _end(self, session_id: str) -> None:
        opened = self._sessions.pop(session_id, None)
        if opened is not None:
            opened.thread.stop()

    # --------------------------------------------------------------------------------------------------- observations

    async def submit_image_observation(self, request):
        """Keeps a camera image."""
        self._opened(request.session_uuid).session.add_image(driving.read_encoded_image(request))
        return common.Empty()

    async def submit_egomotion_observation(self, request):
        """Keeps ego poses and how the car moved."""
        self._opened(request.session_uuid).session.add_states(driving_states.read_states(request))
        return common.Empty()

    async def submit_route(self, request):
        """Keeps the way ahead."""
        self._opened(request.session_uuid).session.set_route(driving_paths.read_route(request.route))
        return common.Empty()

    async def submit_recording_ground_truth(self, request):
        """Keeps the log's own future."""
        self._opened(request.session_uuid).session.set_recorded(driving_paths.read_recorded(request.ground_truth))
        return common.Empty()

    async def submit_lidar_observation(self, request):
        """Keeps a LiDAR sweep."""
        session = self._opened(request.session_uuid).session
        session.add_sweep(driving.read_sweep(request, session.start.rig.lidars))
        return common.Empty()

    async def submit_actor_observation(self, request):
        """Keeps the true actors."""
        session = self._opened(request.session_uuid).session
        session.set_actors(request.timestamp_us, driving.read_actors(request))
        return common.Empty()

    # -------------------------------------------------------------------------------------------------------- driving

    async def drive(self, request):
        """A plan for what was observed up to ``time_now_us``."""
        opened = self._opened(request.session_uuid)
        driving.check_time("time_now_us", max(request.time_now_us, request.time_query_us))
        question = opened.session.question(request.time_now_us)
        try:
            return await self._run(opened.thread, lambda: self._answer(opened, question))
        finally:
            opened.last_call_s = time.monotonic()

    async def _run(self, thread: PolicyThread, function: Callable[[], T]) -> T:
        try:
            return await thread.run(function, self._options.plan_timeout_s)
        except TimeoutError:
            raise DeadlinePassedError(
                f"policy {self._name!r} has not answered within {self._options.plan_timeout_s:g} s"
            ) from None

    def _answer(self, opened: _Open, question: Question):
        observation = sealed(opened.session.observation(question))
        with _answering_for(self._name):
            plan = check_plan(opened.policy.plan(observation), observation.t_us)
            if plan.stop_session:
                plan = _last_plan(plan, question.ego)
        reply = egodriver.DriveResponse()
        driving_paths.write_plan(question.ego, plan, reply)
        return reply

    async def get_policy(self, request):
        """What the policy is called and reads."""
        reply = egodriver.PolicyDescription()
        driving.write_policy(self._name, self._needs, reply)
        return reply

    async def get_version(self, request):
        """Version of this package and of the interface."""
        reply = common.VersionId(version_id=f"{nurec_sim.__version__} {self._name}")
        api = reply.grpc_api_version
        api.major, api.minor, api.patch = API_VERSION
        return reply

    async def shut_down(self, request):
        """Stops the server, if it was started so that clients may."""
        if not self._options.allow_shut_down:
            raise UnsupportedError("this driver was not started with permission to be shut down by clients")
        self._request_stop()
        return common.Empty()


@contextmanager
def _answering_for(name: str) -> Iterator[None]:
    """Turns whatever the policy raises into a ``PlanError`` that names it, even an attempt to end the process."""
    try:
        yield
    except PlanError as error:
        raise PlanError(f"policy {name!r}: {error}") from error
    except BaseException as error:
        log.info("policy %r failed", name, exc_info=error)
        raise PlanError(f"policy {name!r} failed: {described(error)}") from error


def _last_plan(plan: Plan, ego: EgoState) -> Plan:
    """A plan that asks to stop, fit to be driven: what the policy answered if it can be, else standing still."""
    try:
        checked = check_plan(replace(plan, stop_session=False), ego.t_us)
        return replace(checked, stop_session=True)
    except NurecSimError:
        return Plan(np.array([ego.t_us + STANDING_US]), np.zeros((1, 3)), stop_session=True)
