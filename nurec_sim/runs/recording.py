"""The videos of a run: of every rollout, and of the recorded drive beside them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from nurec_sim.errors import NurecSimError, WriteError
from nurec_sim.files.new_files import writing
from nurec_sim.metrics.offroad_grid import OffroadGrid
from nurec_sim.runs import folder as layout
from nurec_sim.runs.top_view import record_lidar, record_log_lidar
from nurec_sim.runs.video import WIDTH_PX, Picture, record_log, record_video
from nurec_sim.sim import Scenario
from nurec_sim.sim.actors import edited_actors
from nurec_sim.sim.policy_sensors import find_camera, find_lidar
from nurec_sim.sim.rollout import STATE_US, timeline
from nurec_sim.types import CameraFrame, Clip, GaussianScene, LidarFrame, Needs, Rollout, Sense, SensorFrame


class Recorder:
    """Keeps what a policy sees, as the loop's ``on_frames``, so that the videos do not render it again.

    Args:
        scene: what is driven in.
        scenario: its sensors and edited actors.
        needs: of the policy.
        grid: for off-road captions.
        with_lidar: also record the first LiDAR from above.
    """

    def __init__(
        self, scene: GaussianScene, scenario: Scenario, needs: Needs, grid: OffroadGrid | None, with_lidar: bool
    ) -> None:
        self._scene, self._scenario, self._needs, self._grid = scene, scenario, needs, grid
        self._camera = find_camera(scene.rig, "front")
        self._lidar = find_lidar(scene.rig, "any") if with_lidar and scene.rig.lidars else None
        self._images: dict[int, Picture] = {}
        self._sweeps: dict[int, LidarFrame] = {}

    def __call__(self, t_us: int, frames: Mapping[str, SensorFrame]) -> None:
        """Keeps the frames of one instant."""
        for frame in frames.values():
            if isinstance(frame, CameraFrame):
                if frame.camera.id == self._camera.id:
                    self._images[t_us] = frame.rgb
            elif self._lidar is not None and frame.lidar.id == self._lidar.id:
                self._sweeps[t_us] = frame

    @property
    def width_px(self) -> int:
        """Width of the video: as wide as the policy's images if it sees this camera."""
        if {"front", self._camera.id} & {*self._needs.cameras, *self._scenario.sensors.record_cameras}:
            return self._scenario.sensors.image_width_px or self._needs.image_width_px
        return min(WIDTH_PX, self._camera.width_px)

    def write(self, rollout: Rollout, sense: Sense, folder: Path, progress: Callable[[float], None]) -> None:
        """Writes the videos of a rollout; a renderer failure does not fail the rollout but is written as well.

        Args:
            rollout: the rollout.
            sense: renders what the policy did not see.
            folder: of the rollout.
            progress: called with the fraction done.
        """
        try:
            scene, start_us = self._scene, timeline(self._scenario, self._scene).start_us
            overrides = edited_actors(
                self._scenario, scene.id, scene.ego, scene.tracks, start_us, rollout.seed
            ).overrides
            with writing(folder / layout.VIDEO):
                record_video(
                    rollout, sense, self._camera, folder / layout.VIDEO, grid=self._grid, overrides=overrides,
                    width_px=self.width_px, show_ego=self._camera.id in self._scene.ego_images, seen=self._images,
                    progress=progress,
                )  # fmt: skip
            if self._lidar is not None:
                with writing(folder / layout.LIDAR):
                    record_lidar(rollout, sense, self._lidar, folder / layout.LIDAR, overrides, self._sweeps)
        except WriteError:
            raise
        except NurecSimError as error:
            for name in (layout.VIDEO, layout.LIDAR):
                (folder / name).unlink(missing_ok=True)
            (folder / layout.VIDEO_ERROR).write_text(f"{error}\n", encoding="utf-8")


def record_recording(clip: Clip, scene: GaussianScene, scenario: Scenario, folder: Path) -> None:
    """Writes videos of what the log recorded during a scenario, one frame per state.

    Args:
        clip: the log.
        scene: one of its reconstructions.
        scenario: the scenario.
        folder: of the scene in the run folder.
    """
    times = timeline(scenario, scene)
    states_us = np.arange(times.start_us, times.end_us + 1, STATE_US)
    with writing(folder / layout.RECORDED):
        if clip.rig.cameras:
            camera = find_camera(clip.rig, "front")
            record_log(clip, camera, states_us, folder / layout.RECORDED, min(WIDTH_PX, camera.width_px))
        if clip.rig.lidars:
            record_log_lidar(clip, find_lidar(clip.rig, "any"), states_us, folder / layout.RECORDED_LIDAR)
