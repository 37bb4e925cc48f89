"""What is rendered: sensors by name, and their requests along a path. Every frame has another pose."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scenes import PATH_S, BenchScene

from nurec_sim import geometry, sensors
from nurec_sim.types import (
    CameraModel,
    Fisheye,
    FTheta,
    FThetaReference,
    LidarModel,
    Matrix4,
    Pinhole,
    SensorRequest,
    Shutter,
    Windshield,
    WindshieldReference,
)
from nurec_sim.world.plan.rig import street_rig

CAMERA_AXES = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.6], [0, 0, 0, 1]])
"""rig_from_camera of a camera 1.6 m above the ground that looks forward."""
LIDAR_MOUNT = geometry.pose_from_xyyaw(0.0, 0.0, 0.0, 1.8)
EXPOSURE_US = 30_000
SWEEP_US = 100_000
OUTPUTS = ("rgb", "depth", "alpha")


@dataclass(frozen=True)
class SensorCase:
    """Sensors that are rendered together: one, or all of a tick."""

    sensors: tuple[CameraModel | LidarModel, ...]
    about: str
    outputs: tuple[str, ...] = OUTPUTS
    standing: bool = False

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows, of the first sensor."""
        return sensor_size(self.sensors[0])


def sensor_size(sensor: CameraModel | LidarModel) -> tuple[int, int]:
    """Columns and rows of pixels or beams."""
    if isinstance(sensor, LidarModel):
        return len(sensor.azimuth_rad), len(sensor.elevation_rad)
    return sensor.width_px, sensor.height_px


def camera(width: int, height: int, lens=None, yaw_deg: float = 0.0, id: str = "camera", **more) -> CameraModel:
    """A camera 90 degrees wide, if it is not given another lens."""
    lens = lens or Pinhole(width / 2, width / 2, width / 2, height / 2)
    mount = geometry.pose_from_xyyaw(0.0, 0.0, np.radians(yaw_deg)) @ CAMERA_AXES
    return CameraModel(id, width, height, lens, mount, **more)


def ftheta(width: int, height: int, field_deg: float) -> FTheta:
    """An F-theta lens ``field_deg`` wide, of the shape that automotive lenses have."""
    edge = np.radians(field_deg / 2)
    slope = width / 2 / (edge - 0.04 * edge**3)
    return FTheta(
        width / 2, height / 2, FThetaReference.ANGLE_TO_PIXELDIST, (), (0.0, slope, 0.0, -0.04 * slope), edge * 1.3
    )


def lidar(name: str, columns: int = 1800) -> LidarModel:
    """A LiDAR on the roof."""
    return sensors.lidar_model(name, LIDAR_MOUNT, id="lidar", columns=columns)


GLASS = Windshield(
    WindshieldReference.FORWARD,
    horizontal=(0.001, 1.004, 0.002, 0.001, -0.003, 0.001),
    vertical=(0.003, 0.001, -0.002, 1.006, 0.002, -0.004),
)
SURROUND = tuple(
    camera(960, 540, yaw_deg=yaw, id=name)
    for name, yaw in (("front", 0.0), ("left", 80.0), ("right", -80.0), ("rear", 180.0))
)
SENSORS: dict[str, SensorCase] = {
    "pinhole-640": SensorCase((camera(640, 360),), "pinhole, global shutter"),
    "pinhole-960": SensorCase((camera(960, 540),), "pinhole, global shutter"),
    "pinhole-1920": SensorCase((camera(1920, 1080),), "pinhole, global shutter"),
    "normals-960": SensorCase((camera(960, 540),), "pinhole, all outputs", (*OUTPUTS, "label", "normal")),
    "rolling-960": SensorCase((camera(960, 540, shutter=Shutter.TOP_TO_BOTTOM),), "pinhole, rolling shutter"),
    "distorted-960": SensorCase(
        (camera(960, 540, Pinhole(480, 480, 480, 270, (-0.12, 0.03, 0, 0, 0, 0), (5e-4, -3e-4))),),
        "pinhole with radial and tangential distortion",
    ),
    "fisheye-960": SensorCase((camera(960, 540, Fisheye(330, 330, 480, 270, (0.02, -0.004, 0, 0), 1.6)),), "fisheye"),
    "ftheta-1920": SensorCase((camera(1920, 1080, ftheta(1920, 1080, 90.0)),), "F-theta, 90 degrees wide"),
    "ftheta-wide-1920": SensorCase((camera(1920, 1080, ftheta(1920, 1080, 120.0)),), "F-theta, 120 degrees wide"),
    "windshield-1920": SensorCase(
        (camera(1920, 1080, ftheta(1920, 1080, 90.0), windshield=GLASS),), "F-theta behind a windshield"
    ),
    "rolling-ftheta-1920": SensorCase(
        (camera(1920, 1080, ftheta(1920, 1080, 90.0), shutter=Shutter.TOP_TO_BOTTOM),), "F-theta, rolling shutter"
    ),
    "lidar-128": SensorCase((lidar("PANDAR128"),), "128 x 1800 beams, driving"),
    "lidar-128-standing": SensorCase((lidar("PANDAR128"),), "128 x 1800 beams, standing", standing=True),
    "lidar-64-sparse": SensorCase((lidar("HDL-64", 600),), "64 x 600 beams, driving"),
    "lidar-48-sparse": SensorCase(tuple(street_rig().lidars.values()), "48 x 600 beams, driving"),
    "lidar-64": SensorCase((lidar("HDL-64"),), "64 x 1800 beams, driving"),
    "tick": SensorCase((*SURROUND, lidar("PANDAR128")), "four cameras and a LiDAR in one call"),
}


def tick_requests(bench: BenchScene, case: SensorCase, path: str, frames: int) -> list[list[SensorRequest]]:
    """For each of ``frames`` instants, evenly spread over the path, a request per sensor."""
    last_us = bench.scene.span_us[1] - SWEEP_US
    length_s = min(PATH_S, (last_us - bench.start_us) / 1e6)
    ticks = []
    for t_s in (np.arange(frames) + 0.5) / frames * length_s:
        begin = bench.start_us + round(t_s * 1e6)
        ticks.append([request(bench, case, sensor, path, t_s, begin) for sensor in case.sensors])
    return ticks


def request(
    bench: BenchScene, case: SensorCase, sensor: CameraModel | LidarModel, path: str, t_s: float, start_us: int
) -> SensorRequest:
    """One frame; a global shutter and a standing LiDAR do not move during the exposure."""
    is_lidar = isinstance(sensor, LidarModel)
    exposure_us = SWEEP_US if is_lidar else EXPOSURE_US
    still = case.standing or (isinstance(sensor, CameraModel) and sensor.shutter is Shutter.GLOBAL)
    mount: Matrix4 = sensor.rig_from_lidar if isinstance(sensor, LidarModel) else sensor.rig_from_camera
    rig = bench.paths[path]
    poses = np.stack([rig(t_s) @ mount, rig(t_s if still else t_s + exposure_us / 1e6) @ mount])
    return SensorRequest(bench.scene.id, sensor, start_us, start_us + exposure_us, poses)


def resized(case: SensorCase, width: int, height: int) -> SensorCase:
    """The same camera with fewer pixels, for peers that would take minutes."""
    small = tuple(sensors.scaled_camera(sensor, width, height) for sensor in case.sensors)  # type: ignore[arg-type]
    return dataclasses.replace(case, sensors=small)
