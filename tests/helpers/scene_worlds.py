"""Named scenes for the tests of the archive: small, and with one of everything."""

import numpy as np
import shapely

from nurec_sim import geometry
from nurec_sim.lenses import Fisheye, FTheta, FThetaReference, Pinhole
from nurec_sim.scene.precision import archived
from nurec_sim.sensors import lidar_model
from nurec_sim.types import (
    Box,
    CameraModel,
    DynamicGaussians,
    Gaussians,
    GaussianScene,
    Label,
    Rig,
    RoadMap,
    Shutter,
    Track,
    Trajectory,
    Windshield,
    WindshieldReference,
)

START_US = 1_700_000_000_123_457
END_US = START_US + 4_000_001
FRONT = np.array([[0.0, 0.0, 1.0, 1.7], [-1.0, 0.0, 0.0, 0.1], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]])


def gaussians(count: int, seed: int, sh_terms: int = 0) -> Gaussians:
    """Random Gaussians over 60 m of street: labels of every kind, half of the intensities unknown."""
    rng = np.random.default_rng(seed)
    f32 = np.float32
    intensity = rng.random(count, f32)
    intensity[rng.random(count) < 0.5] = np.nan
    rest = rng.normal(size=(count, sh_terms, 3)).astype(f32) if sh_terms else None
    return Gaussians(
        mean_m=rng.uniform([-5, -20, 0.2], [60, 20, 8], (count, 3)).astype(f32),
        quat_wxyz=geometry.quat_normalize(rng.normal(size=(count, 4))).astype(f32),
        scale_m=rng.uniform(0.01, 0.3, (count, 3)).astype(f32),
        opacity=rng.random(count, f32),
        rgb=rng.random((count, 3), f32),
        normal=rng.normal(size=(count, 3)).astype(f32),
        label=rng.choice([Label.OTHER, Label.ROAD, Label.MOVABLE], count).astype(np.uint8),
        intensity=intensity,
        sh_rest=rest,
    )


