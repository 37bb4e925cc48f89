"""Every dataclass that crosses a module border.

Conventions (all modules): transforms are spelt ``a_from_b`` and take ``b`` coordinates to ``a``; metres, radians,
integer microseconds; intervals are half-open; quaternions are ``wxyz`` with ``w >= 0``. Rig: x forward, y left, z up,
origin at the rear axle on the ground. Camera: x right, y down, z forward. LiDAR: x forward, y left, z up. Pixels have
their origin at the image corner, centres at +0.5. Gaussian scales are standard deviations in metres and opacities lie
in 0..1. World: metres, z up.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, UInt8

from nurec_sim import geometry

Matrix4 = Float64[np.ndarray, "4 4"]


# ---------------------------------------------------------------------------------------------------- trajectories


@dataclass(frozen=True)
class Trajectory:
    """A body's poses over time, strictly increasing in time.

    Raises:
        ValueError: shapes differ, times do not increase, or a value is not finite.
    """

    t_us: Int64[np.ndarray, " t"]
    world_from_body: Float64[np.ndarray, "t 4 4"]

    def __post_init__(self) -> None:
        t_us = np.ascontiguousarray(self.t_us, dtype=np.int64)
        poses = np.ascontiguousarray(self.world_from_body, dtype=np.float64)
        if t_us.ndim != 1 or len(t_us) == 0 or poses.shape != (len(t_us), 4, 4):
            raise ValueError(f"a trajectory needs times [t] and poses [t,4,4], t >= 1; got {t_us.shape}, {poses.shape}")
        if np.any(np.diff(t_us) <= 0):
            raise ValueError("trajectory times must increase strictly")
        if not np.isfinite(poses).all():
            raise ValueError("trajectory poses must be finite")
        object.__setattr__(self, "t_us", t_us)
        object.__setattr__(self, "world_from_body", poses)

    @property
    def start_us(self) -> int:
        """First time."""
        return int(self.t_us[0])

    @property
    def end_us(self) -> int:
        """Last time (inclusive)."""
        return int(self.t_us[-1])

    @property
    def position_m(self) -> Float64[np.ndarray, "t 3"]:
        """Body origins in the world."""
        return self.world_from_body[:, :3, 3]

    def covers(self, t_us: int) -> bool:
        """Whether ``t_us`` lies between the first and the last time, both included."""
        return self.start_us <= t_us <= self.end_us

    def at(self, t_us: int | Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "*n 4 4"]:
        """Poses at ``t_us``: positions interpolated linearly, rotations by slerp; held before and after the ends."""
        return geometry.interpolate_poses(self.t_us, self.world_from_body, t_us)


# --------------------------------------------------------------------------------------------------------- sensors


class Shutter(enum.Enum):
    """Direction in which an image is exposed; rows or columns share one instant."""

    GLOBAL = "global"
    TOP_TO_BOTTOM = "top_to_bottom"
    LEFT_TO_RIGHT = "left_to_right"
    BOTTOM_TO_TOP = "bottom_to_top"
    RIGHT_TO_LEFT = "right_to_left"


@dataclass(frozen=True)
class Pinhole:
    """OpenCV pinhole: rational radial k1..k6, tangential p1 p2, thin prism s1..s4; corner-origin principal point."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    radial: tuple[float, ...] = (0.0,) * 6
    tangential: tuple[float, ...] = (0.0,) * 2
    thin_prism: tuple[float, ...] = (0.0,) * 4

    @property
    def distorted(self) -> bool:
        """Whether any distortion coefficient differs from zero."""
        return any(self.radial) or any(self.tangential) or any(self.thin_prism)


