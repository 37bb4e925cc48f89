"""The observations of one session, and what its policy sees of them at a given time.

Observations may come in any order and more than once; the newest that is not later than the time of the question
counts. The car is where its newest ego pose says, so a plan is one of that time, and nothing is extrapolated.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry
from nurec_sim.errors import RequestError, ScenarioError, SessionError, TooLargeError
from nurec_sim.serving.driver.images import image_size, see_image
from nurec_sim.serving.driver.motion import ego_states
from nurec_sim.serving.wire.driving import EncodedImage, SessionStart
from nurec_sim.serving.wire.driving_paths import Placed, RecordedFuture, RouteWaypoints, moved
from nurec_sim.serving.wire.driving_states import ReportedState
from nurec_sim.sim.policy_sensors import find_camera, find_lidar
from nurec_sim.types import ActorState, EgoState, LidarFrame, Needs, Observation, Rig, Trajectory

MAX_AGE_US = 1_000_000
"""Oldest pose, image or sweep that a plan may be based on."""
KEPT_FRAMES, KEPT_STATES, MAX_SESSION_BYTES = 4, 2000, 256 << 20
HISTORY_STATES, HISTORY_STEP_US, STEP_SLACK_US = 21, 100_000, 5_000
FUTURE_STEP_US, FUTURE_POINTS = 100_000, 50


@dataclass(frozen=True)
class Question:
    """All that a policy needs for one plan; images still as they came."""

    ego: EgoState
    history: tuple[EgoState, ...]
    images: Mapping[str, EncodedImage]
    sweeps: Mapping[str, LidarFrame]
    route: tuple[RouteWaypoints, Placed] | None
    recorded: tuple[RecordedFuture, Placed] | None
    actors: tuple[ActorState, ...] | None


class Session:
    """What a client has submitted in one session.

    Args:
        start: sensors, outline and names of the client.
        needs: what the policy reads.
        route_speed_mps: speed along routes that come without one.
    """

    def __init__(self, start: SessionStart, needs: Needs, route_speed_mps: float) -> None:
        self.start, self.needs, self.route_speed_mps = start, needs, route_speed_mps
        self._states: list[ReportedState] = []
        self._images: dict[str, list[EncodedImage]] = {}
        self._sweeps: dict[str, list[LidarFrame]] = {}
        self._route: RouteWaypoints | None = None
        self._recorded: RecordedFuture | None = None
        self._actors: tuple[int, tuple[ActorState, ...]] | None = None

    # ------------------------------------------------------------------------------------------------- what comes in

    def add_states(self, states: list[ReportedState]) -> None:
        """Ego states; one at a time that is known already replaces it."""
        by_time = {state.t_us: state for state in (*self._states, *states)}
        self._states = [by_time[t_us] for t_us in sorted(by_time)][-KEPT_STATES:]

    def add_image(self, image: EncodedImage) -> None:
        """A camera image; one without bytes, as of a client whose renderer is switched off, is none.

        Raises:
            RequestError: no such camera, or no image.
            TooLargeError: too many pixels, or too many bytes in this session.
        """
        if image.camera_id not in self.start.rig.cameras:
            raise RequestError(
                f"camera {image.camera_id!r} is not of this session; have {sorted(self.start.rig.cameras)}"
            )
        if not image.data:
            return
        image_size(image.data, f"the image of camera {image.camera_id!r}")
        images = self._images | {image.camera_id: _with(self._images.get(image.camera_id, []), image)}
        _check_room(images, self._sweeps)
        self._images = images

    def add_sweep(self, frame: LidarFrame) -> None:
        """A LiDAR sweep.

        Raises:
            TooLargeError: too many bytes in this session.
        """
        sweeps = self._sweeps | {frame.lidar.id: _with(self._sweeps.get(frame.lidar.id, []), frame)}
        _check_room(self._images, sweeps)
        self._sweeps = sweeps

    def set_route(self, route: RouteWaypoints) -> None:
        """The way ahead; replaces the last one."""
        self._route = route

    def set_recorded(self, recorded: RecordedFuture) -> None:
        """The log's own future; replaces the last one."""
        self._recorded = recorded

    def set_actors(self, t_us: int, actors: tuple[ActorState, ...]) -> None:
        """True actors; replace the last ones."""
        self._actors = (t_us, actors)

    # ------------------------------------------------------------------------------------------------ what is asked

    def question(self, now_us: int) -> Question:
        """What is known at ``now_us``; quick, nothing is decoded.

        Raises:
            SessionError: no ego pose, or an image, sweep or actors that the policy needs have not come or are too old.
        """
        last = bisect_right(self._states, now_us, key=lambda state: state.t_us)
        if last == 0:
            first = f"; the first one is of {self._states[0].t_us}" if self._states else ""
            raise SessionError(f"no ego pose up to time_now_us {now_us} has been submitted{first}")
        states = self._states[:last]
        _check_age("the newest ego pose", states[-1].t_us, now_us)
        history = tuple(ego_states(states, _history(states)))
        images = {
            name: _newest(f"camera {name!r}", self._frames_of_camera(name), now_us) for name in self.needs.cameras
        }
        sweeps = {name: _newest(f"LiDAR {name!r}", self._frames_of_lidar(name), now_us) for name in self.needs.lidars}
        route, recorded = self._route, self._recorded
        return Question(
            history[-1],
            history,
            images,
            sweeps,
            None if route is None else (route, _state_at(states, route.t_us)),
            None if recorded is None else (recorded, _state_at(states, recorded.t_us)),
            self._actors_of(now_us) if self.needs.privileged else None,
        )

    def observation(self, question: Question) -> Observation:
        """The question as the policy sees it: images decoded and rectified. May run in any thread.

        Raises:
            RequestError: an image is damaged or its camera cannot be rectified, or the car lies on its side.
        """
        ego, cameras = question.ego, self.start.rig.cameras
        frames = {
            name: see_image(image, cameras[image.camera_id], self.needs.image_width_px)
            for name, image in question.images.items()
        }
        route_m, route_speed = np.zeros((0, 2)), np.zeros(0)
        if question.route is not None:
            route, then = question.route
            above = route.seen_from_above(then)
            route_m = moved(np.column_stack([above, np.zeros(len(above))]), then, ego)[:, :2]
            given = route.speed_mps
            route_speed = np.full(len(route_m), self.route_speed_mps) if given is None else given
        future_t_us, future = np.zeros(0, np.int64), np.zeros((0, 3))
        if question.recorded is not None:
            recorded, then = question.recorded
            future_t_us, future = _future(recorded.pose_t_us, moved(recorded.seen_from_above(then), then, ego), ego)
        return Observation(
            ego.t_us, ego, question.history, frames, question.sweeps, route_m, route_speed, future_t_us, future,
            question.actors,
        )  # fmt: skip

    def _frames_of_camera(self, name: str) -> list[EncodedImage]:
        """Images of the policy's camera ``name``: mapped by the client, else one of those that send images."""
        seen = {camera_id: camera for camera_id, camera in self.start.rig.cameras.items() if camera_id in self._images}
        try:
            camera_id = self.start.sensor_ids.get(name) or find_camera(Rig(seen, {}), name).id
        except ScenarioError:
            raise SessionError(
                f"the policy needs camera {name!r}, of which no image has been submitted; have {sorted(seen)}"
            ) from None
        return self._images.get(camera_id, [])

    def _frames_of_lidar(self, name: str) -> list[LidarFrame]:
        seen = {lidar_id: lidar for lidar_id, lidar in self.start.rig.lidars.items() if lidar_id in self._sweeps}
        try:
            lidar_id = self.start.sensor_ids.get(name) or find_lidar(Rig({}, seen), name).id
        except ScenarioError:
            raise SessionError(
                f"the policy needs LiDAR {name!r}, of which no sweep has been submitted; have {sorted(seen)}. "
                "Only clients of nurec_sim submit sweeps"
            ) from None
        return self._sweeps.get(lidar_id, [])

    def _actors_of(self, now_us: int) -> tuple[ActorState, ...]:
        if self._actors is None:
            raise SessionError("the policy reads true actors (privileged); only clients of nurec_sim submit them")
        _check_age("the newest set of actors", self._actors[0], now_us)
        return self._actors[1]


