"""The layered Gaussian world."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt8

from nurec_sim import display
from nurec_sim.types.logs import RoadMap, Track
from nurec_sim.types.rows import rows_of
from nurec_sim.types.sensors import Rig
from nurec_sim.types.trajectories import Trajectory


class Label(enum.IntEnum):
    """Semantic class of a Gaussian and of a rendered pixel."""

    OTHER = 0
    ROAD = 1
    MOVABLE = 2
    SKY = 3
    EGO = 4


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians, as structure of arrays.

    ``rgb`` is the display-space colour in 0..1 (degree 0); ``sh_rest`` holds the view-dependent spherical-harmonic
    coefficients of degree 1 and up (k = 3, 8 or 15, basis and order as in 3DGS files) or None. ``intensity`` is the
    LiDAR return in 0..1, NaN where unknown. ``normal`` is a unit vector, zero where unknown. ``ray_drop`` is the
    probability in 0..1 that a LiDAR beam which meets the Gaussian does not return (glass, black paint, water), or None:
    every beam returns. ``falloff`` is the share in 0..1 of the intensity that is lost at grazing incidence, or None:
    none is. A beam that meets the surface at an angle a from its normal returns
    ``intensity * (1 - falloff * (1 - |cos a|))``.
    """

    mean_m: Float32[np.ndarray, "n 3"]
    quat_wxyz: Float32[np.ndarray, "n 4"]
    scale_m: Float32[np.ndarray, "n 3"]
    opacity: Float32[np.ndarray, " n"]
    rgb: Float32[np.ndarray, "n 3"]
    normal: Float32[np.ndarray, "n 3"]
    label: UInt8[np.ndarray, " n"]
    intensity: Float32[np.ndarray, " n"]
    sh_rest: Float32[np.ndarray, "n k 3"] | None = None
    ray_drop: Float32[np.ndarray, " n"] | None = None
    falloff: Float32[np.ndarray, " n"] | None = None

    def __len__(self) -> int:
        return len(self.mean_m)

    def __repr__(self) -> str:
        harmonics = 0 if self.sh_rest is None else self.sh_rest.shape[1]
        return f"Gaussians({len(self):,}, {harmonics} harmonics beyond the colour)"

    def __getitem__(self, index: np.ndarray | slice) -> Gaussians:
        given = [name for name in (*GAUSSIAN_FIELDS, *OPTIONAL_GAUSSIAN_FIELDS) if getattr(self, name) is not None]
        fields: dict[str, Any] = dict(zip(given, rows_of((getattr(self, name) for name in given), index), strict=True))
        return Gaussians(**fields)

    @classmethod
    def empty(cls, n: int = 0) -> Gaussians:
        """N Gaussians of zeros (identity rotation, unknown intensity, no optional fields)."""
        quat = np.zeros((n, 4), np.float32)
        quat[:, 0] = 1
        zeros3 = np.zeros((n, 3), np.float32)
        return cls(zeros3, quat, zeros3.copy(), np.zeros(n, np.float32), zeros3.copy(), zeros3.copy(),
                   np.zeros(n, np.uint8), np.full(n, np.nan, np.float32))  # fmt: skip

    @classmethod
    def concatenate(cls, parts: Sequence[Gaussians]) -> Gaussians:
        """Concatenates Gaussians; either all parts have ``sh_rest`` of the same degree, or none has.

        If some parts have ``ray_drop`` or ``falloff``, the others get 0.
        """
        if not parts:
            return cls.empty()
        rest = [part.sh_rest for part in parts]
        merged = None if all(r is None for r in rest) else np.concatenate([r for r in rest if r is not None])
        if merged is not None and any(r is None for r in rest):
            raise ValueError("cannot join Gaussians with and without sh_rest")
        fields: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts]) for name in GAUSSIAN_FIELDS
        }
        for name in ("ray_drop", "falloff"):
            given = [getattr(part, name) for part in parts]
            if any(values is not None for values in given):
                fields[name] = np.concatenate(
                    [np.zeros(len(p), np.float32) if v is None else v for p, v in zip(parts, given, strict=True)]
                )
        return cls(**fields, sh_rest=merged)


