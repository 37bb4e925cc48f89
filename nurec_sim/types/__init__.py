"""All dataclasses that are shared between modules.

Conventions (all modules): a transform ``a_from_b`` maps coordinates in ``b`` to ``a``; metres, radians, integer
microseconds; intervals are half-open; quaternions are ``wxyz`` with ``w >= 0``. Rig: x forward, y left, z up, origin at
the rear axle on the ground. Camera: x right, y down, z forward. LiDAR: x forward, y left, z up. Pixel coordinates
originate at the image corner, pixel centres are at +0.5. Gaussian scales are standard deviations in metres, opacities
lie in 0..1. World: metres, z up.
"""

from nurec_sim.lenses import Fisheye, FTheta, FThetaReference, Lens, Pinhole
from nurec_sim.types.frames import CameraFrame, LidarFilter, LidarFrame, Sense, SensorFrame, SensorRequest
from nurec_sim.types.logs import (
    MOVABLE_LABELS,
    Clip,
    LogReader,
    LogSource,
    RoadMap,
    Sweep,
    SweepPoints,
    Track,
)
from nurec_sim.types.loop import (
    ActorState,
    EgoState,
    Event,
    Needs,
    Observation,
    Plan,
    Policy,
    Reduce,
    Rollout,
    Series,
)
from nurec_sim.types.methods import ActorsName, Method, Progress
from nurec_sim.types.scenes import (
    GAUSSIAN_FIELDS,
    OPTIONAL_GAUSSIAN_FIELDS,
    DynamicGaussians,
    Gaussians,
    GaussianScene,
    Label,
)
from nurec_sim.types.sensors import (
    LIDAR_SECTORS,
    Box,
    CameraModel,
    LidarModel,
    Rig,
    Shutter,
    Spin,
    Windshield,
    WindshieldReference,
)
from nurec_sim.types.trajectories import (
    Matrix4,
    Trajectory,
)

__all__ = [
    "ActorsName",
    "ActorState",
    "Box",
    "CameraFrame",
    "CameraModel",
    "Clip",
    "DynamicGaussians",
    "EgoState",
    "Event",
    "FTheta",
    "FThetaReference",
    "Fisheye",
    "GAUSSIAN_FIELDS",
    "GaussianScene",
    "Gaussians",
    "Label",
    "Lens",
    "LidarFilter",
    "LidarFrame",
    "LIDAR_SECTORS",
    "LidarModel",
    "LogReader",
    "LogSource",
    "MOVABLE_LABELS",
    "Matrix4",
    "Method",
    "Needs",
    "OPTIONAL_GAUSSIAN_FIELDS",
    "Observation",
    "Pinhole",
    "Plan",
    "Policy",
    "Progress",
    "Reduce",
    "Rig",
    "RoadMap",
    "Rollout",
    "Sense",
    "SensorFrame",
    "SensorRequest",
    "Series",
    "Shutter",
    "Spin",
    "Sweep",
    "SweepPoints",
    "Track",
    "Trajectory",
    "Windshield",
    "WindshieldReference",
]