def road_height(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """A road that climbs, is crowned, and rolls gently."""
    return 0.03 * x_m - 0.02 * np.abs(y_m) + 0.3 * np.sin(x_m / 15)


def curved_path(count: int = 41) -> Trajectory:
    """A left turn of radius 40 m driven at 12 m/s on the road of ``road_height``."""
    s = np.linspace(0, 48, count)
    yaw = s / 40
    x, y = 40 * np.sin(yaw), 40 * (1 - np.cos(yaw))
    poses = [geometry.pose_from_xyyaw(*xyt) for xyt in zip(x, y, yaw, road_height(x, y), strict=True)]
    return Trajectory(START_US + (s / 12 * 1e6).astype(np.int64), np.stack(poses))


def cameras() -> dict[str, CameraModel]:
    """Every lens, shutter and windshield."""
    glass = Windshield(
        WindshieldReference.BACKWARD, (1e-4, 1.001, 2e-5, 0.0, 0.0, 1e-5), (0.0, 1e-5, 1e-5, 1.002, 1e-5, 0.0),
        (-1e-4, 0.999, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.998, 0.0, 0.0),
    )  # fmt: skip
    pinhole = Pinhole(
        801.1, 799.9, 639.7, 360.2, (-0.31, 0.11, 1e-3, 0.01, 0.02, 3e-4), (1e-4, -2e-4), (1e-5, 2e-5, 0.0, 1e-6)
    )
    ftheta = FTheta(
        640.25, 360.75, FThetaReference.PIXELDIST_TO_ANGLE, (0.0, 1 / 600, 0.0, 1e-11), (), 1.2, (1.001, 1e-4, -1e-4)
    )
    lenses = {
        "front": (pinhole, Shutter.TOP_TO_BOTTOM, glass),
        "left": (Fisheye(300.0, 301.0, 640.0, 360.0, (0.01, -0.003, 1e-4, 0.0), 1.4), Shutter.LEFT_TO_RIGHT, None),
        "rear": (ftheta, Shutter.BOTTOM_TO_TOP, None),
        "right": (Pinhole(500.0, 500.0, 640.0, 360.0), Shutter.RIGHT_TO_LEFT, None),
        "roof": (Pinhole(500.0, 510.0, 630.0, 365.0), Shutter.GLOBAL, None),
    }
    return {
        name: CameraModel(name, 1280, 720, lens, FRONT.copy(), shutter, glass)
        for name, (lens, shutter, glass) in lenses.items()
    }


def moving_car(track: int, count: int, seed: int, sh_terms: int) -> DynamicGaussians:
    """Two windows of three knots of a moving thing."""
    part = gaussians(count, seed, sh_terms)
    window = np.arange(count) % 2
    knots_us = START_US + np.array([[0, 500_000, 1_000_000], [500_000, 1_000_000, 1_500_003]])[window]
    steps = np.array([-1.0, 0.0, 1.0], np.float32)[None, :, None] * np.array([3.0, 0.1, 0.0], np.float32)
    return DynamicGaussians(part, knots_us, part.mean_m[:, None] + steps, np.full(count, track, np.int32))


def join(parts: list[DynamicGaussians]) -> DynamicGaussians:
    """All moving Gaussians one after the other, then shuffled."""
    order = np.random.default_rng(9).permutation(sum(map(len, parts)))
    return DynamicGaussians(
        Gaussians.concatenate([part.gaussians for part in parts])[order],
        *(np.concatenate([getattr(part, name) for part in parts])[order] for name in ("knot_t_us", "knot_m", "track")),
    )


def full_scene(sh_terms: int = 8) -> GaussianScene:
    """A scene with one of everything an archive can hold, at the precision of archives."""
    rng = np.random.default_rng(1)
    still = Trajectory(np.array([START_US]), geometry.pose_from_xyyaw(20, -4, 0.3, 0.7)[None])
    tracks = [
        Track("1/car", "automobile", (4.5, 1.9, 1.6), curved_path(9)),
        Track("1:car", "person", (0.6, 0.7, 1.8), still, controllable=False),
    ]
    lane = curved_path().position_m
    street = np.array(shapely.LineString(lane[::8, :2]).buffer(4.0, cap_style="square").exterior.coords)[:-1]
    hole = np.array([[18.0, 1.5], [19.0, 2.0], [19.0, 3.0]])
    lidars = {name: lidar_model(name, FRONT.copy(), id=name, columns=90) for name in ("VLP-16", "PANDAR128")}
    scene = GaussianScene(
        id="clip-é \"7\"",
        static=gaussians(400, 3, sh_terms),
        dynamic=join([moving_car(0, 40, 4, sh_terms), moving_car(1, 6, 5, sh_terms), moving_car(-1, 7, 6, sh_terms)]),
        sky=rng.random((6, 8, 8, 3), np.float32),
        isp={"front": rng.normal(size=(3, 4)), "rear": np.eye(3, 4)},
        rig=Rig(cameras(), lidars, Box((1.4, 0.01, 0.75), (4.9, 1.9, 1.5))),
        ego=curved_path(),
        tracks=tracks,
        road_map=RoadMap(((street, hole), (hole * 3 + 100,)), (lane,)),
        span_us=(START_US, END_US),
        camera_times_us={"front": START_US + np.array([[0, 30_000], [100_000, 130_000]]),
                         "roof": START_US + np.array([[60_005, 60_005]])},
        provenance={"method": "lift", "settings": {"voxel_m": 0.1, "names": ["a", None, True, 3]}},
    )  # fmt: skip
    return archived(scene)


def empty_scene() -> GaussianScene:
    """The least there can be: no Gaussians, no sensors, a car that stands still."""
    ego = Trajectory(np.array([2_000_000]), np.eye(4)[None])
    return GaussianScene("empty", Gaussians.empty(), DynamicGaussians.empty(), np.zeros((6, 1, 1, 3), np.float32), {},
                         Rig({}, {}), ego, [], None, (1_000_000, 3_000_000))  # fmt: skip


def hilly_road(seed: int = 0) -> GaussianScene:
    """Road Gaussians along ``curved_path`` on the surface of ``road_height``, with a hole and a few outliers."""
    rng = np.random.default_rng(seed)
    path = curved_path()
    t_us = rng.integers(path.start_us, path.end_us, 12_000)
    poses = path.at(t_us)
    xy = poses[:, :2, 3] + poses[:, :2, 1] * rng.uniform(-6, 6, (len(t_us), 1))
    xy = xy[np.linalg.norm(xy - poses[3, :2, 3], axis=1) > 1.0]
    road = gaussians(len(xy), seed)
    road.mean_m[:, :2], road.mean_m[:, 2] = xy, road_height(*xy.T)
    road.mean_m[:10, 2] += 40
    road.label[:] = Label.ROAD
    base = empty_scene()
    return archived(
        GaussianScene("hilly", road, base.dynamic, base.sky, {}, base.rig, path, [], None, (START_US, END_US))
    )
