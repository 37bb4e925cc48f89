"""Mutated requests through the server's own handlers, without a socket, and a share of them over one."""

from __future__ import annotations

import asyncio
import random
import time
from collections import Counter
from dataclasses import dataclass, field
from types import SimpleNamespace

import grpc
import numpy as np
from mutations import damage, mutate
from serving_world import LAST_US, START_US, camera_request, lidar_request, rig, scene

from nurec_sim import geometry
from nurec_sim.serving import wire
from nurec_sim.serving.calls import Call, Service, enter_call, register
from nurec_sim.serving.sensor_service import SensorService, ServiceOptions
from nurec_sim.serving.sensor_service.scene_urls import URL_KEY
from nurec_sim.serving.server import SensorServer
from nurec_sim.serving.store import SceneStore
from nurec_sim.serving.wire import ImageFormat, sensorsim
from nurec_sim.serving.wire.requests import write_poses

Code = grpc.StatusCode
STATUS_MAP = frozenset({
    Code.OK, Code.INVALID_ARGUMENT, Code.NOT_FOUND, Code.OUT_OF_RANGE, Code.RESOURCE_EXHAUSTED,
    Code.FAILED_PRECONDITION, Code.PERMISSION_DENIED,
})  # fmt: skip
"""What docs/serving.md allows as the answer to a request; INTERNAL is a bug."""
NUMBERS = {code.value[0] for code in STATUS_MAP}
LIMIT_S = 30.0
OPTIONS = ServiceOptions(max_pixels=1 << 18, max_edited_scenes=1)
URLS = ("file:///no/x.usdz", "http://127.0.0.1/x.usdz", "file://", "", "\x7f", "x" * 3000, "file:///etc/passwd")


@dataclass
class Tally:
    """What came of the requests: counts by status, the slowest, and faults with the number that brings each back."""

    codes: Counter[str] = field(default_factory=Counter)
    slowest_s: float = 0.0
    faults: list[str] = field(default_factory=list)

    def note(self, number: int, name: str, code: grpc.StatusCode, text: str, seconds: float) -> None:
        self.codes[code.name] += 1
        self.slowest_s = max(self.slowest_s, seconds)
        if code not in STATUS_MAP:
            self.faults.append(f"request {number}: {name}: {code.name}: {text[:300]}")
        if seconds > LIMIT_S:
            self.faults.append(f"request {number}: {name}: took {seconds:.1f} s")


def corpus() -> list[tuple[str, bytes]]:
    """Valid requests of every procedure."""
    found = []
    actors = {"car-1": np.stack([geometry.pose_from_xyyaw(12, -2, 0.1, 0.8)] * 2)}
    aggregated = sensorsim.AggregatedRenderRequest()
    for camera_id in rig().cameras:
        for image_format in ImageFormat if camera_id == "front" else (ImageFormat.PNG,):  # others are slow to set up
            message = sensorsim.RGBRenderRequest()
            wire.write_camera_request(camera_request(camera_id, actors=actors), message, scene_id="street")
            message.image_format, message.resolution_h = image_format, 33
            message.resolution_w = 1
            found.append(("render_rgb", message))
        late = sensorsim.RGBRenderRequest()
        late.CopyFrom(message)
        late.image_format, late.frame_start_us, late.frame_end_us = ImageFormat.PNG, LAST_US + 10**6, LAST_US + 10**7
        batch = sensorsim.BatchRGBRenderRequest()
        batch.items.add(camera_name=camera_id, request=message)
        batch.items.add(camera_name="again", request=found[1][1])
        found += [("batch_render_rgb", batch), ("render_rgb", late)]
    for name in (None, 0, 1):
        sweep = sensorsim.LidarRenderRequest()
        wire.write_lidar_request(lidar_request(), sweep, scene_id="street")
        if name is not None:
            sweep.lidar_config.Clear()
            sweep.lidar_config.lidar_type = name
        sweep.render_filter.opacity_threshold = 0.5
        sweep.render_filter.enable_distance_filter = True
        found += [("render_lidar", sweep)] * (3 if name is None else 1)
    aggregated.rgb_requests.add().CopyFrom(found[1][1])
    aggregated.lidar_requests.add().CopyFrom(sweep)
    edit = sensorsim.EditAssetsRequest(scene_id="street")
    edit.replace.add(original_id="car-1", replacement_id="parked-1").object_size.size_x = 4
    edit.replace[0].object_size.size_y = edit.replace[0].object_size.size_z = 2
    entry = edit.insert.add(id="new", asset_id="other/car-1", semantic_class="automobile")
    for t_us in (START_US, LAST_US):
        write_poses(
            geometry.pose_from_xyyaw(15, 2, 0.1, 0.8)[None], [entry.trajectory.poses.add(timestamp_us=t_us).pose]
        )
    found += [("render_aggregated", aggregated)] * 2 + [("edit_assets", edit)] * 4
    for name, method in wire.METHODS.items():
        message = method.request()
        if "scene_id" in method.request.DESCRIPTOR.fields_by_name:
            message.scene_id = "street"
        if name not in {other for other, _ in found}:
            found.append((name, message))
    return [(name, message.SerializeToString()) for name, message in found]