@dataclass(frozen=True)
class Fisheye:
    """OpenCV fisheye: r = theta (1 + k1 theta^2 + .. + k4 theta^8); valid up to ``max_angle_rad`` off the axis."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    radial: tuple[float, ...] = (0.0,) * 4
    max_angle_rad: float = np.pi / 2


class FThetaReference(enum.Enum):
    """Which of the two F-theta polynomials is exact; the other one is only a first guess."""

    PIXELDIST_TO_ANGLE = "pixeldist_to_angle"
    ANGLE_TO_PIXELDIST = "angle_to_pixeldist"


@dataclass(frozen=True)
class FTheta:
    """F-theta: pixel distance and angle are polynomials of each other, coefficients from power 0 up.

    ``pixel = [[c, d], [e, 1]] @ (r(theta) * direction) + (cx, cy)``. The principal point here is corner-origin like
    every pixel of ours; formats that count pixel centres as whole numbers add 0.5 when they read
    (``spec/scene_usdz.md`` 1.5). An empty polynomial is filled in by numeric inversion of the other one.
    """

    cx_px: float
    cy_px: float
    reference: FThetaReference
    pixeldist_to_angle: tuple[float, ...] = ()
    angle_to_pixeldist: tuple[float, ...] = ()
    max_angle_rad: float = np.pi / 2
    linear_cde: tuple[float, float, float] = (1.0, 0.0, 0.0)


class WindshieldReference(enum.Enum):
    """Which windshield polynomials are exact."""

    FORWARD = "forward"
    BACKWARD = "backward"


@dataclass(frozen=True)
class Windshield:
    """Bivariate windshield: angles (phi, theta) = asin(x), asin(y) of a ray, each mapped by a polynomial in both.

    Coefficients: for y-power 0 all x-powers, then y-power 1 with one x-power fewer, ... (6 of order 2, 15 of order 4).
    Forward takes the external ray to the one behind the glass (used before projecting); the inverse takes it back.
    """

    reference: WindshieldReference
    horizontal: tuple[float, ...]
    vertical: tuple[float, ...]
    horizontal_inverse: tuple[float, ...] = ()
    vertical_inverse: tuple[float, ...] = ()


Lens = Pinhole | Fisheye | FTheta


@dataclass(frozen=True, eq=False)
class CameraModel:
    """One camera of a rig: size, lens, shutter and where it sits."""

    id: str
    width_px: int
    height_px: int
    lens: Lens
    rig_from_camera: Matrix4
    shutter: Shutter = Shutter.GLOBAL
    windshield: Windshield | None = None


class Spin(enum.Enum):
    """Sense of rotation seen from above."""

    CLOCKWISE = "clockwise"
    COUNTERCLOCKWISE = "counterclockwise"


@dataclass(frozen=True, eq=False)
class LidarModel:
    """A spinning LiDAR as a grid of beams, rows from high to low, columns in the order they fire.

    A beam of row r, column c points to elevation ``elevation_rad[r]``, azimuth
    ``azimuth_rad[c] + row_azimuth_offset_rad[r]`` (counter-clockwise from x forward). Column c fires at the fraction
    ``c / (columns - 1)`` of the sweep.
    """

    id: str
    elevation_rad: Float64[np.ndarray, " rows"]
    azimuth_rad: Float64[np.ndarray, " columns"]
    row_azimuth_offset_rad: Float64[np.ndarray, " rows"]
    rig_from_lidar: Matrix4
    spin: Spin = Spin.CLOCKWISE
    frequency_hz: float = 10.0
    range_m: tuple[float, float] = (0.5, 200.0)


@dataclass(frozen=True)
class Box:
    """An upright cuboid in its parent's axes."""

    center_m: tuple[float, float, float]
    size_m: tuple[float, float, float]


@dataclass(frozen=True)
class Rig:
    """The sensors of a car and its outline, all in the rig frame. Mappings keep the order of the log."""

    cameras: Mapping[str, CameraModel]
    lidars: Mapping[str, LidarModel]
    body: Box = Box((1.4, 0.0, 0.75), (4.9, 1.9, 1.5))


# ------------------------------------------------------------------------------------------------------------ logs

MOVABLE_LABELS = ("automobile", "heavy_truck", "bus", "trailer", "train", "other_vehicle", "person", "rider", "animal")


@dataclass(frozen=True)
class Track:
    """One labelled object over time; ``path`` holds the poses of its box centre (x forward, y left, z up)."""

    id: str
    label: str
    size_m: tuple[float, float, float]
    path: Trajectory
    controllable: bool = True


@dataclass(frozen=True)
class RoadMap:
    """What is known of the road: drivable areas as (outer ring, holes...) of [k,2] metres, lane centre lines [k,3]."""

    drivable: tuple[tuple[Float64[np.ndarray, "k 2"], ...], ...] = ()
    lanes: tuple[Float64[np.ndarray, "k 3"], ...] = ()


@dataclass(frozen=True)
class Sweep:
    """One LiDAR turn, motion-compensated to ``t_us``; ``intensity`` in 0..1 or None, ``point_t_us`` when fired."""

    t_us: int
    start_us: int
    end_us: int
    world_from_lidar: Matrix4
    xyz_m: Float64[np.ndarray, "n 3"]
    intensity: Float32[np.ndarray, " n"] | None
    point_t_us: Int64[np.ndarray, " n"]

    @property
    def xyz_world_m(self) -> Float64[np.ndarray, "n 3"]:
        """Points in the world."""
        return geometry.transform_points(self.world_from_lidar, self.xyz_m)


