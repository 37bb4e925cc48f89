"""Dense depth pictures of the key views, and which body each of their pixels shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8

from nurec_sim import geometry
from nurec_sim.compute.cores import in_order
from nurec_sim.compute.kernels import inner, kernel
from nurec_sim.reconstruct.lift import depth, sky_pixels
from nurec_sim.reconstruct.lift.beam_rows import close_rows, row_gaps
from nurec_sim.reconstruct.lift.bodies import Surfels
from nurec_sim.reconstruct.lift.edges import trim_edges
from nurec_sim.reconstruct.lift.fusion import FARTHEST, fused_depths
from nurec_sim.reconstruct.lift.lifting import NOBODY, STATIC
from nurec_sim.reconstruct.lift.neighbours import in_colours_of, neighbours_of, views_beside
from nurec_sim.reconstruct.lift.settings import LiftSettings
from nurec_sim.reconstruct.lift.splat import (
    WIDEST_OF_ACTORS_PX,
    WIDEST_PX,
    close_gaps,
    draw_surfels,
    trim_silhouettes,
    world_point,
)
from nurec_sim.reconstruct.lift.views import WorkingView
from nurec_sim.types import LidarModel

OUTLINE_M = 0.6
"""Unmeasured pixels up to this far outside of a box may show its object."""
MARGIN_M = 0.1
"""Pixels this far outside of a box belong to it: boxes are not exact."""
CODES = 128
"""So many views' census, 8 bytes a pixel, are kept: neighbours of one key view are mostly those of the next ones."""


@dataclass(frozen=True)
class DepthPicture:
    """Inverse depth of a view; the body that each pixel shows, the surfel that gave its depth (-1: none); sky.

    ``free``: the depth is not to be believed, because recorded beams passed there or other views dispute it.
    """

    inverse_depth: Float32[np.ndarray, "h w"]
    body: Int32[np.ndarray, "h w"]
    surfel: Int32[np.ndarray, "h w"]
    sky: Bool[np.ndarray, "h w"]
    free: Bool[np.ndarray, "h w"]


def depth_pictures(
    views: Sequence[WorkingView],
    bodies: Sequence[Surfels],
    lidars: Sequence[LidarModel],
    settings: LiftSettings,
    progress: Callable[[float], None],
) -> list[DepthPicture]:
    """Dense depth of the key views, matched against all views and fused among key views.

    Args:
        views: working views; those with ``key`` get a picture.
        bodies: measured surfaces, the static world first.
        lidars: scanners that measured them.
        settings: ``views``: depth levels and number of neighbours.
        progress: called with the fraction of the key views that is done.
    """
    keys = [k for k, view in enumerate(views) if view.key]
    options = settings.views
    # The sky is judged against the brightest parts of this log: exposure differs between logs.
    bright = (
        float(np.percentile(np.concatenate([v.rgb[::8, ::8].mean(axis=-1).ravel() for v in views]), 98)) if views else 0
    )

    @lru_cache(CODES)
    def code(n: int) -> np.ndarray:
        return depth.census(_gray(views[n]))

    def one(k: int) -> tuple[DepthPicture, np.ndarray]:
        view = views[k]
        prior, index, body = _draw(view, bodies, lidars)
        trim_silhouettes(prior, index, _gray(view))
        sky = sky_pixels.sky_coloured(view, prior, bright)
        likeness = sky_pixels.sky_likeness(view.rgb, sky, view.tile.valid)
        around = [(views[n].packed, views[n].rgb, code(n)) for n in neighbours_of(views, k, options.neighbours)]
        if options.neighbours:
            around += [(views[n].packed, in_colours_of(view, views[n], prior), code(n)) for n in views_beside(views, k)]
        dense = depth.dense_inverse_depth(
            view.packed, view.world_from_view, view.rgb, prior, likeness, around, options.inverse_depths
        )
        # Pixels that show nothing of the world neither agree with a point nor look through it.
        dense[~view.tile.valid] = np.nan
        # Where smoothing overruled the splatted surfel, the pixel does not show that surfel.
        index[dense != prior] = -1
        drawn = np.where(index >= 0, body, STATIC)
        return DepthPicture(dense, drawn, index, sky, np.zeros(dense.shape, bool)), likeness

    def with_bodies(k: int, picture: DepthPicture) -> DepthPicture:
        body = _bodies_of_pixels(views[k], bodies, picture.inverse_depth, picture.body)
        return replace(picture, body=body, surfel=np.where(body == picture.body, picture.surfel, -1))

    drawn, likeness = [], []
    for done, (picture, like) in enumerate(in_order(one, keys)):
        progress(done / len(keys))
        drawn.append(picture)
        likeness.append(like)
    bodies_of = [p.body for p in in_order(lambda each: with_bodies(*each), zip(keys, drawn, strict=True))]
    # What moves is not where its neighbours in time show it.
    static = [
        np.where(body == 0, p.inverse_depth, np.float32(np.nan)) for p, body in zip(drawn, bodies_of, strict=True)
    ]
    # What looks like sky and is far stays so, and what does not look like it is no farther than a surface can be.
    fixed = [
        (p.surfel >= 0) | ((like == depth.SKY) & (p.inverse_depth <= depth.NO_SURFACE))
        for p, like in zip(drawn, likeness, strict=True)
    ]
    surfaces = [like == depth.NOT_SKY for like in likeness]
    fused, disputed = fused_depths(
        [views[k] for k in keys], static, fixed, surfaces, options.agreement, options.fusion_rounds
    )
    drawn = [
        replace(picture, inverse_depth=np.where(body == 0, fused_depth, picture.inverse_depth), free=doubt)
        for picture, body, fused_depth, doubt in zip(drawn, bodies_of, fused, disputed, strict=True)
    ]

    def trimmed(k: int, picture: DepthPicture) -> DepthPicture:
        depth = trim_edges(picture.inverse_depth, views[k].rgb)
        body = np.where(depth < picture.inverse_depth, STATIC, picture.body)
        return with_bodies(k, replace(picture, inverse_depth=depth, body=body))

    return list(in_order(lambda each: trimmed(*each), zip(keys, drawn, strict=True)))


