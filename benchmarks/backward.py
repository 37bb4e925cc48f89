"""Rows of the differentiable renderer: an image forward, then the gradients of its outputs back to the Gaussians."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Iterator
from typing import Any

import cases
import numpy as np
import parity
import torch
from cases import SENSORS
from plan import Options
from scenes import BenchScene

from nurec_sim.render.cpu.backward import gradients
from nurec_sim.render.cpu.pack import morton_order
from nurec_sim.render.spec import to_uint8
from nurec_sim.types import (
    CameraFrame,
    CameraModel,
    DynamicGaussians,
    LidarFilter,
    LidarFrame,
    SensorFrame,
    SensorRequest,
)

BACKWARD_SENSORS = ("pinhole-640", "pinhole-960", "lidar-128")
TRAINED = ("mean_m", "quat_wxyz", "scale_m", "opacity", "rgb")


def rows(name: str, built: BenchScene, options: Options, tick: Callable[[str], None]) -> Iterator[dict[str, Any]]:
    """A row per sensor: ``ms_median`` is the backward pass, ``forward_ms_median`` the forward pass just before it.

    The loss is a random weight on every value of colour, depth and alpha (LiDARs: range, intensity and alpha), so that
    every path of the gradients is taken. Gradients reach positions, rotations, scales, opacities and colours.
    """
    threads, frames = options.thread_count, max(2, options.repeats // 3)
    ordered = built.scene.static[morton_order(built.scene.static.mean_m)]
    scene = dataclasses.replace(built.scene, static=ordered, dynamic=DynamicGaussians.empty(), isp={})
    tensors = gradients.GaussianTensors.of(ordered)
    for column in TRAINED:
        getattr(tensors, column).requires_grad_()
    path = next(iter(built.paths))
    for sensor in BACKWARD_SENSORS if not options.sensors else options.sensors:
        if sensor not in BACKWARD_SENSORS:
            continue
        ticks = cases.tick_requests(built, SENSORS[sensor], path, frames)
        first_ms = sum(_step(tensors, scene, ticks[0][0], threads)[:2])
        forward, backward, cpu = np.array(
            [(_step(tensors, scene, asked, threads), tick(sensor))[0][:3] for (asked,) in ticks]
        ).T
        width, height = SENSORS[sensor].size
        asked = ticks[len(ticks) // 2][0]
        frame = _step(tensors, scene, asked, threads)[3]
        against = parity.against_spec(scene, [asked], [frame], options.parity_rays) if options.parity_rays else {}
        yield {
            **parity.NOTHING,
            "name": f"{name} {sensor} {path} backward",
            "width": width,
            "height": height,
            "gaussians": len(scene.static),
            "threads": threads,
            "scene": name,
            "sensor": sensor,
            "path": path,
            "backend": "ours backward",
            "frames": len(ticks),
            "ms_median": float(np.median(backward)),
            "ms_p99": float(np.quantile(backward, 0.99)),
            "cpu_ms_median": float(np.median(cpu)),
            "ms_first": first_ms,
            "forward_ms_median": float(np.median(forward)),
            "backward_over_forward": float(np.median(backward / forward)),
            "load_average": os.getloadavg()[0],
            **against,
        }


def _step(
    tensors: gradients.GaussianTensors, scene, asked: SensorRequest, threads: int
) -> tuple[float, float, float, SensorFrame]:
    """Milliseconds forward, backward and backward's CPU time; and the frame."""
    for column in TRAINED:
        getattr(tensors, column).grad = None
    pose = torch.from_numpy(np.asarray(asked.world_from_sensor, np.float64))
    began = time.perf_counter()
    images: Any
    if isinstance(asked.sensor, CameraModel):
        images = gradients.render_camera(tensors, asked.sensor, pose, torch.from_numpy(scene.sky), threads)
        outputs = (images.rgb, images.depth, images.alpha)
    else:
        images = gradients.render_lidar(tensors, asked.sensor, pose, threads)
        outputs = (images.range, images.intensity, images.alpha)
    rendered = time.perf_counter()
    seeded = torch.Generator().manual_seed(5)
    loss = sum((output * torch.rand(output.shape, generator=seeded)).sum() for output in outputs)
    ready, cpu = time.perf_counter(), time.process_time()
    loss.backward()
    done = time.perf_counter()
    frame = _frame(asked, *(image.detach().numpy() for image in outputs))
    return (rendered - began) * 1e3, (done - ready) * 1e3, (time.process_time() - cpu) * 1e3, frame


def _frame(asked: SensorRequest, values: np.ndarray, second: np.ndarray, alpha: np.ndarray) -> SensorFrame:
    """The images as a frame of the renderer: colour, depth and alpha, or range, intensity and alpha."""
    if isinstance(asked.sensor, CameraModel):
        return CameraFrame(asked.sensor, asked.start_us, asked.end_us, to_uint8(values), second, alpha)
    nearest, farthest = asked.sensor.range_m
    returns = (alpha > LidarFilter().opacity_threshold) & (values >= nearest) & (values <= farthest)
    beam = np.flatnonzero(returns).astype(np.int32)
    nowhere = np.full((len(beam), 3), np.nan, np.float32)
    return LidarFrame(asked.sensor, asked.start_us, asked.end_us, nowhere, values[returns], second[returns], beam)
