"""The moving layer prepared for kernels: packed once per scene, posed for every frame in a millisecond or two.

It renders ``layers.moving_gaussians``. A block holds Gaussians of one track that live at about the same time, so most
blocks are skipped at any instant, and a re-posed actor turns whole blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from nurec_sim import geometry
from nurec_sim.render.cpu.kernel import f4, inner, kernel
from nurec_sim.render.cpu.pack import (
    BLOCK,
    COLOUR,
    FIELDS,
    LOG_OPACITY,
    MAX_OPACITY,
    MEAN,
    NEVER_SEEN,
    NORMAL,
    QUAT,
    REACH,
    SCALE,
    PackedGaussians,
    gaussian_columns,
    morton_order,
    to_blocks,
)
from nurec_sim.render.cpu.project.colours import harmonics_1, harmonics_2, harmonics_3
from nurec_sim.render.cpu.records import EYE_HIGH, EYE_LOW, FEATURES, LOG_255, SCRATCH, VIEW
from nurec_sim.render.cpu.simd import LANES
from nurec_sim.render.layers import LARGEST, drawable
from nurec_sim.types import DynamicGaussians, Matrix4, Track

if TYPE_CHECKING:
    from nurec_sim.render.cpu.workers import Workers

AGE_US = 100_000
"""Gaussians of a track are grouped by the time of their middle knot, in steps of this, then by place."""

# Columns of a motion: rotation (row-major), translation, the rotation as a quaternion, the eye as the recorded actor
# would see it, and 1 where there is any motion at all.
ROTATION, TRANSLATION, TURN, EYE, MOVED = 0, 9, 12, 16, 19
MOTION = 20

LOG_MAX_OPACITY = float(np.log(MAX_OPACITY))


class MovingBlocks(NamedTuple):
    """Blocks of a ``PackedMoving`` as its kernel reads them."""

    fields: Float32[np.ndarray, "blocks 22 256"]
    sh_rest: Float32[np.ndarray, "blocks k3 256"]
    knot_us: Float64[np.ndarray, "blocks 3 256"]
    knot_m: Float32[np.ndarray, "blocks 9 256"]
    track: Int64[np.ndarray, " blocks"]
    reach_m: Float64[np.ndarray, " blocks"]


class PlacedBlocks(NamedTuple):
    """Blocks at an instant, and spheres around their live Gaussians."""

    fields: Float32[np.ndarray, "b 22 256"]
    centre_m: Float64[np.ndarray, "b 3"]
    radius_m: Float64[np.ndarray, " b"]
    """0 where nothing is alive."""


@dataclass(frozen=True, eq=False)
class PackedMoving:
    """A dynamic layer in blocks of ``BLOCK`` rows of one track each; rows that fill up are never alive.

    ``fields`` is as in ``PackedGaussians`` at the middle knot, but LOG_OPACITY is not capped: that is done after
    fading. Times count from ``base_us``. ``reach_m`` is the farthest that a block's Gaussians reach from their centres.
    Paths are those of all tracks one after the other, track k moved by k * ``stride_us`` in time. Gaussians in the box
    of track k have ``track`` k plus the number of tracks; ``boxed`` lists those k.
    """

    fields: Float32[np.ndarray, "blocks 22 256"]
    sh_rest: Float32[np.ndarray, "blocks k3 256"]
    index: Int32[np.ndarray, "blocks 256"]
    knot_us: Float64[np.ndarray, "blocks 3 256"]
    knot_m: Float32[np.ndarray, "blocks 9 256"]
    track: Int64[np.ndarray, " blocks"]
    boxed: Int64[np.ndarray, " some_tracks"]
    life_us: Float64[np.ndarray, "blocks 2"]
    reach_m: Float64[np.ndarray, " blocks"]
    base_us: int
    track_of: Mapping[str, int]
    path_us: Int64[np.ndarray, " samples"]
    path: Float64[np.ndarray, "samples 4 4"]
    span_us: Int64[np.ndarray, "tracks 2"]
    stride_us: int

    @classmethod
    def of(cls, dynamic: DynamicGaussians, tracks: Sequence[Track]) -> PackedMoving:
        """Pack a layer; Gaussians that can never be rendered are left out.

        Args:
            dynamic: the layer.
            tracks: what ``dynamic.track`` indexes.
        """
        owner = dynamic.track.astype(np.int64)
        if dynamic.in_box is not None:
            owner[dynamic.in_box] += len(tracks)
        rows = _grouped_rows(dynamic, owner)
        filled = rows >= 0
        chosen, gaussians = rows[filled], dynamic.gaussians

        def blocked(columns: np.ndarray, dtype: type, fill: np.ndarray | float = 0) -> np.ndarray:
            """Columns [chosen,c] as blocks [blocks,c,256]."""
            result: np.ndarray = np.empty((*rows.shape, columns.shape[1]), dtype)
            result[...] = fill
            result[filled] = columns
            return np.ascontiguousarray(result.transpose(0, 2, 1))

        columns = gaussian_columns(gaussians, chosen)
        columns[:, LOG_OPACITY] = np.log(gaussians.opacity[chosen].astype(np.float64))
        fields = blocked(columns, np.float32, fill=to_blocks(columns[:0], 1, fill=LOG_OPACITY)[0, :, 0])
        sh_rest = np.zeros((0, 0, 0), np.float32)
        if gaussians.sh_rest is not None and len(rows):
            sh_rest = blocked(np.nan_to_num(gaussians.sh_rest[chosen].reshape(len(chosen), -1)), np.float32)
        knots = dynamic.knot_t_us[chosen]
        base_us = int(knots.min()) if len(knots) else 0
        knot_us = blocked(knots - base_us, np.float64, fill=np.nan)
        # All paths share one time axis, track k shifted by k strides, so one search finds the poses of all tracks.
        span_us = np.array([(track.path.start_us, track.path.end_us) for track in tracks], np.int64).reshape(-1, 2)
        stride_us = int((span_us[:, 1] - span_us[:, 0]).max(initial=0)) + 1
        return cls(
            fields=fields,
            sh_rest=sh_rest,
            index=rows.astype(np.int32),
            knot_us=knot_us,
            knot_m=blocked(dynamic.knot_m[chosen].reshape(-1, 9), np.float32),
            track=owner[rows[:, 0]],
            boxed=np.unique(owner[chosen][owner[chosen] >= len(tracks)]) - len(tracks),
            # NaN in rows that only fill up: ignored here, and every comparison with it is false, so they are never
            # alive.
            life_us=np.stack([np.nanmin(knot_us[:, 0], axis=1), np.nanmax(knot_us[:, 2], axis=1)], axis=-1),
            reach_m=fields[:, SCALE : SCALE + 3].max(axis=(1, 2), where=filled[:, None], initial=0) * REACH,
            base_us=base_us,
            track_of={track.id: k for k, track in enumerate(tracks)},
            path_us=np.concatenate(
                [np.zeros(0, np.int64)]
                + [track.path.t_us - track.path.start_us + k * stride_us for k, track in enumerate(tracks)]
            ),
            path=np.concatenate([np.zeros((0, 4, 4)), *(track.path.world_from_body for track in tracks)]),
            span_us=span_us,
            stride_us=stride_us,
        )

    def __len__(self) -> int:
        """Number of blocks."""
        return len(self.fields)

    def at(
        self,
        t_us: int,
        actors: Mapping[str, Matrix4],
        hidden: Set[str],
        eye_m: Float64[np.ndarray, " 3"],
        workers: Workers,
        scratch: Callable[[str, tuple[int, ...], type], np.ndarray],
    ) -> PackedGaussians:
        """The layer at an instant, without ``sh_rest``: colours are those seen from ``eye_m``.

        Args:
            t_us: instant.
            actors: requested ``world_from_box`` by track id; ids that no track has are ignored.
            hidden: ids of tracks that are left out.
            eye_m: view point in the world.
            workers: threads to run on.
            scratch: returns the frame's scratch arrays (``workers.Scratch``); the result lives as long as they do.
        """
        instant = float(t_us - self.base_us)
        motions, gone = self._motions(t_us, actors, np.asarray(eye_m, np.float64))
        # A hidden track hides both its loose Gaussians and those in its box.
        left_out = np.array([k for name, k in self.track_of.items() if name in hidden], np.int64)
        gone = np.concatenate([gone, left_out, left_out + len(self.span_us)])
        lives = (self.life_us[:, 0] <= instant) & (instant <= self.life_us[:, 1])
        blocks = np.flatnonzero(lives & ~np.isin(self.track, gone))
        count = len(blocks)
        fields = scratch("moving fields", (count, FIELDS, BLOCK), np.float32)
        placed = PlacedBlocks(fields, np.empty((count, 3)), np.empty(count))
        moving = MovingBlocks(self.fields, self.sh_rest, self.knot_us, self.knot_m, self.track, self.reach_m)
        workers.run(
            put_in_place,
            [(moving, blocks, first, last, instant, motions, placed) for first, last in workers.ranges(count, 8)],
        )
        index = self.index[blocks].reshape(-1)
        return PackedGaussians(fields, np.zeros((0, 0, 0), np.float32), index, placed.centre_m, placed.radius_m)

    def _motions(
        self, t_us: int, actors: Mapping[str, Matrix4], eye_m: Float64[np.ndarray, " 3"]
    ) -> tuple[Float64[np.ndarray, "owners 20"], Int64[np.ndarray, " some_owners"]]:
        """Motions by ``track``, the last, for Gaussians of no track, being none; and which are not there at all."""
        count = len(self.span_us)
        motions = np.zeros((2 * count + 1, MOTION))
        motions[:, [ROTATION, ROTATION + 4, ROTATION + 8, TURN]] = 1
        motions[:, EYE : EYE + 3] = eye_m
        asked = np.array([self.track_of[name] for name in actors if name in self.track_of], np.int64)
        tracks = np.union1d(asked, self.boxed).astype(np.int64)
        if len(tracks) == 0:
            return motions, tracks
        start, end = self.span_us[tracks, 0], self.span_us[tracks, 1]
        recorded = geometry.interpolate_poses(
            self.path_us, self.path, np.clip(t_us, start, end) - start + tracks * self.stride_us
        )
        shown = recorded.copy()
        for name in actors:
            if name in self.track_of:
                shown[np.searchsorted(tracks, self.track_of[name])] = actors[name]
        is_asked = np.isin(tracks, asked)
        rows = np.concatenate([tracks[is_asked], tracks + count])
        # Loose Gaussians are recorded in the world: undo the recorded pose first. Those in a box are given in the box.
        moved = np.concatenate([shown[is_asked] @ geometry.inverse(recorded[is_asked]), shown])
        back = geometry.inverse(moved)
        motions[rows, ROTATION : ROTATION + 9] = moved[:, :3, :3].reshape(-1, 9)
        motions[rows, TRANSLATION : TRANSLATION + 3] = moved[:, :3, 3]
        motions[rows, TURN : TURN + 4] = geometry.quat_from_matrix(moved[:, :3, :3])
        # View-dependent colours are evaluated in the recorded frame: the eye is moved back instead of the Gaussians.
        motions[rows, EYE : EYE + 3] = back[:, :3, :3] @ eye_m + back[:, :3, 3]
        motions[rows, MOVED] = 1
        return motions, tracks[~is_asked & ((t_us < start) | (end < t_us))] + count


def _grouped_rows(dynamic: DynamicGaussians, owner: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, "blocks 256"]:
    """Rows of the layer's Gaussians that can be rendered, by track, time and place; -1 fills up each track."""
    keep = drawable(dynamic.gaussians) & (np.abs(dynamic.knot_m) <= LARGEST).all(axis=(1, 2))
    rows = np.flatnonzero(keep)
    if len(rows) == 0:
        return np.zeros((0, BLOCK), np.int64)
    # Stable sorts: by place, then by track and time, so neighbours stay together within a group.
    rows = rows[morton_order(dynamic.gaussians.mean_m[rows])]
    rows = rows[np.lexsort((dynamic.knot_t_us[rows, 1] // AGE_US, owner[rows]))]
    cuts = np.flatnonzero(np.diff(owner[rows])) + 1
    groups = np.split(rows, cuts)
    return np.concatenate([np.pad(g, (0, -len(g) % BLOCK), constant_values=-1).reshape(-1, BLOCK) for g in groups])


@inner
def _interpolate(fields, knot_us, knot_m, block, instant, out, alive):
    """Place and faded opacity of a block's rows at ``instant``; returns how many are alive."""
    count = 0
    for i in range(BLOCK):
        first, middle, last = knot_us[block, 0, i], knot_us[block, 1, i], knot_us[block, 2, i]
        after = instant >= middle
        start, end = (middle, last) if after else (first, middle)
        fraction = (instant - start) / max(end - start, 1.0)
        x = fraction if after else 1.0 - fraction
        x2 = x * x
        x4 = x2 * x2
        # The opacity fades by exp(-x^10), x being the time from the middle knot over that to the outer one.
        log_opacity = np.float64(fields[block, LOG_OPACITY, i]) - x4 * x4 * x2
        seen = (first <= instant) & (instant <= last) & (log_opacity >= -LOG_255)
        alive[i] = f4(1) if seen else f4(0)
        count += np.int64(seen)
        out[LOG_OPACITY, i] = f4(min(log_opacity, LOG_MAX_OPACITY)) if seen else f4(NEVER_SEEN)
        for k in range(3):
            a, b, c = knot_m[block, k, i], knot_m[block, 3 + k, i], knot_m[block, 6 + k, i]
            before, behind = (b, c) if after else (a, b)
            mean = np.float64(before) * (1.0 - fraction) + np.float64(behind) * fraction
            out[MEAN + k, i] = f4(mean) if seen else f4(0)
    return count


@inner
def _evaluate_colours(sh_rest, block, motion, out, view, scratch):
    """Replace a block's colours by those seen from the motion's eye; centres are still where they were recorded."""
    for k in range(3):
        # High and low part of the eye, as in ``records.view_parameters``.
        view[EYE_HIGH + k] = f4(motion[EYE + k])
        view[EYE_LOW + k] = f4(motion[EYE + k] - np.float64(view[EYE_HIGH + k]))
    for lane in range(0, BLOCK, LANES):
        place = out.ctypes.data + 4 * lane
        rest = sh_rest.ctypes.data + 4 * (block * sh_rest.shape[1] * BLOCK + lane)
        if sh_rest.shape[1] == 9:
            harmonics_1(place, rest, view.ctypes.data, scratch.ctypes.data)
        elif sh_rest.shape[1] == 24:
            harmonics_2(place, rest, view.ctypes.data, scratch.ctypes.data)
        else:
            harmonics_3(place, rest, view.ctypes.data, scratch.ctypes.data)
        for k in range(3):
            for i in range(LANES):
                out[COLOUR + k, lane + i] = scratch[FEATURES + k, i]


@inner
def _move(motion, out):
    """Carry a block's centres, rotations and normals along with its actor."""
    m = motion
    for i in range(BLOCK):
        x, y, z = np.float64(out[MEAN, i]), np.float64(out[MEAN + 1, i]), np.float64(out[MEAN + 2, i])
        u, v, w = np.float64(out[NORMAL, i]), np.float64(out[NORMAL + 1, i]), np.float64(out[NORMAL + 2, i])
        for k in range(3):
            a, b, c = m[ROTATION + 3 * k], m[ROTATION + 3 * k + 1], m[ROTATION + 3 * k + 2]
            out[MEAN + k, i] = f4(a * x + b * y + c * z + m[TRANSLATION + k])
            out[NORMAL + k, i] = f4(a * u + b * v + c * w)
    aw, ax, ay, az = m[TURN], m[TURN + 1], m[TURN + 2], m[TURN + 3]
    for i in range(BLOCK):
        bw, bx = np.float64(out[QUAT, i]), np.float64(out[QUAT + 1, i])
        by, bz = np.float64(out[QUAT + 2, i]), np.float64(out[QUAT + 3, i])
        out[QUAT, i] = f4(aw * bw - ax * bx - ay * by - az * bz)
        out[QUAT + 1, i] = f4(aw * bx + ax * bw + ay * bz - az * by)
        out[QUAT + 2, i] = f4(aw * by - ax * bz + ay * bw + az * bx)
        out[QUAT + 3, i] = f4(aw * bz + ax * by - ay * bx + az * bw)


@kernel
def put_in_place(moving, blocks, first, last, instant, motions, placed):
    """Write blocks of a ``PackedMoving`` as they are at an instant, and spheres around their live Gaussians.

    Args:
        moving: see ``PackedMoving``.
        blocks: numbers of the blocks to write.
        first: first entry of ``blocks`` to take.
        last: one behind the last.
        instant: time since the layer's base (us).
        motions: [2 tracks + 1,20] see the columns above; the last is for Gaussians of no track.
        placed: output, an entry per entry of ``blocks``.
    """
    fields, sh_rest, knot_us, knot_m, track, reach_m = moving
    alive = np.empty(BLOCK, np.float32)
    view, scratch = np.zeros(VIEW, np.float32), np.empty((SCRATCH, LANES), np.float32)
    for n in range(first, last):
        block = blocks[n]
        out = placed.fields[n]
        owner = track[block]
        motion = motions[owner if 0 <= owner < len(motions) - 1 else len(motions) - 1]
        for k in range(QUAT, FIELDS):
            for i in range(BLOCK):
                out[k, i] = fields[block, k, i]
        count = _interpolate(fields, knot_us, knot_m, block, instant, out, alive)
        if sh_rest.shape[1] > 0 and count > 0:
            _evaluate_colours(sh_rest, block, motion, out, view, scratch)
        if motion[MOVED] > 0.0:
            _move(motion, out)
        diagonal = 0.0
        for k in range(3):
            low, high = f4(np.inf), f4(-np.inf)
            for i in range(BLOCK):
                low = min(low, out[MEAN + k, i] if alive[i] > f4(0) else f4(np.inf))
                high = max(high, out[MEAN + k, i] if alive[i] > f4(0) else f4(-np.inf))
            placed.centre_m[n, k] = (np.float64(low) + np.float64(high)) / 2.0 if count > 0 else 0.0
            diagonal += (np.float64(high) - np.float64(low)) ** 2 if count > 0 else 0.0
        # Half the diagonal of the centres' box plus the farthest that a Gaussian reaches from its centre.
        placed.radius_m[n] = np.sqrt(diagonal) / 2.0 + reach_m[block] if count > 0 else 0.0
