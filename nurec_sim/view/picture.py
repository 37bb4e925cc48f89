"""Pictures of views: rendered worlds, recorded images, and what is drawn over them."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
from jaxtyping import Float64, UInt8

from nurec_sim import geometry, sensors
from nurec_sim.errors import NurecSimError
from nurec_sim.logs.overlay import draw_box, draw_lines, draw_points
from nurec_sim.render.images.still import picture, tinted
from nurec_sim.render.support import MAP_PX, VIEW_PX, Support
from nurec_sim.types import CameraFrame, CameraModel, LidarFrame, LidarModel, SensorRequest
from nurec_sim.view.camera import recorded_index, request_of
from nurec_sim.view.rollouts import caption, events_of, lines_of
from nurec_sim.view.sources import Opened
from nurec_sim.view.state import NO_LIDAR, RECORDED_LIDAR, Stage, View

BOX_RGB, SELECTED_RGB = (255, 255, 255), (255, 210, 60)
RECORDED_RGB, DRIVEN_RGB, PLAN_RGB = (200, 200, 200), (80, 150, 255), (60, 230, 120)
ROOF_M = 1.9
"""Height of a LiDAR from a beam table, for cars without a LiDAR."""
NAMES_WITHIN_M = 60.0
"""Names farther away would hide one another."""
COARSE_STEP = 4
"""While the camera moves, one of so many LiDAR points is drawn."""
RECORDED_PATH_STEP_US = 100_000

Image = UInt8[np.ndarray, "h w 3"]


def lidar_names(opened: Opened) -> list[str]:
    """What LiDAR points can be shown: none, recorded ones, those of the rig's LiDARs, those of any beam table."""
    rig = opened.worlds[0].rig
    recorded = [RECORDED_LIDAR] if opened.clip is not None and opened.clip.rig.lidars else []
    return [NO_LIDAR, *recorded, *rig.lidars, *(name for name in sensors.LIDAR_TABLES if name not in rig.lidars)]


