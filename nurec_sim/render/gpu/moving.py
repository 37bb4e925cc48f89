"""The moving layer on the device: uploaded once, put in place for the sensors of each batch by a kernel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nurec_sim import geometry
from nurec_sim.render.cpu.pack import BLOCK, FIELDS, LOG_OPACITY, MAX_OPACITY, gaussian_columns, to_blocks
from nurec_sim.render.gpu.launcher import Launcher
from nurec_sim.render.gpu.pipeline import Blocks
from nurec_sim.render.gpu.views import Batch
from nurec_sim.render.layers import drawable
from nurec_sim.render.rays import reference_pose
from nurec_sim.types import DynamicGaussians, SensorRequest, Track

if TYPE_CHECKING:
    import torch

MOTION = np.dtype(
    [
        ("rotation", np.float64, (3, 3)),
        ("translation", np.float64, 3),
        ("quat", np.float32, 4),
        ("moved", np.float32),
        ("gone", np.float32),
    ]
)
"""The struct ``Motion`` of ``kernels/moving.cu``, field by field."""


@dataclass(frozen=True, eq=False)
class MovingLayer:
    """Dynamic Gaussians on the device, in blocks.

    ``fields`` [b,21,256] are those of the middle knots with opacities that are not capped, ``sh_rest`` [b,3k,256] or
    [0,0,0], ``knot_m`` [b,9,256], ``knot_us`` [b,3,256] and ``track`` [b,256]. Gaussians in the box of track k have
    ``track`` k plus the number of tracks.
    """

    fields: torch.Tensor
    sh_rest: torch.Tensor
    knot_m: torch.Tensor
    knot_us: torch.Tensor
    track: torch.Tensor
    tracks: Sequence[Track]

    def __len__(self) -> int:
        """Number of blocks."""
        return len(self.fields)

    @classmethod
    def of(cls, dynamic: DynamicGaussians, tracks: Sequence[Track], device: torch.device) -> MovingLayer:
        """A layer, copied to a device; what can never be drawn is left out."""
        import torch

        gaussians = dynamic.gaussians
        chosen = np.flatnonzero(drawable(gaussians) & np.isfinite(dynamic.knot_m).all(axis=(1, 2)))
        blocks = -(-len(chosen) // BLOCK)
        columns = gaussian_columns(gaussians, chosen)
        columns[:, LOG_OPACITY] = np.log(gaussians.opacity[chosen].astype(np.float64))
        rest = gaussians.sh_rest
        sh_rest = np.zeros((0, 0, 0), np.float32)
        if rest is not None and blocks:
            sh_rest = to_blocks(np.nan_to_num(rest[chosen].reshape(len(chosen), -1)).astype(np.float32), blocks)
        times, track = np.zeros((blocks * BLOCK, 3), np.int64), np.full(blocks * BLOCK, -1, np.int32)
        owner = dynamic.track.copy()
        if dynamic.in_box is not None:
            owner[dynamic.in_box] += len(tracks)
        times[: len(chosen)], track[: len(chosen)] = dynamic.knot_t_us[chosen], owner[chosen]
        arrays = (
            to_blocks(columns, blocks, fill=LOG_OPACITY),
            sh_rest,
            to_blocks(dynamic.knot_m[chosen].reshape(len(chosen), 9), blocks),
            np.ascontiguousarray(times.reshape(blocks, BLOCK, 3).transpose(0, 2, 1)),
            track,
        )
        fields, sh, knot_m, knot_us, of_track = (torch.from_numpy(array).to(device) for array in arrays)
        return cls(fields, sh, knot_m, knot_us, of_track, tracks)

    def placed(self, launcher: Launcher, batch: Batch, requests: Sequence[SensorRequest]) -> Blocks:
        """The layer as each sensor of a batch sees it, view after view."""
        import torch

        if len(self) == 0:
            return Blocks.none(launcher.device)
        views = len(requests)
        motions = np.zeros((views, max(2 * len(self.tracks), 1)), MOTION)
        instants = np.zeros(views, np.int64)
        for k, (request, sensor) in enumerate(zip(requests, batch.sensors, strict=True)):
            reference = sensor.tensors.grid.reference
            _, instants[k] = reference_pose(request, reference)
            self._fill(motions[k], request, reference, int(instants[k]))
        device = launcher.device
        fields = torch.empty((views * len(self), FIELDS, BLOCK), device=device)
        launcher.launch(
            "place_moving", (len(self), views), batch.views, self.fields, self.sh_rest, self.sh_rest.shape[1] // 3,
            self.knot_m, self.knot_us, self.track, torch.from_numpy(motions.view(np.uint8)).to(device),
            motions.shape[1], torch.from_numpy(instants).to(device), float(np.log(MAX_OPACITY)), fields,
        )  # fmt: skip
        empty = Blocks.none(device)
        return Blocks(fields, empty.sh_rest, empty.spheres)

    def _fill(self, motions: np.ndarray, request: SensorRequest, reference: float, t_us: int) -> None:
        """Where each track's Gaussians are shown, those in the world first, then those in its box."""
        for k, track in enumerate(self.tracks):
            if track.id in request.hidden:
                for row in (motions[k], motions[k + len(self.tracks)]):
                    row["moved"] = row["gone"] = 1
                continue
            recorded, pair = track.path.at(t_us), request.actors.get(track.id)
            shown = recorded
            if pair is not None:
                shown = geometry.interpolate_pose_pair(np.asarray(pair, np.float64), np.array(reference))
                _move(motions[k], shown @ geometry.inverse(recorded))
            boxed = motions[k + len(self.tracks)]
            _move(boxed, shown)
            boxed["gone"] = pair is None and not track.path.covers(t_us)


def _move(row: np.void, new_from_given: np.ndarray) -> None:
    row["rotation"], row["translation"] = new_from_given[:3, :3], new_from_given[:3, 3]
    row["quat"] = geometry.quat_from_matrix(new_from_given[:3, :3])
    row["moved"] = 1
