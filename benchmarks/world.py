"""Measures the true world: what images and LiDAR turns of a town cost, and how exact their ground truth is."""

from __future__ import annotations

import dataclasses
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import tyro

from nurec_sim import sensors
from nurec_sim.types import (
    CameraModel,
    Fisheye,
    FTheta,
    FThetaReference,
    LidarModel,
    Rig,
    SensorRequest,
    Shutter,
    Windshield,
    WindshieldReference,
)
from nurec_sim.world import LABEL_OF_CLASS, TrueWorld, street_rig, town_plan
from nurec_sim.world.plan.town import TownPlan
from nurec_sim.world.sense.isp import random_response
from nurec_sim.world.sense.stage import Quality
from nurec_sim.world.sense.truth import TrueView, follow, scene_flow

LIDARS = ("PANDAR128", "HDL-64", "VLP-16")
CLIP_LIMIT_S = 20.0
Row = tuple[str, float, str]
"""What was measured, its CPU-seconds, and what came out."""


@dataclass(frozen=True)
class Options:
    """Render a town with all its ground truth, compare OpenGL with ray casting, and print one table.

    Args:
        seed: of the town.
        frames: of the clip; its row is a promise at 18.
        size: width and height of images.
        quick: skip LiDARs and unusual lenses.
    """

    seed: int = 3
    frames: int = 18
    size: tuple[int, int] = (448, 256)
    quick: bool = False


def main() -> int:
    """Prints the table; 1 if a promise of the true world is not kept."""
    options = tyro.cli(Options, description=Options.__doc__)
    plan, rig = town_plan(options.seed), street_rig(*options.size)
    print(f"town {plan.seed}, template {plan.template}, weather {plan.weather.preset}, images {options.size}")
    print(f"{'what':34s} {'CPU s':>8s} {'load':>5s}  result")
    kept = True
    for name, seconds, result in rows(plan, rig, options):
        print(f"{name:34s} {seconds:8.3f} {os.getloadavg()[0]:5.1f}  {result}", flush=True)
        kept &= "MISSED" not in result
    print(f"threads {os.environ.get('LP_NUM_THREADS', os.cpu_count())} (llvmpipe), {cv2.getNumThreads()} (OpenCV)")
    return 0 if kept else 1


def rows(plan: TownPlan, rig: Rig, options: Options) -> Iterator[Row]:
    """All rows, one after the other."""
    front = rig.cameras["camera_front"]
    _, seconds = timed(lambda: town_plan(options.seed))
    yield "plan a town and 12 s of its traffic", seconds, f"{len(plan.actors)} actors"
    rendered, seconds = timed(lambda: TrueWorld(plan))
    yield f"build a town ({rendered.backend})", seconds, f"{rendered.town.model.ngeom} geoms"
    cast = TrueWorld(plan, "rays")
    with rendered, cast:
        yield from clip_rows(rendered, rig, options.frames)
        yield agreement("pinhole", rendered, cast, front)
        for shutter, milliseconds in ((Shutter.TOP_TO_BOTTOM, 15), (Shutter.LEFT_TO_RIGHT, 30)):
            rolling = dataclasses.replace(front, shutter=shutter)
            name = f"{shutter.value} {milliseconds} ms"
            yield agreement(name, rendered, cast, rolling, milliseconds * 1000)
        if not options.quick:
            for name, camera in lenses(front).items():
                yield agreement(name, rendered, cast, camera)
            for name in LIDARS:
                yield from lidar_rows(plan, cast, sensors.lidar_model(name, rig.lidars["lidar_top"].rig_from_lidar))
    for quality in (Quality(), Quality(samples=0), Quality(shadow_px=0), Quality(samples=0, shadow_px=0)):
        with TrueWorld(plan, quality=quality) as world:
            request = request_at(plan, front, 2.0)
            world.view(request)
            seconds = timed(lambda: [world.view(request) for _ in range(4)])[1] / 4  # noqa: B023
            yield "one view", seconds, f"samples {quality.samples}, shadow map {quality.shadow_px}"