class Painter:
    """Paints views; safe to use from many threads.

    Args:
        opened: worlds, log and rollouts.
    """

    def __init__(self, opened: Opened) -> None:
        self.opened, self.stage = opened, Stage(opened)
        self.events = {name: events_of(rollout) for name, rollout in opened.rollouts.items()}
        self._sweeps: dict[tuple, Float64[np.ndarray, "n 3"]] = {}
        self._supports: dict[int, Support] = {}
        self._supports_lock = threading.Lock()
        self._lock = threading.Lock()

    def paint(self, view: View, scale: float = 1.0, selected: str | None = None) -> Image:
        """The picture of a view, of the canvas' aspect ratio.

        Args:
            view: what is looked at.
            scale: fraction of the full number of pixels to each side; see ``camera.request_of``.
            selected: a track whose box is highlighted.

        Raises:
            NurecSimError: the renderer or the server cannot do it.
        """
        shown, request = self._drawn_over(view, scale, selected)
        if view.other is not None:
            second, _ = self._drawn_over(replace(view, world=view.other), scale, selected)
            shown = _wiped(shown, second, view.wipe)
        recorded = self._recorded(view, shown.shape)
        if recorded is not None and view.recorded == "blend":
            mixed = shown * (1 - view.blend) + recorded * view.blend
            shown = np.rint(mixed).astype(np.uint8)
        elif recorded is not None:
            stacked = view.size_px[0] < 2 * view.size_px[1] * shown.shape[1] / shown.shape[0]
            shown = np.concatenate([shown, recorded], axis=0 if stacked else 1)
        if (rollout := self.stage.rollout(view)) is not None:
            _write(shown, caption(rollout, self.events[view.rollout or ""], view.t_us))
        return _padded(shown, view.size_px) if view.camera is not None else shown

    def _drawn_over(self, view: View, scale: float, selected: str | None) -> tuple[Image, SensorRequest]:
        """One world's rendering with points, boxes and paths."""
        world, request = self.stage.world(view), request_of(self.stage, view, scale)
        layer = view.layer if view.layer in world.layers else "rgb"
        outputs = ("rgb",) if layer in ("rgb", "support") else ("rgb", layer)
        (frame,) = world.sense([request], outputs)
        assert isinstance(frame, CameraFrame)
        if layer == "support":
            # Recorded views are compared with at VIEW_PX: a finer map would show no more.
            width_px = min(MAP_PX if view.moving else VIEW_PX, frame.camera.width_px)
            image = tinted(frame.rgb, self._support(view.world).map(request, width_px))
        else:
            image = np.array(picture(frame, layer))  # rendered arrays may be read-only
        camera, poses = frame.camera, request.world_from_sensor
        if view.lidar != NO_LIDAR:
            draw_points(image, camera, poses, self.points(view)[:: COARSE_STEP if view.moving else 1])
        if view.route:
            self._draw_routes(image, camera, poses, view)
        if view.boxes or view.names or selected:
            self._draw_actors(image, camera, poses, view, selected)
        return image, request

    def _support(self, world: int) -> Support:
        """The recorded views of a world, rendered when its support is first asked for."""
        with self._supports_lock:  # whoever else asks meanwhile waits, and finds them
            if world not in self._supports:
                renderer = self.opened.worlds[world].renderer
                assert renderer is not None  # else support is none of the world's layers
                self._supports[world] = Support(renderer)
            return self._supports[world]

    def _draw_actors(
        self, image: Image, camera: CameraModel, poses: np.ndarray, view: View, selected: str | None
    ) -> None:
        for track in self.stage.tracks(view).values():
            box = self.stage.box(view, track)
            if box is None:
                continue
            chosen = track.id == selected
            if view.boxes or chosen:
                draw_box(image, camera, poses, track.size_m, box, SELECTED_RGB if chosen else BOX_RGB)
            if view.names and np.linalg.norm(box[:3, 3] - poses[0, :3, 3]) < NAMES_WITHIN_M:
                top = box[:3, 3] + [0, 0, track.size_m[2] / 2 + 0.3]
                uv, valid, _ = sensors.project_rolling(camera, poses, top[None])
                if valid[0] and sensors.in_image(camera, uv)[0]:
                    found = "" if track.labelled else ", detected"
                    _text(image, f"{track.id} {track.label}{found}", uv[0], SELECTED_RGB if chosen else BOX_RGB)

    def _draw_routes(self, image: Image, camera: CameraModel, poses: np.ndarray, view: View) -> None:
        recorded = self.stage.world(view).ego
        times = np.arange(recorded.start_us, recorded.end_us, RECORDED_PATH_STEP_US)
        width = max(1, round(image.shape[0] / 400))
        draw_lines(image, camera, poses, recorded.at(times)[None, :, :3, 3], RECORDED_RGB, width)
        if view.camera is None:  # the car itself, seen from outside
            body, ego = self.stage.world(view).rig.body, self.stage.ego(view, view.t_us)
            centre = ego @ geometry.pose(np.eye(3), np.array(body.center_m))
            draw_box(image, camera, poses, body.size_m, centre, DRIVEN_RGB)
        if (rollout := self.stage.rollout(view)) is not None:
            driven, plan = lines_of(rollout, view.t_us)
            draw_lines(image, camera, poses, driven[None], DRIVEN_RGB, width)
            draw_lines(image, camera, poses, plan[None], PLAN_RGB, width + 1)

    def points(self, view: View) -> Float64[np.ndarray, "n 3"]:
        """LiDAR points of a view in the world: recorded, or rendered at the car's pose.

        Raises:
            NurecSimError: there is no such LiDAR.
        """
        clip = self.opened.clip
        if view.lidar == RECORDED_LIDAR and clip is not None:
            found = []
            for name in clip.rig.lidars:
                times = clip.sweep_times_us(name).mean(axis=1)
                if len(times):
                    found.append(clip.sweep(name, int(np.argmin(np.abs(times - view.t_us)))).xyz_world_m)
            return np.concatenate(found) if found else np.zeros((0, 3))
        lidar, world = self._lidar(view), self.stage.world(view)
        first, last = world.times_us
        # A sweep that ends at the view's time, as a policy would get it; a scene begins with one that starts there.
        start_us = max(first, view.t_us - round(1e6 / lidar.frequency_hz))
        end_us = min(max(view.t_us, start_us + 1), last + 1)
        poses = self.stage.ego(view, np.array([start_us, end_us])) @ lidar.rig_from_lidar
        actors = self.stage.overrides(view, start_us, end_us)
        key = (view.world, view.lidar, start_us, poses.tobytes(), *((k, v.tobytes()) for k, v in actors.items()))
        with self._lock:
            if key in self._sweeps:
                return self._sweeps[key]
        (sweep,) = world.sense([SensorRequest(world.id, lidar, start_us, end_us, poses, actors)], ())
        assert isinstance(sweep, LidarFrame)
        points = geometry.transform_points(poses[1], sweep.xyz_m)
        with self._lock:
            self._sweeps = {key: points, **dict(list(self._sweeps.items())[:1])}  # two: a wipe shows two worlds
        return points

    def _lidar(self, view: View) -> LidarModel:
        lidars = self.stage.world(view).rig.lidars
        if view.lidar in lidars:
            return lidars[view.lidar]
        if view.lidar not in sensors.LIDAR_TABLES:
            raise NurecSimError(f"no LiDAR {view.lidar!r}; have {lidar_names(self.opened)}")
        roof = geometry.pose(np.eye(3), np.array([0.0, 0.0, ROOF_M]))
        mounting = next((lidar.rig_from_lidar for lidar in lidars.values()), roof)
        return sensors.lidar_model(view.lidar, mounting)

    def _recorded(self, view: View, shape: tuple[int, ...]) -> Image | None:
        """The recorded image of the view's camera and time, of a picture's size; None if there is none to show."""
        import cv2

        index, clip = recorded_index(self.stage, view), self.opened.clip
        if index is None or clip is None or view.camera is None:
            return None
        image = clip.image(view.camera, index)
        how = cv2.INTER_AREA if shape[0] < image.shape[0] else cv2.INTER_LINEAR
        return cv2.resize(image, (shape[1], shape[0]), interpolation=how).astype(np.uint8)


