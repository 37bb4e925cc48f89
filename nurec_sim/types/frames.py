"""Requests for sensor frames, and the frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8

from nurec_sim import display
from nurec_sim.errors import RequestError
from nurec_sim.types.sensors import CameraModel, LidarModel


@dataclass(frozen=True)
class SensorRequest:
    """A request for one frame: sensor, exposure [start, end), sensor poses at both ends, and actors to re-pose.

    ``actors`` maps track ids to ``world_from_box`` at start and end; all other tracks follow their recorded paths.
    Tracks in ``hidden`` are not rendered, even if they are in ``actors``; unknown ids are ignored. ``apply_isp``
    enables the scene's colour correction for the camera, ``show_ego`` puts the ego vehicle over its image as the
    recording camera saw it (``GaussianScene.ego_images``); other outputs than colours show the street behind it.
    """

    scene_id: str
    sensor: CameraModel | LidarModel
    start_us: int
    end_us: int
    world_from_sensor: Float64[np.ndarray, "2 4 4"]
    actors: Mapping[str, Float64[np.ndarray, "2 4 4"]] = field(default_factory=dict)
    hidden: Set[str] = frozenset()
    apply_isp: bool = True
    show_ego: bool = False

    @property
    def middle_us(self) -> int:
        """Middle of the exposure."""
        return (self.start_us + self.end_us) // 2


@dataclass(frozen=True)
class CameraFrame:
    """A rendered image.

    ``depth_m`` is the depth of the visible surface along the optical axis, 0 where there is none; ``normal`` is its
    unit normal in the world, facing the camera, zero where unknown.
    """

    camera: CameraModel
    start_us: int
    end_us: int
    rgb: UInt8[np.ndarray, "h w 3"]
    depth_m: Float32[np.ndarray, "h w"] | None = None
    alpha: Float32[np.ndarray, "h w"] | None = None
    label: UInt8[np.ndarray, "h w"] | None = None
    normal: Float32[np.ndarray, "h w 3"] | None = None

    def __repr__(self) -> str:
        planes = [name for name in ("rgb", "depth_m", "alpha", "label", "normal") if getattr(self, name) is not None]
        size = f"{self.camera.width_px}x{self.camera.height_px}"
        return f"CameraFrame({self.camera.id!r}, {size}, {self.start_us} to {self.end_us} us: {', '.join(planes)})"

    def _repr_jpeg_(self) -> bytes:
        """The image, for notebooks."""
        return display.jpeg(self.rgb)


@dataclass(frozen=True)
class LidarFilter:
    """Criteria by which beams of a simulated LiDAR are dropped.

    Args:
        raydrop_threshold: beams with a higher drop probability are dropped, 0..1.
        opacity_threshold: beams whose accumulated opacity does not exceed it have no return, 0..1.
        distance_threshold_m: beams whose range differs by more than this from the mean range of all Gaussians that
            they hit see two surfaces (an edge, a floater) and are dropped; None keeps them.

    Raises:
        RequestError: a threshold is not finite or out of range.
    """

    raydrop_threshold: float = 0.5
    opacity_threshold: float = 0.5
    distance_threshold_m: float | None = None

    def __post_init__(self) -> None:
        for name in ("raydrop_threshold", "opacity_threshold"):
            if not 0 <= getattr(self, name) <= 1:
                raise RequestError(f"{name} must lie in 0..1, got {getattr(self, name)}")
        limit = self.distance_threshold_m
        if limit is not None and not 0 <= limit < math.inf:
            raise RequestError(f"distance_threshold_m must be finite and not negative, or None, got {limit}")


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

    def __repr__(self) -> str:
        return f"LidarFrame({self.lidar.id!r}, {self.start_us} to {self.end_us} us: {len(self.beam):,} returns)"

    def _repr_png_(self) -> bytes:
        """The points from above, for notebooks."""
        return display.sweep_png(self.xyz_m)


SensorFrame = CameraFrame | LidarFrame
Sense = Callable[[Sequence[SensorRequest]], Sequence[SensorFrame]]
"""Renders one frame per request, in order: the loop's only interface to a renderer, a server or the ground truth."""