GAUSSIAN_FIELDS = ("mean_m", "quat_wxyz", "scale_m", "opacity", "rgb", "normal", "label", "intensity")
OPTIONAL_GAUSSIAN_FIELDS = ("sh_rest", "ray_drop", "falloff")
SHOWN_BESIDE_M, SHOWN_ABOVE_M = 20.0, 3.0
"""What a scene shows of itself in notebooks: so far beside the recorded path, up to this height above it."""
RIGID_LIFE_US = 10**12
"""Knot spacing of rigid Gaussians, long enough that they do not fade during a log."""


@dataclass(frozen=True)
class DynamicGaussians:
    """Gaussians that move: three knots each (paper section 3.1).

    ``gaussians.mean_m`` is the middle knot. Between knots positions are linear; opacity is multiplied by
    ``exp(-x**10)`` with x = (t - t2) / (t3 - t2) after the middle knot and (t2 - t) / (t2 - t1) before it, so a
    Gaussian exists from its first to its last knot. ``track`` indexes ``GaussianScene.tracks``, -1 for none. All
    positions and rotations are in the world, as recorded; re-posing an actor applies
    ``world_from_box(requested) @ inverse(track.path.at(t))``.

    ``in_box`` marks rigid parts of their track (None: there are none). Their positions, rotations and normals are in
    the frame of the track's box; they exist while the track's path covers the instant or a request poses the actor.
    """

    gaussians: Gaussians
    knot_t_us: Int64[np.ndarray, "n 3"]
    knot_m: Float32[np.ndarray, "n 3 3"]
    track: Int32[np.ndarray, " n"]
    in_box: Bool[np.ndarray, " n"] | None = None

    def __len__(self) -> int:
        return len(self.gaussians)

    def __repr__(self) -> str:
        return f"DynamicGaussians({len(self):,} of {len(set(self.track.tolist()))} tracks)"

    @classmethod
    def concatenate(cls, parts: Sequence[DynamicGaussians]) -> DynamicGaussians:
        """Concatenates dynamic Gaussians; a single part is returned unchanged."""
        if len(parts) <= 1:
            return parts[0] if parts else cls.empty()
        in_box = None
        if any(part.in_box is not None for part in parts):
            in_box = np.concatenate([np.zeros(len(p), bool) if p.in_box is None else p.in_box for p in parts])
        return cls(
            Gaussians.concatenate([part.gaussians for part in parts]),
            np.concatenate([part.knot_t_us for part in parts]),
            np.concatenate([part.knot_m for part in parts]),
            np.concatenate([part.track for part in parts]),
            in_box,
        )

    @classmethod
    def rigid(cls, gaussians: Gaussians, track: Int32[np.ndarray, " n"], t_us: int) -> DynamicGaussians:
        """Rigid parts of tracks, in the frames of their boxes; they do not fade within days of ``t_us``."""
        knot_t_us = np.tile(t_us + np.array([-RIGID_LIFE_US, 0, RIGID_LIFE_US], np.int64), (len(gaussians), 1))
        knot_m = np.repeat(gaussians.mean_m[:, None], 3, axis=1)
        return cls(gaussians, knot_t_us, knot_m, track.astype(np.int32), np.ones(len(gaussians), bool))

    def at(self, t_us: int) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, "k 3"], Float64[np.ndarray, " k"]]:
        """Indices of the Gaussians that exist at ``t_us``, their positions (metres, world, as recorded), and fade 0..1.

        Positions of Gaussians ``in_box`` stay in the frames of their boxes.
        """
        rows = np.flatnonzero((self.knot_t_us[:, 0] <= t_us) & (t_us <= self.knot_t_us[:, 2]))
        times, each = self.knot_t_us[rows], np.arange(len(rows))
        # Two segments meet at the middle knot: before it knots 0 and 1 are interpolated, after it knots 1 and 2.
        after = t_us >= times[:, 1]
        low = np.where(after, 1, 0)
        start_us, end_us = times[each, low], times[each, low + 1]
        fraction = (t_us - start_us) / np.maximum(end_us - start_us, 1)
        # x of the paper: 0 at the middle knot, 1 at the outer one, where exp(-1) is left before the cut.
        fade = np.exp(-(np.where(after, fraction, 1 - fraction) ** 10))
        before_m, after_m = (self.knot_m[rows, low + k].astype(np.float64) for k in (0, 1))
        with np.errstate(invalid="ignore"):  # knots that are not finite stay so
            return rows, before_m * (1 - fraction[:, None]) + after_m * fraction[:, None], fade

    @classmethod
    def empty(cls) -> DynamicGaussians:
        """No Gaussians."""
        return cls(Gaussians.empty(), np.zeros((0, 3), np.int64), np.zeros((0, 3, 3), np.float32),
                   np.zeros(0, np.int32))  # fmt: skip


