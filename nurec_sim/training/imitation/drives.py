"""Examples for imitation: images at poses beside a recorded drive, and what an expert who sees the truth does there.

An expert that only ever drives well never shows how to recover (Ross et al., DAgger, 2011). Here its answer is known
from any pose, so the ego is put beside its path, turned, ahead of its time, at other speeds, and behind other vehicles.
Everything about a place follows from its town, its number and the settings. One file per town (``.npz``).
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from nurec_sim import geometry
from nurec_sim.errors import TrainingError
from nurec_sim.files.new_files import write_file
from nurec_sim.plugins import load_policy
from nurec_sim.sim.actors import Actors
from nurec_sim.sim.recorded import RecordedDrive
from nurec_sim.training.imitation.config import DriveSettings
from nurec_sim.types import (
    ActorState,
    CameraFrame,
    CameraModel,
    EgoState,
    Matrix4,
    Observation,
    Pinhole,
    Policy,
    Rig,
    SensorRequest,
)
from nurec_sim.world import TownPlan, TrueWorld, street_rig, town_plan

GENERATOR = 1
"""Version, to be raised when the same settings would give other examples."""
EXPERT = "route_follower"
VIEWS = {"front": (0.0, 95.0), "tele": (0.0, 299.0), "left": (60.0, 95.0), "right": (-60.0, 95.0)}
"""Cameras: yaw (degrees) and focal length (pixels) of images of ``SIZE_PX``, wider than any policy looks."""
SIZE_PX, HORIZON_PX = (220, 100), 40.0
MARGIN_US = 500_000
PATH_M = np.array([3.0, 6.0, 10.0, 15.0, 20.0, 28.0])
"""Distances along the path at which the expert's path is kept."""
AFTER_S = np.array([0.5, 1.0, 2.0, 3.0, 4.0])
"""Times at which its speed is kept."""
PATH_SPEED_MPS = (6.0, 16.0)
NEAREST_M, FARTHEST_M = 3.0, 42.0
"""Where vehicles are put, before the front bumper; near ones more often, since they decide."""
CLEAR_M = 1.0
"""Nothing is put nearer than this to the ego's front bumper."""


@dataclass(frozen=True, eq=False)
class Drives:
    """Examples of one town, ``places`` n with ``answers`` k each.

    Attributes:
        images: of every camera of ``VIEWS``, in its order.
        rig_from_camera: pose of each camera.
        turn_rad: heading of an answer against the images, left positive.
        speed_mps: of the ego.
        route_m: the route in the rig frame, NaN behind its end.
        route_speed_mps: recorded speed there.
        path_m: where the expert drives, at ``PATH_M``.
        later_mps: the expert's speed after ``AFTER_S``.
    """

    images: UInt8[np.ndarray, "n cameras h w 3"]
    rig_from_camera: Float64[np.ndarray, "cameras 4 4"]
    turn_rad: Float32[np.ndarray, "n k"]
    speed_mps: Float32[np.ndarray, "n k"]
    route_m: Float32[np.ndarray, "n k 20 2"]
    route_speed_mps: Float32[np.ndarray, "n k 20"]
    path_m: Float32[np.ndarray, "n k p 2"]
    later_mps: Float32[np.ndarray, "n k s"]

    def frame(self, place: int, camera: str) -> CameraFrame:
        """An image as policies get theirs."""
        index = list(VIEWS).index(camera)
        return CameraFrame(view_camera(camera, self.rig_from_camera[index]), 0, 1, self.images[place, index])


def view_camera(name: str, rig_from_camera: Matrix4) -> CameraModel:
    """The camera of an image."""
    focal, (width, height) = VIEWS[name][1], SIZE_PX
    return CameraModel(name, width, height, Pinhole(focal, focal, width / 2, HORIZON_PX), rig_from_camera)


def drive_names(settings: DriveSettings) -> list[str]:
    """Names of the files of all towns."""
    kept = {name: value for name, value in settings.model_dump().items() if name not in ("first_town", "towns")}
    text = json.dumps({"generator": GENERATOR, **kept}, sort_keys=True)
    stem = hashlib.sha256(text.encode()).hexdigest()[:12]
    return [f"drives-{stem}-{settings.first_town + town:06d}.npz" for town in range(settings.towns)]


def generate_drives(settings: DriveSettings, folder: Path, backend: str | None = None) -> Iterator[Path]:
    """Generates the missing towns and yields every file when it is there."""
    for k, name in enumerate(drive_names(settings)):
        if not (folder / name).is_file():
            _write(folder / name, town_drives(settings, settings.first_town + k, backend))
        yield folder / name