class Clip(Protocol):
    """A driving log, read lazily. ``logs.open_clip`` makes one from a path."""

    @property
    def id(self) -> str:
        """Name of the log."""
        ...

    @property
    def rig(self) -> Rig:
        """Sensors and outline of the car."""
        ...

    @property
    def ego(self) -> Trajectory:
        """Recorded poses of the rig."""
        ...

    @property
    def tracks(self) -> Sequence[Track]:
        """Labelled objects; empty when the log has no boxes."""
        ...

    @property
    def road_map(self) -> RoadMap | None:
        """What is known of the road."""
        ...

    @property
    def span_us(self) -> tuple[int, int]:
        """[start, end) of the log; start >= 1_000_000."""
        ...

    def camera_times_us(self, camera_id: str) -> Int64[np.ndarray, "frames 2"]:
        """Exposure start and end of every frame; equal when the log knows one time only."""
        ...

    def world_from_camera(self, camera_id: str, index: int) -> Float64[np.ndarray, "2 4 4"]:
        """Camera poses at the start and the end of the exposure."""
        ...

    def image(self, camera_id: str, index: int) -> UInt8[np.ndarray, "h w 3"]:
        """One RGB frame."""
        ...

    def sweep_times_us(self, lidar_id: str) -> Int64[np.ndarray, "sweeps 2"]:
        """Start and end of every sweep."""
        ...

    def sweep(self, lidar_id: str, index: int) -> Sweep:
        """One motion-compensated sweep."""
        ...


# ---------------------------------------------------------------------------------------------------------- scenes


