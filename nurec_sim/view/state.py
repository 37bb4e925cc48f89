"""What one browser tab looks at, as a value that is replaced by every change."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Set
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from nurec_sim import geometry
from nurec_sim.render.images.still import Layer
from nurec_sim.sim.actors import HIDDEN_BELOW_M
from nurec_sim.types import Matrix4, Rollout, Track
from nurec_sim.view.sources import Opened, World

NO_LIDAR, RECORDED_LIDAR = "none", "recorded"


@dataclass(frozen=True, eq=False)
class View:
    """Everything that a picture depends on.

    Attributes:
        t_us: the instant.
        size_px: width and height of the browser's canvas.
        world: index of the world that is shown; ``other`` that on the right of the wipe, None for no comparison.
        wipe: where the wipe line is, 0 at the left to 1 at the right.
        camera: id of a camera of the rig, with its lens and shutter; None for the free camera.
        browser_from_eye: pose of the free camera in the browser's frame; ``fov_rad`` its vertical field of view.
        follow: whether the browser's frame moves with the car.
        ego_offset: the car's pose in the frame of its recorded (or driven) pose.
        offsets: by track, its pose in the frame of its recorded pose; ``hidden`` tracks are left out.
        layer: what is shown of the rendering.
        apply_isp: whether the cameras' colour correction is applied.
        recorded: how recorded images are shown; ``blend`` is their weight.
        lidar: ``none``, ``recorded``, a LiDAR of the rig, or the name of a beam table.
        boxes, names: whether actors have boxes, and their ids and labels beside them.
        route: whether recorded and driven paths and plans are shown.
        rollout: name of the rollout that is shown; None for the recording.
        splats: whether the browser draws Gaussians itself instead of the renderer's picture.
        moving: whether the camera or anything else is moving, so that a coarse picture will do.
    """

    t_us: int
    size_px: tuple[int, int] = (640, 360)
    world: int = 0
    other: int | None = None
    wipe: float = 0.5
    camera: str | None = None
    browser_from_eye: Matrix4 = field(default_factory=lambda: np.eye(4))
    fov_rad: float = 1.0
    follow: bool = True
    ego_offset: Matrix4 = field(default_factory=lambda: np.eye(4))
    offsets: Mapping[str, Matrix4] = field(default_factory=dict)
    hidden: Set[str] = frozenset()
    layer: Layer = "rgb"
    apply_isp: bool = True
    recorded: Literal["off", "beside", "blend"] = "off"
    blend: float = 0.5
    lidar: str = NO_LIDAR
    boxes: bool = False
    names: bool = False
    route: bool = True
    rollout: str | None = None
    splats: bool = False
    moving: bool = False


class Stage:
    """Where everything is at a view's time: the car, the actors, the browser's frame."""

    def __init__(self, opened: Opened) -> None:
        self.opened = opened
        first = opened.worlds[0]
        # Browsers compute in single precision: far from the origin, their frame begins where the drive does.
        self._origin = geometry.pose(np.eye(3), np.round(first.ego.position_m[0]))

    def world(self, view: View) -> World:
        """The world that is shown."""
        return self.opened.worlds[view.world]

    def rollout(self, view: View) -> Rollout | None:
        """The rollout that is shown."""
        return None if view.rollout is None else self.opened.rollouts[view.rollout]

    def times_us(self, view: View) -> tuple[int, int]:
        """First and last time of the rollout that is shown, or of all worlds."""
        rollout = self.rollout(view)
        if rollout is not None:
            return rollout.states[0].t_us, rollout.states[-1].t_us
        spans = [world.times_us for world in self.opened.worlds]
        return max(start for start, _ in spans), min(end for _, end in spans)

    def ego(self, view: View, t_us: int | np.ndarray) -> np.ndarray:
        """Poses of the rig in the world at times: driven or recorded, moved by the view's offset."""
        rollout = self.rollout(view)
        if rollout is not None:
            return geometry.interpolate_poses(rollout.t_us, rollout.world_from_rig, t_us)
        return self.world(view).ego.at(t_us) @ view.ego_offset

    def world_from_browser(self, view: View) -> Matrix4:
        """The browser's frame: fixed, or with the car's place and heading, but level."""
        if not view.follow:
            return self._origin
        rollout = self.rollout(view)
        # Without the offset: dragging the car must not drag the camera along.
        car = self.ego(view, view.t_us) if rollout else self.world(view).ego.at(view.t_us)
        return geometry.pose_from_xyyaw(car[0, 3], car[1, 3], float(geometry.yaw_of(car)), car[2, 3])

    def tracks(self, view: View) -> dict[str, Track]:
        """Tracks that exist at the view's time, by id."""
        return {track.id: track for track in self.world(view).tracks if self.recorded_box(view, track) is not None}

    def recorded_box(self, view: View, track: Track, t_us: int | None = None) -> Matrix4 | None:
        """Pose of a track's box as recorded, or in the rollout; None where it is absent."""
        t_us = view.t_us if t_us is None else t_us
        rollout = self.rollout(view)
        if rollout is not None and track.id in rollout.actors:
            poses = rollout.actors[track.id]
            known = np.isfinite(poses[:, 0, 0])
            times = rollout.t_us[known]
            if len(times) == 0 or not times[0] <= t_us <= times[-1]:
                return None
            return geometry.interpolate_poses(times, poses[known], t_us)
        single = len(track.path.t_us) == 1
        return track.path.at(t_us) if single or track.path.covers(t_us) else None

    def box(self, view: View, track: Track, t_us: int | None = None) -> Matrix4 | None:
        """Pose of a track's box, moved by the view's offset; None where it is absent or hidden."""
        recorded = self.recorded_box(view, track, t_us)
        if recorded is None or track.id in view.hidden:
            return None
        return recorded @ view.offsets[track.id] if track.id in view.offsets else recorded

    def overrides(self, view: View, start_us: int, end_us: int) -> dict[str, np.ndarray]:
        """Actor poses for a request, [2,4,4] each: those that are not where they were recorded."""
        rollout = self.rollout(view)
        result = {}
        for track in self.world(view).tracks:
            driven = rollout is not None and track.id in rollout.actors
            if not (driven or track.id in view.offsets or track.id in view.hidden):
                continue
            first, last = self.box(view, track, start_us), self.box(view, track, end_us)
            if first is not None and last is not None:
                result[track.id] = np.stack([first, last])
            else:  # a request cannot remove an actor: it is placed out of sight
                gone = track.path.at(np.array([start_us, end_us]))
                gone[:, 2, 3] -= HIDDEN_BELOW_M
                result[track.id] = gone
        return result


class Session:
    """The view of one browser tab, changed by callbacks and read by the drawing thread; thread-safe."""

    def __init__(self, view: View) -> None:
        self._view = view
        self._changed = threading.Condition()
        self._version = 0
        self._moved_s = 0.0
        self.playing = False

    @property
    def view(self) -> View:
        """The current view."""
        return self._view

    @property
    def version(self) -> int:
        """Number of changes so far."""
        return self._version

    @property
    def still_s(self) -> float:
        """Seconds since something last moved."""
        return time.monotonic() - self._moved_s

    def change(self, moving: bool = False, **values: Any) -> View:
        """Replaces fields of the view; ``moving`` says that more changes will follow at once."""
        with self._changed:
            self._view = replace(self._view, **values)
            self._version += 1
            if moving:
                self._moved_s = time.monotonic()
            self._changed.notify_all()
            return self._view

    def wait(self, seen: int, timeout_s: float) -> bool:
        """Waits until there are more than ``seen`` changes; False if there were none in time."""
        with self._changed:
            return self._changed.wait_for(lambda: self._version != seen, timeout_s)
