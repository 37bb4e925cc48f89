"""Windows of a log: single sweeps, as range images in the world."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from nurec_sim import geometry
from nurec_sim.geometry import arc_length
from nurec_sim.logs.fired import as_fired, fired_fraction
from nurec_sim.network.lidar.range_image import RangeImage
from nurec_sim.reconstruct.free_space import chosen_sweeps
from nurec_sim.sensors import range_map
from nurec_sim.types import Clip

PATH_M, DURATION_S, MOST_LENGTHS = 50.0, 10.0, 8.0
"""The number of windows is for this length of path or time, and grows with both up to so many times."""
BODY_MARGIN_M = 0.3
LEAST_M = 0.5


@dataclass(frozen=True, eq=False)
class SweepWindow:
    """A sweep over the beams of its LiDAR.

    Attributes:
        image: in the axes of the LiDAR at the sweep's reference time.
        world_from_image: pose of these axes.
        t_us: reference time.
        point_t_us: firing times of the returns, in the order of the image's returns.
        beams_known: whether the returns are those of the LiDAR's beams (``RangeMap.known``).
    """

    image: RangeImage
    world_from_image: Float64[np.ndarray, "4 4"]
    t_us: int
    point_t_us: Int64[np.ndarray, " n"]
    beams_known: bool

    @property
    def xyz_world_m(self) -> Float64[np.ndarray, "n 3"]:
        """The returns in the world."""
        xyz = self.image.xyz_m[self.image.returned].astype(np.float64)
        return geometry.transform_points(self.world_from_image, xyz)

    @cached_property
    def range_m(self) -> Float32[np.ndarray, " n"]:
        """Range of the returns."""
        x, y, z = (self.image.xyz_m - self.image.eye_m)[self.image.returned].T
        return np.sqrt(x * x + y * y + z * z)

    @cached_property
    def spacing_m(self) -> Float32[np.ndarray, " n"]:
        """Distance between beams at the returns, along rows or columns, the smaller one."""
        step = np.minimum(self.image.row_step_rad, self.image.column_step_rad)[:, None]
        step = np.broadcast_to(step, self.image.returned.shape)[self.image.returned]
        return (self.range_m * step).astype(np.float32)


def choose_windows(clip: Clip, hold_out: Collection[int], per_length: int) -> list[tuple[str, int]]:
    """LiDAR and index of the sweeps to use, in the order of time; ``per_length`` for every 50 m or 10 s."""
    path_m, span_s = float(arc_length(clip.ego.position_m)[-1]), (clip.span_us[1] - clip.span_us[0]) / 1e6
    lengths = min(max(path_m / PATH_M, span_s / DURATION_S, 1.0), MOST_LENGTHS)
    chosen = chosen_sweeps(clip, hold_out, round(lengths * per_length))
    return sorted(chosen, key=lambda each: (int(clip.sweep_times_us(each[0])[each[1], 0]), each))


def read_window(clip: Clip, lidar: str, index: int) -> SweepWindow | None:
    """A sweep as a range image, without returns from the ego vehicle; None if nothing is left."""
    sweep = clip.sweep(lidar, index)
    near = np.linalg.norm(sweep.xyz_m, axis=1)
    keep = np.isfinite(sweep.xyz_m).all(axis=1) & (near > LEAST_M) & ~_on_ego(clip, sweep.xyz_world_m, sweep.t_us)
    if not keep.any():
        return None
    intensity = None if sweep.intensity is None else sweep.intensity[keep]
    sweep = dataclasses.replace(sweep, xyz_m=sweep.xyz_m[keep], intensity=intensity, point_t_us=sweep.point_t_us[keep])
    fired, poses = as_fired(clip, lidar, sweep)
    beams = range_map(clip.rig.lidars[lidar], fired)
    returned = beams.point >= 0
    if not returned.any():
        return None
    eye = geometry.interpolate_pose_pair(poses, beams.fraction(fired_fraction(sweep)))[:, :3, 3]
    eye = geometry.transform_points(geometry.inverse(sweep.world_from_lidar), eye)
    missing = np.full(returned.shape, np.nan, np.float32)
    measured = missing if sweep.intensity is None else beams.image(sweep.intensity).astype(np.float32)
    image = RangeImage.over(beams.lidar, sweep.xyz_m[beams.point], eye, returned, measured)
    return SweepWindow(image, sweep.world_from_lidar, sweep.t_us, sweep.point_t_us[beams.point[returned]], beams.known)


def _on_ego(clip: Clip, xyz_world_m: Float64[np.ndarray, "n 3"], t_us: int) -> Bool[np.ndarray, " n"]:
    body = clip.rig.body
    xyz = geometry.transform_points(geometry.inverse(clip.ego.at(t_us)), xyz_world_m)
    return geometry.points_in_box(xyz - body.center_m, body.size_m, BODY_MARGIN_M)
