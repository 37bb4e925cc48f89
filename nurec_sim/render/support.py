"""Support: how much of what a scene shows rests on what its cameras recorded, per pixel in 0..1.

A pixel shows a point of a surface, or the sky as a point at infinity. A recorded view saw that point if the scene,
shown from there, has a surface at the same depth; it looked through the point if its surface lies behind. Then

    support = seen / (seen + looked through + DOUBT) * max over the views that saw the point of
              exp(-angle / ANGLE_RAD) * min(1, distance / recorded distance) ** CLOSER

where ``angle`` is the one between the pixel's ray and the recorded ray at the point, and the last factor counts going
nearer than the recording, which has no more detail. Points that no view saw have support 0: what is shown there is
invented, and right by chance at best. Points in the box of a track are followed with it.

The constants were fitted on three generated towns with two methods, so that support is about the share of pixels that
are right; ``nurec-sim evaluate --protocol shift`` measures that on others (``evaluate.support``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from nurec_sim import geometry, sensors
from nurec_sim.errors import RequestError
from nurec_sim.render.device import Renderer
from nurec_sim.types import CameraFrame, CameraModel, GaussianScene, SensorRequest, Shutter

DOUBT = 0.2
"""Counts like so many views that looked through: a single view shows a colour, but not at which depth."""
ANGLE_RAD = np.pi
CLOSER = 0.25
SAME_SHARE, SAME_PER_M = 0.03, 1e-3
"""Inverse depths are the same within this share of them, plus so much (1/m): 0.2 m at 5 m, 4 m at 50 m."""
MOST_VIEWS, LEAST_PER_CAMERA = 48, 8
"""Recorded views that are compared with, evenly over the log; together, and of each of many cameras."""
VIEW_PX = 240
"""Width at which recorded views are shown."""
MAP_PX = 96
"""Width of a map of support unless asked for another."""
BOX_MARGIN_M = 0.2


@dataclass(frozen=True, eq=False)
class RecordedView:
    """A recorded frame, at a smaller size; ``renderer`` shows what it saw of the scene."""

    renderer: Renderer
    camera: CameraModel
    t_us: int
    world_from_camera: Float64[np.ndarray, "4 4"]

    @cached_property
    def inverse_m(self) -> Float32[np.ndarray, "h w"]:
        """1 / depth along the optical axis, 0 for the sky."""
        pair, scene_id = np.stack([self.world_from_camera] * 2), self.renderer.scene.id
        request = SensorRequest(scene_id, self.camera, self.t_us, self.t_us + 1, pair)
        frame = self.renderer.render_camera(request, ("depth",))
        assert frame.depth_m is not None
        return np.where(frame.depth_m > 0, 1 / np.maximum(frame.depth_m, 1e-6), 0).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Points:
    """Points that are looked at, metres: ``direction`` from the eye (unit) and ``distance_m``, infinite for the sky.

    ``track`` is the index of the track whose box holds a point, -1 for none; ``world_from_box`` those of the tracks at
    the instant.
    """

    eye_m: Float64[np.ndarray, " 3"]
    direction: Float64[np.ndarray, "n 3"]
    distance_m: Float64[np.ndarray, " n"]
    track: Int64[np.ndarray, " n"]
    world_from_box: dict[int, Float64[np.ndarray, "4 4"]]


@dataclass(frozen=True, eq=False)
class Evidence:
    """How recorded views saw points.

    Attributes:
        seen: number of views that saw each point.
        through: number of views that looked through it.
        angle_rad: between the ray to the point and the recorded ray of the view that counts most; pi without one.
        closer: distance over the recorded distance of that view: below 1 nearer than the recording; 0 without one.
    """

    seen: Int64[np.ndarray, " n"]
    through: Int64[np.ndarray, " n"]
    angle_rad: Float64[np.ndarray, " n"]
    closer: Float64[np.ndarray, " n"]

    @property
    def support(self) -> Float64[np.ndarray, " n"]:
        """Support of the points, 0..1."""
        agreed = self.seen / (self.seen + self.through + DOUBT)
        return agreed * weight(self.angle_rad, self.closer)


def weight(angle_rad: Float64[np.ndarray, "*n"], closer: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
    """What a view that saw a point is worth for a view from elsewhere; see the module."""
    return np.exp(-angle_rad / ANGLE_RAD) * np.minimum(closer, 1.0) ** CLOSER


class Support:
    """The recorded views of a scene, to compare other views with.

    Args:
        renderer: of the scene.
        progress: called with the fraction done.
        most: about so many recorded views, evenly over the log; together, but ``LEAST_PER_CAMERA`` of each.
        ahead: whether to show all views of the scene now, instead of each when it is first compared with.

    Raises:
        RequestError: the scene does not know when its cameras recorded.
    """

    def __init__(
        self,
        renderer: Renderer,
        progress: Callable[[float], None] = lambda done: None,
        most: int = MOST_VIEWS,
        ahead: bool = True,
    ) -> None:
        self._renderer, self._scene = renderer, renderer.scene
        frames = recorded_frames(renderer.scene, most)
        if not frames:
            raise RequestError(f"scene {renderer.scene.id!r} has no times of recorded frames: its support is unknown")
        self._views = []
        for number, (camera, t_us) in enumerate(frames):
            progress(number / len(frames))
            small = small_camera(camera, min(VIEW_PX, camera.width_px))
            pose = self._scene.ego.at(t_us) @ camera.rig_from_camera
            self._views.append(RecordedView(renderer, small, t_us, pose))
            if ahead:
                _ = self._views[-1].inverse_m

    def map(self, request: SensorRequest, width_px: int = MAP_PX) -> Float32[np.ndarray, "h w"]:
        """Support of what a camera shows.

        Args:
            request: a camera's; of a moving one the middle of the exposure counts.
            width_px: width of the map; its height follows.
        """
        points, valid = self.points(request, width_px)
        return np.where(valid, self.evidence(points).support.reshape(valid.shape), 0).astype(np.float32)

    def points(self, request: SensorRequest, width_px: int = MAP_PX) -> tuple[Points, Bool[np.ndarray, "h w"]]:
        """What a camera shows, row by row, and which pixels are valid."""
        assert isinstance(request.sensor, CameraModel)
        camera, pose = small_camera(request.sensor, width_px), _middle_pose(request)
        actors = {name: np.repeat(_middle(pair)[None], 2, axis=0) for name, pair in request.actors.items()}
        still = dataclasses.replace(
            request, sensor=camera, start_us=request.middle_us, end_us=request.middle_us + 1, actors=actors,
            world_from_sensor=np.stack([pose, pose]), show_ego=False,
        )  # fmt: skip
        frame = self._renderer.render_camera(still, ("depth",))
        return points_of(frame, still, self._scene)

    def evidence(self, points: Points) -> Evidence:
        """How the recorded views saw points."""
        count = len(points.distance_m)
        seen, through = np.zeros(count, np.int64), np.zeros(count, np.int64)
        best, angle, closer = np.zeros(count), np.full(count, np.pi), np.zeros(count)
        times_us = np.array([view.t_us for view in self._views], np.int64)
        body, then_from_now = _motions(points, self._scene, times_us)
        for view, motions in zip(self._views, then_from_now, strict=True):
            saw, passed, between, distance = _compare(points, motions[body], view)
            seen += saw
            through += passed
            with np.errstate(invalid="ignore"):  # infinitely far both: the sky is as far from everywhere
                ratio = np.where(np.isfinite(distance), points.distance_m / distance, 1.0)
            worth = np.where(saw, weight(between, ratio), 0)
            better = worth > best
            best[better], angle[better], closer[better] = worth[better], between[better], ratio[better]
        return Evidence(seen, through, angle, closer)


def recorded_frames(scene: GaussianScene, most: int = MOST_VIEWS) -> list[tuple[CameraModel, int]]:
    """Camera and middle of the exposure of the frames that a scene was made from; at most about ``most``."""
    used = [name for name in scene.provenance.get("cameras", scene.rig.cameras) if name in scene.rig.cameras]
    used = [name for name in used if len(scene.camera_times_us.get(name, ()))]
    each = max(most // max(len(used), 1), LEAST_PER_CAMERA)
    frames = []
    for name in used:
        middle = np.asarray(scene.camera_times_us[name], np.int64).sum(axis=1) // 2
        for place in np.unique(np.linspace(0, len(middle) - 1, min(each, len(middle))).round().astype(int)):
            # An instant [t, t + 1) must lie in the scene.
            frames.append((scene.rig.cameras[name], int(np.clip(middle[place], scene.span_us[0], scene.span_us[1]))))
    return frames


def points_of(
    frame: CameraFrame, request: SensorRequest, scene: GaussianScene
) -> tuple[Points, Bool[np.ndarray, "h w"]]:
    """The points that a frame with depth shows, row by row, and which pixels are valid."""
    assert frame.depth_m is not None
    rays, valid = sensors.pixel_rays(frame.camera)
    pose, depth = request.world_from_sensor[0], frame.depth_m.reshape(-1).astype(np.float64)
    ray = np.where(valid[..., None], rays, (0.0, 0.0, 1.0)).reshape(-1, 3)
    distance = np.where(depth > 0, depth / np.maximum(ray[:, 2], 1e-6), np.inf)
    direction = geometry.rotate_vectors(pose[:3, :3], ray)
    track = np.full(len(ray), -1, np.int64)
    boxes: dict[int, np.ndarray] = {}
    near = np.flatnonzero(depth > 0)
    xyz = pose[:3, 3] + direction[near] * distance[near, None]
    for index, each in enumerate(scene.tracks):
        if each.id in request.hidden or not (each.id in request.actors or each.path.covers(request.start_us)):
            continue
        box = request.actors[each.id][0] if each.id in request.actors else each.path.at(request.start_us)
        mine = geometry.points_in_box(geometry.transform_points(geometry.inverse(box), xyz), each.size_m, BOX_MARGIN_M)
        if mine.any():
            track[near[mine]], boxes[index] = index, box
    return Points(pose[:3, 3], direction, distance, track, boxes), valid


def _motions(
    points: Points, scene: GaussianScene, times_us: Int64[np.ndarray, " views"]
) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "views bodies 4 4"]]:
    """Number of the body of each point (0 is the world), and the motions of the bodies from now to each time.

    Motions are NaN at times at which the body's track was not there.
    """
    body = np.zeros(len(points.track), np.int64)
    motions = np.full((len(times_us), 1 + len(points.world_from_box), 4, 4), np.nan)
    motions[:, 0] = np.eye(4)
    for number, (index, box) in enumerate(points.world_from_box.items(), start=1):
        path = scene.tracks[index].path
        body[points.track == index] = number
        there = (path.start_us <= times_us) & (times_us <= path.end_us)
        motions[there, number] = path.at(times_us[there]) @ geometry.inverse(box)
    return body, motions


def _compare(
    points: Points, then_from_now: Float64[np.ndarray, "n 4 4"], view: RecordedView
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Which points a view saw and looked through, the angle between its ray and theirs, and its distance to them."""
    turn = then_from_now[:, :3, :3]
    direction = np.einsum("nij,nj->ni", turn, points.direction)
    far = ~np.isfinite(points.distance_m)
    reach = np.where(far, 1.0, points.distance_m)
    eye = turn @ points.eye_m + then_from_now[:, :3, 3] - view.world_from_camera[:3, 3]
    # Points at infinity have only a direction, the same from everywhere.
    offset = direction * reach[:, None] + np.where(far[:, None], 0.0, eye)
    distance = np.linalg.norm(offset, axis=1)
    along = np.einsum("ni,ni->n", direction, offset) / np.maximum(distance, 1e-9)
    local = geometry.rotate_vectors(view.world_from_camera[:3, :3].T, offset)
    uv, valid = sensors.project(view.camera, local)
    inside = valid & sensors.in_image(view.camera, uv) & (local[:, 2] > 0)
    inverse = np.where(far, 0.0, 1 / np.maximum(local[:, 2], 1e-6))
    saw, passed = np.zeros(len(far), bool), np.zeros(len(far), bool)
    if inside.any():
        saw[inside], passed[inside] = _same_depth(view.inverse_m, uv[inside], inverse[inside])
    return saw, passed, np.arccos(np.clip(along, -1, 1)), np.where(far, np.inf, distance)


