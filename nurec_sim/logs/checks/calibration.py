"""Checks that LiDAR and images align better as calibrated than under alternative interpretations of the calibration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.logs.checks.alignment import CalibrationView, Fit, comparable_image, fit
from nurec_sim.logs.checks.borders import Pairs, find_pairs
from nurec_sim.logs.checks.measure import Measure
from nurec_sim.logs.checks.sampling import SampledSweep, point_of_view
from nurec_sim.logs.checks.turned import is_upright, slightly_turned, wrong_readings
from nurec_sim.logs.clip import Clip
from nurec_sim.types import Matrix4

FURTHEST_US = 500_000
SEEN_ERRORS = 3.3
CLEAR_ERRORS = 1.5
CLEAR_SMALL_ERRORS = 3.0
LYING_ERRORS = 2.5
"""Additional evidence, in standard errors, required of a pose whose image is not upright."""
ALLOWED_TURN_DEG, ALLOWED_SHIFT_M = 5.0, 0.5
FASTEST_MPS, FASTEST_DEG_S = 40.0, 60.0


def check_calibration(clip: Clip, sweeps: Sequence[SampledSweep]) -> list[Measure]:
    """One row per camera: alignment of LiDAR and images, and any alternative pose that aligns significantly better."""
    pairs: dict[int, Pairs] = {}
    rows = []
    for name in clip.rig.cameras:
        what = f"LiDAR in camera {name!r}"
        apart = _frames_apart(clip, name)
        if apart:
            rows.append(Measure(what, "not looked at: its frames have other poses", (apart,)))
            continue
        views = _views(clip, name, sweeps, pairs)
        if not views:
            rows.append(Measure(what, "cannot tell: no sweep about the time of an image"))
            continue
        rows.append(_verdict(name, what, clip.rig.cameras[name].rig_from_camera, clip.rig_from_log, views))
    return rows


def _verdict(name: str, what: str, given: Matrix4, rig_from_log: Matrix4, views: Sequence[CalibrationView]) -> Measure:
    """Compares the given pose with every alternative; figures are gains in standard errors."""
    as_given = fit(views, given)
    errors = as_given.errors - (0.0 if is_upright(given) else LYING_ERRORS)
    others = [(fit(views, pose), name, CLEAR_ERRORS) for name, pose in wrong_readings(given, rig_from_log)]
    others += [(fit(views, pose), name, CLEAR_SMALL_ERRORS) for name, pose in slightly_turned(given)]
    # Small turns need a larger margin than gross errors: neighbouring poses are nearly as good by nature.
    clear = [row for row in others if row[0].errors > max(SEEN_ERRORS, errors + row[2])]
    if clear:
        best, meaning, _ = max(clear, key=lambda row: row[0].errors)
        fault = (
            f"camera {name!r}: borders in the LiDAR meet borders in the image clearly better if its pose is "
            f"{meaning}: {best.errors:.1f} standard errors above chance, as given {as_given.errors:.1f}"
        )
        return Measure(what, _figure(as_given, best), (fault,))
    best = max((fit_ for fit_, _, margin in others if margin == CLEAR_ERRORS), key=lambda each: each.errors)
    if as_given.errors < SEEN_ERRORS:
        return Measure(what, "cannot tell: " + _figure(as_given, best))
    return Measure(what, _figure(as_given, best))


def _figure(given: Fit, other: Fit) -> str:
    return f"fits at {given.errors:.1f} standard errors, turned or inverted at most {other.errors:.1f}"


def _views(
    clip: Clip, camera_id: str, sweeps: Sequence[SampledSweep], known: dict[int, Pairs]
) -> list[CalibrationView]:
    """The camera's image nearest in time to each sweep, with the sweep's points in the rig frame at that time."""
    camera = clip.rig.cameras[camera_id]
    times = clip.camera_times_us(camera_id).mean(axis=1)
    views = []
    for number, each in enumerate(sweeps if len(times) else ()):
        index = int(np.argmin(np.abs(times - each.sweep.t_us)))
        if abs(times[index] - each.sweep.t_us) > FURTHEST_US:
            continue
        try:
            image = clip.image(camera_id, index)
        except ClipError:
            continue
        if number not in known:
            origin = point_of_view(clip, clip.rig.lidars[each.lidar_id])
            known[number] = find_pairs(each.rig_m, each.sweep.intensity, origin)
        middle = geometry.interpolate_pose_pair(clip.world_from_camera(camera_id, index), np.array([0.5]))[0]
        # The rig pose implied by the frame's own pose, which may be more accurate than the ego's.
        rig_from_world = camera.rig_from_camera @ geometry.inverse(middle)
        points = geometry.transform_points(rig_from_world @ each.sweep.world_from_lidar, each.sweep.xyz_m)
        views.append(CalibrationView(camera, comparable_image(image), points, known[number]))
    return views


def _frames_apart(clip: Clip, camera_id: str) -> str | None:
    """The fault, if a camera's per-frame poses deviate from the ego's poses and the calibration.

    The tolerance grows with the time between a frame and the nearest ego pose, by the largest plausible motion.
    """
    records = clip.image_records(camera_id)
    turns, shifts = [], []
    for record in records:
        t_us = (record.start_us + record.end_us) // 2
        gap_s = float(np.abs(clip.ego.t_us - t_us).min()) * 1e-6
        there = clip.ego.at(t_us) @ clip.rig.cameras[camera_id].rig_from_camera
        middle = geometry.interpolate_pose_pair(record.world_from_camera, np.array([0.5]))[0]
        # trace(R) = 1 + 2 cos(angle) for the relative rotation R.
        cosine = (np.trace(there[:3, :3].T @ middle[:3, :3]) - 1) / 2
        turns.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))) - FASTEST_DEG_S * gap_s)
        shifts.append(np.linalg.norm(there[:3, 3] - middle[:3, 3]) - FASTEST_MPS * gap_s)
    if not records or (np.median(turns) < ALLOWED_TURN_DEG and np.median(shifts) < ALLOWED_SHIFT_M):
        return None
    return (
        f"camera {camera_id!r}: its frames' own poses lie {max(0.0, float(np.median(shifts))):.2f} m and "
        f"{max(0.0, float(np.median(turns))):.0f} degrees off those of the ego and the calibration; "
        "T_ego_cam in calib.json may be inverted"
    )
