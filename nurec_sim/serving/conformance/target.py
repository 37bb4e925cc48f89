"""The server under test: calls to it, and plain requests that any server should answer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import grpc
import numpy as np
from jaxtyping import Float64, UInt8

from nurec_sim.errors import ServerError
from nurec_sim.files.closing import Closing
from nurec_sim.files.decoding import TooMuchError, check_image
from nurec_sim.serving import wire
from nurec_sim.serving.wire import ImageFormat, sensorsim
from nurec_sim.serving.wire.requests import write_poses
from nurec_sim.types import Matrix4, Trajectory

HEIGHT_PX = 90
CONNECT_S = 5.0
"""For the connection; a server that listens takes a moment, whatever it has to load."""


class Failed(Exception):
    """A rule is broken; the text says how."""


class Skipped(Exception):
    """A rule does not apply, or cannot be seen; the text says why."""


def expect(condition: object, text: str) -> None:
    """Ends a check as failed unless ``condition`` holds; ``text`` says what was seen and what was expected."""
    if not condition:
        raise Failed(text)


class Target(Closing):
    """One scene of a server.

    Use it as a context manager, or call ``close``.

    Args:
        address: ``host:port``, plain text.
        scene_id: which scene; the first one listed if empty.
        timeout_s: for one call; the first may have to load the scene.
        allow_changes: whether checks may edit the scene for a moment, which other clients would see.
    """

    def __init__(
        self, address: str, scene_id: str = "", *, timeout_s: float = 120.0, allow_changes: bool = False
    ) -> None:
        self.address, self.timeout_s, self.allow_changes = address, timeout_s, allow_changes
        self._wanted = scene_id
        self.channel = grpc.insecure_channel(
            address,
            options=[
                ("grpc.max_receive_message_length", wire.MAX_MESSAGE_BYTES),
                ("grpc.max_send_message_length", wire.MAX_MESSAGE_BYTES),
                ("grpc.enable_http_proxy", 0),
            ],
        )

    def connect(self, timeout_s: float = CONNECT_S) -> None:
        """Waits until something listens at the address.

        Raises:
            ServerError: nothing does.
        """
        try:
            grpc.channel_ready_future(self.channel).result(timeout=timeout_s)
        except grpc.FutureTimeoutError:
            raise ServerError(
                f"no gRPC server without TLS answers at {self.address} within {timeout_s:g} s; is it running there?"
            ) from None

    def close(self) -> None:
        """Ends the connection."""
        self.channel.close()

    # ----------------------------------------------------------------------------------------------------------- calls

    def call(self, name: str, request: Any = None, **options: Any) -> Any:
        """The reply of a procedure; arguments as for ``begin``.

        Raises:
            grpc.RpcError: the server refuses it.
        """
        return self.begin(name, request, **options).result()

    def begin(
        self,
        name: str,
        request: Any = None,
        *,
        path: str = wire.SERVICE,
        metadata: Sequence[tuple[str, str]] = (),
        timeout_s: float | None = None,
    ) -> Any:
        """Starts a call.

        Args:
            name: the procedure.
            request: a message, its bytes, or None for an empty message.
            path: the service name in the URL of the call.
            metadata: (key, value) pairs that are sent with it.
            timeout_s: time limit; the target's own if None.
        """
        method = wire.METHODS[name]
        data = request if isinstance(request, bytes) else (request or method.request()).SerializeToString()
        procedure = self.channel.unary_unary(f"/{path}/{name}", response_deserializer=method.reply.FromString)
        return procedure.future(data, timeout=timeout_s or self.timeout_s, metadata=metadata, wait_for_ready=True)

    def refused(self, name: str, request, *codes: grpc.StatusCode) -> str:
        """The status and text with which a request is refused; fails if it is accepted, or refused otherwise."""
        wanted = " or ".join(code.name for code in codes) or "any error"
        try:
            self.call(name, request)
        except grpc.RpcError as error:
            if not codes or error.code() in codes:
                return f"{error.code().name}: {error.details()}"
            raise Failed(f"expected {wanted}, got {error.code().name}: {error.details()}") from error
        raise Failed(f"expected {wanted}, but it was accepted")

    # ----------------------------------------------------------------------------------------------------------- scene

    @cached_property
    def scene_id(self) -> str:
        """Id of the scene under test."""
        if self._wanted:
            return self._wanted
        ids = self.call("get_available_scenes").scene_ids
        if not ids:
            raise Skipped("the server lists no scenes; name one")
        return ids[0]

    @cached_property
    def cameras(self) -> list:
        """The ``AvailableCamera`` messages of the scene."""
        request = sensorsim.AvailableCamerasRequest(scene_id=self.scene_id)
        return list(self.call("get_available_cameras", request).available_cameras)

    @cached_property
    def path(self) -> Trajectory:
        """The recorded path of the rig in the world."""
        request = sensorsim.AvailableTrajectoriesRequest(scene_id=self.scene_id)
        found = self.call("get_available_trajectories", request).available_trajectories
        expect(found, "the scene has no trajectory")
        return wire.read_trajectory(found[0].trajectory, "trajectory")

    @cached_property
    def tracks(self) -> list:
        """The ``DynamicObjectTrack`` messages of the scene; skips the check where the server does not list them."""
        request = sensorsim.DynamicObjectsRequest(scene_id=self.scene_id)
        try:
            return list(self.call("get_dynamic_objects", request).dynamic_objects)
        except grpc.RpcError as error:
            if error.code() == grpc.StatusCode.UNIMPLEMENTED:
                raise Skipped("the server does not list its dynamic objects") from error
            raise

    @property
    def middle_us(self) -> int:
        """An instant in the middle of the path."""
        return (self.path.start_us + self.path.end_us) // 2

    # -------------------------------------------------------------------------------------------------------- requests

    def camera(self, number: int = 0):
        """One of the scene's cameras."""
        expect(self.cameras, "the scene has no cameras")
        return self.cameras[number % len(self.cameras)]

    def world_from_camera(self, camera, t_us: int) -> Matrix4:
        """Pose of a camera of the rig at a time."""
        mounting = camera.rig_to_camera
        return self.path.at(t_us) @ wire.read_mounting(mounting, f"rig_to_camera of {camera.logical_id!r}")

    def request(self, camera=None, t_us: int | None = None, image_format: int = ImageFormat.PNG):
        """A small picture of a camera at an instant, by its native intrinsics; nothing but published fields."""
        camera = camera or self.camera()
        t_us = self.middle_us if t_us is None else t_us
        message = sensorsim.RGBRenderRequest(
            scene_id=self.scene_id,
            resolution_h=HEIGHT_PX,
            resolution_w=self.width(camera.intrinsics),
            frame_start_us=t_us,
            frame_end_us=t_us + 1,
            image_format=image_format,
            image_quality=95,
        )
        message.camera_intrinsics.CopyFrom(camera.intrinsics)
        place(message.sensor_pose, self.world_from_camera(camera, t_us))
        return message

    @staticmethod
    def width(intrinsics, height: int = HEIGHT_PX) -> int:
        """Width at which a picture of some height keeps the aspect ratio."""
        return max(1, height * intrinsics.resolution_w // max(intrinsics.resolution_h, 1))

    def picture(self, request) -> UInt8[np.ndarray, "h w 3"]:
        """The decoded picture of a request for PNG or JPEG."""
        return decode(self.call("render_rgb", request).image_bytes)

    def changed(self, *changes: Callable) -> UInt8[np.ndarray, "h w 3"]:
        """The picture of the plain request after some changes to it."""
        request = self.request()
        for change in changes:
            change(request)
        return self.picture(request)


def decode(data: bytes) -> UInt8[np.ndarray, "h w 3"]:
    """Pixels of an image file."""
    import cv2

    try:
        if data.startswith((b"\x89PNG", b"\xff\xd8")):  # OpenCV bounds others itself, less tightly
            check_image(data)
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    except TooMuchError as error:
        raise Failed(f"a picture {error}") from None
    except (ValueError, cv2.error):
        image = None
    if image is None:
        raise Failed(f"{len(data)} bytes came that are no image; they begin with {data[:8]!r}")
    return image[:, :, ::-1]


def difference(one: np.ndarray, other: np.ndarray) -> float:
    """Mean absolute difference of two pictures in 8-bit steps."""
    expect(one.shape == other.shape, f"pictures of one size were expected, got {one.shape[:2]} and {other.shape[:2]}")
    return float(np.abs(one.astype(float) - other).mean())


def place(message, start: Matrix4, end: Matrix4 | None = None) -> None:
    """Fills a ``PosePair`` with published fields only; both poses are the same if no end is given."""
    poses: Float64[np.ndarray, "2 4 4"] = np.stack([start, start if end is None else end])
    message.Clear()
    write_poses(poses, [message.start_pose, message.end_pose])
    for pose in (message.start_pose, message.end_pose):
        pose.ClearField("exact")


def unit_error(quats: Sequence) -> float:
    """How far the squared norms of quaternion messages are from 1, at most."""
    return max((abs(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z - 1) for q in quats), default=0.0)
