"""Rules about several pictures in one call."""

from __future__ import annotations

import grpc

from nurec_sim.serving.conformance.kit import check
from nurec_sim.serving.conformance.target import Target, expect
from nurec_sim.serving.wire import sensorsim


def _batch(target: Target) -> sensorsim.BatchRGBRenderRequest:
    """One picture of each of up to three cameras, by their ids."""
    batch = sensorsim.BatchRGBRenderRequest()
    for camera in target.cameras[:3]:
        batch.items.add(camera_name=camera.logical_id, request=target.request(camera))
    return batch


@check("batch-names", optional=True)
def names(target: Target) -> str:
    """A batch answers every camera name exactly once, with success."""
    batch = _batch(target)
    reply = target.call("batch_render_rgb", batch)
    wanted, got = sorted(i.camera_name for i in batch.items), sorted(i.camera_name for i in reply.items)
    expect(got == wanted, f"{wanted} were asked, {got} came")
    failed = {i.camera_name: i.error_message for i in reply.items if not i.success}
    expect(not failed, f"valid items failed: {failed}")
    return f"{wanted}"


@check("batch-equals-single", optional=True)
def equals_single(target: Target) -> str:
    """A picture of a batch is the one that a single call gives."""
    batch = _batch(target)
    pictures = {i.camera_name: i.result.image_bytes for i in target.call("batch_render_rgb", batch).items}
    for item in batch.items:
        single = target.call("render_rgb", item.request).image_bytes
        expect(pictures.get(item.camera_name) == single, f"camera {item.camera_name!r} differs from its single call")
    return f"{len(batch.items)} pictures"


@check("batch-item-error", optional=True)
def item_error(target: Target) -> str:
    """What is wrong with one item is said in that item; the others are rendered."""
    batch = _batch(target)
    broken = batch.items.add(camera_name="broken", request=target.request())
    broken.request.frame_end_us = broken.request.frame_start_us
    lost = batch.items.add(camera_name="lost", request=target.request())
    lost.request.scene_id = "no-such-scene-anywhere"
    try:
        reply = {item.camera_name: item for item in target.call("batch_render_rgb", batch).items}
    except grpc.RpcError as error:
        expect(error.code() == grpc.StatusCode.UNIMPLEMENTED, f"the whole batch was refused with {error.code().name}")
        raise
    expect(len(reply) == len(batch.items), f"{len(batch.items)} items were asked, {len(reply)} came")
    for name in ("broken", "lost"):
        expect(not reply[name].success, f"item {name!r} cannot be rendered, but it says success")
        expect(reply[name].error_message, f"item {name!r} failed without an error_message")
    failed = {n: i.error_message for n, i in reply.items() if not i.success and n not in ("broken", "lost")}
    expect(not failed, f"valid items failed beside the broken ones: {failed}")
    return f"{reply['broken'].error_message}"


@check("batch-empty", optional=True)
def empty(target: Target) -> str:
    """A batch of nothing gives nothing."""
    reply = target.call("batch_render_rgb", sensorsim.BatchRGBRenderRequest())
    expect(not reply.items, f"{len(reply.items)} items came")
    return "no items"


@check("aggregated", optional=True)
def aggregated(target: Target) -> str:
    """render_aggregated gives each picture in its place."""
    request = sensorsim.AggregatedRenderRequest(rgb_requests=[target.request(c) for c in target.cameras[:2]])
    reply = target.call("render_aggregated", request)
    expect(len(reply.rgb_returns) == len(request.rgb_requests), f"{len(reply.rgb_returns)} pictures came")
    for one, got in zip(request.rgb_requests, reply.rgb_returns, strict=True):
        expect(target.call("render_rgb", one).image_bytes == got.image_bytes, "a picture differs from its single call")
    return f"{len(reply.rgb_returns)} pictures"
