"""Videos of a LiDAR from above: the car drives to the right, colours are heights."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry
from nurec_sim.errors import RequestError
from nurec_sim.runs.video import Overrides, Picture, write_video
from nurec_sim.types import Box, Clip, LidarFrame, LidarModel, Rollout, Sense, SensorRequest

AHEAD_M, BEHIND_M, BESIDE_M = 50.0, 20.0, 17.5
PIXELS_PER_M = 6
EVERY_STATES = 5
"""One sweep per half second; pictures between repeat it."""
GROUND_M, TALL_M = 0.3, 4.0
BACKGROUND, GROUND, EGO = (15, 23, 42), (71, 85, 105), (96, 165, 250)


def record_lidar(
    rollout: Rollout, sense: Sense, lidar: LidarModel, path: Path, overrides: Overrides,
    seen: Mapping[int, LidarFrame],
) -> None:  # fmt: skip
    """Simulates sweeps along a rollout and encodes them as seen from above.

    Args:
        rollout: the rollout.
        sense: the renderer.
        lidar: a LiDAR of the rig.
        path: the ``.mp4`` to write.
        overrides: poses of edited actors at (start_us, end_us).
        seen: sweeps of that LiDAR that the policy got, by time in microseconds; they are not simulated again.
    """

    def pictures() -> Iterator[Picture]:
        picture = None
        for index, state in enumerate(rollout.states):
            if picture is None or index % EVERY_STATES == 0:
                t_us, pose = state.t_us, state.world_from_rig @ lidar.rig_from_lidar
                frame: object = seen.get(t_us)
                if frame is None:
                    request = SensorRequest(
                        rollout.scene_id, lidar, t_us, t_us + 1, np.stack([pose, pose]), dict(overrides(t_us, t_us))
                    )
                    (frame,) = sense([request])
                if not isinstance(frame, LidarFrame):
                    raise RequestError(f"expected a sweep of {lidar.id!r}, got {type(frame).__name__}")
                picture = draw_points(geometry.transform_points(lidar.rig_from_lidar, frame.xyz_m), rollout.rig.body)
            yield picture

    write_video(path, pictures())


def record_log_lidar(clip: Clip, lidar: LidarModel, states_us: Int64[np.ndarray, " t"], path: Path) -> None:
    """The recorded sweeps nearest in time, as ``record_lidar`` shows simulated ones.

    Args:
        clip: the log.
        lidar: one of its LiDARs.
        states_us: times of the rollouts' states.
        path: the ``.mp4`` to write; not written if the log has no sweep.
    """
    times = clip.sweep_times_us(lidar.id).mean(axis=1)

    def pictures() -> Iterator[Picture]:
        picture = None
        for index, t_us in enumerate(states_us if len(times) else ()):
            if picture is None or index % EVERY_STATES == 0:
                sweep = clip.sweep(lidar.id, int(np.abs(times - t_us).argmin()))
                rig_from_world = geometry.inverse(clip.ego.at(int(t_us)))
                picture = draw_points(geometry.transform_points(rig_from_world, sweep.xyz_world_m), clip.rig.body)
            yield picture

    write_video(path, pictures())


def draw_points(xyz_rig_m: Float64[np.ndarray, "n 3"], body: Box) -> Picture:
    """Points from above, ground grey and higher points coloured by height, with the car's outline."""
    size = round((AHEAD_M + BEHIND_M) * PIXELS_PER_M), round(2 * BESIDE_M * PIXELS_PER_M)
    picture = np.full((size[1], size[0], 3), BACKGROUND, np.uint8)
    # Low points first, so that an obstacle is not hidden by the ground below it.
    points = xyz_rig_m[np.argsort(xyz_rig_m[:, 2], kind="stable")]
    palette = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
    place = np.floor(_pixels(points)).astype(np.int64)
    inside = ((place >= 0) & (place < size)).all(axis=1)
    place, height = place[inside], points[inside, 2]
    share = np.clip((height - GROUND_M) / (TALL_M - GROUND_M), 0, 1)
    colours = palette[np.rint(60 + 195 * share).astype(np.uint8)]
    colours[height < GROUND_M] = GROUND
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        picture[np.minimum(place[:, 1] + down, size[1] - 1), np.minimum(place[:, 0] + right, size[0] - 1)] = colours
    corners = geometry.box_corners_xy(geometry.pose(np.eye(3), np.array(body.center_m)), *body.size_m[:2])
    cv2.polylines(picture, [np.rint(_pixels(corners)).astype(np.int32)], True, EGO, 1, cv2.LINE_AA)
    return picture


def _pixels(points: Float64[np.ndarray, "n _"]) -> Float64[np.ndarray, "n 2"]:
    return np.column_stack([(points[:, 0] + BEHIND_M) * PIXELS_PER_M, (BESIDE_M - points[:, 1]) * PIXELS_PER_M])
