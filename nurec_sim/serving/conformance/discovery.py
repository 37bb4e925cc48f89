"""Rules about the service itself and discovery of scenes."""

from __future__ import annotations

import grpc

from nurec_sim.serving import wire
from nurec_sim.serving.conformance.kit import check
from nurec_sim.serving.conformance.target import Skipped, Target, expect, unit_error
from nurec_sim.serving.wire import sensorsim

_NRE, _NUREC, _SHORT = wire.SERVICE_PATHS
QUAT_TOLERANCE = 1e-4  # AlpaSim's clients refuse more


@check("path-nre")
def path_nre(target: Target) -> str:
    """The service answers as /nre.grpc.protos.sensorsim.SensorsimService."""
    return f"version {target.call('get_version', path=_NRE).version_id!r}"


@check("path-nurec", optional=True)
def path_nurec(target: Target) -> str:
    """It may also answer as /nurec.grpc.protos.sensorsim.SensorsimService, as of 26.10."""
    return f"version {target.call('get_version', path=_NUREC).version_id!r}"


@check("path-short", optional=True)
def path_short(target: Target) -> str:
    """It may also answer as /sensorsim.SensorsimService, as of 26.10."""
    return f"version {target.call('get_version', path=_SHORT).version_id!r}"


@check("version")
def version(target: Target) -> str:
    """get_version returns the server's version and that of its interface, the same every time."""
    one, other = target.call("get_version"), target.call("get_version")
    expect(one.version_id, "version_id is empty")
    expect(one.HasField("grpc_api_version"), "grpc_api_version is missing")
    expect(one == other, f"two calls gave {one.version_id!r} and {other.version_id!r}")
    api = one.grpc_api_version
    return f"version {one.version_id!r}, interface {api.major}.{api.minor}.{api.patch}"


@check("health", optional=True)
def health(target: Target) -> str:
    """The standard health service says SERVING."""
    from grpc_health.v1 import health_pb2, health_pb2_grpc

    reply = health_pb2_grpc.HealthStub(target.channel).Check(health_pb2.HealthCheckRequest(), timeout=10)
    expect(reply.status == health_pb2.HealthCheckResponse.SERVING, f"the status is {reply.status}, SERVING is 1")
    return "SERVING"


@check("server-config", optional=True)
def server_config(target: Target) -> str:
    """get_server_config gives texts by name."""
    return f"{len(target.call('get_server_config').config)} entries"


@check("scenes-listed")
def scenes_listed(target: Target) -> str:
    """get_available_scenes lists each scene once, in a reply below gRPC's default limit of 4 MiB."""
    reply = target.call("get_available_scenes")
    ids = list(reply.scene_ids)
    expect(ids, "no scene is listed")
    expect(len(set(ids)) == len(ids), "a scene is listed more than once")
    expect(reply.ByteSize() < 4 << 20, f"the reply has {reply.ByteSize():,} bytes")
    return f"{len(ids)} scenes, the first is {ids[0]!r}"


@check("scene-unknown")
def scene_unknown(target: Target) -> str:
    """A scene that is not there is NOT_FOUND, whatever is asked of it."""
    name = "no-such-scene-anywhere"
    request = target.request()
    request.scene_id = name
    for procedure, message in (
        ("get_available_cameras", sensorsim.AvailableCamerasRequest(scene_id=name)),
        ("get_available_trajectories", sensorsim.AvailableTrajectoriesRequest(scene_id=name)),
        ("render_rgb", request),
    ):
        text = target.refused(procedure, message, grpc.StatusCode.NOT_FOUND)
    return text


@check("loaded-scenes", optional=True)
def loaded_scenes(target: Target) -> str:
    """get_loaded_scenes counts a scene that was just rendered."""
    target.picture(target.request())
    counts = {entry.scene_id: entry.loaded_instance_count for entry in target.call("get_loaded_scenes").scenes}
    listed = set(target.call("get_available_scenes").scene_ids)
    expect(any(counts.values()), f"a scene was rendered, but those loaded are {counts}")
    expect(counts.keys() <= listed, f"{sorted(counts.keys() - listed)} are loaded but not listed")
    return f"{counts}"


