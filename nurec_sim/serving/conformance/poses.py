"""Rules about sensor poses and shutters."""

from __future__ import annotations

import grpc
import numpy as np

from nurec_sim import geometry
from nurec_sim.serving.conformance.kit import check
from nurec_sim.serving.conformance.target import Skipped, Target, difference, expect, place

Code = grpc.StatusCode
_TURN_RAD = 0.12
_TOP_TO_BOTTOM, _GLOBAL = 1, 5


def _shuttered(target: Target, start, end, shutter: int) -> np.ndarray:
    request = target.request()
    request.frame_end_us = request.frame_start_us + 30_000
    request.camera_intrinsics.shutter_type = shutter
    place(request.sensor_pose, start, end)
    return target.picture(request)


def _two_poses(target: Target) -> tuple[np.ndarray, np.ndarray]:
    """The camera's pose, and the same turned a little about the world's vertical in its place."""
    start = target.world_from_camera(target.camera(), target.middle_us)
    end = start.copy()
    end[:3, :3] = geometry.rotation_from_yaw(_TURN_RAD) @ start[:3, :3]
    return start, end


@check("shutter-rolling")
def rolling(target: Target) -> str:
    """With two poses and ROLLING_TOP_TO_BOTTOM the first rows are seen from the start, the last from the end."""
    start, end = _two_poses(target)
    first, last = (_shuttered(target, pose, pose, _TOP_TO_BOTTOM) for pose in (start, end))
    rolling = _shuttered(target, start, end, _TOP_TO_BOTTOM)
    rows = max(4, len(rolling) // 8)
    for name, part, near, far in (("first", slice(0, rows), first, last), ("last", slice(-rows, None), last, first)):
        apart = difference(near[part], far[part])
        if apart < 1:
            continue
        gap, other = difference(rolling[part], near[part]), difference(rolling[part], far[part])
        expect(gap < other, f"the {name} rows are nearer to the other pose ({other:.1f}) than to their own ({gap:.1f})")
    if difference(first, last) < 1:
        raise Skipped("the picture has too little in it to tell")
    gaps = difference(rolling, first), difference(rolling, last)
    return f"{gaps[0]:.1f} steps from the start's picture, {gaps[1]:.1f} from the end's"


@check("shutter-global")
def global_shutter(target: Target) -> str:
    """With two poses and GLOBAL all rows are seen from one pose."""
    start, end = _two_poses(target)
    image = _shuttered(target, start, end, _GLOBAL)
    middle = geometry.interpolate_pose_pair(np.stack([start, end]), np.array(0.5))
    gaps = {
        name: difference(image, _shuttered(target, pose, pose, _GLOBAL))
        for name, pose in (("start", start), ("middle", middle), ("end", end))
    }
    nearest = min(gaps, key=lambda name: gaps[name])
    rolling = difference(image, _shuttered(target, start, end, _TOP_TO_BOTTOM))
    expect(gaps[nearest] <= rolling, f"it is nearer to a rolling shutter ({rolling:.1f}) than to any pose: {gaps}")
    return f"seen from the {nearest} pose"


def _spoilt(target: Target, change) -> str:
    request = target.request()
    change(request)
    return target.refused("render_rgb", request, Code.INVALID_ARGUMENT)


@check("pose-missing")
def missing(target: Target) -> str:
    """A request without a sensor pose is INVALID_ARGUMENT."""
    return _spoilt(target, lambda r: r.ClearField("sensor_pose"))


@check("pose-not-finite")
def not_finite(target: Target) -> str:
    """A pose that is not finite is INVALID_ARGUMENT."""
    return _spoilt(target, lambda r: setattr(r.sensor_pose.start_pose.vec, "x", float("nan")))


@check("pose-not-rigid")
def not_rigid(target: Target) -> str:
    """A quaternion of length 2 is INVALID_ARGUMENT."""
    return _spoilt(target, lambda r: setattr(r.sensor_pose.end_pose.quat, "w", 2.0))


@check("pose-quaternion-sign")
def quaternion_sign(target: Target) -> str:
    """Quaternions q and -q are the same rotation; AlpaSim's w may be negative."""
    request = target.request()
    plain = target.picture(request)
    for pose in (request.sensor_pose.start_pose, request.sensor_pose.end_pose):
        quat = pose.quat
        quat.w, quat.x, quat.y, quat.z = -quat.w, -quat.x, -quat.y, -quat.z
    gap = difference(target.picture(request), plain)
    expect(gap < 0.5, f"with -q the picture differs by {gap:.1f} steps")
    return f"{gap:.2f} steps apart"


@check("pose-never-driven")
def never_driven(target: Target) -> str:
    """A pose beside the recorded path renders, and shows something else."""
    request = target.request()
    plain = target.picture(request)
    aside = target.world_from_camera(target.camera(), target.middle_us)
    aside[:3, 3] += target.path.at(target.middle_us)[:3, 1]  # one metre to the left
    place(request.sensor_pose, aside)
    gap = difference(target.picture(request), plain)
    expect(gap > 0, "one metre to the left the picture is the same")
    return f"{gap:.1f} steps apart"
