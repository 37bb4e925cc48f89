"""A remote policy: any driver with AlpaSim's egodriver interface, in our loop.

The session opens with the first plan of a rollout, for only then it is known which images are rendered.
"""

from __future__ import annotations

import uuid
import weakref
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import grpc

from nurec_sim.errors import PlanError, RequestError, ScenarioError, ServerError
from nurec_sim.files.closing import Closing
from nurec_sim.render.images.encode import encode_image
from nurec_sim.serving.connection import channel_options
from nurec_sim.serving.wire import common, driving, driving_paths, driving_states, egodriver
from nurec_sim.types import CameraFrame, Needs, Observation, Plan, Rig

SCHEME = "grpc"
OTHER_NEEDS = Needs(cameras=("front",), image_width_px=512)
"""Default for drivers that do not report their needs: AlpaSim sends them the front camera."""
MAX_TIMEOUT_S = 3600.0
_REPEATABLE = ("get_policy", "get_version", "submit_image_observation", "submit_egomotion_observation",
               "submit_route", "submit_recording_ground_truth", "submit_lidar_observation",
               "submit_actor_observation")  # fmt: skip
"""Idempotent calls, which may be retried; ``start_session`` and ``drive`` are not."""
_RETRY = {
    "maxAttempts": 3, "initialBackoff": "0.1s", "maxBackoff": "1s", "backoffMultiplier": 2.0,
    "retryableStatusCodes": ["UNAVAILABLE"],
}  # fmt: skip
_HANG_UP_S = 2.0


