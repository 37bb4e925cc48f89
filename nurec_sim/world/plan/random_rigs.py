"""Random sensor rigs with one to five cameras of any lens type, by seed.

Cameras of a rig share their size and the kind of their lenses. Angles in the tables are degrees.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from nurec_sim import geometry, sensors
from nurec_sim.lenses import Fisheye, FTheta, FThetaReference, Lens, Pinhole
from nurec_sim.types import CameraModel, LidarModel, Matrix4, Rig, Shutter
from nurec_sim.world.plan.rig import CAMERA_FROM_RIG_AXES, LIDAR_ID, dense_near_horizon

CAMERA_COUNTS = (1, 3, 5)
LENS_KINDS = {"pinhole": 0.6, "distorted": 0.15, "fisheye": 0.1, "ftheta": 0.15}
"""Probability of each lens type."""
SHUTTERS = {
    Shutter.GLOBAL: 0.72,
    Shutter.TOP_TO_BOTTOM: 0.2,
    Shutter.BOTTOM_TO_TOP: 0.04,
    Shutter.LEFT_TO_RIGHT: 0.04,
}
FIELD_DEG = {"pinhole": (45.0, 110.0), "distorted": (45.0, 100.0), "fisheye": (90.0, 140.0), "ftheta": (60.0, 125.0)}
"""Horizontal field of view from border to border."""
PATCH_PX = 14
ASPECT = (1.3, 3.3)
DEFAULT_LIDAR = "64x900"
SIDE_YAW_DEG, REAR_YAW_DEG = (45.0, 62.0), (125.0, 150.0)


def random_rig(
    seed: int,
    cameras: int | None = None,
    pixels: int = 65856,
    lens: str | None = None,
    lidar: str | None = DEFAULT_LIDAR,
) -> Rig:
    """The rig of ``seed``: the same arguments always give the same rig.

    Args:
        seed: at least 0.
        cameras: 1 (front), 3 (with front left and right) or 5 (with rear left and right); random if None.
        pixels: width times height, met within 10 percent; sides are multiples of 14 pixels.
        lens: ``pinhole``, ``distorted``, ``fisheye`` or ``ftheta``; random if None, most often a pinhole.
        lidar: ``64x900``, a key of ``sensors.LIDAR_TABLES``, or None for a rig without a LiDAR.

    Raises:
        ValueError: a value outside the options above; the message names it and the allowed ones.
    """
    if seed < 0:
        raise ValueError(f"a rig needs a seed >= 0, got {seed}")
    if cameras is not None and cameras not in CAMERA_COUNTS:
        raise ValueError(f"a rig has {', '.join(map(str, CAMERA_COUNTS))} cameras, got {cameras}")
    if lens is not None and lens not in LENS_KINDS:
        raise ValueError(f"no kind of lens {lens!r}; have {list(LENS_KINDS)}")
    if pixels < 64 * PATCH_PX**2:
        raise ValueError(f"an image needs at least {64 * PATCH_PX**2} pixels, got {pixels}")
    # The second key separates this stream from those of other generators with the same seed.
    rng = np.random.default_rng([seed, 0x416])
    count = int(rng.choice(CAMERA_COUNTS)) if cameras is None else cameras
    # Sampled even if ``lens`` overrides it, so that all later samples stay the same.
    kind = str(rng.choice(list(LENS_KINDS), p=list(LENS_KINDS.values())))
    shutter = list(SHUTTERS)[int(rng.choice(len(SHUTTERS), p=list(SHUTTERS.values())))]
    size = _size_px(rng, pixels)
    mounts, kind = _mounts(rng), lens or kind
    fields = np.repeat(np.deg2rad(rng.uniform(*FIELD_DEG[kind], 3)), (1, 2, 2))  # front, front sides, rear sides
    models = [
        _camera(rng, name, mounts[name], size, kind, float(field), shutter)
        for name, field in list(zip(mounts, fields, strict=True))[:count]
    ]
    return Rig({model.id: model for model in models}, _lidars(rng, lidar))


def random_readout_us(seed: int) -> int:
    """How long a rolling shutter of the rig of ``seed`` takes from its first to its last line: 8 to 33 ms."""
    return int(np.random.default_rng([seed, 0x4EAD]).integers(8_000, 33_001))


def _size_px(rng: np.random.Generator, pixels: int) -> tuple[int, int]:
    """Sides in whole patches: of all that meet the wanted number of pixels, those nearest to a random aspect ratio."""
    # Sides of whole patches keep images usable by networks that work on patches of 14 pixels.
    patches = pixels / PATCH_PX**2
    # Log-uniform: ratios have no preferred direction.
    wanted = np.exp(rng.uniform(*np.log(ASPECT)))
    rows = np.arange(4, int(np.sqrt(patches)) + 2)
    columns = np.maximum(np.rint(patches / rows), 4).astype(int)
    fits = np.abs(rows * columns / patches - 1) < 0.1
    # Distance in log ratio; sizes that miss the pixel count are out.
    off = np.where(fits, np.abs(np.log(columns / rows / wanted)), np.inf)
    best = int(np.argmin(off))
    return int(columns[best]) * PATCH_PX, int(rows[best]) * PATCH_PX


def _mounts(rng: np.random.Generator) -> dict[str, tuple[float, Float64[np.ndarray, " 3"]]]:
    """Yaw (radians) and place of all five cameras; left and right mirror each other up to a small misalignment."""
    front_x, rear_x, half = rng.uniform(1.3, 2.3), rng.uniform(-0.3, 1.0), rng.uniform(0.35, 0.85)
    height, aside = rng.uniform(1.2, 2.2), rng.uniform(*SIDE_YAW_DEG)
    behind, drop = rng.uniform(*REAR_YAW_DEG), rng.uniform(-0.2, 0.1)
    mounts = {"camera_front": (0.0, np.array([front_x, rng.normal(0, 0.05), height]))}
    for name, yaw, x in (("front", aside, front_x - 0.2), ("rear", behind, rear_x)):
        for side, word in ((1, "left"), (-1, "right")):
            place = np.array([x, side * half, max(height + drop, 1.2)])
            mounts[f"camera_{name}_{word}"] = (float(np.deg2rad(side * yaw)), place)
    return mounts


def _camera(
    rng: np.random.Generator,
    name: str,
    mount: tuple[float, Float64[np.ndarray, " 3"]],
    size_px: tuple[int, int],
    kind: str,
    field_rad: float,
    shutter: Shutter,
) -> CameraModel:
    yaw, place = mount
    tilt, roll = np.deg2rad(rng.normal(1.0, 2.0)), np.deg2rad(rng.normal(0.0, 0.7))
    # Yaw, then pitch, then roll, each with a small mounting error.
    turn = geometry.rotation_from_yaw(yaw + np.deg2rad(rng.normal(0, 1.2))) @ _pitch(tilt) @ _roll(roll)
    pose = geometry.pose(turn @ CAMERA_FROM_RIG_AXES, place)
    return CameraModel(name, *size_px, _lens(rng, kind, size_px, field_rad), pose, shutter)


def _pitch(down_rad: float) -> Float64[np.ndarray, "3 3"]:
    c, s = np.cos(down_rad), np.sin(down_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _roll(angle_rad: float) -> Float64[np.ndarray, "3 3"]:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _lens(rng: np.random.Generator, kind: str, size_px: tuple[int, int], field_rad: float) -> Lens:
    """A lens whose image is about ``field_rad`` wide; narrower and less distorted until every pixel has a ray."""
    width, height = size_px
    centre = float(width * rng.uniform(0.48, 0.52)), float(height * rng.uniform(0.4, 0.54))
    shape = rng.uniform(-1.0, 1.0, 6)
    # Strong distortion folds the image, so that rim pixels have no ray; easing towards an ideal lens removes the fold.
    for ease in 0.9 ** np.arange(20):
        lens = _MAKERS[kind](width, centre, ease * field_rad / 2, ease * shape)
        if sensors.pixel_rays(CameraModel("", width, height, lens, np.eye(4)))[1].all():
            break
    return lens


Centre = tuple[float, float]
Shape = Float64[np.ndarray, " 6"]
"""Deviation of each lens property from its nominal value, within -1..1."""


def _pinhole(width: int, centre: Centre, half_rad: float, shape: Shape) -> Lens:
    focal = width / 2 / np.tan(half_rad)
    return Pinhole(float(focal), float(focal * (1 + 0.01 * shape[0])), *centre)


def _distorted(width: int, centre: Centre, half_rad: float, shape: Shape) -> Lens:
    """Barrel or slight pincushion distortion."""
    # Distortion of the Brown-Conrady model: r (1 + k1 r^2 + k2 r^4 + k3 r^6).
    radial = (-0.12 + 0.18 * shape[0], 0.04 + 0.04 * shape[1], 0.01 * shape[2])
    edge = np.tan(half_rad)
    spread = edge * (1 + np.polynomial.polynomial.polyval(edge**2, (0.0, *radial)))
    # The ray at half the field lies on the image border; the bound keeps folded lenses finite.
    focal = float(width / 2 / max(spread, 0.3 * edge))
    k1, k2, k3 = (float(value) for value in radial)
    tangential = (float(6e-4 * shape[3]), float(6e-4 * shape[4]))
    return Pinhole(focal, focal, *centre, radial=(k1, k2, k3, 0.0, 0.0, 0.0), tangential=tangential)


def _angular(width: int, half_rad: float, shape: Shape) -> tuple[float, float, float]:
    """Focal length and two coefficients: distance = focal (angle + k1 angle^3 + k2 angle^5)."""
    k1, k2 = float(-0.02 + 0.06 * shape[0]), float(0.01 * shape[1])
    return float(width / 2 / (half_rad + k1 * half_rad**3 + k2 * half_rad**5)), k1, k2


def _fisheye(width: int, centre: Centre, half_rad: float, shape: Shape) -> Lens:
    focal, k1, k2 = _angular(width, half_rad, shape)
    return Fisheye(focal, focal * float(1 + 0.01 * shape[2]), *centre, radial=(k1, k2, 0.0, 0.0))


def _ftheta(width: int, centre: Centre, half_rad: float, shape: Shape) -> Lens:
    """With either polynomial as the reference."""
    focal, k1, k2 = _angular(width, half_rad, shape)
    distances = (0.0, focal, 0.0, focal * k1, 0.0, focal * k2)
    lens = FTheta(*centre, FThetaReference.ANGLE_TO_PIXELDIST, angle_to_pixeldist=distances)
    if shape[3] > 0:
        return lens
    # The inverse polynomial is fitted out to twice the image width, then becomes the reference.
    filled = sensors.fill_ftheta(lens, 2.0 * width)
    return replace(filled, reference=FThetaReference.PIXELDIST_TO_ANGLE)


_MAKERS = {"pinhole": _pinhole, "distorted": _distorted, "fisheye": _fisheye, "ftheta": _ftheta}


def _lidars(rng: np.random.Generator, name: str | None) -> dict[str, LidarModel]:
    if name is None:
        return {}
    mount: Matrix4 = geometry.pose(
        geometry.rotation_from_yaw(np.deg2rad(rng.normal(0, 1))),
        np.array([rng.uniform(0.7, 1.4), 0.0, rng.uniform(1.75, 2.2)]),
    )
    if name == DEFAULT_LIDAR:
        return {LIDAR_ID: dense_near_horizon(64, 900, mount)}
    if name not in sensors.LIDAR_TABLES:
        raise ValueError(f"no LiDAR {name!r}; have {[DEFAULT_LIDAR, *sensors.LIDAR_TABLES]}")
    return {LIDAR_ID: sensors.lidar_model(name, mount, LIDAR_ID)}
