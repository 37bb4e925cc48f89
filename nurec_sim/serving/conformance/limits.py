"""Rules about limits, ego masks, deadlines, and scenes by URL."""

from __future__ import annotations

import time

import grpc

from nurec_sim.serving.conformance.kit import check
from nurec_sim.serving.conformance.target import Failed, Skipped, Target, difference, expect
from nurec_sim.serving.wire import ImageFormat

Code = grpc.StatusCode
CARLA_BYTES = 10_000_000


@check("limit-size")
def size(target: Target) -> str:
    """A picture of 65535 x 65535 is refused at once, and the server goes on."""
    request = target.request()
    request.resolution_h = request.resolution_w = 65535
    begin = time.perf_counter()
    text = target.refused("render_rgb", request, Code.RESOURCE_EXHAUSTED, Code.INVALID_ARGUMENT)
    expect(time.perf_counter() - begin < 10, "the refusal took more than 10 s")
    expect(target.call("get_version").version_id, "the server does not answer any more")
    return text


@check("limit-reply")
def reply(target: Target) -> str:
    """A JPEG in native size stays below the 10 MB that CARLA's client takes."""
    request = target.request(image_format=ImageFormat.JPEG)
    spec = target.camera().intrinsics
    request.resolution_h, request.resolution_w = spec.resolution_h, spec.resolution_w
    length = len(target.call("render_rgb", request).image_bytes)
    expect(length < CARLA_BYTES, f"it has {length:,} bytes")
    return f"{spec.resolution_w}x{spec.resolution_h} in {length:,} bytes"


@check("deadline")
def deadline(target: Target) -> str:
    """A call whose deadline is too short ends with DEADLINE_EXCEEDED, or in time; the server goes on."""
    try:
        target.call("render_rgb", target.request(), timeout_s=0.001)
        text = "it was answered within a millisecond"
    except grpc.RpcError as error:
        expect(error.code() == Code.DEADLINE_EXCEEDED, f"expected DEADLINE_EXCEEDED, got {error.code().name}")
        text = "DEADLINE_EXCEEDED"
    expect(target.picture(target.request()).size, "the server does not render any more")
    return text


@check("ego-mask")
def ego_mask(target: Target) -> str:
    """An ego mask that is listed covers a part of its camera's picture."""
    cameras = {camera.logical_id: camera for camera in target.cameras}
    listed = [entry.ego_mask_id for entry in target.call("get_available_ego_masks").ego_mask_metadata]
    found = [mask for mask in listed if mask.camera_logical_id in cameras]
    if not found:
        raise Skipped("no mask of a camera of this scene is listed")
    request = target.request(cameras[found[0].camera_logical_id])
    plain = target.picture(request)
    request.insert_ego_mask = True
    request.ego_mask_id.CopyFrom(found[0])
    gap = difference(target.picture(request), plain)
    expect(gap > 0, "the picture is the same with and without the mask")
    return f"{found[0].rig_config_id}/{found[0].camera_logical_id}: {gap:.1f} steps"


@check("ego-mask-unknown")
def ego_mask_unknown(target: Target) -> str:
    """An ego mask that is not listed is refused, not left out in silence."""
    request = target.request()
    request.insert_ego_mask = True
    request.ego_mask_id.rig_config_id = "no-such-rig"
    request.ego_mask_id.camera_logical_id = target.camera().logical_id
    return target.refused("render_rgb", request, Code.INVALID_ARGUMENT, Code.NOT_FOUND)


def _with_scene(target: Target, url: str, name: str) -> grpc.RpcError:
    """How a request with a scene's address beside it is refused."""
    try:
        target.call("get_version", metadata=(("x-nre-scene-url", url), ("x-nre-scene-id", name)))
    except grpc.RpcError as error:
        return error
    raise Skipped("the server does not look at x-nre-scene-url")


@check("scene-url-absent")
def scene_url_absent(target: Target) -> str:
    """x-nre-scene-url of a file that is not there is refused, whatever procedure it comes with."""
    error = _with_scene(target, "file:///no/such/file.usdz", "conformance")
    allowed = (Code.INVALID_ARGUMENT, Code.NOT_FOUND, Code.FAILED_PRECONDITION, Code.PERMISSION_DENIED)
    expect(error.code() in allowed, f"it was refused with {error.code().name}: {error.details()}")
    return f"{error.code().name}: {error.details()}"


@check("scene-url-name")
def scene_url_name(target: Target) -> str:
    """x-nre-scene-id may hold letters, digits, _ and - only."""
    error = _with_scene(target, "file:///no/such/file.usdz", "../conformance")
    if error.code() not in (Code.INVALID_ARGUMENT, Code.PERMISSION_DENIED):
        raise Failed(f"expected INVALID_ARGUMENT, got {error.code().name}: {error.details()}")
    return f"{error.code().name}: {error.details()}"