def _with(frames: list, frame) -> list:
    """Frames in order of time with one more; one that ends at the same time is replaced, the oldest are dropped."""
    kept = [other for other in frames if other.end_us != frame.end_us]
    insort(kept, frame, key=lambda other: other.end_us)
    return kept[-KEPT_FRAMES:]


def _check_room(images: Mapping[str, list[EncodedImage]], sweeps: Mapping[str, list[LidarFrame]]) -> None:
    """Refuses what would take more memory than a session may have."""
    held = sum(len(image.data) for kept in images.values() for image in kept)
    for sweep in (sweep for kept in sweeps.values() for sweep in kept):
        held += sum(values.nbytes for values in (sweep.xyz_m, sweep.range_m, sweep.intensity, sweep.beam))
    if held > MAX_SESSION_BYTES:
        raise TooLargeError(f"a session may hold {MAX_SESSION_BYTES} bytes of images and sweeps, got {held}")


def _newest(name: str, frames: list, now_us: int):
    """The newest frame that is over by now; an instant [t, t + 1) is over at t."""
    past = [frame for frame in frames if frame.end_us <= now_us + 1]
    if not past:
        raise SessionError(f"no frame of {name} up to time_now_us {now_us} has been submitted")
    _check_age(f"the newest frame of {name}", past[-1].end_us, now_us)
    return past[-1]


