"""The `lift` method: coloured LiDAR and lifted pixels as Gaussians, without a network or an optimisation.

Sweeps give the geometry: they are gathered in the world (or in the box frame of their actor), thinned, and get normals.
Images give the detail: each frame gets a dense depth, measured where surfels lie in it and matched against its
neighbours elsewhere, and its pixels are lifted. Every surface is owned by the view that saw it from nearest; surfels
stay where no view saw them. What nothing covers is sky.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8

from nurec_sim import geometry
from nurec_sim.errors import ReconstructError
from nurec_sim.reconstruct import actors as actor_layer
from nurec_sim.reconstruct import colour, depth, lifting, points, surfaces
from nurec_sim.reconstruct.ground import Ground, find_ground
from nurec_sim.reconstruct.lifting import NOBODY, STATIC, Lifted
from nurec_sim.reconstruct.points import Actor, Cloud
from nurec_sim.reconstruct.settings import LiftSettings
from nurec_sim.reconstruct.sky import make_sky
from nurec_sim.reconstruct.views import View, read_views
from nurec_sim.types import Clip, Gaussians, GaussianScene, Label

THREADS = 2
KEPT_SHARE = 0.4
"""Share of the pixels of all views that owns a surface, about; to meet the budget before ownership is known."""
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Surfels:
    """The measured surface of one rigid body (``actor`` None: the static world), in its frame."""

    actor: Actor | None
    cloud: Cloud
    normal: Float32[np.ndarray, "n 3"]
    spacing_m: Float32[np.ndarray, " n"]
    label: UInt8[np.ndarray, " n"]

    def world_from_body(self, t_us: int) -> np.ndarray:
        """Where the body is."""
        return np.eye(4) if self.actor is None else self.actor.path.at(t_us)

    def present(self, t_us: int) -> bool:
        """Whether the body is known to be there."""
        return self.actor is None or bool(self.actor.present(np.array(t_us)))


@dataclass(frozen=True)
class DepthPicture:
    """Dense inverse depth of a view; which body each pixel shows, the surfel that gave its depth (-1: none), and sky."""

    inverse_depth: Float32[np.ndarray, "h w"]
    body: Int32[np.ndarray, "h w"]
    surfel: Int32[np.ndarray, "h w"]
    sky: Bool[np.ndarray, "h w"]


def lift(
    clip: Clip, cameras: Sequence[str], hold_out: set[int], progress: Progress, settings: LiftSettings
) -> GaussianScene:
    """Reconstruct a clip from its sweeps and the frames of the given cameras.

    Raises:
        ReconstructError: the clip has no LiDAR sweep to build from.
    """
    clock = _Clock(progress)
    clock.start("sweeps")
    actors = points.actors_of(clip, settings.points)
    gathered = points.gather(clip, actors, hold_out, settings.points, clock.fraction)
    if gathered.point_count == 0:
        raise ReconstructError(
            f"clip {clip.id!r}: method 'lift' needs LiDAR sweeps; have lidars {list(clip.rig.lidars)} "
            f"with no usable points after holding out sweeps {sorted(hold_out)}"
        )
    clock.start("ground and surfaces")
    bodies, ground = _surfels(clip, actors, gathered, settings)
    clock.start("images")
    views = read_views(clip, cameras, settings.views, clock.fraction)
    clock.start("depth")
    pictures = _depth_pictures(views, bodies, settings, clock.fraction)
    views = [view for view in views if view.key]
    clock.start("colours")
    isp, lonely = _isp(views, pictures, bodies, cameras)
    canonical = [colour.to_canonical(view.rgb, isp[view.camera_id]).astype(np.uint8) for view in views]
    clock.start("lifting")
    static, moving, lifted = Gaussians.empty(), [], 0
    for number, body in enumerate(bodies):
        clock.fraction(number / len(bodies))
        gaussians, count = _body_gaussians(number, body, ground, views, pictures, canonical, settings)
        lifted += count
        if body.actor is None:
            static = gaussians
        elif len(gaussians):
            windows = actor_layer.windows_of(body.actor, clip.span_us, settings)
            moving.append(actor_layer.emit(body.actor, gaussians, windows))
    clock.start("sky")
    sky = make_sky(views, canonical, [_sky_weight(p, v, settings) for p, v in zip(pictures, views, strict=True)],
                   settings.sky_px)  # fmt: skip
    dynamic = actor_layer.join(moving)
    clock.stop()
    counts = {
        "sweeps": gathered.sweep_count,
        "points": gathered.point_count,
        "views": len(views),
        "lifted": lifted,
        "static": len(static),
        "dynamic": len(dynamic),
    }
    provenance = {
        "method": "lift",
        "settings": dataclasses.asdict(settings),
        "cameras": list(cameras),
        "held_out_sweeps": sorted(hold_out),
        "seconds": clock.seconds,
        "counts": counts,
        "unknown": _unknown(clip, cameras, actors, gathered, lonely),
    }
    return GaussianScene(
        id=clip.id,
        static=static,
        dynamic=dynamic,
        sky=sky,
        isp=isp,
        rig=clip.rig,
        ego=clip.ego,
        tracks=clip.tracks,
        road_map=clip.road_map,
        span_us=clip.span_us,
        camera_times_us={camera: clip.camera_times_us(camera) for camera in clip.rig.cameras},
        provenance=provenance,
    )


def _sky_weight(picture: DepthPicture, view: View, settings: LiftSettings) -> np.ndarray:
    """How much each pixel tells of the sky: 1 if it is far and looks like sky, little if it is merely far."""
    far = (picture.inverse_depth < 1 / settings.views.max_depth_m) & view.tile.valid
    return np.where(far, np.where(picture.sky, 1.0, 0.02), 0.0)


class _Clock:
    """Seconds per stage, and progress calls."""

    def __init__(self, progress: Progress) -> None:
        self.progress, self.seconds, self.stage, self.since = progress, {}, "", 0.0

    def start(self, stage: str) -> None:
        self.stop()
        self.stage, self.since = stage, time.perf_counter()
        self.progress(stage, 0.0)

    def fraction(self, fraction: float) -> None:
        self.progress(self.stage, fraction)

    def stop(self) -> None:
        if self.stage:
            self.seconds[self.stage] = round(time.perf_counter() - self.since, 3)
            self.progress(self.stage, 1.0)


# ------------------------------------------------------------------------------------------------------ geometry


def _surfels(
    clip: Clip, actors: Sequence[Actor], gathered: points.Gathered, settings: LiftSettings
) -> tuple[list[Surfels], Ground]:
    """Surfels of the static world and of each actor; ground within reach is one regular sheet."""
    feet = [world for _, world in gathered.feet.values()]
    everything = np.concatenate([gathered.static.xyz_m, *feet])
    ground = find_ground(everything, clip.ego.world_from_body, settings.ground)
    static, ghosts = gathered.static, np.zeros(len(gathered.static), bool)
    above = ground.above(static.xyz_m)
    if settings.points.carve and gathered.sweep_count > settings.points.carve_votes:
        ghosts = points.seen_through(static, gathered.range_images, settings.points.carve_votes) & ~(above < 0.25)
    sheet = ground.sheet(static)
    standing = static[~ghosts & ~(np.abs(above) < 0.08)]
    standing, normal, spacing = surfaces.surface_of(standing)
    row, column, _ = ground.cells(sheet.xyz_m)
    road = ground.road[row, column]
    bodies = [
        Surfels(
            None,
            Cloud.concatenate([standing, sheet]),
            np.concatenate([normal, ground.normals()[row, column].astype(np.float32)]),
            np.concatenate([spacing, sheet.spacing_m]),
            np.concatenate([np.full(len(standing), Label.OTHER), np.where(road, Label.ROAD, Label.OTHER)]).astype(np.uint8),
        )
    ]
    for actor in actors:
        cloud = gathered.actors[actor.index]
        if actor.index in gathered.feet:
            box_feet, world_feet = gathered.feet[actor.index]
            cloud = Cloud.concatenate([cloud, points.thinned(box_feet[~(np.abs(ground.above(world_feet)) < 0.08)])])
        cloud, normal, spacing = surfaces.surface_of(cloud)
        bodies.append(Surfels(actor, cloud, normal, spacing, np.full(len(cloud), Label.MOVABLE, np.uint8)))
    return bodies, ground


def _depth_pictures(
    views: Sequence[View], bodies: Sequence[Surfels], settings: LiftSettings, progress: Callable[[float], None]
) -> list[DepthPicture]:
    """Dense depth of the key views, matched against all views."""
    keys = [k for k, view in enumerate(views) if view.key]
    options = settings.views
    step = 1 / options.min_depth_m / (options.levels - 1)
    bright = float(np.percentile(np.concatenate([v.rgb[::8, ::8].mean(axis=-1).ravel() for v in views]), 98)) if views else 0
    grays = [v.rgb.mean(axis=-1).astype(np.uint8) for v in views]
    with ThreadPoolExecutor(THREADS) as pool:
        codes = list(pool.map(depth.census, grays))

        def one(k: int) -> DepthPicture:
            view = views[k]
            prior, index, body = _draw(view, bodies)
            depth.trim_silhouettes(prior, index, grays[k])
            sky = lifting.sky_coloured(view, prior, bright)
            around = [(views[n].packed, views[n].rgb, codes[n]) for n in neighbours_of(views, k, options.neighbours)]
            dense = depth.dense_inverse_depth(
                view.packed, view.world_from_view, view.rgb, prior, sky, around, options.levels, step
            )
            dense[~view.tile.valid] = 0
            index[dense != prior] = -1
            drawn = np.where(index >= 0, body, STATIC)
            body = _bodies_of_pixels(view, bodies, dense, drawn)
            index[body != drawn] = -1
            return DepthPicture(dense, body, index, sky)

        pictures = []
        for done, picture in enumerate(pool.map(one, keys)):
            progress(done / len(keys))
            pictures.append(picture)
    return pictures


def _draw(view: View, bodies: Sequence[Surfels]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Splat all bodies: inverse depth, surfel row within its body, and body number per pixel."""
    offset, starts, jobs = 0, [], []
    for surfels in bodies:
        starts.append(offset)
        if surfels.present(view.t_us) and len(surfels.cloud):
            pose = geometry.inverse(view.world_from_view) @ surfels.world_from_body(view.t_us)
            jobs.append((view.packed_from(pose), surfels.cloud.xyz_m, surfels.normal, surfels.spacing_m, offset))
        offset += len(surfels.cloud)
    inverse_depth, index = depth.draw_surfels(view.rgb.shape[:2], jobs)
    body = np.zeros(index.shape, np.int32)
    drawn = index >= 0
    body[drawn] = np.searchsorted(starts, index[drawn], side="right") - 1
    # Bodies without surfels share their start with the next one: searchsorted picks the last, which holds the row.
    index[drawn] -= np.asarray(starts, np.int32)[body[drawn]]
    return inverse_depth, index, body


