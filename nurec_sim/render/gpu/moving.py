"""The moving layer on the device: uploaded once, posed for the sensors of each batch by a kernel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Int32

from nurec_sim.render.cpu.pack import BLOCK, FIELDS, LOG_OPACITY, MAX_OPACITY, gaussian_columns, to_blocks
from nurec_sim.render.gpu.batch import Batch
from nurec_sim.render.gpu.launcher import THREADS, Launcher
from nurec_sim.render.gpu.pipeline import Blocks
from nurec_sim.render.layers import drawable
from nurec_sim.types import DynamicGaussians, SensorRequest, Track

if TYPE_CHECKING:
    import torch

MOTION_BYTES = 120
"""Of the struct ``Motion`` of ``kernels/moving.cu``."""
NOT_ASKED, HIDDEN = -1, -2


@dataclass(frozen=True, eq=False)
class MovingLayer:
    """Dynamic Gaussians on the device, in blocks.

    ``fields`` [b,21,256] are those of the middle knots with opacities that are not capped, ``sh_rest`` [b,3k,256] or
    [0,0,0], ``knot_m`` [b,9,256], ``knot_us`` [b,3,256] and ``track`` [b,256]. Gaussians in the box of track k have
    ``track`` k plus the number of tracks. Recorded paths lie one after the other: samples ``path_first[k]`` to
    ``path_first[k + 1] - 1`` of ``path_us`` and ``path`` [samples,4,4] are those of track k.
    """

    fields: torch.Tensor
    sh_rest: torch.Tensor
    knot_m: torch.Tensor
    knot_us: torch.Tensor
    track: torch.Tensor
    path_first: torch.Tensor
    path_us: torch.Tensor
    path: torch.Tensor
    number_of: Mapping[str, int]

    def __len__(self) -> int:
        """Number of blocks."""
        return len(self.fields)

    @classmethod
    def of(cls, dynamic: DynamicGaussians, tracks: Sequence[Track], device: torch.device) -> MovingLayer:
        """A layer, copied to a device; Gaussians that can never be rendered are left out."""
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
        # Rows that only fill a block up have no track and are never seen.
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
            np.cumsum([0, *(len(each.path.t_us) for each in tracks)], dtype=np.int32),
            np.concatenate([np.zeros(0, np.int64), *(each.path.t_us for each in tracks)]),
            np.concatenate([np.zeros((0, 4, 4)), *(each.path.world_from_body for each in tracks)]),
        )
        moved = [torch.from_numpy(np.ascontiguousarray(array)).to(device) for array in arrays]
        fields, sh, knot_m, knot_us, of_track, path_first, path_us, path = moved
        number_of = {each.id: k for k, each in enumerate(tracks)}
        return cls(fields, sh, knot_m, knot_us, of_track, path_first, path_us, path, number_of)

    def asked(self, requests: Sequence[SensorRequest]) -> Int32[np.ndarray, "views tracks"]:
        """Which pair of poses re-poses each track.

        Args:
            requests: the requests of a batch.

        Returns:
            Numbers of pairs, counted over the actors of all requests in their order; NOT_ASKED, or HIDDEN.
        """
        table = np.full((len(requests), len(self.number_of)), NOT_ASKED, np.int32)
        names: tuple[str, ...] = ()
        number, first = self.number_of, 0
        tracks = places = np.zeros(0, np.int64)
        for row, request in zip(table, requests, strict=True):
            # The sensors of one instant are mostly requested with the same actors.
            if names != tuple(request.actors):
                names = tuple(request.actors)
                found = np.array([number.get(name, -1) for name in names], np.int64)
                places = np.flatnonzero(found >= 0)
                tracks = found[places]
            row[tracks] = first + places
            first += len(names)
            hidden = [number[name] for name in request.hidden if name in number]
            if hidden:
                row[hidden] = HIDDEN
        return table

    def placed(self, launcher: Launcher, batch: Batch, asked: torch.Tensor, pairs: torch.Tensor) -> Blocks:
        """The layer as each sensor of a batch sees it, view after view.

        Args:
            launcher: runs the kernels.
            batch: the sensors.
            asked: result of the method ``asked``, on the device.
            pairs: [n,2,4,4] float64 on the device.
        """
        import torch

        device, tracks, empty = launcher.device, len(self.number_of), Blocks.none(launcher.device)
        if len(self) == 0:
            return empty
        views = batch.view_count
        motions = torch.empty(views * 2 * tracks * MOTION_BYTES, dtype=torch.uint8, device=device)
        launcher.launch(
            "move_tracks", (-(-tracks // THREADS), views), batch.views, tracks, asked, pairs, self.path_first,
            self.path_us, self.path, motions,
        )  # fmt: skip
        fields = torch.empty((views * len(self), FIELDS, BLOCK), device=device)
        launcher.launch(
            "place_moving", (len(self), views), batch.views, self.fields, self.sh_rest, self.sh_rest.shape[1] // 3,
            self.knot_m, self.knot_us, self.track, motions, 2 * tracks, float(np.log(MAX_OPACITY)), fields,
        )  # fmt: skip
        return Blocks(fields, empty.sh_rest, empty.spheres)