class Label(enum.IntEnum):
    """Semantic class of a Gaussian and of a rendered pixel."""

    OTHER = 0
    ROAD = 1
    MOVABLE = 2
    SKY = 3
    EGO = 4


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians, as structure of arrays.

    ``rgb`` is the display-space colour in 0..1 (degree 0); ``sh_rest`` holds the view-dependent spherical-harmonic
    coefficients of degree 1 and up (k = 3, 8 or 15, basis and order as in 3DGS files) or None. ``intensity`` is the
    LiDAR return in 0..1, NaN where unknown. ``normal`` is a unit vector, zero where unknown.
    """

    mean_m: Float32[np.ndarray, "n 3"]
    quat_wxyz: Float32[np.ndarray, "n 4"]
    scale_m: Float32[np.ndarray, "n 3"]
    opacity: Float32[np.ndarray, " n"]
    rgb: Float32[np.ndarray, "n 3"]
    normal: Float32[np.ndarray, "n 3"]
    label: UInt8[np.ndarray, " n"]
    intensity: Float32[np.ndarray, " n"]
    sh_rest: Float32[np.ndarray, "n k 3"] | None = None

    def __len__(self) -> int:
        return len(self.mean_m)

    def __getitem__(self, index: np.ndarray | slice) -> Gaussians:
        fields: dict[str, Any] = {name: getattr(self, name)[index] for name in GAUSSIAN_FIELDS}
        return Gaussians(**fields, sh_rest=None if self.sh_rest is None else self.sh_rest[index])

    @classmethod
    def empty(cls, n: int = 0) -> Gaussians:
        """N Gaussians of zeros (identity rotation, unknown intensity)."""
        quat = np.zeros((n, 4), np.float32)
        quat[:, 0] = 1
        zeros3 = np.zeros((n, 3), np.float32)
        return cls(zeros3, quat, zeros3.copy(), np.zeros(n, np.float32), zeros3.copy(), zeros3.copy(),
                   np.zeros(n, np.uint8), np.full(n, np.nan, np.float32))  # fmt: skip

    @classmethod
    def concatenate(cls, parts: Sequence[Gaussians]) -> Gaussians:
        """All parts one after the other; every part has ``sh_rest`` of one degree, or none has."""
        if not parts:
            return cls.empty()
        rest = [part.sh_rest for part in parts]
        merged = None if all(r is None for r in rest) else np.concatenate([r for r in rest if r is not None])
        if merged is not None and any(r is None for r in rest):
            raise ValueError("cannot join Gaussians with and without sh_rest")
        fields: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts]) for name in GAUSSIAN_FIELDS
        }
        return cls(**fields, sh_rest=merged)


GAUSSIAN_FIELDS = ("mean_m", "quat_wxyz", "scale_m", "opacity", "rgb", "normal", "label", "intensity")


@dataclass(frozen=True)
class DynamicGaussians:
    """Gaussians that move: three knots each (paper section 3.1).

    ``gaussians.mean_m`` is the middle knot. Between knots positions are linear; opacity is multiplied by
    ``exp(-x**10)`` with x = (t - t2) / (t3 - t2) after the middle knot and (t2 - t) / (t2 - t1) before it, so a
    Gaussian lives from its first to its last knot. ``track`` indexes ``GaussianScene.tracks``, -1 for none. All
    positions and rotations are in the world, as recorded; re-posing an actor applies
    ``world_from_box(requested) @ inverse(track.path.at(t))``.
    """

    gaussians: Gaussians
    knot_t_us: Int64[np.ndarray, "n 3"]
    knot_m: Float32[np.ndarray, "n 3 3"]
    track: Int32[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.gaussians)

    @classmethod
    def empty(cls) -> DynamicGaussians:
        """No Gaussians."""
        return cls(Gaussians.empty(), np.zeros((0, 3), np.int64), np.zeros((0, 3, 3), np.float32),
                   np.zeros(0, np.int32))  # fmt: skip


@dataclass(frozen=True)
class GaussianScene:
    """A layered Gaussian world: what a reconstruction gives, an archive holds and a renderer draws.

    ``sky`` is a cubemap ``[6,h,h,3]`` of display-space colours, faces and axes as in ``geometry.cubemap_directions``.
    ``isp`` maps a camera id to ``[3,4]``: shown colour = ``isp[:, :3] @ colour + isp[:, 3]``, after sky compositing.
    ``provenance`` is plain JSON: method, settings, what was not known (no map, no boxes, ...).
    """

    id: str
    static: Gaussians
    dynamic: DynamicGaussians
    sky: Float32[np.ndarray, "6 h h 3"]
    isp: Mapping[str, Float64[np.ndarray, "3 4"]]
    rig: Rig
    ego: Trajectory
    tracks: Sequence[Track]
    road_map: RoadMap | None
    span_us: tuple[int, int]
    camera_times_us: Mapping[str, Int64[np.ndarray, "frames 2"]] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)


# --------------------------------------------------------------------------------------------------------- sensing


@dataclass(frozen=True)
class SensorRequest:
    """Ask for one frame: sensor, exposure [start, end), its poses at both ends, and actors to re-pose.

    ``actors`` maps track ids to ``world_from_box`` at start and end; tracks not named move as recorded.
    """

    scene_id: str
    sensor: CameraModel | LidarModel
    start_us: int
    end_us: int
    world_from_sensor: Float64[np.ndarray, "2 4 4"]
    actors: Mapping[str, Float64[np.ndarray, "2 4 4"]] = field(default_factory=dict)


@dataclass(frozen=True)
class CameraFrame:
    """A rendered image. ``depth_m`` is the distance along the optical axis of the visible surface, 0 where none."""

    camera: CameraModel
    start_us: int
    end_us: int
    rgb: UInt8[np.ndarray, "h w 3"]
    depth_m: Float32[np.ndarray, "h w"] | None = None
    alpha: Float32[np.ndarray, "h w"] | None = None
    label: UInt8[np.ndarray, "h w"] | None = None
    normal: Float32[np.ndarray, "h w 3"] | None = None


@dataclass(frozen=True)
class LidarFrame:
    """A simulated sweep: returns only, in the sensor frame at the end of the spin; beam = row * columns + column."""

    lidar: LidarModel
    start_us: int
    end_us: int
    xyz_m: Float32[np.ndarray, "n 3"]
    range_m: Float32[np.ndarray, " n"]
    intensity: Float32[np.ndarray, " n"]
    beam: Int32[np.ndarray, " n"]


SensorFrame = CameraFrame | LidarFrame
Sense = Callable[[Sequence[SensorRequest]], Sequence[SensorFrame]]
"""Renders requests, one frame each, in order: the loop's only view of a renderer, a server or the true world."""


# ----------------------------------------------------------------------------------------------------- closed loop


@dataclass(frozen=True)
class EgoState:
    """The car at one instant: rig pose, speed along x, acceleration, yaw rate, front-wheel angle."""

    t_us: int
    world_from_rig: Matrix4
    speed_mps: float
    accel_mps2: float = 0.0
    yaw_rate_radps: float = 0.0
    steering_rad: float = 0.0


@dataclass(frozen=True)
class ActorState:
    """A true actor around the ego, in the rig frame of now. Only policies that declare ``privileged`` see it."""

    id: str
    label: str
    size_m: tuple[float, float, float]
    rig_from_box: Matrix4
    velocity_mps: Float64[np.ndarray, " 2"]