def town_drives(settings: DriveSettings, town: int, backend: str | None = None) -> Drives:
    """The examples of one town."""
    plan = town_plan(town, "train", seconds=settings.town_s)
    mounts = _mounts(np.random.default_rng([plan.seed, 0xE9E]))
    cameras = [view_camera(name, mount) for name, mount in zip(VIEWS, mounts, strict=True)]
    expert = load_policy(EXPERT)
    expert.reset(street_rig(), 0)
    images, answers = [], []
    with TrueWorld(plan, backend) as world:
        for place in range(settings.places):
            scene = _Place(plan, settings, np.random.default_rng([plan.seed, place, 0xE2E]))
            pose = scene.world_from_rig
            requests = [
                SensorRequest("", camera, scene.t_us, scene.t_us + 1, np.stack([pose @ camera.rig_from_camera] * 2),
                              scene.moved)
                for camera in cameras
            ]  # fmt: skip
            frames = world.sense(requests)
            images.append([frame.rgb for frame in frames if isinstance(frame, CameraFrame)])
            answers.append([scene.answer(expert, mounts[0]) for _ in range(settings.answers)])
    columns = [np.array([[answer[i] for answer in place] for place in answers], np.float32) for i in range(6)]
    return Drives(np.array(images, np.uint8), np.array(mounts), *columns)


def _mounts(rng: np.random.Generator) -> list[Matrix4]:
    """Poses of the cameras: each town has a rig of its own height and pitch."""
    ahead, height, pitch = rng.uniform(1.2, 2.0), rng.uniform(1.25, 1.8), np.deg2rad(rng.normal(0, 0.7))
    poses = []
    for name, (yaw_deg, _) in VIEWS.items():
        yaw = np.deg2rad(yaw_deg + (rng.normal(0, 4) if name in ("left", "right") else 0.0))
        forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        # Columns are the camera's axes in the rig: right, down, forward.
        axes = np.stack([right, np.cross(forward, right), forward], axis=1)
        poses.append(geometry.pose(axes, np.array([ahead, 0.5 * np.sin(yaw), height])))
    return poses


