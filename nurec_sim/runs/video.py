"""H.264 videos of a rollout's front camera with captions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from nurec_sim.errors import RequestError
from nurec_sim.metrics.collision import find_contacts
from nurec_sim.metrics.offroad import RoadState, judge_footprints
from nurec_sim.metrics.offroad_grid import OffroadGrid
from nurec_sim.sensors import scaled_camera
from nurec_sim.types import CameraFrame, CameraModel, Rollout, Sense, SensorRequest

FRAMES_PER_CALL = 4
FRAMES_PER_S = 10
CODEC_OPTIONS = {"preset": "veryfast", "crf": "24", "threads": "1"}
Overrides = Callable[[int, int], Mapping[str, Float64[np.ndarray, "2 4 4"]]]


def record_video(
    rollout: Rollout,
    sense: Sense,
    camera: CameraModel,
    path: Path | str,
    *,
    grid: OffroadGrid | None = None,
    overrides: Overrides | None = None,
    width_px: int = 480,
    progress: Callable[[float], None] | None = None,
) -> Path:
    """Renders a camera at every state of a rollout and encodes the video deterministically.

    Args:
        rollout: the rollout.
        sense: the renderer.
        camera: a camera of the rig, rendered at ``width_px`` with even sides.
        path: the ``.mp4`` to write.
        grid: for off-road captions.
        overrides: actor poses at (start_us, end_us); default: actors of the rollout.
        width_px: width of the video.
        progress: called with the fraction done.

    Raises:
        RequestError: the rollout has no states, or the renderer returns unexpected frames.
    """
    import av

    if not rollout.states:
        raise RequestError("a rollout without states has no video")
    width = max(16, width_px // 2 * 2)
    height = max(16, round(width * camera.height_px / camera.width_px / 2) * 2)
    camera = scaled_camera(camera, width, height)
    captions = _captions(rollout, grid)
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=FRAMES_PER_S, options=CODEC_OPTIONS)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.time_base = Fraction(1, FRAMES_PER_S)
        for first in range(0, len(rollout.states), FRAMES_PER_CALL):
            indices = range(first, min(first + FRAMES_PER_CALL, len(rollout.states)))
            requests = [_request(rollout, index, camera, overrides) for index in indices]
            frames = list(sense(requests))
            if len(frames) != len(requests):
                raise RequestError(f"the renderer returned {len(frames)} frames for {len(requests)} requests")
            for index, frame in zip(indices, frames, strict=True):
                if not isinstance(frame, CameraFrame) or frame.rgb.shape != (height, width, 3):
                    raise RequestError(f"expected an image of {width}x{height}, got {_described(frame)}")
                picture = av.VideoFrame.from_ndarray(_captioned(frame.rgb, *captions[index]), format="rgb24")
                picture.pts = index
                container.mux(stream.encode(picture))
            if progress is not None:
                progress((indices[-1] + 1) / len(rollout.states))
        container.mux(stream.encode())
    return Path(path)


def _described(frame: object) -> str:
    return f"one of {frame.rgb.shape}" if isinstance(frame, CameraFrame) else type(frame).__name__


def _request(rollout: Rollout, index: int, camera: CameraModel, overrides: Overrides | None) -> SensorRequest:
    t_us = rollout.states[index].t_us
    pose = rollout.states[index].world_from_rig @ camera.rig_from_camera
    if overrides is not None:
        actors = dict(overrides(t_us, t_us))
    else:
        poses = {actor: path[index] for actor, path in rollout.actors.items()}
        actors = {actor: np.stack([at, at]) for actor, at in poses.items() if np.isfinite(at).all()}
    return SensorRequest(rollout.scene_id, camera, t_us, t_us + 1, np.stack([pose, pose]), actors)


def _captions(rollout: Rollout, grid: OffroadGrid | None) -> list[tuple[str, str]]:
    """Caption and alarm text (possibly empty) per state."""
    t_us = rollout.t_us
    alarms: list[list[str]] = [[] for _ in t_us]
    for contact in find_contacts(rollout):
        for index in np.flatnonzero(t_us >= contact.t_us):
            alarms[index].append(f"COLLISION {contact.side}")
    if grid is not None:
        verdicts = judge_footprints(grid, rollout.world_from_rig, rollout.rig.body).verdict
        for state, verdict in enumerate(verdicts):
            if verdict != RoadState.ON and t_us[state] >= rollout.first_closed_loop_us:
                alarms[state].append("OFF ROAD" if verdict == RoadState.OFF else "road unknown")
    plain = [
        f"{rollout.policy}  {(t - t_us[0]) / 1e6:4.1f} s  {state.speed_mps:4.1f} m/s"
        + ("" if t >= rollout.first_closed_loop_us else "  (log)")
        for t, state in zip(t_us, rollout.states, strict=True)
    ]
    return [(text, "  ".join(dict.fromkeys(alarm))) for text, alarm in zip(plain, alarms, strict=True)]


def _captioned(rgb: UInt8[np.ndarray, "h w 3"], text: str, alarm: str) -> UInt8[np.ndarray, "h w 3"]:
    """The image with a dark bar at the bottom: caption on the left, alarm on the right."""
    import cv2

    picture = np.ascontiguousarray(rgb).copy()
    height, width = picture.shape[:2]
    scale, font = max(width / 1000, 0.3), cv2.FONT_HERSHEY_SIMPLEX
    bar = int(34 * scale) + 4
    picture[height - bar :] = picture[height - bar :] // 4
    base = (int(8 * scale), height - int(11 * scale) - 1)
    cv2.putText(picture, text, base, font, 0.8 * scale, (255, 255, 255), 1, cv2.LINE_AA)
    if alarm:
        alarm_width = cv2.getTextSize(alarm, font, 0.8 * scale, 1)[0][0]
        corner = (width - alarm_width - int(8 * scale), base[1])
        cv2.putText(picture, alarm, corner, font, 0.8 * scale, (255, 170, 80), 1, cv2.LINE_AA)
    return picture
