"""What the optimisation compares with: images of the log, and the LiDAR returns that each of them can see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from nurec_sim import geometry, sensors
from nurec_sim.reconstruct.lift.colour import SATURATED
from nurec_sim.types import CameraModel, Clip, GaussianScene

CELL_PX = 6
"""Returns hide others behind them within cells of so many pixels: the LiDAR sees past edges that hide from a camera."""
HIDDEN = 1.06
"""A return so much farther than the nearest one in its cell or the cells beside it is hidden."""
NEAREST_M = 1.0
BOX_MARGIN_M = 0.3
"""Returns so near to a labelled box belong to it."""


@dataclass(frozen=True, eq=False)
class Returns:
    """LiDAR returns of static surfaces in an image: place (pixels, centres at +0.5) and depth along the axis."""

    uv_px: Float64[np.ndarray, "n 2"]
    depth_m: Float64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.depth_m)


@dataclass(frozen=True, eq=False)
class TrainingView:
    """One image of the log.

    Attributes:
        camera: its camera.
        frame: its index among the camera's images.
        t_us: middle of its exposure.
        world_from_camera: poses at the start and the end of the exposure.
        image: what was recorded.
        returns: LiDAR returns that it can see, measured within half a sweep of it.
        ego: where it shows the ego vehicle, which is not part of the scene; None if nowhere.
    """

    camera: CameraModel
    frame: int
    t_us: int
    world_from_camera: Float64[np.ndarray, "2 4 4"]
    image: UInt8[np.ndarray, "h w 3"]
    returns: Returns
    ego: Bool[np.ndarray, "h w"] | None = None

    def colours_beside(self, shown: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
        """The image, 0..1, with the colours ``shown`` of the scene where these are no error.

        That is where the image shows the ego vehicle, and where it is saturated and the scene is brighter.
        """
        colours = self.image.astype(np.float32) / np.float32(255)
        # Clipped as it was, a bright sky would have another brightness in every exposure.
        np.copyto(colours, shown, where=(colours > SATURATED) & (shown > colours))
        if self.ego is not None:
            colours[self.ego] = shown[self.ego]
        return colours


def training_views(
    clip: Clip, scene: GaussianScene, cameras: Sequence[str], hold_out_sweeps: set[int]
) -> list[TrainingView]:
    """All images of some cameras, in the order of cameras and frames.

    Args:
        clip: the driving log.
        scene: its tracks tell which returns belong to something that moves.
        cameras: ids of the cameras.
        hold_out_sweeps: sweeps that must not be read, by index, of every LiDAR.
    """
    sweeps = _Sweeps(clip, scene, hold_out_sweeps)
    views = []
    for name in cameras:
        camera = clip.rig.cameras[name]
        ego = scene.ego_images[name][..., 3] > 0 if name in scene.ego_images else None
        for frame, (start_us, end_us) in enumerate(clip.camera_times_us(name).tolist()):
            t_us, pair = (start_us + end_us) // 2, np.asarray(clip.world_from_camera(name, frame), np.float64)
            seen = returns_in(camera, pair, sweeps.near(t_us))
            views.append(TrainingView(camera, frame, t_us, pair, clip.image(name, frame), seen, ego))
    return views


class _Sweeps:
    """Static returns of the sweep nearest in time, the latest ones kept."""

    def __init__(self, clip: Clip, scene: GaussianScene, hold_out: set[int]) -> None:
        self._clip, self._kept = clip, dict[tuple[str, int], np.ndarray]()
        self._tracks = scene.tracks
        self._times = {
            lidar: [
                (int(times.sum()) // 2, index, int(times[1] - times[0]))
                for index, times in enumerate(clip.sweep_times_us(lidar))
                if index not in hold_out
            ]
            for lidar in clip.rig.lidars
        }

    def near(self, t_us: int) -> Float64[np.ndarray, "n 3"]:
        """World points of static surfaces, of each LiDAR's sweep that is nearest in time."""
        parts = [np.zeros((0, 3))]
        for lidar, times in self._times.items():
            if not times:
                continue
            middle, index, span = min(times, key=lambda each: abs(each[0] - t_us))
            if abs(middle - t_us) <= max(span, 100_000):
                parts.append(self._static(lidar, index))
        return np.concatenate(parts)

    def _static(self, lidar: str, index: int) -> np.ndarray:
        if (lidar, index) not in self._kept:
            sweep = self._clip.sweep(lidar, index)
            xyz = sweep.xyz_world_m
            free = np.isfinite(xyz).all(axis=1)
            for track in self._tracks:
                if track.path.covers(sweep.t_us):
                    pose = track.path.at(sweep.t_us)
                    reach = np.linalg.norm(track.size_m) / 2 + BOX_MARGIN_M
                    near = np.flatnonzero(np.abs(xyz - pose[:3, 3]).max(axis=1) < reach)
                    box = geometry.transform_points(geometry.inverse(pose), xyz[near])
                    free[near[geometry.points_in_box(box, track.size_m, BOX_MARGIN_M)]] = False
            self._kept[lidar, index] = xyz[free]
        return self._kept[lidar, index]


def returns_in(
    camera: CameraModel, world_from_camera: Float64[np.ndarray, "2 4 4"], xyz_world_m: Float64[np.ndarray, "n 3"]
) -> Returns:
    """Returns inside of an image that nothing nearer hides."""
    uv, valid, fraction = sensors.project_rolling(camera, world_from_camera, xyz_world_m)
    # Bilinear interpolation needs a pixel's centre on every side.
    valid &= (uv[:, 0] > 0.5) & (uv[:, 0] < camera.width_px - 0.5)
    valid &= (uv[:, 1] > 0.5) & (uv[:, 1] < camera.height_px - 0.5)
    uv, points, fraction = uv[valid], xyz_world_m[valid], fraction[valid]
    poses = geometry.inverse(geometry.interpolate_pose_pair(world_from_camera, fraction))
    depth = np.einsum("nj,nj->n", poses[:, 2, :3], points) + poses[:, 2, 3]
    shown = (depth > NEAREST_M) & ~_hidden(uv, depth, (camera.height_px, camera.width_px))
    return Returns(uv[shown], depth[shown])


def _hidden(uv: np.ndarray, depth: np.ndarray, shape: tuple[int, int]) -> Bool[np.ndarray, " n"]:
    """Returns that lie behind another one in the same cell or in one beside it."""
    rows, columns = shape[0] // CELL_PX + 1, shape[1] // CELL_PX + 1
    row, column = (uv[:, 1] / CELL_PX).astype(np.int64), (uv[:, 0] / CELL_PX).astype(np.int64)
    # A coarse z-buffer, with a rim of one cell so that the 3 x 3 minimum needs no special case at the border.
    nearest = np.full((rows + 2, columns + 2), np.inf)
    np.minimum.at(nearest, (row + 1, column + 1), depth)
    around = np.min([nearest[1 + i : rows + 1 + i, 1 + j : columns + 1 + j] for i in (-1, 0, 1) for j in (-1, 0, 1)], 0)
    return depth > HIDDEN * around[row, column] + 0.2