def timed(work: Callable):
    """A result and the CPU-seconds of all threads that it took."""
    start = time.process_time()
    result = work()
    return result, time.process_time() - start


def request_at(plan: TownPlan, sensor: CameraModel | LidarModel, seconds: float, duration_us: int = 0) -> SensorRequest:
    """The sensor on the recorded drive."""
    start = plan.span_us[0] + round(seconds * 1e6)
    mount = sensor.rig_from_lidar if isinstance(sensor, LidarModel) else sensor.rig_from_camera
    return SensorRequest("", sensor, start, start + duration_us,
                         plan.ego_trajectory().at(np.array([start, start + duration_us])) @ mount)  # fmt: skip


def clip_rows(world: TrueWorld, rig: Rig, frames: int) -> Iterator[Row]:
    """A clip with all ground truth, and how well its flow explains the next frame."""
    responses = {name: random_response(np.random.default_rng([7, i])) for i, name in enumerate(rig.cameras)}
    times = np.linspace(0, 0.9 * (world.plan.span_us[1] - world.plan.span_us[0]) * 1e-6, frames)
    views: dict[tuple[str, int], tuple[SensorRequest, TrueView]] = {}
    flows: dict[tuple[str, int], np.ndarray] = {}

    def render() -> None:
        with TrueWorld(world.plan, responses=responses) as noisy:
            for index, seconds in enumerate(times):
                for name, camera in rig.cameras.items():
                    request = request_at(noisy.plan, camera, seconds)
                    view = noisy.view(request)
                    then = request_at(noisy.plan, camera, times[min(index + 1, frames - 1)]).start_us
                    flows[name, index] = scene_flow(view, camera, request.world_from_sensor[0],
                                                    noisy.boxes(request.start_us), noisy.boxes(then))  # fmt: skip
                    views[name, index] = request, view

    seconds = timed(render)[1]
    verdict = "" if frames != 18 else f" (at most {CLIP_LIMIT_S:g}: {'kept' if seconds <= CLIP_LIMIT_S else 'MISSED'})"
    yield f"{frames} frames x {len(rig.cameras)} cameras, all truths", seconds, f"with town and context{verdict}"
    explained = [
        flow_consistency(*views[name, index], flows[name, index], *views[name, index + 1])
        for name, index in views
        if index + 1 < frames
    ]
    pixels, instances = np.nanmean(np.array(explained), axis=0)
    kept = "kept" if pixels > 0.99 and instances > 0.98 else "MISSED"
    yield "flow to the next frame", 0.0, f"explains {pixels:.4f} of pixels, {instances:.4f} of instances: {kept}"


def flow_consistency(
    request: SensorRequest, view: TrueView, flow_m: np.ndarray, request_then: SensorRequest, then: TrueView
) -> tuple[float, float]:
    """Share of points that the next frame sees where they should be, or hides; share of those on actors that agree."""
    camera = request.sensor
    assert isinstance(camera, CameraModel)
    uv, range_m = follow(view, camera, request.world_from_sensor[0], flow_m, request_then.world_from_sensor[0])
    inside = sensors.in_image(camera, uv)
    column, row = np.floor(uv[inside]).astype(int).T
    expected = range_m[inside]
    # The nearest and the furthest surface within a pixel: edges are nowhere exactly.
    shown = np.where(then.range_m > 0, then.range_m, np.inf)
    nearest = cv2.erode(shown, np.ones((3, 3)))[row, column]
    slack = 0.02 * expected + 0.05
    seen = np.abs(shown[row, column] - expected) < slack
    same = then.instance[row, column][seen] == view.instance[inside][seen]
    moving = view.instance[inside][seen] > 0
    return float(np.mean(nearest < expected + slack)), float(same[moving].mean()) if moving.any() else np.nan


