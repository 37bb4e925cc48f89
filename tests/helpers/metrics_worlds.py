"""Named worlds for the tests of metrics and reports: rollouts by hand, and a Gaussian S-curve with its true polygon."""

from __future__ import annotations

import dataclasses

import numpy as np

from nurec_sim import geometry
from nurec_sim.sensors import lidar_model
from nurec_sim.types import (
    CameraModel,
    DynamicGaussians,
    EgoState,
    Event,
    Gaussians,
    GaussianScene,
    Label,
    Pinhole,
    Plan,
    Rig,
    RoadMap,
    Rollout,
    Track,
    Trajectory,
)

T0_US = 2_000_000
STEP_US = 100_000
CAR_M = (4.5, 1.8, 1.5)
LOOK_FORWARD = np.array([[0.0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.4], [0, 0, 0, 1]])


def rig() -> Rig:
    camera = CameraModel("front", 64, 36, Pinhole(50.0, 50.0, 32.0, 18.0), LOOK_FORWARD)
    return Rig({"front": camera}, {})


def straight_poses(count: int, speed_mps: float = 10.0, y: float = 0.0, x0: float = 0.0, z: float = 0.0) -> np.ndarray:
    return np.stack([geometry.pose_from_xyyaw(x0 + speed_mps * 0.1 * i, y, 0.0, z) for i in range(count)])


def rollout(
    poses: np.ndarray,
    actors: dict[str, np.ndarray] | None = None,
    recorded: np.ndarray | None = None,
    warm_up: int = 0,
    sizes: dict[str, tuple[float, float, float]] | None = None,
    **changes,
) -> Rollout:
    """States along ``poses`` at 10 Hz, with speeds, accelerations and yaw rates by differences."""
    actors = actors or {}
    t_us = T0_US + STEP_US * np.arange(len(poses))
    recorded = poses if recorded is None else recorded
    if len(poses) > 1:
        speed = np.linalg.norm(np.gradient(poses[:, :2, 3], 0.1, axis=0), axis=1)
        accel = np.gradient(speed, 0.1)
        yaw_rate = np.gradient(np.unwrap(geometry.yaw_of(poses)), 0.1)
    else:
        speed = accel = yaw_rate = np.zeros(len(poses))
    states = tuple(
        EgoState(int(t), pose, float(v), float(a), float(w))
        for t, pose, v, a, w in zip(t_us, poses, speed, accel, yaw_rate, strict=True)
    )
    plan_t = np.arange(1, 51) * STEP_US
    plans = tuple(
        (int(t), Plan(t + plan_t, np.stack([speed[i] * plan_t / 1e6, np.zeros(50), np.zeros(50)], axis=1)))
        for i, t in enumerate(t_us)
        if i % 5 == 0
    )
    fields = {
        "scenario": "drive",
        "scene_id": "street",
        "reconstruction": "lift",
        "policy": "route_follower",
        "seed": 0,
        "rig": rig(),
        "states": states,
        "actors": actors,
        "actor_sizes_m": {actor: (sizes or {}).get(actor, CAR_M) for actor in actors},
        "actor_labels": dict.fromkeys(actors, "automobile"),
        "recorded": Trajectory(T0_US + STEP_US * np.arange(len(recorded)), recorded),
        "plans": plans,
        "events": (),
        "first_closed_loop_us": T0_US + STEP_US * warm_up,
    }
    return Rollout(**{**fields, **changes})


def failed_rollout(**changes) -> Rollout:
    """A policy that raised before the first state."""
    broken = {"states": (), "plans": (), "status": "failed", "error": "PlanError: plan has NaN poses"}
    broken["events"] = (Event(T0_US, "plan_error", "plan has NaN poses"),)
    return rollout(straight_poses(2), **{**broken, **changes})


def standing(count: int, x: float, y: float, yaw: float = 0.0, z: float = 0.75) -> np.ndarray:
    return np.repeat(geometry.pose_from_xyyaw(x, y, yaw, z)[None], count, axis=0)


def full_rollout() -> Rollout:
    """Every field of a rollout in use: a LiDAR, an actor that appears late, a plan that ends the session, an event."""
    sensors = Rig(rig().cameras, {"top": lidar_model("VLP-16", np.eye(4), id="top", columns=90)})
    poses = standing(20, 15.0, 3.0)
    poses[:4] = np.nan
    run = rollout(straight_poses(20), {"a": poses, "b": standing(20, 40, 0)}, rig=sensors)
    stop = (run.plans[-1][0], Plan(run.plans[-1][1].t_us[:3], run.plans[-1][1].pose[:3], stop_session=True))
    return dataclasses.replace(run, plans=(*run.plans[:-1], stop), events=(Event(2_000_000, "clipped", "ä \n 'x'"),))


# ------------------------------------------------------------------------------------------------- Gaussian S-curve

ROAD_HALF_M = 3.7
SIDEWALK_M = 3.0
LENGTH_M = 120.0


def curve_y(x: np.ndarray) -> np.ndarray:
    return 6.0 * np.sin(np.asarray(x) / LENGTH_M * 2 * np.pi)


def curve_yaw(x: np.ndarray) -> np.ndarray:
    return np.arctan(6.0 * 2 * np.pi / LENGTH_M * np.cos(np.asarray(x) / LENGTH_M * 2 * np.pi))


def curve_height(x: np.ndarray, grade: float) -> np.ndarray:
    return grade * np.asarray(x)


def curve_points(x: np.ndarray, offset: np.ndarray) -> np.ndarray:
    yaw = curve_yaw(x)
    return np.stack([x - offset * np.sin(yaw), curve_y(x) + offset * np.cos(yaw)], axis=-1)


