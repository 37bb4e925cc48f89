"""Gaussians of one body: its pixels lifted and owned, and the surfels that no view saw."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from nurec_sim import geometry
from nurec_sim.compute.cores import usable_cores
from nurec_sim.reconstruct.free_space import SweepBeams
from nurec_sim.reconstruct.lift import colour, lifting, surfaces
from nurec_sim.reconstruct.lift.bodies import Surfels
from nurec_sim.reconstruct.lift.ground import Ground
from nurec_sim.reconstruct.lift.lifting import Lifted
from nurec_sim.reconstruct.lift.pictures import DepthPicture
from nurec_sim.reconstruct.lift.settings import LiftSettings
from nurec_sim.reconstruct.lift.views import WorkingView
from nurec_sim.types import Gaussians, Label

GROUND_M = 0.12
"""Points so near to the ground belong to it."""
LOW_M, GRAZING = 0.5, 0.03
"""Pixels wrongly this low over the ground show the ground, unless their rays are flatter than this slope."""
KEPT_SHARE = 0.4
"""Share of the pixels of all views that owns a surface, about; to meet the budget before ownership is known."""


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
        colours[camera] = rgb / 255, np.isfinite(pixel)
    return colour.solve_isp(cameras, colours)


def _look_up(xyz, normal, views, pictures, rgb, body: Surfels | None) -> tuple[np.ndarray, ...]:
    """Colours of points of a body (None: the world), the pixel size they were seen with, views looking through."""
    if not views or not len(xyz):
        return np.zeros((len(xyz), 3), np.float32), np.full(len(xyz), np.inf, np.float32), np.zeros(len(xyz), np.int32)
    packed, present = _packed(views, body)
    depths, stack = lifting.stacked([p.inverse_depth for p in pictures]), lifting.stacked(rgb)
    parts = np.array_split(np.arange(len(xyz)), usable_cores())
    with ThreadPoolExecutor(usable_cores()) as pool:
        results = list(
            pool.map(
                lambda part: colour.seen_colours(xyz[part], normal[part], packed, depths, stack, present, 0.002), parts
            )
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
    """The pixels of all views that show each body, in its frame, thinned to the budget.

    Args:
        bodies: the static world, then the actors; the numbers in ``DepthPicture.body`` index it.
        views: working views.
        pictures: their dense depth, in the same order.
        rgb: their canonical colours, 0..255 [h,w,3], in the same order.
        settings: ``views.budget`` and ``views.max_depth_m`` are used.

    Returns:
        Lifted points per body, in the order of ``bodies``.
    """
    parts = [[Lifted.empty()] for _ in bodies]
    pixels = sum(view.rgb.shape[0] * view.rgb.shape[1] for view in views)
    thinning = 2 ** max(0, int(np.ceil(np.log2(max(KEPT_SHARE * pixels / settings.views.budget, 1)))))
    for k, (view, picture) in enumerate(zip(views, pictures, strict=True)):
        near = (picture.inverse_depth > 1 / settings.views.max_depth_m) & view.tile.valid
        near &= lifting.lattice(near.shape, thinning)
        # These are of the whole view, so they are computed before the loop over bodies.
        points, normals = (
            lifting.points_of(view, picture.inverse_depth),
            lifting.normals_of(view, picture.inverse_depth),
        )
        rays = lifting.rays_of(view)
        for number in np.unique(picture.body[near & (picture.body >= 0)]):
            body, mask = bodies[number], near & (picture.body == number)
            body_from_world = geometry.inverse(body.world_from_body(view.t_us))
            xyz = geometry.transform_points(body_from_world, points[mask])
            surfel = picture.surfel[mask]
            normal = normals[mask] @ body_from_world[:3, :3].T
            normal = np.where((surfel >= 0)[:, None], body.normal[surfel] if len(body.cloud) else normal, normal)
            ray = rays[mask]
            ray /= np.linalg.norm(ray, axis=1, keepdims=True)
            ray = ray @ (body_from_world @ view.world_from_view)[:3, :3].T
            z = 1 / picture.inverse_depth[mask].astype(np.float64)
            pixel_m = np.sqrt(thinning) * z / view.tile.focal_px
            mine = np.full(len(z), k, np.int32)
            parts[number].append(Lifted(xyz, normal, ray, z, pixel_m, rgb[k][mask].astype(np.float32), surfel, mine))
    return [Lifted.concatenate(each) for each in parts]


def body_gaussians(
    body: Surfels,
    pixels: Lifted,
    ground: Ground,
    views: Sequence[WorkingView],
    pictures: Sequence[DepthPicture],
    rgb: Sequence[np.ndarray],
    settings: LiftSettings,
    beams: Sequence[SweepBeams] = (),
) -> tuple[Gaussians, int]:
    """Gaussians of one body in its frame, and how many of them were lifted from pixels; none where beams passed.

    Args:
        body: its measured surface.
        pixels: its lifted pixels (``body_pixels``), before ownership.
        ground: labels lifted points on the road, and lets footprints on it stretch further.
        views: working views.
        pictures: their dense depth, in the same order.
        rgb: their canonical colours, 0..255 [h,w,3], in the same order.
        settings: opacity, and the depth levels of the matching.
        beams: recorded beams; Gaussians in the space that they passed are dropped.
    """
    cloud = body.cloud
    seen_rgb, pixel, through = _look_up(cloud.xyz_m, body.normal, views, pictures, rgb, body)
    shown = colour.fill_unseen(cloud.xyz_m, seen_rgb / 255, np.isfinite(pixel), cloud.intensity)
    # A view replaces surfels by its pixels unless it sees them so obliquely that surfels are the finer of the two.
    keep = (pixel > 3 * body.spacing_m) & (np.isfinite(pixel) | (through == 0))
    discs = surfaces.discs(cloud.xyz_m[keep], body.normal[keep], body.spacing_m[keep], shown[keep],
                           cloud.intensity[keep], body.label[keep], settings.opacity)  # fmt: skip
    parts = [discs[~body.in_free_space(discs, beams)]]
    lifted = _owned(pixels, body, views, pictures, rgb, settings)
    if len(lifted):
        footprints = _lifted_gaussians(lifted, body, ground, settings)
        free = body.in_free_space(footprints, beams)
        parts.append(footprints[~free])
        if body.actor is None:
            # What hovers low over the road shows the road: dropped, it would leave a hole.
            footprints = _lifted_gaussians(on_ground(lifted[free], ground), body, ground, settings)
            parts.append(footprints[~body.in_free_space(footprints, beams)])
    return Gaussians.concatenate(parts), sum(map(len, parts[1:]))


def on_ground(lifted: Lifted, ground: Ground) -> Lifted:
    """Lifted points low over the ground, moved along their rays down to it; all others are left out."""
    moved = lifted[(ground.above(lifted.xyz_m) < LOW_M) & (lifted.ray[:, 2] < -GRAZING)]
    step = np.zeros(len(moved))
    for _ in range(3):  # the ground is not level
        above = ground.above(moved.xyz_m + step[:, None] * moved.ray)
        step += np.where(np.isfinite(above), above, 0.0) / -moved.ray[:, 2]
    xyz = moved.xyz_m + step[:, None] * moved.ray
    row, column, _ = ground.cells(xyz)
    depth = moved.depth_m + step
    return dataclasses.replace(
        moved,
        xyz_m=xyz,
        normal=ground.normals()[row, column],
        depth_m=depth,
        pixel_m=moved.pixel_m * depth / moved.depth_m,
        surfel=np.full(len(moved), -1, np.int32),
    )[(np.abs(ground.above(xyz)) < GROUND_M) & (depth > 0)]


def _owned(
    everything: Lifted,
    body: Surfels,
    views: Sequence[WorkingView],
    pictures: Sequence[DepthPicture],
    rgb: Sequence[np.ndarray],
    settings: LiftSettings,
) -> Lifted:
    """The pixels of a body that no other view owns."""
    if not len(everything):
        return everything
    packed, present = _packed(views, body)
    step = 1 / settings.views.min_depth_m / (settings.views.levels - 1)
    depth_stack, rgb_stack = lifting.stacked([picture.inverse_depth for picture in pictures]), lifting.stacked(rgb)
    # Boxes are not exact enough to tell from afar whether a view looks through an actor.
    matched = (everything.surfel < 0) & (body.actor is None)
    cuts = np.linspace(0, len(everything), usable_cores() + 1).astype(np.int64)
    chunks = [slice(first, last) for first, last in zip(cuts[:-1], cuts[1:], strict=True)]
    with ThreadPoolExecutor(usable_cores()) as pool:
        jobs = [
            pool.submit(
                lifting.owned,
                everything.xyz_m[part],
                everything.depth_m[part],
                everything.view[part],
                matched[part],
                everything.rgb[part],
                packed,
                depth_stack,
                rgb_stack,
                present,
                0.3 * step,
                lifting.OWNER_RING,
                lifting.OWNER_BORDER,
            )
            for part in chunks
        ]
        kept = [job.result() for job in jobs]  # fmt: skip
    return everything[np.concatenate(kept)]


def _lifted_gaussians(lifted: Lifted, body: Surfels, ground: Ground, settings: LiftSettings) -> Gaussians:
    """Footprint Gaussians; label and intensity from the surfel that gave the depth, or from the ground below."""
    from_surfel = lifted.surfel >= 0
    n = len(lifted)
    label = np.full(n, Label.OTHER if body.actor is None else Label.MOVABLE, np.uint8)
    intensity = np.full(n, np.nan, np.float32)
    if len(body.cloud):
        label = np.where(from_surfel, body.label[lifted.surfel], label)
        intensity = np.where(from_surfel, body.cloud.intensity[lifted.surfel], intensity)
    stretch = np.full(n, surfaces.MOST_STRETCH)
    if body.actor is None:
        flat = np.abs(ground.above(lifted.xyz_m)) < GROUND_M
        stretch = np.where(flat, surfaces.MOST_STRETCH_OF_GROUND, stretch)
        label = np.where(~from_surfel & ground.is_road(lifted.xyz_m), Label.ROAD, label)
    return surfaces.footprints(lifted.xyz_m, lifted.normal, lifted.ray, lifted.pixel_m, lifted.rgb / 255, intensity,
                               label, settings.opacity, stretch)  # fmt: skip