@check("cameras-listed")
def cameras_listed(target: Target) -> str:
    """Each camera has one id, said twice, a native size, a lens and a shutter type."""
    expect(target.cameras, "the scene has no cameras")
    ids = [camera.logical_id for camera in target.cameras]
    expect(all(ids) and len(set(ids)) == len(ids), f"logical ids must be there and differ, got {ids}")
    for camera in target.cameras:
        spec, name = camera.intrinsics, camera.logical_id
        expect(spec.logical_id == name, f"camera {name!r} has intrinsics.logical_id {spec.logical_id!r}")
        expect(min(spec.resolution_h, spec.resolution_w) > 1, f"camera {name!r} has no native size")
        expect(spec.WhichOneof("camera_param"), f"camera {name!r} has no lens parameters")
        expect(1 <= spec.shutter_type <= 5, f"camera {name!r} has shutter_type {spec.shutter_type}; 1 to 5 are known")
    return ", ".join(f"{c.logical_id} {c.intrinsics.resolution_w}x{c.intrinsics.resolution_h}" for c in target.cameras)


@check("camera-mountings")
def camera_mountings(target: Target) -> str:
    """rig_to_camera is the pose of the camera in the rig: a unit quaternion, and within 20 m of its origin."""
    worst = unit_error([camera.rig_to_camera.quat for camera in target.cameras])
    expect(worst <= QUAT_TOLERANCE, f"a quaternion's squared norm is {worst:.2g} away from 1")
    for camera in target.cameras:
        place = camera.rig_to_camera.vec
        reach = max(abs(place.x), abs(place.y), abs(place.z))
        expect(reach < 20, f"camera {camera.logical_id!r} is {reach:.1f} m from the rig")
    return f"{len(target.cameras)} cameras, quaternions within {worst:.1g}"


@check("ftheta-both-polynomials")
def ftheta_polynomials(target: Target) -> str:
    """F-theta cameras come with both polynomials, a largest angle and linear terms."""
    found = [c for c in target.cameras if c.intrinsics.WhichOneof("camera_param") == "ftheta_param"]
    if not found:
        raise Skipped("the scene has no F-theta camera")
    for camera in found:
        lens, name = camera.intrinsics.ftheta_param, camera.logical_id
        expect(lens.pixeldist_to_angle_poly, f"camera {name!r} lacks pixeldist_to_angle_poly")
        expect(lens.angle_to_pixeldist_poly, f"camera {name!r} lacks angle_to_pixeldist_poly")
        expect(lens.max_angle > 0, f"camera {name!r} has max_angle {lens.max_angle}")
        expect(lens.linear_cde.linear_c, f"camera {name!r} has linear_c {lens.linear_cde.linear_c}; 1 is the identity")
    return f"{len(found)} cameras"


@check("trajectory")
def trajectory(target: Target) -> str:
    """The rig's path has strictly increasing times and unit quaternions."""
    request = sensorsim.AvailableTrajectoriesRequest(scene_id=target.scene_id)
    found = target.call("get_available_trajectories", request).available_trajectories
    expect(len(found) == 1, f"one trajectory is expected, got {len(found)}")
    poses = found[0].trajectory.poses
    times = [sample.timestamp_us for sample in poses]
    expect(len(times) > 1, f"a path of at least two poses is expected, got {len(times)}")
    expect(all(a < b for a, b in zip(times, times[1:], strict=False)), "times do not increase strictly")
    worst = unit_error([sample.pose.quat for sample in poses])
    expect(worst <= QUAT_TOLERANCE, f"a quaternion's squared norm is {worst:.2g} away from 1")
    return f"{len(times)} poses over {(times[-1] - times[0]) / 1e6:.2f} s"


@check("ego-masks-listed", optional=True)
def ego_masks_listed(target: Target) -> str:
    """Each ego mask is named by rig and camera."""
    masks = [entry.ego_mask_id for entry in target.call("get_available_ego_masks").ego_mask_metadata]
    expect(all(m.rig_config_id and m.camera_logical_id for m in masks), "a mask lacks its rig or its camera")
    return f"{len(masks)} masks"


@check("unknown-fields")
def unknown_fields(target: Target) -> str:
    """Fields that the server does not know are ignored, as protobuf wants it; AlpaSim's branches send 1013."""
    request = target.request()
    plain = target.call("render_rgb", request).image_bytes
    extra = request.SerializeToString() + b"\xaa\x3f\x04\x0a\x02\x0a\x00" + b"\xf0\xff\x01\x07"  # 1013, 4094
    expect(target.call("render_rgb", extra).image_bytes == plain, "the picture differs with unknown fields")
    return "fields 1013 and 4094 made no difference"


@check("malformed-bytes")
def malformed_bytes(target: Target) -> str:
    """Bytes that are no message are refused, and the server goes on."""
    text = target.refused("render_rgb", b"\xff\xff\xff")
    expect(target.call("get_version").version_id, "the server does not answer any more")
    return text