def _same_depth(
    image: Float32[np.ndarray, "h w"], uv_px: Float64[np.ndarray, "n 2"], inverse_m: Float64[np.ndarray, " n"]
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Whether an image of inverse depth shows the same depths, and whether all that it shows there lies behind.

    At an edge a pixel may show either side, or a mean of both: whatever lies between the nearest and the farthest of
    the four pixels around is the same.
    """
    height, width = image.shape
    left, top = np.floor(uv_px - 0.5).astype(int).T
    columns = np.clip([left, left + 1], 0, width - 1)
    rows = np.clip([top, top + 1], 0, height - 1)
    around = image[rows[:, None], columns[None]].reshape(4, -1)
    far, near = around.min(axis=0), around.max(axis=0)
    margin = SAME_SHARE * np.maximum(near, inverse_m) + SAME_PER_M
    return (far - margin <= inverse_m) & (inverse_m <= near + margin), near < inverse_m - margin


def small_camera(camera: CameraModel, width_px: int) -> CameraModel:
    """The camera with fewer pixels, all at one instant."""
    height_px = max(1, round(width_px * camera.height_px / camera.width_px))
    return dataclasses.replace(sensors.scaled_camera(camera, width_px, height_px), shutter=Shutter.GLOBAL)


def _middle_pose(request: SensorRequest) -> Float64[np.ndarray, "4 4"]:
    return _middle(np.asarray(request.world_from_sensor, np.float64))


def _middle(pair: Float64[np.ndarray, "2 4 4"]) -> Float64[np.ndarray, "4 4"]:
    return np.asarray(geometry.interpolate_pose_pair(pair, np.array(0.5)))
