"""The closed loop: one policy driven through one scene once.

::

    log ──► warm-up (ego pinned to the log) ──► every replan_s: sense ──► plan ──► check ──► track in 10 ms ticks

The loop gets frames only through ``sense``, independent of the renderer. It uses integer microseconds, no wall clock
and no randomness except the seeded initial state, so a second run gives the same bytes.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from nurec_sim import geometry
from nurec_sim.errors import PlanError, PolicyError, ScenarioError
from nurec_sim.sim.actors import Actors, edited_actors
from nurec_sim.sim.control import CONTROLLERS, PlannedPath
from nurec_sim.sim.policy_host import PLAN_TIMEOUT_S, PolicyHost, described
from nurec_sim.sim.policy_sensors import SceneFacts, SensorSuite
from nurec_sim.sim.recorded import RecordedDrive
from nurec_sim.sim.scenario import STATE_S, Perturbation, Scenario
from nurec_sim.sim.vehicle import TICK_US, VehicleLimits, VehicleState
from nurec_sim.types import EgoState, Event, Matrix4, Observation, Plan, Policy, Rollout, Sense, SensorFrame

STATE_US = int(round(STATE_S * 1e6))
HISTORY_STATES = 21
"""Length of the state history: 2 s at 10 Hz, the current state included."""

OnFrames = Callable[[int, Mapping[str, SensorFrame]], None]


def run_rollout(
    scenario: Scenario,
    policy: Policy,
    sense: Sense,
    facts: SceneFacts,
    *,
    reconstruction: str = "",
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
    on_frames: OnFrames | None = None,
    plan_timeout_s: float = PLAN_TIMEOUT_S,
) -> Rollout:
    """Runs ``policy`` in a scene and records everything that metrics need.

    Every fault (a policy that raises, exits, hangs or returns an invalid plan, a failing renderer, a missing sensor, a
    scenario that does not fit the scene) gives a rollout of status ``failed`` with the error text and all states so
    far; only a real Ctrl-C raises.

    Args:
        scenario: what is driven.
        policy: runs in its own thread and gets read-only copies.
        sense: the renderer.
        facts: rig, recorded drive, tracks and time span of the scene.
        reconstruction: name of the reconstruction, copied into the rollout.
        seed: of the initial state, and passed to the policy's ``reset``.
        progress: called with the fraction of the scenario done.
        on_frames: called with time (microseconds) and frames by sensor name after each rendering.
        plan_timeout_s: time limit of each call of the policy; a ``PolicyHost`` has its own limit instead.
    """
    if not isinstance(policy, PolicyHost):
        host = PolicyHost(lambda: policy, plan_timeout_s)
        try:
            return run_rollout(
                scenario, host, sense, facts, reconstruction=reconstruction, seed=seed, progress=progress,
                on_frames=on_frames,
            )  # fmt: skip
        finally:
            host.close()
    drive = _Drive(scenario, policy, sense, facts, seed, progress or (lambda fraction: None), on_frames)
    error = ""
    try:
        drive.run()
    except _Failure as failure:
        error = failure.text
        drive.note(failure.kind, failure.text)
    times = np.array([state.t_us for state in drive.states], np.int64)
    return Rollout(
        scenario=scenario.name,
        scene_id=facts.id,
        reconstruction=reconstruction,
        policy=policy.name,
        seed=seed,
        rig=facts.rig,
        states=tuple(drive.states),
        actors={track_id: drive.actors.poses(track_id, times) for track_id in drive.actors.tracks},
        actor_sizes_m={track_id: track.size_m for track_id, track in drive.actors.tracks.items()},
        actor_labels={track_id: track.label for track_id, track in drive.actors.tracks.items()},
        recorded=facts.ego,
        plans=tuple(drive.plans),
        events=tuple(drive.events),
        status="failed" if error else "ok",
        error=error,
        first_closed_loop_us=drive.first_closed_us,
    )


@dataclass(frozen=True)
class Timeline:
    """Times of a rollout: states from ``start_us`` to ``end_us`` (both included) every 0.1 s."""

    start_us: int
    first_closed_us: int
    end_us: int
    clipped: str = ""


def timeline(scenario: Scenario, facts: SceneFacts) -> Timeline:
    """Clips a scenario to the recording, as AlpaSim does: a log that ends early ends the rollout.

    Raises:
        ScenarioError: the scenario starts after the end of the recording.
    """
    # ``span_us`` is half-open, while a state at the last microsecond of the ego trajectory still has a pose.
    begin = max(facts.span_us[0], facts.ego.start_us)
    last = min(facts.span_us[1] - 1, facts.ego.end_us)
    start = begin + _us(scenario.start_s)
    if start > last:
        raise ScenarioError(
            f"scenario '{scenario.name}' starts {scenario.start_s:g} s into scene '{facts.id}', "
            f"which lasts {max(0, last - begin) / 1e6:.1f} s"
        )
    wanted = start + _us(scenario.duration_s)
    end = start + (min(wanted, last) - start) // STATE_US * STATE_US
    text = f"the recording ends {(end - start) / 1e6:.1f} s after the start; duration_s is {scenario.duration_s:g}"
    return Timeline(start, min(start + _us(scenario.warm_up_s), end), end, text if end < wanted else "")


def start_offset(perturbation: Perturbation, scene_id: str, seed: int) -> tuple[float, float, float]:
    """Lateral offset (m), yaw offset (rad) and speed factor of the initial state, from scene and seed only."""
    # Philox is counter-based and keyed by (scene, seed), so the sample does not depend on the order of the rollouts.
    key = int.from_bytes(hashlib.sha256(f"{scene_id}/start".encode()).digest()[:8], "little")
    lateral, yaw, speed = np.random.Generator(np.random.Philox(key=[key, seed])).standard_normal(3)
    return (
        float(lateral) * perturbation.lateral_m,
        float(yaw) * math.radians(perturbation.yaw_deg),
        max(0.0, 1 + float(speed) * perturbation.speed_fraction),
    )


class _Failure(Exception):
    """Ends a rollout as failed."""

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind, self.text = kind, text


@contextmanager
def _failing_as(kind: str) -> Iterator[None]:
    """Converts any exception into a failure of this rollout; other rollouts continue."""
    try:
        yield
    except _Failure:
        raise
    except PolicyError as error:
        raise _Failure("policy_error", str(error)) from error
    except Exception as error:
        raise _Failure(kind, described(error)) from error


class _Drive:
    """The mutable state of one rollout."""

    def __init__(
        self, scenario: Scenario, policy: Policy, sense: Sense, facts: SceneFacts, seed: int,
        progress: Callable[[float], None], on_frames: OnFrames | None,
    ) -> None:  # fmt: skip
        self.scenario, self.policy, self.sense, self.facts, self.seed = scenario, policy, sense, facts, seed
        self.progress, self.on_frames = progress, on_frames
        self.recorded = RecordedDrive(facts.ego)
        self.actors = Actors(facts.tracks, {})
        self.limits = VehicleLimits()
        self.states: list[EgoState] = []
        self.plans: list[tuple[int, Plan]] = []
        self.events: list[Event] = []
        self.first_closed_us = facts.ego.start_us
        self.offset = np.eye(4)
        self.trace: list[
            tuple[int, VehicleState]
        ] = []  # every tick of the closed loop, for exposures that started earlier
        self.station_m = 0.0

    def note(self, kind: str, text: str) -> None:
        """Record an event at the last state."""
        t_us = self.states[-1].t_us if self.states else self.facts.ego.start_us
        self.events.append(Event(t_us, kind, text))

    def run(self) -> None:
        """Warm-up, then closed loop to the end of the scenario."""
        try:
            times = timeline(self.scenario, self.facts)
            self.actors = edited_actors(
                self.scenario, self.facts.id, self.facts.ego, self.facts.tracks, times.start_us, self.seed
            )
        except ScenarioError as error:
            self.states.append(self.logged_state(self.facts.ego.start_us))
            raise _Failure("scenario_error", str(error)) from None
        # The offset is in the rig frame (right-multiplied), so the whole warm-up runs beside the log, without a jump
        # when the policy takes over.
        lateral, yaw, speed_factor = start_offset(self.scenario.perturbation, self.facts.id, self.seed)
        self.offset = geometry.pose_from_xyyaw(0.0, lateral, yaw)
        self.first_closed_us = times.first_closed_us
        for t_us in range(times.start_us, times.first_closed_us + 1, STATE_US):
            self.states.append(self.logged_state(t_us))
        if times.clipped:
            self.events.append(Event(times.end_us, "clipped", times.clipped))
        try:
            suite = SensorSuite(self.policy.needs, self.scenario.sensors, self.facts)
        except ScenarioError as error:
            raise _Failure("sensor_missing", f"policy '{self.policy.name}': {error}") from None
        except Exception as error:  # needs with invalid types
            raise _Failure("policy_error", f"its needs cannot be met: {described(error)}") from error
        with _failing_as("policy_error"):
            self.policy.reset(self.facts.rig, self.seed)
        self.closed_loop(suite, times, speed_factor)
        self.progress(1.0)

    def closed_loop(self, suite: SensorSuite, times: Timeline, speed_factor: float) -> None:
        """Sense, plan and track until the end, or until the policy requests a stop."""
        car = self.car_at_start(speed_factor)
        if speed_factor != 1.0:
            # The policy must observe the perturbed speed, so the last logged state is replaced.
            self.states[-1] = self.state_of(times.first_closed_us, car)
        self.trace.append((times.first_closed_us, car))
        track = CONTROLLERS[self.scenario.controller]
        replan_us = _us(self.scenario.replan_s)
        sense_us = _us(self.scenario.sensors.interval_s or self.scenario.replan_s)
        path, planned_us, driven_m = None, times.first_closed_us, 0.0
        for t_us in range(times.first_closed_us, times.end_us, TICK_US):
            elapsed_us = t_us - times.first_closed_us
            plans_now = elapsed_us % replan_us == 0
            if plans_now or elapsed_us % sense_us == 0:
                frames = self.render(suite, t_us)
            if plans_now:
                self.progress((t_us - times.start_us) / max(1, times.end_us - times.start_us))
                plan = self.ask(suite, t_us, frames)
                self.plans.append((t_us, plan))
                if plan.stop_session:
                    self.note("stop_session", f"policy '{self.policy.name}' requested a stop")
                    return
                path, planned_us, driven_m = PlannedPath(plan, car, t_us), t_us, 0.0
            assert path is not None
            # Arc length actually driven, for the integral part of the speed control.
            car, before = track(path, car, t_us - planned_us, driven_m, self.limits), car
            driven_m += math.hypot(car.x_m - before.x_m, car.y_m - before.y_m)
            self.trace.append((t_us + TICK_US, car))
            if (elapsed_us + TICK_US) % STATE_US == 0:
                self.states.append(self.state_of(t_us + TICK_US, car))

    # ------------------------------------------------------------------------------------------- one plan

    def render(self, suite: SensorSuite, t_us: int) -> dict[str, SensorFrame]:
        """Renders the current frames."""
        with _failing_as("sense_error"):
            frames = suite.sense(self.sense, t_us, self.pose_at, self.actors.overrides)
        if self.on_frames is not None and frames:
            self.on_frames(t_us, frames)
        return frames

    def ask(self, suite: SensorSuite, t_us: int, frames: Mapping[str, SensorFrame]) -> Plan:
        """The policy's validated plan at ``t_us``."""
        observation = self.observe(suite, t_us, frames)
        try:
            return self.policy.plan(observation)
        except PlanError as error:
            kind = "policy_error" if isinstance(error, PolicyError) else "plan_error"
            raise _Failure(kind, str(error)) from None

    def observe(self, suite: SensorSuite, t_us: int, frames: Mapping[str, SensorFrame]) -> Observation:
        """The policy's observation at ``t_us``."""
        ego, car = self.states[-1], self.trace[-1][1]
        cameras, lidars = suite.for_policy(frames)
        route, route_speed = self.recorded.route(car.x_m, car.y_m, car.yaw_rad, self.station_m)
        future_t_us, future = self.recorded.future(t_us, car.x_m, car.y_m, car.yaw_rad)
        actors = self.actors.seen_from(t_us, ego.world_from_rig) if self.policy.needs.privileged else None
        history = tuple(self.states[-HISTORY_STATES:])
        return Observation(
            t_us, ego, history, cameras, lidars, route, route_speed, future_t_us, future, actors
        )  # fmt: skip

    # ------------------------------------------------------------------------------------------- the ego

    def logged_state(self, t_us: int) -> EgoState:
        """The recorded ego state, with the initial offset applied."""
        speed, accel, yaw_rate = self.recorded.motion(t_us)
        # Inverse bicycle model; below 0.5 m/s the yaw rate is mostly noise and the quotient meaningless.
        steering = math.atan(yaw_rate * self.limits.wheelbase_m / speed) if speed > 0.5 else 0.0
        steering = min(max(steering, -self.limits.steering_rad), self.limits.steering_rad)
        return EgoState(t_us, self.facts.ego.at(t_us) @ self.offset, speed, accel, yaw_rate, steering)

    def car_at_start(self, speed_factor: float) -> VehicleState:
        """The car state at the end of the warm-up."""
        last = self.states[-1]
        x, y = last.world_from_rig[:2, 3]
        self.station_m = self.recorded.station(x, y, near_m=self.recorded.station_of_time(last.t_us))
        yaw = float(geometry.yaw_of(last.world_from_rig))
        return VehicleState(
            float(x), float(y), yaw, last.speed_mps * speed_factor, last.accel_mps2, last.steering_rad
        )  # fmt: skip

    def state_of(self, t_us: int, car: VehicleState) -> EgoState:
        """The car as a state on the ground; also advances the station on the recorded path."""
        self.station_m = self.recorded.station(car.x_m, car.y_m, near_m=self.station_m)
        pose = self.recorded.on_ground(car.x_m, car.y_m, car.yaw_rad, self.station_m)
        rate = car.yaw_rate_radps(self.limits)
        return EgoState(t_us, pose, car.speed_mps, car.accel_mps2, rate, car.steering_rad)

    def pose_at(self, t_us: int) -> Matrix4:
        """Rig pose at a past time: from the ticks of the closed loop, before that from the log."""
        if t_us == self.states[-1].t_us:
            return self.states[-1].world_from_rig
        if t_us < self.first_closed_us:
            return self.facts.ego.at(t_us) @ self.offset
        # Linear between ticks of 10 ms: the deviation from the arc, a_lat dt^2 / 8, is below 0.2 mm at 10 m/s^2.
        index, rest_us = divmod(t_us - self.first_closed_us, TICK_US)
        before = self.trace[index][1]
        after = self.trace[min(index + 1, len(self.trace) - 1)][1]
        f = rest_us / TICK_US
        x, y = before.x_m + f * (after.x_m - before.x_m), before.y_m + f * (after.y_m - before.y_m)
        yaw = before.yaw_rad + f * (after.yaw_rad - before.yaw_rad)
        return self.recorded.on_ground(x, y, yaw, self.recorded.station(x, y, near_m=self.station_m))


def _us(seconds: float) -> int:
    return int(round(seconds * 1e6))
