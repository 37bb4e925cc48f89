"""Single frames, for renderers that work on batches."""

from __future__ import annotations

import abc
from collections.abc import Sequence

from nurec_sim.render.requests import SENSED_OUTPUTS, check_camera_call, check_lidar_call
from nurec_sim.types import CameraFrame, LidarFilter, LidarFrame, SensorFrame, SensorRequest


class SingleFrames(abc.ABC):
    """``device.Renderer``'s two methods for one frame."""

    @abc.abstractmethod
    def _frames(
        self, requests: Sequence[SensorRequest], outputs: Sequence[str], filter: LidarFilter
    ) -> list[SensorFrame]:
        """Frames of requests whose outputs have been checked.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``.
        """

    def render_camera(self, request: SensorRequest, outputs: Sequence[str] = SENSED_OUTPUTS) -> CameraFrame:
        """A camera frame with ``rgb`` and those of depth, alpha, label and normal that ``outputs`` names.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``; or an unknown output.
        """
        check_camera_call(request, outputs)
        frame = self._frames([request], outputs, LidarFilter())[0]
        assert isinstance(frame, CameraFrame)
        return frame

    def render_lidar(self, request: SensorRequest, filter: LidarFilter | None = None) -> LidarFrame:
        """A sweep: the beams that return by ``filter`` (``LidarFilter()`` if None); see ``spec.sweep_frame``.

        Raises:
            RequestError, OutOfRangeError, TooLargeError: see ``requests.check_request``.
        """
        check_lidar_call(request)
        frame = self._frames([request], (), filter or LidarFilter())[0]
        assert isinstance(frame, LidarFrame)
        return frame
