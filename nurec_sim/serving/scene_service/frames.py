"""Camera frames with geometry and labels, and sweeps as range maps."""

from __future__ import annotations

from contextlib import ExitStack

from nurec_sim.errors import RequestError
from nurec_sim.serving import wire
from nurec_sim.serving.sensor_service import SensorService
from nurec_sim.serving.sensor_service.rendering import BYTES_A_POINT
from nurec_sim.serving.wire import nurec_sim_v1 as v1

_BYTES_A_BEAM = 8  # range and intensity


class Frames:
    """Renders as the sensor service does, in its queue and with its limits.

    Args:
        sensors: admits requests and renders.
    """

    def __init__(self, sensors: SensorService) -> None:
        self._sensors = sensors

    async def camera(self, message):
        """A ``RenderCameraReply``."""
        outputs = wire.outputs_of(message.outputs)
        if not message.HasField("request"):
            raise RequestError("request is missing: the camera frame to render")
        asked = message.request
        if "rgb" not in outputs:  # without rgb its format is not checked
            asked = type(asked).FromString(asked.SerializeToString())
            asked.image_format = wire.ImageFormat.PNG
        with ExitStack() as held:
            job = await self._sensors.admit_camera(asked, held)
            size = wire.bytes_a_pixel(outputs) * job.pixels + ("rgb" in outputs) * job.planar_bytes
            self._sensors.check_reply(size, "pixels", "or smaller images, or for fewer outputs")

            def render():
                (frame,) = job.loaded.renderer.sense([job.request], outputs)
                reply = v1.RenderCameraReply()
                wire.write_outputs(frame, reply)
                if "rgb" in outputs:
                    (image,) = self._sensors.images.of([frame], [job.options])
                    if isinstance(image, Exception):
                        raise image
                    reply.rgb = image.image_bytes
                return reply

            with self._sensors.spending(job.pixels):
                return await self._sensors.renders.run(job.pixels, render)

    async def lidar(self, message):
        """A ``RenderLidarReply``."""
        if not message.HasField("request"):
            raise RequestError("request is missing: the sweep to render")
        if message.form not in list(wire.SweepForm):
            known = ", ".join(f"{form.name} ({form.value})" for form in wire.SweepForm)
            raise RequestError(f"form must be one of {known}; got {message.form}")
        as_map = message.form == wire.SweepForm.RANGE_MAP
        with ExitStack() as held:
            job = await self._sensors.admit_lidar(message.request, held)
            self._sensors.check_reply((_BYTES_A_BEAM if as_map else BYTES_A_POINT) * job.beams, "sweep", "beams")

            def render():
                reply = v1.RenderLidarReply()
                if as_map:
                    wire.write_range_map(job.render(), reply.range_map)
                else:
                    wire.write_lidar_frame(job.render(), reply.points)
                return reply

            with self._sensors.spending(job.beams):
                return await self._sensors.renders.run(job.beams, render)