def requests(count: int, seed: int):
    """(number, procedure, bytes, metadata) of mutated requests; each depends on the seed and its number only."""
    start = corpus()
    for number in range(count):
        rng = random.Random(f"{seed}/{number}")
        name, data = rng.choice(start)
        message = wire.METHODS[name].request.FromString(data)
        for _ in range(rng.choice((0, 1, 1, 1, 2, 3))):
            mutate(rng, message)
        data = message.SerializeToString()
        if rng.random() < 0.25:
            data = damage(rng, data)
        if rng.random() < 0.02:
            data = rng.choice(start)[1]  # of another procedure
        metadata = {}
        if rng.random() < 0.03:
            metadata = {"x-nre-scene-url": rng.choice(URLS), "x-nre-scene-id": rng.choice(("a", "", "../a", "street"))}
        yield number, name, data, metadata


class _Context:
    """As much of a call as the handlers use."""

    async def abort(self, code: grpc.StatusCode, text: str) -> None:
        self.code, self.text = code, text
        raise grpc.aio.AbortError


class _Handlers:
    """Collects what is registered."""

    def add_generic_rpc_handlers(self, handlers) -> None:
        (self.service,) = handlers

    def of(self, name: str):
        details = SimpleNamespace(method=f"/{wire.SERVICE}/{name}", invocation_metadata=())
        return self.service.service(details).unary_unary


def store() -> SceneStore:
    """Two scenes. One frame of each sensor is rendered at once: kernels are not compiled within a request's limit."""
    made = SceneStore([scene(), scene("other", seed=1)], threads=2)
    made.get("street").renderer.sense([*map(camera_request, ("front", "wide", "fish")), lidar_request()])
    return made


def fuzz_handlers(
    count: int, seed: int = 0, report=lambda done, tally: None, options: ServiceOptions = OPTIONS
) -> Tally:
    """Requests through the handlers of a server in this process, one after the other."""
    return asyncio.run(_fuzz_handlers(count, seed, report, options))


async def _fuzz_handlers(count: int, seed: int, report, options: ServiceOptions) -> Tally:
    tally, handlers = Tally(), _Handlers()
    service = SensorService(store(), options, lambda: None)
    register(handlers, Service(wire.SERVICE, service, (), {URL_KEY: service.offer_scene}))
    try:
        for number, name, data, metadata in requests(count, seed):
            context, begin = _Context(), time.perf_counter()
            enter_call(Call(name, metadata=metadata))
            try:
                reply = await asyncio.wait_for(handlers.of(name)(data, context), LIMIT_S)
                code, text = Code.OK, _fault_of(name, wire.METHODS[name].reply.FromString(reply))
                if text:
                    tally.faults.append(f"request {number}: {name}: {text}")
            except grpc.aio.AbortError:
                code, text = context.code, context.text
            except TimeoutError:
                code, text = Code.DEADLINE_EXCEEDED, f"no answer within {LIMIT_S} s"
            tally.note(number, name, code, text, time.perf_counter() - begin)
            if number % 200 == 199:
                await service.restore_model_parameters(sensorsim.RestoreModelParametersRequest(scene_id="street"))
                await service.restore_model_parameters(sensorsim.RestoreModelParametersRequest(scene_id="other"))
                report(number + 1, tally)
    finally:
        service.close()
    return tally


def _fault_of(name: str, reply) -> str:
    """What is wrong with a reply that says success."""
    if name == "render_rgb" and not reply.image_bytes:
        return "an empty picture"
    if name == "render_lidar" and len(reply.point_xyzs_buffer) != 12 * reply.num_points:
        return "a buffer of another length than the points"
    if name == "batch_render_rgb":
        for item in reply.items:
            if item.success != bool(item.result.image_bytes) or (not item.success and not item.error_message):
                return f"item {item.camera_name!r} is neither a picture nor an explained error"
            if item.error_code not in NUMBERS:
                return f"item {item.camera_name!r} failed with status {item.error_code}: {item.error_message}"
    return ""


def fuzz_socket(count: int, seed: int = 1) -> Tally:
    """Requests over a socket, several in flight."""
    tally = Tally()
    with SensorServer(store(), port=0, options=OPTIONS) as address, grpc.insecure_channel(address) as channel:
        waiting: list = []
        for number, name, data, metadata in requests(count, seed):
            fit = [(key, value) for key, value in metadata.items() if value.isascii() and value.isprintable()]
            procedure = channel.unary_unary(f"/{wire.SERVICE}/{name}")
            waiting.append((number, name, time.perf_counter(), procedure.future(data, timeout=LIMIT_S, metadata=fit)))
            if len(waiting) == 8:
                _finish(tally, waiting.pop(0))
        for call in waiting:
            _finish(tally, call)
        channel.unary_unary(f"/{wire.SERVICE}/get_version")(b"", timeout=LIMIT_S)  # it still answers
    return tally


def _finish(tally: Tally, call) -> None:
    number, name, begin, future = call
    error = future.exception()
    code = Code.OK if error is None else error.code()
    tally.note(number, name, code, "" if error is None else error.details() or "", time.perf_counter() - begin)