class _Place:
    """An ego pose and the actors around it at one instant of a town."""

    def __init__(self, plan: TownPlan, settings: DriveSettings, rng: np.random.Generator) -> None:
        ego = plan.ego_trajectory()
        self.drive, self.rng, self.settings = RecordedDrive(ego), rng, settings
        self.body = street_rig(16, 16, 2, 8).body
        self.front_m = self.body.center_m[0] + self.body.size_m[0] / 2
        actors = Actors(plan.tracks(), {})
        self.moved: dict[str, Float64[np.ndarray, "2 4 4"]] = {}
        for _ in range(20):
            self.t_us = int(rng.integers(ego.start_us + MARGIN_US, ego.end_us - MARGIN_US))
            shift_us = int(1e6 * settings.shifted_s * rng.uniform(-1, 1))
            base_us = min(max(self.t_us + shift_us, ego.start_us), ego.end_us)
            beside = float(np.clip(rng.normal(), -3, 3)) * settings.beside_m
            yaw = np.deg2rad(settings.turned_deg) * float(np.clip(rng.normal(), -3, 3))
            wanted = ego.at(base_us) @ geometry.pose_from_xyyaw(0.0, beside, yaw)
            self.world_from_rig, self.station_m = self._on_ground(wanted)
            self.speed_mps = self.drive.motion(base_us)[0]
            self.actors = {state.id: state for state in actors.seen_from(self.t_us, self.world_from_rig)}
            if not any(self._overlaps(state) for state in self.actors.values()):
                break
        if rng.random() < settings.blocked:
            self._move_one(plan)

    def _on_ground(self, wanted: Matrix4) -> tuple[Matrix4, float]:
        x, y, yaw = float(wanted[0, 3]), float(wanted[1, 3]), float(geometry.yaw_of(wanted))
        station = self.drive.station(x, y)
        return self.drive.on_ground(x, y, yaw, station), station

    def _overlaps(self, state: ActorState) -> bool:
        """Whether an actor's box reaches into the ego's, a margin of 0.2 m included."""
        corners = geometry.box_corners_xy(state.rig_from_box, state.size_m[0], state.size_m[1])
        edges = np.concatenate([corners + f * (np.roll(corners, 1, axis=0) - corners) for f in np.linspace(0, 1, 8)])
        away = np.abs(edges - np.asarray(self.body.center_m[:2])) - np.asarray(self.body.size_m[:2]) / 2
        return bool((away.max(axis=1) < 0.2).any())

    def _move_one(self, plan: TownPlan) -> None:
        """Puts a vehicle on the route ahead, or beside it, standing or driving."""
        rng = self.rng
        vehicles = [s for s in self.actors.values() if s.size_m[0] > 3.0]
        place = self.station_m + self.front_m + NEAREST_M + (FARTHEST_M - NEAREST_M) * rng.random() ** 1.5
        if not vehicles or place > self.drive.length_m:
            return
        state = vehicles[int(rng.integers(len(vehicles)))]
        ground = self.drive.ego.at(self.drive.time_at(place))
        # Two of three stand in the way; the others teach which ones do not.
        in_the_way = rng.random() < 2 / 3
        beside = rng.normal(0, 0.4) if in_the_way else rng.choice([-1, 1]) * rng.uniform(2.6, 4.0)
        backwards = 0.0 if in_the_way else np.pi * (rng.random() < 0.5)
        pose = ground @ geometry.pose_from_xyyaw(0.0, beside, backwards + rng.normal(0, 0.05), state.size_m[2] / 2)
        rig_from_box = geometry.inverse(self.world_from_rig) @ pose
        speed = 0.0 if rng.random() < 0.6 else self.speed_mps * rng.uniform(0.2, 0.8)
        moved = ActorState(state.id, state.label, state.size_m, rig_from_box, speed * rig_from_box[:2, 0])
        gap = geometry.box_corners_xy(rig_from_box, *state.size_m[:2])[:, 0].min() - self.front_m
        if gap > CLEAR_M and not self._overlaps(moved):
            self.actors[state.id] = moved
            self.moved[state.id] = np.stack([pose, pose])

    def answer(self, expert: Policy, rig_from_front: Matrix4) -> tuple[object, ...]:
        """Heading and speed of one example, its route, and the expert's path and speeds, as in ``Drives``."""
        rng = self.rng
        turn = np.deg2rad(self.settings.turned_deg) * float(np.clip(rng.normal(), -2.5, 2.5))
        speed = self.speed_mps * rng.uniform(0.5, 1.25) if rng.random() < 0.75 else rng.uniform(0.0, 12.0)
        # The images turn about the camera, not about the rear axle.
        lever = geometry.pose(np.eye(3), rig_from_front[:3, 3])
        turned = lever @ geometry.pose_from_xyyaw(0.0, 0.0, turn) @ geometry.inverse(lever)
        pose = self.world_from_rig @ turned
        x, y, yaw = float(pose[0, 3]), float(pose[1, 3]), float(geometry.yaw_of(pose))
        route, route_speed = self.drive.route(x, y, yaw, self.drive.station(x, y, self.station_m))
        actors = tuple(_seen_from(state, geometry.inverse(turned)) for state in self.actors.values())

        def asked(speed_mps: float, speeds: np.ndarray, seen: tuple[ActorState, ...]) -> np.ndarray:
            ego = EgoState(self.t_us, pose, speed_mps)
            observation = Observation(self.t_us, ego, (ego,), {}, {}, route, speeds, np.zeros(0, np.int64),
                                      np.zeros((0, 3)), seen)  # fmt: skip
            return np.vstack([np.zeros(3), expert.plan(observation).pose])

        # Where it drives: without traffic, and fast enough to get there. How fast: as it is.
        cruise = float(np.clip(speed, *PATH_SPEED_MPS))
        line = asked(cruise, np.full(len(route), cruise), ())[:, :2]
        line = np.vstack([line, line[-1] + 40.0 * _along(line)])
        arc = geometry.arc_length(line)
        path = np.column_stack([np.interp(PATH_M, arc, line[:, i]) for i in range(2)])
        driven = geometry.arc_length(asked(speed, route_speed, actors)[:, :2])
        later = np.interp(AFTER_S, 0.1 * np.arange(50) + 0.05, np.diff(driven) / 0.1)
        padded = np.full((20, 3), np.nan)
        padded[: len(route)] = np.column_stack([route, route_speed])
        return turn, speed, padded[:, :2], padded[:, 2], path, later


def _along(line: Float64[np.ndarray, "k 2"]) -> Float64[np.ndarray, " 2"]:
    """Direction at the end of a line."""
    step = line[-1] - line[-3]
    length = float(np.linalg.norm(step))
    return step / length if length > 0 else np.array([1.0, 0.0])


def _seen_from(state: ActorState, to_from_rig: Matrix4) -> ActorState:
    velocity = to_from_rig[:2, :2] @ state.velocity_mps
    return ActorState(state.id, state.label, state.size_m, to_from_rig @ state.rig_from_box, velocity)


def _write(path: Path, drives: Drives) -> None:
    data = io.BytesIO()
    np.savez_compressed(data, **vars(drives))
    write_file(path, data.getvalue())


def read_drives(path: Path) -> Drives:
    """The examples of a town from their file.

    Raises:
        TrainingError: the file is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            return Drives(**{name: data[name] for name in Drives.__dataclass_fields__})
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise TrainingError(f"{path} is damaged: {error}; delete it, and it is generated again") from None


def rig_of(drives: Drives) -> Rig:
    """The rig of a town's images."""
    return Rig({name: view_camera(name, pose) for name, pose in zip(VIEWS, drives.rig_from_camera, strict=True)}, {})
