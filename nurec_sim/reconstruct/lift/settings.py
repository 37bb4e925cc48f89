"""Settings of the `lift` reconstruction; every length in metres, every angle in degrees where the name says so."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64

BEND = 0.75
"""Inverse-depth levels at infinity are closer by this share than on average, those nearby farther apart."""


@dataclass(frozen=True)
class PointSettings:
    """How sweeps are gathered, split by boxes and thinned."""

    box_margin_m: float = 0.15
    """Boxes grow by this on every side before points are taken out of the static world."""
    standing_m: float = 0.3
    """A track that moves less than this over its labelled life is static: it is kept over the whole clip."""
    min_voxel_m: float = 0.06
    max_voxel_m: float = 0.24
    voxel_per_distance: float = 0.0075
    """Voxel edge per metre of distance to the driven path, rounded down to a power of two times ``min_voxel_m``."""
    max_range_m: float = 250.0
    """Farther returns are dropped."""
    carve: bool = True
    """Drop points, pixels and Gaussians that recorded beams passed through: ghosts of movers, wrong depth."""


@dataclass(frozen=True)
class GroundSettings:
    """The ground height grid and the road grown in it from the driven path."""

    cell_m: float = 0.1
    reach_m: float = 30.0
    """The grid ends this far from the driven path."""
    step_m: float = 0.045
    """A height step across 0.4 m above this, beyond the slope, is a kerb."""
    slope: float = 0.06
    opening_m: float = 0.35
    """Gaps in kerbs narrower than twice this do not let the road through."""
    road_reach_m: float = 14.0
    """No road label farther than this from the driven path."""


@dataclass(frozen=True)
class ViewSettings:
    """The pinhole working views, their depth and the pixels lifted from them."""

    width_px: int = 800
    """Working views have about this width, by a whole-number reduction of the image (``reduction_of``); wider ones in
    short logs (``widened``), down to half of it where pixels outnumber the budget (``pixels_per_gaussian``)."""
    pixels: int = 8_000_000
    """Working views are wider as long as all images together have at most this many pixels."""
    max_field_deg: float = 80.0
    """Wider lenses are cut into several views: a plane has more pixels at its border than the image has there."""
    max_views: int = 40
    """Pixels are lifted from every n-th frame, so that no more working views than this are left."""
    max_frames: int = 240
    """Frames between them only help to find depth; they too are thinned evenly to this number."""
    budget: int = 700_000
    """Gaussians to lift from pixels at most, about: the plainest blocks of pixels become one each to meet it."""
    pixels_per_gaussian: float = 12.0
    """Working views are narrower as long as those that are lifted have more pixels than this for each Gaussian of the
    budget, about 4 of which own what they show. At edges of depth every pixel becomes one, and the rest is left to few
    large blocks; in narrower views edges have fewer pixels."""
    levels: int = 72
    """Inverse-depth hypotheses of the matching, from infinity to ``min_depth_m``."""
    min_depth_m: float = 3.5
    max_depth_m: float = 150.0
    """Surfaces farther than this belong to the sky cubemap."""
    neighbours: int = 4
    """Views that each view is matched against; 0 turns matching off."""
    fusion_rounds: int = 3
    """How often the depths of neighbouring views are fused; 0 leaves each view with its own."""

    def __post_init__(self) -> None:
        """Checks the limits.

        Raises:
            ValueError: one is too small, or the range of depths is empty.
        """
        limits = {"width_px": 1, "pixels": 1, "max_views": 1, "max_frames": 1, "budget": 1, "levels": 2}
        limits |= {"pixels_per_gaussian": 1, "neighbours": 0, "fusion_rounds": 0}
        for name, least in limits.items():
            if not getattr(self, name) >= least:
                raise ValueError(f"{name} must be {least} or more, got {getattr(self, name)}")
        if not 0 < self.max_field_deg < 180:
            raise ValueError(f"max_field_deg must be above 0 and below 180, got {self.max_field_deg}")
        if not 0 < self.min_depth_m < self.max_depth_m:
            raise ValueError(
                f"min_depth_m must be above 0 and below max_depth_m, got {self.min_depth_m} and {self.max_depth_m}"
            )

    @property
    def level_step(self) -> float:
        """Mean difference of two neighbouring inverse-depth levels, 1/m."""
        return 1 / self.min_depth_m / (self.levels - 1)

    @property
    def agreement(self) -> float:
        """Inverse depths of one surface differ by less than this (1/m), plus a share of themselves."""
        return 0.3 * self.level_step

    @property
    def inverse_depths(self) -> Float64[np.ndarray, " levels"]:
        """The inverse-depth hypotheses of the matching, 1/m, from 0; a parabola, so finer the farther away.

        A pixel resolves far surfaces by long baselines and near ones by short ones, so equal steps would be too coarse
        there and too fine here: at 60 m a step of 1/250 m is 14 m.
        """
        level = np.arange(self.levels)
        return self.level_step * level * (1 - BEND + BEND * level / (self.levels - 1))

    def reduction_of(self, width_px: int) -> int:
        """By which whole number images of this width are reduced: the nearest to what ``width_px`` asks for."""
        return max(1, math.ceil(width_px / self.width_px - 0.5))

    def widened(self, images: Sequence[tuple[int, int, int]]) -> ViewSettings:
        """The settings with the largest ``width_px`` that ``pixels`` allows, but no smaller one.

        Args:
            images: of each camera: width and height in pixels, and how many.
        """
        share = min(1.0, self.max_frames / max(sum(count for _, _, count in images), 1))
        for reduction in range(1, max((width for width, _, _ in images), default=1) // self.width_px + 1):
            pixels = share * sum((width // reduction) * (height // reduction) * n for width, height, n in images)
            if pixels <= self.pixels:
                widest = max(width for width, _, _ in images)
                return replace(self, width_px=max(self.width_px, -(-widest // reduction)))
        return self


@dataclass(frozen=True)
class ColourSettings:
    """How colours are solved for, once all Gaussians are there."""

    rounds: int = 8
    """How often an image is taken at most; 0 leaves the colours of single pixels."""
    images: int = 60
    """Images taken in all, about: those of a short log several times, those of a long one evenly thinned. Responses of
    frames between them are interpolated."""
    pixels: int = 50_000_000
    """Images are taken with more pixels than working views as long as all that are taken have at most this many."""
    trust: float = 0.1
    """The first colour of a Gaussian counts like this many pixels."""
    gain_pull: float = 0.01
    """Weight of a frame's gains being 1, next to that of the errors of all of its pixels; of offsets being 0: more."""

    def __post_init__(self) -> None:
        """Checks the limits.

        Raises:
            ValueError: one is too small.
        """
        for name, least in {"rounds": 0, "images": 1, "pixels": 1, "trust": 0, "gain_pull": 0}.items():
            if not getattr(self, name) >= least:
                raise ValueError(f"{name} must be {least} or more, got {getattr(self, name)}")