def _gray(view: WorkingView) -> UInt8[np.ndarray, "h w"]:
    return view.rgb.mean(axis=-1).astype(np.uint8)


def _draw(
    view: WorkingView, bodies: Sequence[Surfels], lidars: Sequence[LidarModel]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Splat all bodies: inverse depth, surfel row within its body, and body number per pixel."""
    offset, starts, jobs = 0, [], []
    for surfels in bodies:
        starts.append(offset)
        if surfels.present(view.t_us) and len(surfels.cloud):
            pose = geometry.inverse(view.world_from_view) @ surfels.world_from_body(view.t_us)
            widest = WIDEST_PX if surfels.actor is None else WIDEST_OF_ACTORS_PX
            jobs.append(
                (view.packed_from(pose), surfels.cloud.xyz_m, surfels.normal, surfels.spacing_m, widest, offset)
            )
        offset += len(surfels.cloud)
    inverse_depth, index = draw_surfels(view.rgb.shape[:2], jobs)
    body = np.zeros(index.shape, np.int32)
    drawn = index >= 0
    body[drawn] = np.searchsorted(starts, index[drawn], side="right") - 1
    # Bodies without surfels share their start with the next one: searchsorted picks the last, which holds the row.
    index[drawn] -= np.asarray(starts, np.int32)[body[drawn]]
    close_rows(inverse_depth, index, body, row_gaps(view, lidars))
    length_m = np.array([0.0 if surfels.actor is None else surfels.box_size_m[0] for surfels in bodies])
    close_gaps(inverse_depth, index, body, length_m, np.float32(view.tile.focal_px))
    return inverse_depth, index, body


def _bodies_of_pixels(view: WorkingView, bodies: Sequence[Surfels], dense: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """Body number per pixel: that of the actor's surfel, else of the box that the pixel lies in, else the world (0)."""
    body = np.where(drawn >= 0, drawn, 0).astype(np.int32)
    numbers = [n for n, surfels in enumerate(bodies) if n > 0 and surfels.present(view.t_us)]
    if numbers:
        world_from_box = np.stack([bodies[n].world_from_body(view.t_us) for n in numbers])
        size = np.array([bodies[n].box_size_m for n in numbers], np.float64)
        numbers_of_pixels(
            view.packed, view.world_from_view, dense, drawn, np.array(numbers), world_from_box,
            geometry.inverse(world_from_box), size, body,
        )  # fmt: skip
    return body


@kernel
def numbers_of_pixels(view, world_from_view, dense, drawn, numbers, world_from_box, box_from_world, size, body):
    """Write into ``body`` the box that open pixels lie in: those that show no actor's surfel, and are not at infinity.

    Args:
        view: [23] packed projection of the view.
        world_from_view: [4,4] its pose.
        dense: [h,w] inverse depth, 1/m; NaN where there is none.
        drawn: [h,w] body of the surfel that a pixel shows, negative where none does.
        numbers: [k] of the boxes' bodies; of several the first one counts.
        world_from_box: [k,4,4].
        box_from_world: [k,4,4].
        size: [k,3] metres.
        body: [h,w] changed.
    """
    m = world_from_view
    reach = np.sqrt(((size / 2 + OUTLINE_M) ** 2).sum(axis=1))
    for row in range(dense.shape[0]):
        for column in range(dense.shape[1]):
            if drawn[row, column] > 0 or not dense[row, column] > 0:
                continue
            x, y, z = world_point(view, m, column + 0.5, row + 0.5, max(np.float64(dense[row, column]), FARTHEST))
            for k in range(len(numbers)):
                # Most pixels are far from most boxes.
                dx, dy = x - world_from_box[k, 0, 3], y - world_from_box[k, 1, 3]
                if abs(dx) > reach[k] or abs(dy) > reach[k] or abs(z - world_from_box[k, 2, 3]) > reach[k]:
                    continue
                up = _along(box_from_world, k, 2, x, y, z)
                # The lowest 15 cm of a box are road more often than tyre.
                if not up > -size[k, 2] / 2 + 0.15:
                    continue
                ahead, left = abs(_along(box_from_world, k, 0, x, y, z)), abs(_along(box_from_world, k, 1, x, y, z))
                off = max(max(ahead - size[k, 0] / 2, left - size[k, 1] / 2), abs(up) - size[k, 2] / 2)
                if off <= MARGIN_M:
                    body[row, column] = numbers[k]
                    break
                # Unmeasured pixels just outside a box are its silhouette at a wrong depth: nobody's.
                if off <= OUTLINE_M and drawn[row, column] < 0:
                    body[row, column] = NOBODY


@inner
def _along(box_from_world, k, axis, x, y, z):
    return (
        box_from_world[k, axis, 0] * x
        + box_from_world[k, axis, 1] * y
        + box_from_world[k, axis, 2] * z
        + box_from_world[k, axis, 3]
    )
