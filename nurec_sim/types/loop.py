"""Data that the closed loop exchanges with policies, and its results."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import display
from nurec_sim.types.frames import CameraFrame, LidarFrame
from nurec_sim.types.sensors import Rig
from nurec_sim.types.trajectories import Matrix4, Trajectory


@dataclass(frozen=True)
class EgoState:
    """The ego vehicle at one instant: rig pose, speed and acceleration along x, yaw rate, front-wheel angle."""

    t_us: int
    world_from_rig: Matrix4
    speed_mps: float
    accel_mps2: float = 0.0
    yaw_rate_radps: float = 0.0
    steering_rad: float = 0.0


@dataclass(frozen=True)
class ActorState:
    """Ground truth of an actor, in the current rig frame. Only policies that declare ``privileged`` receive it."""

    id: str
    label: str
    size_m: tuple[float, float, float]
    rig_from_box: Matrix4
    velocity_mps: Float64[np.ndarray, " 2"]


@dataclass(frozen=True)
class Observation:
    """The input of a policy at ``t_us``.

    ``route_m`` has up to 20 waypoints over the next 80 m of the recorded path, in the rig frame; ``route_speed_mps``
    is the recorded speed at each. ``recorded_t_us`` and ``recorded_pose`` (x, y, yaw in the rig frame) are the recorded
    future, for log replay. ``actors`` is None unless the policy declared ``privileged``.
    """

    t_us: int
    ego: EgoState
    history: tuple[EgoState, ...]
    cameras: Mapping[str, CameraFrame]
    lidars: Mapping[str, LidarFrame]
    route_m: Float64[np.ndarray, "k 2"]
    route_speed_mps: Float64[np.ndarray, " k"]
    recorded_t_us: Int64[np.ndarray, " m"]
    recorded_pose: Float64[np.ndarray, "m 3"]
    actors: tuple[ActorState, ...] | None = None


@dataclass(frozen=True)
class Plan:
    """The output of a policy: poses (x, y, yaw) in the observation's rig frame, at increasing times after it.

    The horizon must be at least 2.5 s; 5 s are recommended. ``stop_session`` requests the end of the rollout.
    """

    t_us: Int64[np.ndarray, " k"]
    pose: Float64[np.ndarray, "k 3"]
    stop_session: bool = False


@dataclass(frozen=True)
class Needs:
    """The sensors that a policy reads; the loop renders no others.

    ``cameras`` and ``lidars`` are sensor ids of the rig, or the aliases ``front`` (the camera facing closest to
    forward), ``tele`` (its middle 30 degrees, or the rig's tele camera), ``left`` and ``right`` (60 degrees aside), and
    ``any`` (the first LiDAR). Images are rendered at ``image_width_px`` with the same field of view.
    """

    cameras: tuple[str, ...] = ()
    lidars: tuple[str, ...] = ()
    image_width_px: int = 320
    privileged: bool = False


class Policy(Protocol):
    """A driver. One instance drives one rollout at a time."""

    name: str
    needs: Needs

    def reset(self, rig: Rig, seed: int) -> None:
        """Clears all state for a new rollout."""
        ...

    def plan(self, observation: Observation) -> Plan:
        """Returns the trajectory to drive."""
        ...


@dataclass(frozen=True)
class Event:
    """An event in a rollout: ``kind`` such as ``plan_error`` or ``stop_session``, with a description."""

    t_us: int
    kind: str
    text: str = ""


@dataclass(frozen=True)
class Rollout:
    """One run of a policy through a scene.

    ``states`` are at 10 Hz; ``actors[id]`` holds ``world_from_box [t,4,4]`` at the same times, NaN while absent.
    ``status`` is ``ok`` or ``failed``; a failed rollout keeps its states up to the failure and its error text.
    """

    scenario: str
    scene_id: str
    reconstruction: str
    policy: str
    seed: int
    rig: Rig
    states: tuple[EgoState, ...]
    actors: Mapping[str, Float64[np.ndarray, "t 4 4"]]
    actor_sizes_m: Mapping[str, tuple[float, float, float]]
    actor_labels: Mapping[str, str]
    recorded: Trajectory
    plans: tuple[tuple[int, Plan], ...]
    events: tuple[Event, ...] = ()
    status: str = "ok"
    error: str = ""
    first_closed_loop_us: int = 0

    def __repr__(self) -> str:
        seconds = (self.states[-1].t_us - self.states[0].t_us) / 1e6 if self.states else 0.0
        counts = {"states": self.states, "plans": self.plans, "actors": self.actors, "events": self.events}
        return (
            f"Rollout of {self.policy!r} in {self.scene_id!r} ({self.reconstruction}), scenario {self.scenario!r}, "
            f"seed {self.seed}\n"
            f"  {self.status}{': ' if self.error else ''}{self.error.split(chr(10))[0]}; {seconds:.1f} s\n"
            f"  {', '.join(f'{len(items)} {name}' for name, items in counts.items())}"
        )

    def _repr_html_(self) -> str:
        """Result, events and the driven path beside the recorded one, for notebooks."""
        title, *facts = repr(self).split("\n")
        start_us = self.states[0].t_us if self.states else 0
        rows = [(fact.strip(), "") for fact in facts]
        rows += [(f"{(event.t_us - start_us) / 1e6:.1f} s: {event.kind}", event.text) for event in self.events]
        driven, recorded = self.world_from_rig[:, :2, 3], self.recorded.position_m[:, :2]
        lines = {"recorded": (recorded, "#94a3b8"), f"driven by {self.policy}": (driven, "#2563eb")}
        return display.table(title, rows) + display.paths(lines)

    @property
    def t_us(self) -> Int64[np.ndarray, " t"]:
        """Times of the states."""
        return np.array([state.t_us for state in self.states], dtype=np.int64)

    @property
    def world_from_rig(self) -> Float64[np.ndarray, "t 4 4"]:
        """Ego poses."""
        return np.array([state.world_from_rig for state in self.states], dtype=np.float64).reshape(-1, 4, 4)


class Reduce(enum.Enum):
    """Reduction of a series to one number."""

    MEAN = "mean"
    MEDIAN = "median"
    MAX = "max"
    MIN = "min"
    LAST = "last"


@dataclass(frozen=True)
class Series:
    """One metric over time. ``valid`` marks the values that could be computed; the others are ignored."""

    name: str
    unit: str
    t_us: Int64[np.ndarray, " t"]
    values: Float64[np.ndarray, " t"]
    valid: np.ndarray
    reduce: Reduce

    def __repr__(self) -> str:
        valid = f"{np.count_nonzero(self.valid)} of {len(self.valid)} valid"
        return f"Series({self.name!r}, {self.reduce.value} {self.value():.4g} {self.unit}, {valid})"

    def _repr_html_(self) -> str:
        """The reduced value and the valid values over time, for notebooks."""
        valid = np.asarray(self.valid, bool)
        row = (f"{self.value():.4g}", self.unit, self.reduce.value, f"{valid.sum()} of {len(valid)} values valid")
        drawn = display.spark(np.asarray(self.t_us, np.float64)[valid], np.asarray(self.values, np.float64)[valid])
        return display.table(self.name, [row]) + drawn

    def value(self) -> float:
        """The reduced series; NaN if no value is valid."""
        values = np.asarray(self.values, np.float64)[np.asarray(self.valid, bool)]
        if len(values) == 0:
            return float("nan")
        if self.reduce is Reduce.LAST:
            return float(values[-1])
        return float(getattr(np, self.reduce.value)(values))
