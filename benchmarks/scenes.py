"""The scenes of the benchmarks: seeded streets that each stress something else, and one reconstructed from a log."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import street

from nurec_sim import geometry
from nurec_sim.types import DynamicGaussians, Gaussians, GaussianScene, Label, Matrix4, Rig, Track, Trajectory

START_US = 2_000_000
PATH_S = 2.0
"""Every path takes this long."""
ROOT = Path(__file__).parent.parent
DEMO_LOG = ROOT / "scenarios" / "demo_clip.zip"
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class BenchScene:
    """A scene and the paths through it: ``world_from_rig`` at 0..``PATH_S`` seconds after ``start_us``, by name."""

    scene: GaussianScene
    paths: Mapping[str, Callable[[float], Matrix4]]
    start_us: int
    about: str


# ------------------------------------------------------------------------------------------------------------ paths

STREET_PATHS = ("drive", "turn", "aside", "back")
LOG_PATHS = {"drive": 0.0, "beside": 1.5}
PATHS = (*STREET_PATHS, "beside")
SPEED_MPS = 9.0


def street_path(name: str, uphill_deg: float = 0.0, seed: int = 7) -> Callable[[float], Matrix4]:
    """A drive along the street; looking ahead, turning from side to side, 60 degrees aside, or back."""
    up = np.radians(uphill_deg)
    nose_up = geometry.pose(
        np.array([[np.cos(up), 0, -np.sin(up)], [0, 1, 0], [np.sin(up), 0, np.cos(up)]]), np.zeros(3)
    )
    sway_m, phase = np.random.default_rng([seed, STREET_PATHS.index(name)]).uniform([0.1, 0.0], [0.3, 6.0])
    start_x = 40.0 if name == "back" else 13.0
    heading_deg = {"drive": 0.0, "turn": 0.0, "aside": 60.0, "back": 180.0}[name]

    def rig(t_s: float) -> Matrix4:
        yaw_deg = heading_deg + np.sin(2 * t_s + phase)
        if name == "turn":
            yaw_deg += 50.0 * np.sin(np.pi * (t_s / PATH_S - 0.5))
        y = street.LANE_Y_M + sway_m * np.sin(1.7 * t_s + phase)
        return geometry.pose_from_xyyaw(start_x + SPEED_MPS * t_s, y, np.radians(yaw_deg)) @ nose_up

    return rig


def log_path(ego: Trajectory, beside_m: float) -> Callable[[float], Matrix4]:
    """The first seconds of the recorded drive, ``beside_m`` to its left."""
    offset = geometry.pose_from_xyyaw(0.0, beside_m, 0.0)
    return lambda t_s: ego.at(ego.start_us + round(t_s * 1e6)) @ offset


# ----------------------------------------------------------------------------------------------------------- scenes


def driving(count: int = 300_000) -> BenchScene:
    """A street with houses, parked cars and trees, and three cars that move: the scene of the headline numbers."""
    rng = np.random.default_rng(1)
    moving, tracks = oncoming_cars(count // 40, rng)
    static = street.surfels(street.street_boxes(rng), count - len(moving), rng)
    return street_scene("driving", static, moving, tracks, driving.__doc__)


def view_dependent(count: int = 300_000) -> BenchScene:
    """The driving scene with spherical harmonics of degree 3."""
    base = driving(count)
    rng = np.random.default_rng(2)

    def shine(gaussians: Gaussians) -> Gaussians:
        return dataclasses.replace(gaussians, sh_rest=rng.normal(0, 0.04, (len(gaussians), 15, 3)).astype(np.float32))

    dynamic = dataclasses.replace(base.scene.dynamic, gaussians=shine(base.scene.dynamic.gaussians))
    scene = dataclasses.replace(base.scene, static=shine(base.scene.static), dynamic=dynamic)
    return dataclasses.replace(base, scene=scene, about=view_dependent.__doc__)


def poles(count: int = 300_000) -> BenchScene:
    """A third of the Gaussians are needles a centimetre thick: poles, wires and fences."""
    rng = np.random.default_rng(3)
    needles = needle_gaussians(count // 3, rng)
    static = street.surfels(street.street_boxes(rng, facades=False), count - len(needles), rng)
    return street_scene("poles", Gaussians.concatenate([static, needles]), about=poles.__doc__)


def haze(count: int = 300_000) -> BenchScene:
    """A dark street in a haze of large, faint Gaussians: every ray meets hundreds before it ends."""
    rng = np.random.default_rng(4)
    n = count // 8
    static = street.surfels(street.street_boxes(rng), count - n, rng)
    static = dataclasses.replace(static, rgb=static.rgb * np.float32(0.18))
    point = rng.uniform((-10, -11, 0), (140, 11, 7), (n, 3))
    lamp = np.exp(-np.abs((point[:, 0] + 6) % 12 - 6) / 2)[:, None]
    fog = street.gaussians_of(
        point,
        rng.uniform(0.25, 0.7, (n, 3)),
        geometry.quat_normalize(rng.standard_normal((n, 4))),
        opacity=rng.uniform(0.01, 0.06, n),
        rgb=(0.08, 0.09, 0.12) + lamp * (0.9, 0.6, 0.25),
    )
    return street_scene("haze", Gaussians.concatenate([static, fog]), sky=0.06, about=haze.__doc__)


def open_sky(count: int = 300_000) -> BenchScene:
    """A crest in open land, the nose up: two thirds of the rays end in the sky."""
    rng = np.random.default_rng(5)
    static = street.surfels(street.street_boxes(rng, facades=False), count, rng)
    return street_scene("sky", static, about=open_sky.__doc__, uphill_deg=11.0)


def large(count: int) -> BenchScene:
    """The street of the driving scene in finer Gaussians, most of them smaller than a pixel."""
    rng = np.random.default_rng(6)
    static = street.surfels(street.street_boxes(rng), count, rng)
    return street_scene("large", static, about=large.__doc__)


def real_log(progress: Progress | None = None) -> BenchScene:
    """A recorded log lifted to Gaussians: a real one where there is one, else the one that ships with the package."""
    folder = Path(os.environ.get("NUREC_SIM_REALDATA", ROOT.parent / "shared" / "realdata"))
    choices = [folder / "kitti_raw_0009", folder / "ddad_6cam", DEMO_LOG]
    return lifted(next(path for path in choices if path.exists()), progress)


def demo_log(progress: Progress | None = None) -> BenchScene:
    """The log that ships with the package, lifted to nearly two million Gaussians, some of them moving."""
    return lifted(DEMO_LOG, progress)


def lifted(clip: Path, progress: Progress | None) -> BenchScene:
    """A log lifted to Gaussians; the archive is kept in ``build/bench_scenes``."""
    from nurec_sim.serving.store import SceneStore

    store = SceneStore([clip], cache_dir=ROOT / "build" / "bench_scenes")
    scene = store.get(store.ids[0], progress=progress).scene
    paths = {name: log_path(scene.ego, beside) for name, beside in LOG_PATHS.items()}
    return BenchScene(scene, paths, scene.ego.start_us, f"{clip.stem}, reconstructed by the method 'lift'")


SCENES: dict[str, Callable[[], BenchScene]] = {
    "driving": driving,
    "view-dependent": view_dependent,
    "poles": poles,
    "haze": haze,
    "sky": open_sky,
    "real": real_log,
    "lifted": demo_log,
    "2m": lambda: large(2_000_000),
    "6m": lambda: large(6_000_000),
}


# ------------------------------------------------------------------------------------------------------------ parts


def street_scene(
    name: str,
    static: Gaussians,
    dynamic: DynamicGaussians | None = None,
    tracks: Sequence[Track] = (),
    about: str | None = None,
    sky: float = 1.0,
    uphill_deg: float = 0.0,
) -> BenchScene:
    """A scene of Gaussians along the street, under a sky of brightness ``sky`` that darkens upwards."""
    up = np.clip(geometry.cubemap_directions(64)[..., 2:], 0, 1)
    cubemap = sky * ((0.80, 0.86, 0.93) * (1 - up) + (0.30, 0.48, 0.78) * up)
    end_us = START_US + int(PATH_S * 1e6) + 1_000_000
    scene = GaussianScene(
        id=name,
        static=static,
        dynamic=DynamicGaussians.empty() if dynamic is None else dynamic,
        sky=cubemap.astype(np.float32),
        isp={"camera": np.array([[1.02, 0.01, 0, 0.005], [0, 0.98, 0, 0.0], [0, 0.01, 1.01, -0.004]])},
        rig=Rig({}, {}),
        ego=Trajectory(np.array([START_US]), np.eye(4)[None]),
        tracks=list(tracks),
        road_map=None,
        span_us=(START_US - 1_000_000, end_us),
    )
    return BenchScene(scene, {path: street_path(path, uphill_deg) for path in STREET_PATHS}, START_US, about or name)


def oncoming_cars(count: int, rng: np.random.Generator) -> tuple[DynamicGaussians, list[Track]]:
    """Cars that come towards the rig and one that leads it, as Gaussians on their sides."""
    times = START_US + np.array([-1_000_000, 1_000_000, 5_000_000])
    size = np.array([4.4, 1.8, 1.5])
    parts, knots, owners, tracks = [], [], [], []
    for k, (x, y, speed) in enumerate(((34.0, -2.0, 9.0), (45.0, 2.0, -9.0), (70.0, 2.0, -12.0))):
        seconds = (times - START_US) / 1e6
        poses = np.stack([geometry.pose_from_xyyaw(x + speed * s, y, 0.0 if speed > 0 else np.pi) for s in seconds])
        tracks.append(Track(f"car-{k}", "automobile", tuple(size), Trajectory(times, poses)))
        n = count // 3
        spacing = np.sqrt(2 * (size[0] * size[1] / 2 + size[0] * size[2] + size[1] * size[2]) / max(n, 1))
        axis = rng.choice(3, n, p=(0.2, 0.5, 0.3))
        facing = np.where(axis == 2, 1.0, rng.choice((-1.0, 1.0), n))
        local = rng.uniform(-0.5, 0.5, (n, 3))
        local[np.arange(n), axis] = 0.5 * facing
        local = local * size + (0, 0, 0.9)
        glass = (local[:, 2] > 1.0) & (axis != 2)
        paint = np.where(glass[:, None], 0.12, rng.uniform(0.1, 0.9, 3))
        body = street.gaussians_of(
            local,
            spacing * np.array([0.62, 0.62, 0.12]) * np.exp(0.3 * rng.standard_normal((n, 3))),
            street.lying_on(axis, facing, rng),
            opacity=rng.uniform(0.3, 0.99, n),
            rgb=np.clip(paint + rng.normal(0, 0.03, (n, 3)), 0, 1),
            label=Label.MOVABLE,
            normal=facing[:, None] * np.eye(3)[axis],
            intensity=0.5,
        )
        place = np.stack([geometry.transform_points(pose, local) for pose in poses], axis=1).astype(np.float32)
        turn = np.broadcast_to(geometry.quat_from_matrix(poses[1, :3, :3]), (n, 4))
        parts.append(
            dataclasses.replace(
                body,
                mean_m=place[:, 1],
                quat_wxyz=geometry.quat_multiply(turn, body.quat_wxyz).astype(np.float32),
                normal=(body.normal @ poses[1, :3, :3].T).astype(np.float32),
            )
        )
        knots.append(place)
        owners.append(np.full(n, k, np.int32))
    cars = Gaussians.concatenate(parts)
    knot_t_us = np.broadcast_to(times, (len(cars), 3)).copy()
    return DynamicGaussians(cars, knot_t_us, np.concatenate(knots), np.concatenate(owners)), tracks


def needle_gaussians(count: int, rng: np.random.Generator) -> Gaussians:
    """Upright poles and fence bars, and wires along the street: thin in two directions, long in the third."""
    length = 0.25
    wire = rng.random(count) < 0.3
    line = rng.integers(0, 8, count)
    post = rng.integers(0, 700, count)
    post_xy = np.stack([rng.uniform(-5, 110, 700), rng.choice((-1, 1), 700) * rng.uniform(7.6, 9.5, 700)], axis=1)
    height = np.where(rng.random(700) < 0.85, 1.4, 6.0)
    point = np.where(
        wire[:, None],
        np.stack([rng.uniform(-10, 130, count), (line - 3.5) * 2.2, 5.5 + 0.15 * line], axis=1),
        np.column_stack([post_xy[post], rng.random(count) * height[post]]),
    )
    h = np.sqrt(0.5)
    quat = np.where(wire[:, None], (h, 0.0, h, 0.0), (1.0, 0.0, 0.0, 0.0))
    scale = np.array([0.010, 0.010, length / 2]) * np.exp(0.2 * rng.standard_normal((count, 3)))
    return street.gaussians_of(
        point + rng.normal(0, 0.004, point.shape),
        scale,
        quat,
        opacity=rng.uniform(0.4, 0.99, count),
        rgb=np.where(wire[:, None], 0.08, 0.35) + rng.normal(0, 0.03, (count, 3)),
        intensity=0.3,
    )