def _check_age(name: str, t_us: int, now_us: int) -> None:
    if now_us - t_us > MAX_AGE_US:
        raise SessionError(
            f"{name} is {(now_us - t_us) / 1e6:.3f} s older than time_now_us {now_us}; "
            f"at most {MAX_AGE_US / 1e6:g} s are allowed"
        )


def _history(states: list[ReportedState]) -> list[int]:
    """Which states are those of the last 2 s at about 10 Hz, the present last."""
    kept = [len(states) - 1]
    for index in range(len(states) - 2, -1, -1):
        if len(kept) == HISTORY_STATES:
            break
        if states[kept[-1]].t_us - states[index].t_us >= HISTORY_STEP_US - STEP_SLACK_US:
            kept.append(index)
    return kept[::-1]


def _state_at(states: list[ReportedState], t_us: int) -> ReportedState:
    """The car at a time of a route (0: now), between the poses where it has to be."""
    if t_us == 0 or t_us >= states[-1].t_us:
        return states[-1]
    after = bisect_right(states, t_us, key=lambda state: state.t_us)
    if after == 0 or states[after - 1].t_us == t_us:
        return states[max(after - 1, 0)]
    between = states[after - 1 : after + 1]
    path = Trajectory(np.array([s.t_us for s in between]), np.array([s.world_from_rig for s in between]))
    return replace(between[0], t_us=t_us, world_from_rig=path.at(t_us))


def _future(
    t_us: Int64[np.ndarray, " n"], xyyaw: Float64[np.ndarray, "n 3"], ego: EgoState
) -> tuple[Int64[np.ndarray, " m"], Float64[np.ndarray, "m 3"]]:
    """The recorded poses every 0.1 s of the next 5 s, as the loop gives them to policies."""
    times = ego.t_us + FUTURE_STEP_US * np.arange(1, FUTURE_POINTS + 1, dtype=np.int64)
    times = times[times <= t_us[-1]] if len(t_us) else times[:0]
    at = np.searchsorted(t_us, times)
    if np.array_equal(t_us[at], times):
        return times, xyyaw[at]
    since, wanted = (t_us - ego.t_us).astype(np.float64), (times - ego.t_us).astype(np.float64)
    yaw = np.interp(wanted, since, np.unwrap(xyyaw[:, 2]))
    place = [np.interp(wanted, since, xyyaw[:, i]) for i in range(2)]
    return times, np.column_stack([*place, geometry.wrap_angle(yaw)])