@dataclass(frozen=True)
class LiftSettings:
    """All settings of ``reconstruct(clip, "lift")``.

    The limits ``max_views``, ``max_frames``, ``pixels`` and ``budget`` of ``views``, and ``images`` and ``pixels`` of
    ``colours``, are for logs of up to ``path_m`` and ``duration_s`` whose cameras have ``detail_px``; others get more
    (``for_log``).
    """

    points: PointSettings = field(default_factory=PointSettings)
    ground: GroundSettings = field(default_factory=GroundSettings)
    views: ViewSettings = field(default_factory=ViewSettings)
    colours: ColourSettings = field(default_factory=ColourSettings)
    sky_px: int = 512
    """Edge of a cubemap face."""
    opacity: float = 0.95
    path_m: float = 50.0
    duration_s: float = 5.0
    most_lengths: float = 8.0
    """Limits grow no further than this, which bounds time and memory."""
    detail_px: int = 350_000
    """Pixels of the working views of one instant, all cameras together."""
    most_detail: float = 2.0
    """``budget`` and the limits of ``colours`` grow no further than this with the square root of the pixels."""

    def __post_init__(self) -> None:
        """Checks the lengths.

        Raises:
            ValueError: one is not positive, or limits would shrink.
        """
        for name in ("sky_px", "path_m", "duration_s", "detail_px"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)}")
        for name in ("most_lengths", "most_detail"):
            if not getattr(self, name) >= 1:
                raise ValueError(f"{name} must be 1 or more, got {getattr(self, name)}")

    def for_log(self, path_m: float, duration_s: float, images: Sequence[tuple[int, int, int]]) -> LiftSettings:
        """The settings for a log: limits that follow its length, and the size and number of its cameras.

        Neighbouring pixels show much the same, and cameras overlap: the Gaussians that are worth their cost grow with
        the square root of the pixels, as do the images that tell their colours.

        Args:
            path_m: length of the driven path, metres.
            duration_s: of the recording; where the car stands others move.
            images: of each camera: width and height in pixels, and how many.
        """
        lengths = min(max(path_m / self.path_m, duration_s / self.duration_s, 1.0), self.most_lengths)
        longer = {name: round(lengths * getattr(self.views, name)) for name in ("max_views", "max_frames", "pixels")}
        views = replace(self.views, **longer).widened(images)
        reduced = [(width // r, height // r) for width, height, _ in images for r in [views.reduction_of(width)]]
        detail = math.sqrt(sum(width * height for width, height in reduced) / self.detail_px)
        limits = min(lengths * min(max(detail, 1.0), self.most_detail), self.most_lengths)
        views = replace(views, budget=round(limits * self.views.budget))
        colours = {name: round(limits * getattr(self.colours, name)) for name in ("images", "pixels")}
        return replace(self, views=views, colours=replace(self.colours, **colours))