@dataclass(frozen=True)
class Observation:
    """What a policy sees at ``t_us``.

    ``route_m`` is up to 20 way points over the next 80 m of the recorded path, in the rig frame;
    ``route_speed_mps`` the recorded speed at each. ``recorded`` is the recorded future (t_us, x, y, yaw in the rig
    frame) for log replay. ``actors`` is None unless the policy declared ``privileged``.
    """

    t_us: int
    ego: EgoState
    history: tuple[EgoState, ...]
    cameras: Mapping[str, CameraFrame]
    lidars: Mapping[str, LidarFrame]
    route_m: Float64[np.ndarray, "k 2"]
    route_speed_mps: Float64[np.ndarray, " k"]
    recorded_t_us: Int64[np.ndarray, " m"]
    recorded_pose: Float64[np.ndarray, "m 3"]
    actors: tuple[ActorState, ...] | None = None


@dataclass(frozen=True)
class Plan:
    """A policy's answer: poses (x, y, yaw) in the rig frame of the observation at increasing times after it.

    At least 2.5 s ahead; return 5 s. ``stop_session`` asks to end the rollout.
    """

    t_us: Int64[np.ndarray, " k"]
    pose: Float64[np.ndarray, "k 3"]
    stop_session: bool = False


@dataclass(frozen=True)
class Needs:
    """What a policy reads; the loop renders nothing else.

    ``cameras`` and ``lidars`` are sensor ids of the rig, or the aliases ``front`` (the camera that looks most
    forward) and ``any`` (the first LiDAR). Images are rendered at ``image_width_px``, keeping the field of view.
    """

    cameras: tuple[str, ...] = ()
    lidars: tuple[str, ...] = ()
    image_width_px: int = 320
    privileged: bool = False


class Policy(Protocol):
    """A driver. One instance drives one rollout at a time."""

    name: str
    needs: Needs

    def reset(self, rig: Rig, seed: int) -> None:
        """Forget everything; a new rollout begins."""
        ...

    def plan(self, observation: Observation) -> Plan:
        """Answer with the poses to drive."""
        ...


@dataclass(frozen=True)
class Event:
    """Something that happened in a rollout: ``kind`` such as ``plan_error`` or ``stop_session``, with a text."""

    t_us: int
    kind: str
    text: str = ""


@dataclass(frozen=True)
class Rollout:
    """One policy driven through one scene once.

    ``states`` are at 10 Hz; ``actors[id]`` holds ``world_from_box [t,4,4]`` at the same times, NaN while absent.
    ``status`` is ``ok`` or ``failed``; a failed rollout keeps its states up to the failure and its error text.
    """

    scenario: str
    scene_id: str
    reconstruction: str
    policy: str
    seed: int
    rig: Rig
    states: tuple[EgoState, ...]
    actors: Mapping[str, Float64[np.ndarray, "t 4 4"]]
    actor_sizes_m: Mapping[str, tuple[float, float, float]]
    actor_labels: Mapping[str, str]
    recorded: Trajectory
    plans: tuple[tuple[int, Plan], ...]
    events: tuple[Event, ...] = ()
    status: str = "ok"
    error: str = ""
    first_closed_loop_us: int = 0

    @property
    def t_us(self) -> Int64[np.ndarray, " t"]:
        """Times of the states."""
        return np.array([state.t_us for state in self.states], dtype=np.int64)

    @property
    def world_from_rig(self) -> Float64[np.ndarray, "t 4 4"]:
        """Ego poses."""
        return np.array([state.world_from_rig for state in self.states], dtype=np.float64).reshape(-1, 4, 4)


class Reduce(enum.Enum):
    """How a series becomes one number."""

    MEAN = "mean"
    MEDIAN = "median"
    MAX = "max"
    MIN = "min"
    LAST = "last"


@dataclass(frozen=True)
class Series:
    """One metric over time. ``valid`` marks the values that could be computed; the others are never counted."""

    name: str
    unit: str
    t_us: Int64[np.ndarray, " t"]
    values: Float64[np.ndarray, " t"]
    valid: np.ndarray
    reduce: Reduce

    def value(self) -> float:
        """The series as one number; NaN where nothing is valid."""
        values = np.asarray(self.values, np.float64)[np.asarray(self.valid, bool)]
        if len(values) == 0:
            return float("nan")
        if self.reduce is Reduce.LAST:
            return float(values[-1])
        return float(getattr(np, self.reduce.value)(values))