class RemotePolicy(Closing):
    """A driver at ``host:port`` as a policy.

    Drivers of this package report their needs; for others name the cameras. A driver that cannot be
    reached, dies, or refuses raises, so that the rollout becomes a failed one.

    Args:
        address: ``host:port``.
        cameras: camera ids or ``front``; None for those that the driver reports, or ``front`` if it reports none.
        lidars: LiDAR ids or ``any``; only drivers of ours take sweeps.
        image_width_px: of the rendered images.
        timeout_s: for one call.
        connect_timeout_s: for a driver that is starting.

    Raises:
        ServerError: the driver cannot be reached in time.
        ScenarioError: ``lidars`` for a driver that takes none.
    """

    def __init__(
        self,
        address: str,
        cameras: Sequence[str] | None = None,
        *,
        lidars: Sequence[str] | None = None,
        image_width_px: int | None = None,
        timeout_s: float = 60.0,
        connect_timeout_s: float = 10.0,
    ) -> None:
        self.address, self._timeout_s = address, timeout_s
        self._channel = grpc.insecure_channel(address, channel_options(_service_config()))
        self._calls = {
            name: self._channel.unary_unary(
                f"/{driving.DRIVER_SERVICE}/{name}", method.request.SerializeToString, method.reply.FromString
            )
            for name, method in driving.DRIVER_METHODS.items()
        }
        self._open_sessions: set[str] = set()
        # Also at the end of the process: a driver allows only so many sessions.
        self._hang_up = weakref.finalize(self, _hang_up, self._channel, self._calls, self._open_sessions)
        try:
            name, needs = self._description(connect_timeout_s)
        except BaseException:
            self.close()
            raise
        self.ours = name is not None
        if lidars and not self.ours:
            self.close()
            raise ScenarioError(f"driver {address} takes no LiDAR sweeps; only drivers of nurec_sim do")
        self.name = f"{name or 'driver'}@{address}"
        self.needs = replace(
            needs,
            cameras=needs.cameras if cameras is None else tuple(cameras),
            lidars=needs.lidars if lidars is None else tuple(lidars),
            image_width_px=image_width_px or needs.image_width_px,
        )
        self.reset(Rig({}, {}), 0)

    @classmethod
    def from_url(cls, url: str) -> RemotePolicy:
        """A driver by ``grpc://host:port``, with ``?cameras=a,b&lidars=any&width=512&timeout=60`` where needed.

        Raises:
            ScenarioError: the URL is malformed; the text says what is allowed.
            ServerError: the driver cannot be reached.
        """
        form = f"{SCHEME}://host:port?cameras=front&lidars=any&width=512&timeout=60"
        try:
            parts = urlsplit(url)
            given = dict(parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query)))
            complete = parts.scheme == SCHEME and parts.hostname and parts.port and not parts.path.strip("/")
            width, timeout_s = int(given.pop("width", 0)), float(given.pop("timeout", 60.0))
        except ValueError as error:
            raise ScenarioError(f"driver '{url}' must look like {form}: {error}") from None
        cameras, lidars = (
            tuple(filter(None, given.pop(name).split(","))) if name in given else None for name in ("cameras", "lidars")
        )
        if not complete or given or width < 0 or not 0 < timeout_s <= MAX_TIMEOUT_S:
            unknown = f"; unknown: {sorted(given)}" if given else ""
            raise ScenarioError(f"driver '{url}' must look like {form}{unknown}")
        return cls(parts.netloc, cameras, lidars=lidars, image_width_px=width or None, timeout_s=timeout_s)

    def close(self) -> None:
        """Ends open sessions and the connection."""
        self._hang_up()

    # ---------------------------------------------------------------------------------------------------------- policy

    def reset(self, rig: Rig, seed: int) -> None:
        """Ends the session of the last rollout; the next plan begins a new one."""
        for session_id in list(self._open_sessions):
            self._open_sessions.discard(session_id)
            with suppress(grpc.RpcError):  # it may have died with its driver, or expired
                self._calls["close_session"](
                    egodriver.DriveSessionCloseRequest(session_uuid=session_id), timeout=_HANG_UP_S
                )
        self._rig, self._seed = rig, seed
        self._session_id, self._sent_us = "", -1

    def plan(self, observation: Observation) -> Plan:
        """The driver's answer to an observation.

        Raises:
            PlanError: the driver's policy failed, or its plan is invalid.
            ServerError: the driver cannot be reached, refuses, or takes too long.
        """
        if not self._session_id:
            self._start(observation)
        self._together(self._submissions(observation))
        request = egodriver.DriveRequest(
            session_uuid=self._session_id, time_now_us=observation.t_us, time_query_us=observation.t_us
        )
        reply = self._outcome("drive", self._begin("drive", request))
        try:
            plan = driving_paths.read_plan(observation.ego, reply)
        except RequestError as error:
            raise PlanError(f"driver {self.address} returned an invalid plan: {error}") from None
        self._sent_us = observation.t_us
        return plan

    # --------------------------------------------------------------------------------------------------------- session

    def _start(self, observation: Observation) -> None:
        cameras = {frame.camera.id: frame.camera for frame in observation.cameras.values()}
        lidars = {frame.lidar.id: frame.lidar for frame in observation.lidars.values()}
        rig = Rig({**self._rig.cameras, **cameras}, {**self._rig.lidars, **lidars}, self._rig.body)
        names = {name: frame.camera.id for name, frame in observation.cameras.items()}
        names |= {name: frame.lidar.id for name, frame in observation.lidars.items()}
        session_id = str(uuid.uuid4())
        request = egodriver.DriveSessionRequest()
        driving.write_session_start(driving.SessionStart(session_id, self._seed, rig, names), request)
        self._open_sessions.add(session_id)
        self._outcome("start_session", self._begin("start_session", request))
        self._session_id = session_id

    def _submissions(self, observation: Observation) -> list[tuple[str, object]]:
        """Everything that the driver does not know yet, as (procedure, message)."""
        ego, session = observation.ego, {"session_uuid": self._session_id}
        states = [state for state in observation.history if state.t_us > self._sent_us]
        ego_message, route = egodriver.RolloutEgoTrajectory(**session), egodriver.RouteRequest(**session)
        driving_states.write_states([*(state for state in states if state.t_us < ego.t_us), ego], ego_message)
        driving_paths.write_route(ego, observation.route_m, observation.route_speed_mps, route.route)
        said: list[tuple[str, object]] = [("submit_egomotion_observation", ego_message), ("submit_route", route)]
        for frame in {frame.camera.id: frame for frame in observation.cameras.values()}.values():
            image = egodriver.RolloutCameraImage(**session)
            driving.write_encoded_image(_encoded(frame), image)
            said.append(("submit_image_observation", image))
        if not self.ours:
            return said
        recorded = egodriver.GroundTruthRequest(**session)
        driving_paths.write_recorded(ego, observation.recorded_t_us, observation.recorded_pose, recorded.ground_truth)
        said.append(("submit_recording_ground_truth", recorded))
        for sweep in {frame.lidar.id: frame for frame in observation.lidars.values()}.values():
            message = egodriver.RolloutLidarSweep(**session)
            driving.write_sweep(sweep, message)
            said.append(("submit_lidar_observation", message))
        if observation.actors is not None:
            actors = egodriver.RolloutActors(timestamp_us=observation.t_us, **session)
            driving.write_actors(observation.actors, actors)
            said.append(("submit_actor_observation", actors))
        return said

    # ----------------------------------------------------------------------------------------------------------- calls

    def _description(self, timeout_s: float) -> tuple[str | None, Needs]:
        """Name and needs of the driver's policy; no name if it is not one of ours."""
        try:
            call = self._calls["get_policy"]
            return driving.read_policy(call(common.Empty(), timeout=timeout_s, wait_for_ready=True))
        except grpc.RpcError as error:
            if error.code() is grpc.StatusCode.UNIMPLEMENTED:
                return None, OTHER_NEEDS
            raise self._failure("get_policy", error, timeout_s) from None

    def _begin(self, name: str, request) -> grpc.Future:
        return self._calls[name].future(request, timeout=self._timeout_s)

    def _together(self, said: Sequence[tuple[str, object]]) -> None:
        """Calls that do not wait for each other."""
        begun = [(name, self._begin(name, message)) for name, message in said]
        try:
            for name, call in begun:
                self._outcome(name, call)
        finally:
            for _, call in begun:
                call.cancel()  # without effect on those that are done

    def _outcome(self, name: str, call: grpc.Future):
        try:
            return call.result()
        except grpc.RpcError as error:
            raise self._failure(name, error, self._timeout_s) from None

    def _failure(self, name: str, error: grpc.RpcError, timeout_s: float) -> PlanError | ServerError:
        code, text = error.code(), error.details() or "no reason given"
        if code is grpc.StatusCode.ABORTED:
            return PlanError(f"driver {self.address}: {text}")
        what = {
            grpc.StatusCode.UNAVAILABLE: "cannot be reached",
            grpc.StatusCode.DEADLINE_EXCEEDED: f"did not answer within {timeout_s:g} s",
        }.get(code, "refused")
        return ServerError(f"driver {self.address} {what}: {name}: {code.name}: {text}")


def _encoded(frame: CameraFrame) -> driving.EncodedImage:
    """PNG: the driver sees the very pixels."""
    data = encode_image(frame.rgb, "png")
    return driving.EncodedImage(frame.camera.id, frame.start_us, frame.end_us, data, as_is=True)


def _hang_up(channel: grpc.Channel, calls: dict, session_ids: set[str]) -> None:
    for session_id in session_ids:
        with suppress(grpc.RpcError):
            calls["close_session"](egodriver.DriveSessionCloseRequest(session_uuid=session_id), timeout=_HANG_UP_S)
    session_ids.clear()
    channel.close()


def _service_config() -> dict[str, Any]:
    names = [{"service": driving.DRIVER_SERVICE, "method": name} for name in _REPEATABLE]
    return {"methodConfig": [{"name": names, "retryPolicy": _RETRY}]}