def _bodies_of_pixels(view: View, bodies: Sequence[Surfels], dense: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """Body number per pixel: that of the actor's surfel, else of the box that the pixel lies in, else the world (0)."""
    body = np.where(drawn >= 0, drawn, 0).astype(np.int32)
    open_pixels = (drawn <= 0) & (dense > 0)
    if len(bodies) > 1 and open_pixels.any():
        xyz = lifting.points_of(view, dense)[open_pixels]
        found, unmeasured = np.zeros(len(xyz), np.int32), (drawn < 0)[open_pixels]
        for number, surfels in enumerate(bodies[1:], start=1):
            if not surfels.present(view.t_us):
                continue
            box = geometry.transform_points(geometry.inverse(surfels.world_from_body(view.t_us)), xyz)
            size = surfels.actor.track.size_m
            upper = box[:, 2] > -size[2] / 2 + 0.15
            inside = geometry.points_in_box(box, size, 0.1) & upper
            found[inside & (found <= 0)] = number
            # Unmeasured pixels just outside a box are its silhouette at a wrong depth: nobody's.
            found[~inside & (found == 0) & unmeasured & geometry.points_in_box(box, size, 0.6) & upper] = NOBODY
        body[open_pixels] = found
    return body


def neighbours_of(views: Sequence[View], k: int, count: int) -> list[int]:
    """Views to match view k against: like direction, a base line between 0.25 and 8 m, best near 1.5 m, close in time."""
    mine = views[k]
    scored = []
    for n, other in enumerate(views):
        move = other.world_from_view[:3, 3] - mine.world_from_view[:3, 3]
        base = float(np.linalg.norm(move))
        facing = float(other.world_from_view[:3, 2] @ mine.world_from_view[:3, 2])
        if n == k or not 0.25 < base < 8.0 or facing < 0.9:
            continue
        ahead = float(move @ mine.world_from_view[:3, 2])
        score = abs(np.log(base / 1.5)) + 2 * (1 - facing) + 0.3 * abs(other.t_us - mine.t_us) / 1e6
        scored.append((score + (0.05 if ahead > 0 else 0.0), n))
    return [n for _, n in sorted(scored)[:count]]


# ------------------------------------------------------------------------------------------------ colour, Gaussians


def _isp(
    views: Sequence[View], pictures: Sequence[DepthPicture], bodies: Sequence[Surfels], cameras: Sequence[str]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Affine response of each camera, from the static surfels that several cameras see."""
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
    parts = np.array_split(np.arange(len(xyz)), THREADS)
    with ThreadPoolExecutor(THREADS) as pool:
        results = list(
            pool.map(
                lambda part: colour.seen_colours(xyz[part], normal[part], packed, depths, stack, present, 0.002), parts
            )
        )
    return tuple(np.concatenate(items) for items in zip(*results, strict=True))


def _packed(views: Sequence[View], body: Surfels | None) -> tuple[np.ndarray, np.ndarray]:
    if body is None or body.actor is None:
        return colour.packed_views(views), np.ones(len(views), bool)
    poses = [body.world_from_body(view.t_us) for view in views]
    return colour.packed_views(views, poses), np.array([body.present(view.t_us) for view in views])


def _body_gaussians(
    number: int,
    body: Surfels,
    ground: Ground,
    views: Sequence[View],
    pictures: Sequence[DepthPicture],
    rgb: Sequence[np.ndarray],
    settings: LiftSettings,
) -> tuple[Gaussians, int]:
    """Gaussians of one body in its frame, and how many of them were lifted from pixels."""
    cloud = body.cloud
    seen_rgb, pixel, through = _look_up(cloud.xyz_m, body.normal, views, pictures, rgb, body)
    shown = colour.fill_unseen(cloud.xyz_m, seen_rgb / 255, np.isfinite(pixel), cloud.intensity)
    # A view replaces surfels by its pixels unless it sees them so obliquely that surfels are the finer of the two.
    keep = (pixel > 3 * body.spacing_m) & (np.isfinite(pixel) | (through == 0))
    parts = [
        surfaces.discs(cloud.xyz_m[keep], body.normal[keep], body.spacing_m[keep], shown[keep], cloud.intensity[keep],
                       body.label[keep], settings.opacity)
    ]  # fmt: skip
    lifted = _lifted(number, body, views, pictures, rgb, settings)
    if len(lifted):
        parts.append(_lifted_gaussians(lifted, body, ground, settings))
    return Gaussians.concatenate(parts), len(lifted)


def _lifted(
    number: int,
    body: Surfels,
    views: Sequence[View],
    pictures: Sequence[DepthPicture],
    rgb: Sequence[np.ndarray],
    settings: LiftSettings,
) -> Lifted:
    """The pixels of all views that show a body and that no other view owns."""
    parts, depths = [], []
    pixels = sum(view.rgb.shape[0] * view.rgb.shape[1] for view in views)
    stride = max(1, int(np.ceil(np.sqrt(KEPT_SHARE * pixels / settings.views.budget))))
    for k, (view, picture) in enumerate(zip(views, pictures, strict=True)):
        mask = (picture.body == number) & (picture.inverse_depth > 1 / settings.views.max_depth_m) & view.tile.valid
        mask &= lifting.lattice(mask.shape, stride)
        if not mask.any():
            continue
        body_from_world = geometry.inverse(body.world_from_body(view.t_us))
        xyz = geometry.transform_points(body_from_world, lifting.points_of(view, picture.inverse_depth)[mask])
        surfel = picture.surfel[mask]
        normal = lifting.normals_of(view, picture.inverse_depth)[mask] @ body_from_world[:3, :3].T
        normal = np.where((surfel >= 0)[:, None], body.normal[surfel] if len(body.cloud) else normal, normal)
        ray = lifting.rays_of(view)[mask]
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        ray = ray @ (body_from_world @ view.world_from_view)[:3, :3].T
        z = 1 / picture.inverse_depth[mask].astype(np.float64)
        parts.append(Lifted(xyz, normal, ray, stride * z / view.tile.focal_px, rgb[k][mask].astype(np.float32), surfel,
                            np.full(len(z), k, np.int32)))  # fmt: skip
        depths.append(z)
    if not parts:
        return Lifted(*(np.zeros((0, 3)),) * 3, np.zeros(0), np.zeros((0, 3), np.float32), *(np.zeros(0, np.int32),) * 2)
    everything, z = Lifted.concatenate(parts), np.concatenate(depths)
    packed, present = _packed(views, body)
    step = 1 / settings.views.min_depth_m / (settings.views.levels - 1)
    depth_stack, rgb_stack = lifting.stacked([picture.inverse_depth for picture in pictures]), lifting.stacked(rgb)
    middle = len(everything) // 2
    chunks = [slice(0, middle), slice(middle, None)]
    with ThreadPoolExecutor(THREADS) as pool:
        jobs = [
            pool.submit(lifting.owned, everything.xyz_m[part], z[part], everything.view[part], everything.rgb[part],
                        packed, depth_stack, rgb_stack, present, 0.3 * step, lifting.OWNER_RING, lifting.OWNER_BORDER)
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
    if body.actor is None:
        label = np.where(~from_surfel & ground.is_road(lifted.xyz_m), Label.ROAD, label)
    return surfaces.footprints(lifted.xyz_m, lifted.normal, lifted.ray, lifted.pixel_m, lifted.rgb / 255, intensity, label,
                               settings.opacity)  # fmt: skip


def _unknown(
    clip: Clip, cameras: Sequence[str], actors: Sequence[Actor], gathered: points.Gathered, lonely: Sequence[str]
) -> list[str]:
    """What the log did not tell, in plain words."""
    notes = []
    if clip.road_map is None:
        notes.append("no map: the road is grown from the driven path up to height steps")
    if not actors:
        notes.append("no boxes: moving objects are baked into the static layer where they were not carved away")
    if not gathered.intensity_known:
        notes.append("no LiDAR intensity: simulated returns have none")
    if not cameras:
        notes.append("no cameras: colours are grey")
    if len(cameras) > 1 and lonely:
        notes.append(f"no shared points: colours of {', '.join(lonely)} are not aligned with the other cameras")
    if gathered.sweep_count == 1:
        notes.append("one sweep only: surfaces behind what it saw are missing")
    return notes
