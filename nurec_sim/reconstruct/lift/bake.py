"""Gaussians of one body: its pixels lifted and owned, and the surfels that no view saw."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int32

from nurec_sim import geometry
from nurec_sim.compute.cores import in_order
from nurec_sim.reconstruct.free_space import SweepBeams
from nurec_sim.reconstruct.lift import colour, lifting, surfaces
from nurec_sim.reconstruct.lift.backdrop import backdrop
from nurec_sim.reconstruct.lift.blocks import block_costs, block_maxima, block_means, chosen_blocks, tolerance_for
from nurec_sim.reconstruct.lift.bodies import Surfels
from nurec_sim.reconstruct.lift.footprints import footprints_of, marked_free, on_level, outside_free_space, parts_of
from nurec_sim.reconstruct.lift.ground import Ground
from nurec_sim.reconstruct.lift.lifting import NOBODY, Lifted
from nurec_sim.reconstruct.lift.pictures import DepthPicture
from nurec_sim.reconstruct.lift.settings import LiftSettings
from nurec_sim.reconstruct.lift.views import WorkingView
from nurec_sim.types import Gaussians

STAYING = 0.88
"""Share of the blocks that own a surface and stay, about: most of the others lie in free space."""
SAMPLED = slice(4, None, 8)
"""Rows and columns of the pixels that tell which share of a view owns what it shows."""
COARSE_PIXEL = 2.0
"""Pixels replace surfels unless they are so many times as wide as surfels are apart."""


def camera_isp(
    views: Sequence[WorkingView], pictures: Sequence[DepthPicture], bodies: Sequence[Surfels], cameras: Sequence[str]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Affine response of each camera, from the static surfels that several cameras see.

    Args:
        views: working views of all cameras.
        pictures: their dense depth, in the same order.
        bodies: measured surfaces; the first one is the static world.
        cameras: ids of the cameras to align, the reference first; those without views are left out.

    Returns:
        As ``colour.solve_isp``: the responses, and the cameras that could not be aligned.
    """
    cameras = [camera for camera in cameras if any(view.camera_id == camera for view in views)]
    world = bodies[0]
    some = slice(None, None, max(1, len(world.cloud) // 100_000))
    colours = {}
    for camera in cameras:
        mine = [k for k, view in enumerate(views) if view.camera_id == camera]
        rgb, pixel, _ = _look_up(world.cloud.xyz_m[some], world.normal[some], [views[k] for k in mine],
                              [pictures[k] for k in mine], [views[k].rgb for k in mine], None)  # fmt: skip
        colours[camera] = rgb / 255, np.isfinite(pixel) & (rgb.max(axis=1) < 255 * colour.SATURATED)
    return colour.solve_isp(cameras, colours)


def _look_up(xyz, normal, views, pictures, rgb, body: Surfels | None) -> tuple[np.ndarray, ...]:
    """Colours of points of a body (None: the world), the pixel size they were seen with, views looking through."""
    if not views or not len(xyz):
        return np.zeros((len(xyz), 3), np.float32), np.full(len(xyz), np.inf, np.float32), np.zeros(len(xyz), np.int32)
    packed, present = _packed(views, body)
    depths, free = (lifting.stacked([getattr(p, name) for p in pictures]) for name in ("inverse_depth", "free"))
    stack = lifting.stacked(rgb)
    results = in_order(
        lambda part: colour.seen_colours(xyz[part], normal[part], packed, depths, free, stack, present, 0.002),
        parts_of(len(xyz)),
    )
    return tuple(np.concatenate(items) for items in zip(*results, strict=True))


def _packed(views: Sequence[WorkingView], body: Surfels | None) -> tuple[np.ndarray, np.ndarray]:
    if body is None or body.actor is None:
        return colour.packed_views(views), np.ones(len(views), bool)
    poses = [body.world_from_body(view.t_us) for view in views]
    return colour.packed_views(views, poses), np.array([body.present(view.t_us) for view in views])


def body_pixels(
    bodies: Sequence[Surfels],
    views: Sequence[WorkingView],
    pictures: Sequence[DepthPicture],
    rgb: Sequence[np.ndarray],
    settings: LiftSettings,
) -> list[Lifted]:
    """The pixels of all views that show each body, in its frame, as blocks (``blocks``) that meet the budget.

    Args:
        bodies: the static world, then the actors; the numbers in ``DepthPicture.body`` index it.
        views: working views.
        pictures: their dense depth, in the same order.
        rgb: their canonical colours, 0..255 [h,w,3], in the same order.
        settings: ``views.budget`` and ``views.max_depth_m`` are used.

    Returns:
        Lifted points per body, in the order of ``bodies``.
    """
    near = [
        np.where((picture.inverse_depth > 1 / settings.views.max_depth_m) & view.tile.valid, picture.body, NOBODY)
        for view, picture in zip(views, pictures, strict=True)
    ]
    costs = list(in_order(lambda k: block_costs(rgb[k], pictures[k].inverse_depth, near[k]), range(len(views))))
    pixels = [int(np.count_nonzero(body >= 0)) for body in near]
    share = _owning_share(bodies[0], views, pictures, near, rgb, settings)
    tolerance = tolerance_for(costs, pixels, share, round(settings.views.budget / STAYING))
    parts = [[Lifted.empty()] for _ in bodies]

    def lift(k: int) -> list[tuple[int, Lifted]]:
        first, edge = chosen_blocks(costs[k], near[k], tolerance)
        shown = near[k].flat[first]
        # Means of pictures of the whole view, so they are computed before the loop over bodies.
        everything = _world_points(k, views[k], pictures[k], rgb[k], first, edge)
        return [
            (number, _in_body(everything[shown == number], views[k], bodies[number])) for number in np.unique(shown)
        ]

    for found in in_order(lift, range(len(views))):
        for number, lifted in found:
            parts[number].append(lifted)
    return [Lifted.concatenate(each) for each in parts]


def _owning_share(
    world: Surfels,
    views: Sequence[WorkingView],
    pictures: Sequence[DepthPicture],
    near: Sequence[np.ndarray],
    rgb: Sequence[np.ndarray],
    settings: LiftSettings,
) -> list[float]:
    """Which share of the pixels of each view owns the static surface that it shows, about: by some of its pixels.

    A car that crawls sees every surface in many views, one that drives fast in few.
    """

    def some(k: int) -> Lifted:
        number = np.arange(near[k].size, dtype=np.int32).reshape(near[k].shape)[SAMPLED, SAMPLED]
        first = number[near[k][SAMPLED, SAMPLED] == 0]
        if not len(first):
            return Lifted.empty()
        single = np.ones(len(first), np.uint8)
        return _in_body(_world_points(k, views[k], pictures[k], rgb[k], first, single), views[k], world)

    sample = Lifted.concatenate([Lifted.empty(), *in_order(some, range(len(views)))])
    owned = _owned(sample, world, views, pictures, rgb, settings)
    count, owning = (np.bincount(sample.view, weight, len(views)) for weight in (None, owned))
    return list(np.where(count > 0, owning / np.maximum(count, 1), 1.0))


def _world_points(
    k: int, view: WorkingView, picture: DepthPicture, rgb: np.ndarray, first: np.ndarray, edge: np.ndarray
) -> Lifted:
    """Blocks of the k-th view as points in the world."""
    depth = picture.inverse_depth
    pictures = lifting.points_of(view, depth), lifting.normals_of(view, depth), lifting.rays_of(view), rgb
    xyz, normal, ray, colours = (block_means(values, first, edge) for values in pictures)
    ray = geometry.rotate_vectors(view.world_from_view[:3, :3], ray)
    normal, ray = (each / np.maximum(np.linalg.norm(each, axis=1, keepdims=True), 1e-9) for each in (normal, ray))
    z = 1 / block_means(depth[..., None].astype(np.float64), first, edge)[:, 0]
    return Lifted(xyz, normal, ray, z, edge * z / view.tile.focal_px, colours.astype(np.float32),
                  block_maxima(picture.surfel, first, edge), np.full(len(first), k, np.int32), first, edge)  # fmt: skip


def _in_body(points: Lifted, view: WorkingView, body: Surfels) -> Lifted:
    """Points of one body of a view, in its frame; normals of its surfels where these gave the depth."""
    body_from_world = geometry.inverse(body.world_from_body(view.t_us))
    turn, measured = body_from_world[:3, :3], points.surfel >= 0
    normal = geometry.rotate_vectors(turn, points.normal)
    normal[measured] = body.normal[points.surfel[measured]]
    return replace(
        points,
        xyz_m=geometry.transform_points(body_from_world, points.xyz_m),
        normal=normal,
        ray=geometry.rotate_vectors(turn, points.ray),
    )


class Baked(NamedTuple):
    """Gaussians of one body, in its frame."""

    gaussians: Gaussians
    lifted: int
    """How many of them, the first ones, were lifted from pixels."""
    shown: Bool[np.ndarray, " n"]
    """Which of them have a colour from an image."""


def body_gaussians(
    body: Surfels,
    pixels: Lifted,
    ground: Ground,
    views: Sequence[WorkingView],
    pictures: Sequence[DepthPicture],
    rgb: Sequence[np.ndarray],
    settings: LiftSettings,
    beams: Sequence[SweepBeams] = (),
    progress: Callable[[float], None] = lambda fraction: None,
) -> Baked:
    """Gaussians of one body; none where beams passed. Surfels that no image shows are grey, by their intensity.

    Args:
        body: its measured surface.
        pixels: its lifted pixels (``body_pixels``), before ownership.
        ground: labels lifted points on the road, and lets footprints on it stretch further.
        views: working views.
        pictures: their dense depth, in the same order.
        rgb: their canonical colours, 0..255 [h,w,3], in the same order.
        settings: opacity, and the depth levels of the matching.
        beams: recorded beams; Gaussians in the space that they passed are dropped.
        progress: called with the fraction done, about.
    """
    stays = _owned(pixels, body, views, pictures, rgb, settings)
    progress(0.25)
    pixel_gaussians, dropped = outside_free_space(pixels[stays], body, ground, settings, beams)
    progress(0.65)
    parts = [pixel_gaussians]
    # Where a pixel's depth is wrong, those of other views take over, and the surfels behind it.
    pictures = marked_free(pictures, dropped)
    rest = pixels[~stays]
    taken = _owned(rest, body, views, pictures, rgb, settings) if len(dropped) else np.zeros(len(rest), bool)
    more = [rest[taken]]
    if body.actor is None:
        # Along grazing ground rings of distance are a few pixels wide, so that each of two views may leave a surface to
        # the other. There in the end only pixels that are still there own.
        stays[~stays] = taken
        left = rest[~taken & on_level(rest, ground)]
        numbers = [picture.body for picture in pictures]

        def in_gaps(owners: Lifted, kept: np.ndarray) -> np.ndarray:
            return _owned(left, body, views, pictures, rgb, settings, lifting.owning(numbers, owners, kept))

        left = left[in_gaps(pixels, stays)]
        # Of all that lie in a gap the nearest: from afar pixels are metres long, and as bright as ground seen along it.
        nearest = in_gaps(left, np.ones(len(left), bool))
        more.append(left[nearest | in_gaps(left, nearest)])
    progress(0.8)
    parts.append(outside_free_space(Lifted.concatenate(more), body, ground, settings, beams)[0])
    if body.actor is None and views:
        behind = backdrop(views, pictures, rgb, ground, settings.views.max_depth_m)
        behind_gaussians = footprints_of(behind, body, ground, settings)
        parts.append(body.outside_free_space(behind_gaussians, beams, ground)[0])
    progress(0.85)
    cloud = body.cloud
    seen_rgb, pixel, through = _look_up(cloud.xyz_m, body.normal, views, pictures, rgb, body)
    seen, keep = np.isfinite(pixel), not_replaced(pixel, through, body.spacing_m)
    colours = np.where(seen[:, None], seen_rgb / np.float32(255), colour.grey_of(cloud.intensity))
    discs = _discs(body, colours, np.flatnonzero(keep), settings.opacity)
    progress(0.9)
    discs, stays = body.outside_free_space(discs, beams, ground)
    lifted = sum(map(len, parts))
    return Baked(Gaussians.concatenate([*parts, discs]), lifted, np.append(np.ones(lifted, bool), seen[keep][stays]))


def not_replaced(
    pixel_m: Float32[np.ndarray, " n"], through: Int32[np.ndarray, " n"], spacing_m: Float32[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Which surfels stay: those that views see so obliquely that surfels are the finer of the two, or not at all.

    Args:
        pixel_m: width of the pixels that show them, along the surface; infinite where none does.
        through: how many views look through them.
        spacing_m: distance between surfels.
    """
    return (pixel_m > COARSE_PIXEL * spacing_m) & (np.isfinite(pixel_m) | (through == 0))


def _discs(body: Surfels, colours: np.ndarray, rows: np.ndarray, opacity: float) -> Gaussians:
    """Some surfels of a body, with these colours of all of them, as Gaussians."""
    cloud = body.cloud

    def made(part: slice) -> Gaussians:
        mine = rows[part]
        return surfaces.discs(cloud.xyz_m[mine], body.normal[mine], body.sigma_m[mine], colours[mine],
                              cloud.intensity[mine], body.label[mine], opacity)  # fmt: skip

    return Gaussians.concatenate([Gaussians.empty(), *in_order(made, parts_of(len(rows)))])


def _only_matched(pixels: Lifted, pictures: Sequence[DepthPicture]) -> Bool[np.ndarray, " n"]:
    """Which pixels have a depth that no beam supports: neither their own surfel nor those above and below them."""
    matched = pixels.surfel < 0
    for k, picture in enumerate(pictures):
        rows = np.flatnonzero(matched & (pixels.view == k))
        between = lifting.between_measured(picture.inverse_depth, picture.surfel >= 0)
        matched[rows] = ~between.flat[pixels.pixel[rows]]
    return matched


def _owned(
    everything: Lifted,
    body: Surfels,
    views: Sequence[WorkingView],
    pictures: Sequence[DepthPicture],
    rgb: Sequence[np.ndarray],
    settings: LiftSettings,
    owns: Sequence[np.ndarray] | None = None,
) -> np.ndarray:
    """Which pixels of a body no other view owns; those not to be believed (``DepthPicture.free``) tell nothing.

    ``owns`` says which pixels of each view may own; None: all.
    """
    if not len(everything):
        return np.zeros(0, bool)
    packed, present = _packed(views, body)
    depths = [np.where(picture.free, np.float32(np.nan), picture.inverse_depth) for picture in pictures]
    depth_stack, rgb_stack = lifting.stacked(depths), lifting.stacked(rgb)
    owner_stack = np.ones(depth_stack.shape, bool) if owns is None else lifting.stacked(owns)
    # Boxes are not exact enough to tell from afar whether a view looks through an actor.
    matched = _only_matched(everything, pictures) & (body.actor is None)
    kept = in_order(
        lambda part: lifting.owned(
            everything.xyz_m[part],
            everything.normal[part],
            everything.depth_m[part],
            everything.view[part],
            matched[part],
            everything.rgb[part],
            packed,
            depth_stack,
            owner_stack,
            rgb_stack,
            present,
            settings.views.agreement,
            lifting.OWNER_RING,
            lifting.OWNER_BORDER,
            body.actor is not None,
        ),
        parts_of(len(everything)),
    )
    return np.concatenate(list(kept))
