"""A renderer for runs whose images are cheap and tell where they were taken."""

import numpy as np

from nurec_sim.types import CameraFrame


def striped(requests):
    """A renderer whose images tell time and place."""
    frames = []
    for request in requests:
        height, width = request.sensor.height_px, request.sensor.width_px
        shade = int(request.world_from_sensor[0, 0, 3] * 5) % 200
        rgb = np.full((height, width, 3), shade, np.uint8)
        rgb[: height // 2] = (120, 170, 230)
        frames.append(CameraFrame(request.sensor, request.start_us, request.end_us, rgb))
    return frames