def _wiped(left: Image, right: Image, where: float) -> Image:
    column = round(where * left.shape[1])
    shown = left.copy()
    shown[:, column:] = right[:, column:]
    shown[:, max(column - 1, 0) : column + 1] = 255
    return shown


def _padded(image: Image, size_px: tuple[int, int]) -> Image:
    """The image with black bars, so that a canvas of such a size shows it undistorted."""
    height, width = image.shape[:2]
    want_width, want_height = width, round(width * size_px[1] / size_px[0])
    if want_height < height:
        want_width, want_height = round(height * size_px[0] / size_px[1]), height
    top, left = (want_height - height) // 2, (want_width - width) // 2
    padded = np.zeros((want_height, want_width, 3), np.uint8)
    padded[top : top + height, left : left + width] = image
    return padded


def _write(image: Image, text: str) -> None:
    """Writes a line at the bottom left."""
    _text(image, text, np.array([8.0, image.shape[0] - 10.0]), (255, 255, 255))


def _text(image: Image, text: str, uv_px: Float64[np.ndarray, " 2"], rgb: tuple[int, int, int]) -> None:
    import cv2

    scale = min(max(image.shape[1] / 1600, 0.35), 0.8)
    place = (int(uv_px[0]), int(uv_px[1]))
    for colour, width in (((0, 0, 0), 3), (rgb, 1)):  # an outline keeps it legible on any ground
        cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, width, cv2.LINE_AA)
