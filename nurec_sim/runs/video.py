"""H.264 videos of a rollout: its front camera with captions, its LiDAR from above, and what the log recorded."""

from __future__ import annotations

import itertools
import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from nurec_sim.errors import RequestError
from nurec_sim.metrics.collision import find_contacts
from nurec_sim.metrics.offroad import RoadState, judge_footprints
from nurec_sim.metrics.offroad_grid import OffroadGrid
from nurec_sim.sensors import pixel_rays, project, scaled_camera
from nurec_sim.sim.policy_sensors import policy_camera
from nurec_sim.types import CameraFrame, CameraModel, Clip, Rollout, Sense, SensorRequest

WIDTH_PX = 480
FRAMES_PER_CALL = 4
FRAMES_PER_S = 10
CODEC_OPTIONS = {"preset": "veryfast", "crf": "24", "threads": "1", "mbtree": "0"}
"""One thread; no macroblock-tree rate control, as x264's reads memory it never wrote: bytes vary between runs."""
WAITING_PICTURES = 2 * FRAMES_PER_CALL
"""Pictures that may wait for the encoder."""
Overrides = Callable[[int, int], Mapping[str, Float64[np.ndarray, "2 4 4"]]]
Picture = UInt8[np.ndarray, "h w 3"]


def record_video(
    rollout: Rollout,
    sense: Sense,
    camera: CameraModel,
    path: Path | str,
    *,
    grid: OffroadGrid | None = None,
    overrides: Overrides | None = None,
    width_px: int = WIDTH_PX,
    show_ego: bool = False,
    seen: Mapping[int, Picture] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Path:
    """Renders a camera at every state of a rollout and encodes the video deterministically.

    Args:
        rollout: the rollout.
        sense: the renderer.
        camera: a camera of the rig, rendered as policies see it: an ideal pinhole, ``width_px`` wide.
        path: the ``.mp4`` to write.
        grid: for off-road captions.
        overrides: actor poses at (start_us, end_us); default: actors of the rollout.
        width_px: width of the images; the video is one pixel smaller where a side is odd.
        show_ego: whether the scene's image of the ego vehicle is put over the images.
        seen: images of that camera and width that the policy got, by time in microseconds; they are not rendered again.
        progress: called with the fraction done.

    Raises:
        RequestError: the rollout has no states, or the renderer returns unexpected frames.
    """
    if not rollout.states:
        raise RequestError("a rollout without states has no video")
    camera = policy_camera(camera, width_px)
    captions = _captions(rollout, grid)

    def pictures() -> Iterator[Picture]:
        def request(index: int) -> SensorRequest:
            return _request(rollout, index, camera, overrides, show_ego)

        images = _rendered(rollout, sense, camera, request, seen or {})
        for index, (image, caption) in enumerate(zip(images, captions, strict=True)):
            yield _captioned(_even(image), *caption)
            if progress is not None:
                progress((index + 1) / len(captions))

    write_video(path, pictures())
    return Path(path)


def record_log(clip: Clip, camera: CameraModel, states_us: Int64[np.ndarray, " t"], path: Path, width_px: int) -> None:
    """The recorded images nearest in time, as the ideal pinhole of ``record_video``.

    Args:
        clip: the log.
        camera: one of its cameras.
        states_us: times of the rollouts' states.
        path: the ``.mp4`` to write; not written if the camera has no image.
        width_px: width of the images.
    """
    import cv2

    target = policy_camera(camera, width_px)
    # Downsampled first, since sampling at single points would alias.
    share = min(1.0, width_px / camera.width_px)
    small = scaled_camera(camera, round(camera.width_px * share), round(camera.height_px * share))
    rays, _ = pixel_rays(target)
    place, valid = project(small, rays.reshape(-1, 3))
    # OpenCV puts the centre of the first pixel at 0, we at 0.5.
    place = np.where(valid[:, None], place - 0.5, -1).astype(np.float32).reshape(*rays.shape[:2], 2)
    times = clip.camera_times_us(camera.id).mean(axis=1)

    def pictures() -> Iterator[Picture]:
        for t_us in states_us if len(times) else ():
            image = clip.image(camera.id, int(np.abs(times - t_us).argmin()))
            image = cv2.resize(image, (small.width_px, small.height_px), interpolation=cv2.INTER_AREA)
            image = cv2.remap(image, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            yield _captioned(_even(image), f"recorded  {(t_us - states_us[0]) / 1e6:4.1f} s", "")

    write_video(path, pictures())


def write_video(target: Path | str | BinaryIO, pictures: Iterable[Picture], frames_per_s: int = FRAMES_PER_S) -> None:
    """Encodes pictures of one even size as an MP4; encoding runs in a thread beside whatever makes the pictures.

    Only in files given by their path the index comes first, so that players begin before all is loaded.
    """
    waiting: queue.Queue[Picture | None] = queue.Queue(WAITING_PICTURES)
    failed: list[BaseException] = []

    def work() -> None:
        sent = _until_none(waiting)
        try:
            _encode(str(target) if isinstance(target, (Path, str)) else target, sent, frames_per_s)
        except BaseException as error:  # raised again by the caller's thread
            failed.append(error)
            for _ in sent:  # so that the caller never waits for room; none are left if the end was what failed
                pass

    encoder = threading.Thread(target=work, name="video", daemon=True)
    encoder.start()
    try:
        for picture in pictures:
            waiting.put(picture)
    finally:
        waiting.put(None)
        encoder.join()
    if failed:
        raise failed[0]


def _encode(target: str | BinaryIO, pictures: Iterator[Picture], frames_per_s: int) -> None:
    import av

    # Nothing is written without a picture: an MP4 needs one for its size.
    first = next(pictures, None)
    if first is None:
        return
    # To put the index in front, the muxer opens the finished file again, by name.
    options = {"movflags": "+faststart"} if isinstance(target, str) else {}
    with av.open(target, "w", format="mp4", options=options) as container:
        stream = container.add_stream("libx264", rate=frames_per_s, options=CODEC_OPTIONS)
        stream.height, stream.width = first.shape[:2]
        stream.pix_fmt, stream.time_base = "yuv420p", Fraction(1, frames_per_s)
        for index, picture in enumerate(itertools.chain([first], pictures)):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame.pts = index
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _until_none(waiting: queue.Queue[Picture | None]) -> Iterator[Picture]:
    while (picture := waiting.get()) is not None:
        yield picture


def _rendered(
    rollout: Rollout,
    sense: Sense,
    camera: CameraModel,
    request: Callable[[int], SensorRequest],
    seen: Mapping[int, Picture],
) -> Iterator[Picture]:
    """The camera's image at every state."""
    times = [state.t_us for state in rollout.states]
    size = (camera.height_px, camera.width_px, 3)
    for first in range(0, len(times), FRAMES_PER_CALL):
        indices = range(first, min(first + FRAMES_PER_CALL, len(times)))
        missing = [index for index in indices if times[index] not in seen]
        frames = list(sense([request(index) for index in missing])) if missing else []
        if len(frames) != len(missing):
            raise RequestError(f"the renderer returned {len(frames)} frames for {len(missing)} requests")
        new: dict[int, Picture] = {}
        for index, frame in zip(missing, frames, strict=True):
            if not isinstance(frame, CameraFrame) or frame.rgb.shape != size:
                raise RequestError(f"expected an image of {size[1]}x{size[0]}, got {_described(frame)}")
            new[index] = frame.rgb
        yield from (new[index] if index in new else seen[times[index]] for index in indices)


def _even(image: Picture) -> Picture:
    """Without the last row or column where a side is odd: chroma subsampling needs even sides."""
    return image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2]


def _described(frame: object) -> str:
    return f"one of {frame.rgb.shape}" if isinstance(frame, CameraFrame) else type(frame).__name__


def _request(
    rollout: Rollout, index: int, camera: CameraModel, overrides: Overrides | None, show_ego: bool = False
) -> SensorRequest:
    t_us = rollout.states[index].t_us
    pose = rollout.states[index].world_from_rig @ camera.rig_from_camera
    if overrides is not None:
        actors = dict(overrides(t_us, t_us))
    else:
        poses = {actor: path[index] for actor, path in rollout.actors.items()}
        actors = {actor: np.stack([at, at]) for actor, at in poses.items() if np.isfinite(at).all()}
    return SensorRequest(rollout.scene_id, camera, t_us, t_us + 1, np.stack([pose, pose]), actors, show_ego=show_ego)


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


def _captioned(rgb: Picture, text: str, alarm: str) -> Picture:
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