def agreement(name: str, rendered: TrueWorld, cast: TrueWorld, camera: CameraModel, duration_us: int = 0) -> Row:
    """A rasterised image against one ray per pixel, each at the exposure time of its line."""
    request = request_at(rendered.plan, camera, 3.0, duration_us)
    rendered.view(request)
    view, seconds = timed(lambda: rendered.view(request))
    exact = cast.view(request)
    labels = float(np.mean(LABEL_OF_CLASS[view.surface] == LABEL_OF_CLASS[exact.surface]))
    same = (view.surface == exact.surface) & (view.instance == exact.instance) & (view.range_m > 0)
    error = np.abs(view.depth_m - exact.depth_m)[same]
    known = same & view.normal.any(-1)
    cosine = np.clip(np.einsum("nc,nc->n", view.normal[known], exact.normal[known]), -1, 1)
    rays, valid = sensors.pixel_rays(camera)
    below = (rays[valid] @ request.world_from_sensor[0][:3, :3].T)[:, 2] < -0.05
    holes = int((below & (view.range_m[valid] == 0)).sum())
    kept = "kept" if np.median(error) < 1e-3 and labels > 0.995 and holes == 0 else "MISSED"
    return f"view, {name}", seconds, (
        f"depth error {np.median(error):.1e} m median, {np.quantile(error, 0.95):.1e} m p95; labels {labels:.4f};"
        f" normals {np.rad2deg(np.median(np.arccos(cosine))):.2f} deg; sky below horizon {holes} px: {kept}"
    )  # fmt: skip


def lenses(front: CameraModel) -> dict[str, CameraModel]:
    """The camera with lenses of all kinds."""
    flat, (width, height) = front.ideal_pinhole, (front.width_px, front.height_px)
    assert flat is not None
    centre = {"cx_px": width / 2, "cy_px": height / 2}
    wide = width / np.deg2rad(120.0)
    glass = Windshield(WindshieldReference.FORWARD, (0.002, 1.01, 0.003, 0.004, 0.002, -0.01),
                       (0.01, 0.004, 0.02, 0.99, 0.01, 0.03))  # fmt: skip
    lens = {
        "distorted pinhole": dataclasses.replace(flat, radial=(-0.32, 0.12, -0.02, 0.0, 0.0, 0.0)),
        "fisheye 190 deg": Fisheye(width / 3.4, width / 3.4, **centre, max_angle_rad=np.deg2rad(95.0)),
        "f-theta 120 deg": FTheta(**centre, reference=FThetaReference.ANGLE_TO_PIXELDIST,
                                  angle_to_pixeldist=(0.0, wide, 3.0, -6.0), max_angle_rad=1.3),
    }  # fmt: skip
    cameras = {name: dataclasses.replace(front, lens=kind) for name, kind in lens.items()}
    return cameras | {"windshield": dataclasses.replace(front, windshield=glass)}


def lidar_rows(plan: TownPlan, cast: TrueWorld, lidar: LidarModel) -> Iterator[Row]:
    """A LiDAR turn by rays and by images, and how far they agree."""
    request = request_at(plan, lidar, 3.0, 100_000)
    exact, seconds = timed(lambda: cast.scan(request))
    size = f"{exact.range_m.shape[0]} x {exact.range_m.shape[1]}"
    yield f"{lidar.id} {size}, rays", seconds, f"{exact.range_m.size / seconds / 1e6:.2f} M rays per CPU-second"
    with TrueWorld(plan, quality=Quality(lidar="rasterised")) as world:
        world.scan(request)
        fast, seconds = timed(lambda: world.scan(request))
    same = (fast.surface == exact.surface) & (fast.instance == exact.instance)
    error = np.abs(fast.range_m - exact.range_m)[same & (exact.range_m > 0) & (fast.range_m > 0)]
    returns = np.mean((fast.range_m > 0) == (exact.range_m > 0))
    yield f"{lidar.id} {size}, rendered", seconds, (
        f"range error {np.median(error):.1e} m median, {np.quantile(error, 0.95):.1e} m p95;"
        f" class {same.mean():.4f}, returns {returns:.4f}"
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
