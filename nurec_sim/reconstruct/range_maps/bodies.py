"""The Gaussians of a window in the world, and those of actors in their boxes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64

from nurec_sim import geometry
from nurec_sim.network.lidar.branch import LidarGaussians
from nurec_sim.network.lidar.footprints import FLOOR
from nurec_sim.reconstruct.lift.points import Actor, returns_in_box
from nurec_sim.reconstruct.lift.settings import PointSettings
from nurec_sim.reconstruct.range_maps.ownership import voxel_edge_m
from nurec_sim.reconstruct.range_maps.windows import SweepWindow
from nurec_sim.types import Gaussians, Label

LABELS = np.array([Label.OTHER, Label.ROAD, Label.MOVABLE], np.uint8)
DARKEST = 0.1


@dataclass(frozen=True, eq=False)
class WindowGaussians:
    """Gaussians with the reference time of their window, firing time, range, and spacing of beams at this range."""

    gaussians: Gaussians
    t_us: Int64[np.ndarray, " n"]
    fired_us: Int64[np.ndarray, " n"]
    range_m: Float32[np.ndarray, " n"]
    spacing_m: Float32[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.gaussians)

    def __getitem__(self, index: np.ndarray) -> WindowGaussians:
        return WindowGaussians(self.gaussians[index], *(getattr(self, name)[index] for name in _FACTS))

    @classmethod
    def concatenate(cls, parts: Sequence[WindowGaussians]) -> WindowGaussians:
        """All one after the other."""
        facts = (np.concatenate([getattr(part, name) for part in parts]) for name in _FACTS)
        return cls(Gaussians.concatenate([part.gaussians for part in parts]), *facts)


_FACTS = ("t_us", "fired_us", "range_m", "spacing_m")


def window_gaussians(
    window: SweepWindow, kept: Bool[np.ndarray, " n"], decoded: LidarGaussians, floor: bool
) -> WindowGaussians:
    """What the branch decoded from the kept returns of a window, in the world.

    With the scale floor, footprints that are smaller than their voxel, of which one is kept, are widened to it.
    """
    pose = window.world_from_image
    beam = np.flatnonzero(kept)[decoded.beam.numpy()]
    scale, spacing = decoded.scale_m.numpy().copy(), window.spacing_m[beam]
    if floor:
        scale[:, :2] = np.maximum(scale[:, :2], FLOOR * voxel_edge_m(spacing)[:, None])
    quat = decoded.quat_wxyz.numpy().astype(np.float64)
    # The third axis is the normal away from the sensor.
    axis = geometry.matrix_from_quat(quat)[..., 2]
    quat = geometry.quat_multiply(geometry.quat_from_matrix(pose[:3, :3])[None], quat)
    known = np.isfinite(window.image.intensity[window.image.returned])[beam]
    intensity = np.where(known, decoded.intensity.numpy(), np.float32(np.nan))
    grey = np.clip(np.where(known, intensity, 0.5), DARKEST, 1)
    xyz = decoded.position_m.numpy().astype(np.float64)
    gaussians = Gaussians(
        mean_m=geometry.transform_points(pose, xyz).astype(np.float32),
        quat_wxyz=geometry.quat_normalize(quat).astype(np.float32),
        scale_m=scale,
        opacity=decoded.opacity.numpy(),
        rgb=np.repeat(grey[:, None], 3, axis=1).astype(np.float32),
        normal=(-axis @ pose[:3, :3].T).astype(np.float32),
        label=LABELS[decoded.logits.numpy().argmax(axis=1)],
        intensity=intensity.astype(np.float32),
        ray_drop=decoded.ray_drop.numpy(),
    )
    time = np.full(len(beam), window.t_us, np.int64)
    return WindowGaussians(gaussians, time, window.point_t_us[beam], window.range_m[beam], spacing)


def split_bodies(found: WindowGaussians, actors: Sequence[Actor]) -> tuple[WindowGaussians, dict[int, WindowGaussians]]:
    """The static world, and by index of their track the Gaussians of actors in the frames of their boxes.

    Gaussians near the bottom of a box stay in the world: they may be road.
    """
    free, parts = np.ones(len(found), bool), {}
    xyz = found.gaussians.mean_m.astype(np.float64)
    margin_m = PointSettings().box_margin_m
    for actor in actors:
        inside, box_xyz, _, foot = returns_in_box(actor, xyz, xyz, found.fired_us, free, margin_m)
        inside, box_xyz = inside[~foot], box_xyz[~foot]
        if not len(inside):
            continue
        free[inside] = False
        turn = geometry.inverse(actor.path.at(found.fired_us[inside]))[:, :3, :3]
        mine = found[inside]
        quat = geometry.quat_multiply(geometry.quat_from_matrix(turn), mine.gaussians.quat_wxyz.astype(np.float64))
        boxed = dataclasses.replace(
            mine.gaussians,
            mean_m=box_xyz.astype(np.float32),
            quat_wxyz=geometry.quat_normalize(quat).astype(np.float32),
            normal=np.einsum("nij,nj->ni", turn, mine.gaussians.normal).astype(np.float32),
        )
        parts[actor.index] = dataclasses.replace(mine, gaussians=boxed)
    return found[free], parts