def s_curve_path(grade: float = 0.0) -> Trajectory:
    """The recorded drive: on the centre line, 10 m/s, rig origin on the ground."""
    x = np.arange(8.0, LENGTH_M - 8.0, 1.0)
    y, yaw, z = curve_y(x), curve_yaw(x), curve_height(x, grade)
    poses = np.stack([geometry.pose_from_xyyaw(*pose) for pose in zip(x, y, yaw, z, strict=True)])
    return Trajectory(T0_US + STEP_US * np.arange(len(x)), poses)


def s_curve_map() -> RoadMap:
    x = np.linspace(0, LENGTH_M, 400)
    left, right = curve_points(x, np.full_like(x, ROAD_HALF_M)), curve_points(x, np.full_like(x, -ROAD_HALF_M))
    return RoadMap(drivable=((np.concatenate([right, left[::-1]]),),))


def s_curve_gaussians(
    seed: int = 0,
    density: float = 60.0,
    confusion: float = 0.01,
    boundary_jitter_m: float = 0.10,
    parked: int = 3,
    bridge: bool = True,
    grade: float = 0.0,
    noise_m: float = 0.02,
) -> Gaussians:
    """Road, raised sidewalks, a bridge deck above, faint floaters, holes under parked cars, wrong labels."""
    draw = np.random.default_rng(seed)
    half = ROAD_HALF_M + SIDEWALK_M
    count = int(density * LENGTH_M * 2 * half)
    x, offset = draw.uniform(0, LENGTH_M, count), draw.uniform(-half, half, count)
    seen_offset = offset + draw.normal(0, boundary_jitter_m, count)
    road = np.abs(seen_offset) < ROAD_HALF_M
    z = curve_height(x, grade) + np.where(np.abs(offset) < ROAD_HALF_M, 0.0, 0.15) + draw.normal(0, noise_m, count)
    keep = np.ones(count, bool)
    for car in range(parked):
        along, side = LENGTH_M * (car + 1) / (parked + 1), 1 if car % 2 else -1
        keep &= ~((np.abs(x - along) < 2.4) & (np.abs(offset - side * 2.3) < 1.0))
    road ^= draw.random(count) < confusion
    xy = curve_points(x, offset)[keep] + draw.normal(0, noise_m, (int(keep.sum()), 2))
    parts = [(np.column_stack([xy, z[keep]]), road[keep], draw.uniform(0.6, 1.0, int(keep.sum())))]
    if bridge:
        n = int(density * 10 * 40)
        deck = np.column_stack([draw.uniform(55, 65, n), draw.uniform(-20, 20, n), np.full(n, 5.5)])
        deck[:, 2] += curve_height(deck[:, 0], grade)
        parts.append((deck, np.ones(n, bool), np.full(n, 0.9)))
    floaters = np.column_stack([draw.uniform(0, LENGTH_M, 2000), draw.uniform(-15, 15, 2000), draw.uniform(0, 2, 2000)])
    parts.append((floaters, draw.random(2000) < 0.5, np.full(2000, 0.04)))
    mean, is_road, opacity = (np.concatenate(column) for column in zip(*parts, strict=True))
    return gaussians(mean, np.where(is_road, Label.ROAD, Label.OTHER), opacity)


def gaussians(mean_m: np.ndarray, label: np.ndarray, opacity: np.ndarray | float = 0.9) -> Gaussians:
    """Small round Gaussians at given places."""
    empty, n = Gaussians.empty(len(mean_m)), len(mean_m)
    return Gaussians(
        mean_m.astype(np.float32), empty.quat_wxyz, np.full((n, 3), 0.05, np.float32),
        np.broadcast_to(np.asarray(opacity, np.float32), n).copy(), empty.rgb, empty.normal, label.astype(np.uint8),
        empty.intensity,
    )  # fmt: skip


def scene(static: Gaussians, ego: Trajectory, road_map: RoadMap | None = None, **provenance) -> GaussianScene:
    span = (ego.start_us, ego.end_us + 1)
    sky = np.zeros((6, 2, 2, 3), np.float32)
    return GaussianScene(
        "street", static, DynamicGaussians.empty(), sky, {}, rig(), ego, (), road_map, span, {}, provenance
    )


# ------------------------------------------------------------------------------------------------ flat closed loop


def flat_street(world_id: str = "street", duration_s: float = 3.0):
    """A flat hand-made world with a parked car, and a Gaussian scene that fits it."""
    from nurec_sim.sim.flat_world import flat_world

    line = np.column_stack([np.linspace(-20, 90, 60), np.zeros(60)])
    path = Trajectory(np.array([1_000_000, 60_000_000]), standing(2, 60.0, -1.75))
    parked = Track("parked", "automobile", CAR_M, path)
    world = flat_world(world_id, line, 8.0, duration_s=duration_s, tracks=(parked,))
    draw = np.random.default_rng(3)
    count = int(30 * 110 * 14)
    mean = np.column_stack([draw.uniform(-20, 90, count), draw.uniform(-7, 7, count), draw.normal(0, 0.02, count)])
    static = gaussians(mean, np.where(np.abs(mean[:, 1]) < world.road_width_m / 2, Label.ROAD, Label.OTHER))
    sky = np.zeros((6, 2, 2, 3), np.float32)
    facts = {"method": "lift", "unknown": ["no road map in the log"]}
    built = GaussianScene(
        world.id, static, DynamicGaussians.empty(), sky, {}, world.rig, world.ego, tuple(world.tracks), None,
        world.span_us, {}, facts,
    )  # fmt: skip
    return built, world