@dataclass(frozen=True)
class GaussianScene:
    """A layered Gaussian world: the output of a reconstruction, the content of an archive, the input of a renderer.

    ``sky`` is a cubemap ``[6,h,h,3]`` of display-space colours, faces and axes as in ``geometry.cubemap_directions``.
    ``isp`` maps a camera id to ``[3,4]``: shown colour = ``isp[:, :3] @ colour + isp[:, 3]``, after sky compositing.
    ``exposures`` maps a camera id to per-frame responses, ``[frames,3,4]`` at the midpoints of ``camera_times_us``;
    where a camera has them they replace ``isp``, interpolated linearly in time.
    ``ego_images`` maps the id of a camera that sees the ego vehicle to that picture, RGBA of the camera's size, with
    alpha 0 where it sees the street.
    ``provenance`` is plain JSON: method, settings, missing information (no map, no boxes, ...).
    """

    id: str
    static: Gaussians
    dynamic: DynamicGaussians
    sky: Float32[np.ndarray, "6 h h 3"]
    isp: Mapping[str, Float64[np.ndarray, "3 4"]]
    rig: Rig
    ego: Trajectory
    tracks: Sequence[Track]
    road_map: RoadMap | None
    span_us: tuple[int, int]
    camera_times_us: Mapping[str, Int64[np.ndarray, "frames 2"]] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    exposures: Mapping[str, Float64[np.ndarray, "frames 3 4"]] = field(default_factory=dict)
    ego_images: Mapping[str, UInt8[np.ndarray, "h w 4"]] = field(default_factory=dict)

    def response(self, camera_id: str, t_us: int) -> Float64[np.ndarray, "3 4"] | None:
        """The colour response of a camera at an instant; None if the scene has none for it."""
        frames = self.exposures.get(camera_id)
        if frames is None:
            return self.isp.get(camera_id)
        middle = np.asarray(self.camera_times_us[camera_id], np.int64).sum(axis=1) // 2
        # The two frames around the instant; a single frame is both of them, and the ends hold their value.
        after = int(np.clip(np.searchsorted(middle, t_us), 1, max(len(middle) - 1, 1)))
        before = min(after - 1, len(middle) - 1)
        after = min(after, len(middle) - 1)
        span = max(int(middle[after] - middle[before]), 1)
        share = float(np.clip((t_us - int(middle[before])) / span, 0, 1))
        return frames[before] * (1 - share) + frames[after] * share

    def __repr__(self) -> str:
        start_us, end_us = self.span_us
        made = f" by {self.provenance['method']!r}" if "method" in self.provenance else ""
        return (
            f"GaussianScene {self.id!r}{made}, {(end_us - start_us) / 1e6:.2f} s from {start_us} us\n"
            f"  Gaussians: {len(self.static):,} static, {len(self.dynamic):,} dynamic; "
            f"sky {'x'.join(map(str, np.shape(self.sky)[:3]))}, {len(self.tracks)} tracks, "
            f"{'no ' if self.road_map is None else ''}road map\n"
            f"  cameras: {', '.join(self.rig.cameras) or 'none'}; LiDARs: {', '.join(self.rig.lidars) or 'none'}"
        )

    def _repr_html_(self) -> str:
        """Facts, and the static Gaussians around the recorded path from above, for notebooks."""
        title, *facts = repr(self).split("\n")
        path_m = self.ego.position_m
        low, high = path_m.min(axis=0) - SHOWN_BESIDE_M, path_m.max(axis=0) + SHOWN_BESIDE_M
        mean_m = self.static.mean_m
        # Roofs and crowns of trees would hide the street.
        shown = (self.static.opacity > 0.3) & (mean_m[:, 2] < path_m[:, 2].max() + SHOWN_ABOVE_M)
        rgb = np.rint(255 * np.clip(self.static.rgb[shown], 0, 1)).astype(np.uint8)
        picture = display.jpeg(display.from_above(mean_m[shown], rgb, low.tolist(), high.tolist()))
        return display.table(title, [(fact.strip(),) for fact in facts]) + display.image_tag(picture)
