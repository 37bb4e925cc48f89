"""Rules for CARLA's NuRec client: times, rig, F-theta cameras, tracks and the map."""

from __future__ import annotations

from typing import Any

import numpy as np

from nurec_sim.errors import ArchiveError
from nurec_sim.scene.interop.validate import maps, shared
from nurec_sim.scene.interop.validate.contents import Contents, entry_of, numbers_of, shown, text_of
from nurec_sim.scene.interop.validate.finding import Report, Rule
from nurec_sim.scene.interop.validate.shared import RIG, TRACKS

CHUNK_KEY = "dummy_chunk_id"
DATA_INFO = "data_info.json"
SHUTTERS = tuple(f"ROLLING_{way}" for way in ("TOP_TO_BOTTOM", "LEFT_TO_RIGHT", "BOTTOM_TO_TOP", "RIGHT_TO_LEFT"))
POLYNOMIALS = ("pixeldist_to_angle_poly", "angle_to_pixeldist_poly")
AGREE_PX = 2.0

RULES = {
    "zip": Rule("error", "a readable ZIP", "nothing is found"),
    "data-info": Rule(
        "error",
        "data_info.json with sequence_id and the integers pose-range.start-timestamp_us < .end-timestamp_us",
        "the client stops with a KeyError",
    ),
    "interval": Rule(
        "warning", "integers sequence_timestamp_interval_us.start < .stop", "tools of NRE do not know the span"
    ),
    "pose-range": Rule("error", "a pose-range within the rig's path", "frames are asked for where there is no pose"),
    "scene-name": Rule(
        "error",
        "a sequence_id that is part of metadata.yaml's scene_id",
        "the client waits for a scene that no server lists",
    ),
    "rig-file": Rule("error", f"{RIG} with a list rig_trajectories", "the client stops with a KeyError"),
    "one-trajectory": Rule("error", "exactly one rig trajectory", "the wrong drive may be taken"),
    "path": Rule(
        "error",
        "as many rigid poses T_rig_worlds [n,4,4] as strictly increasing integers T_rig_world_timestamps_us",
        "the car cannot be placed",
    ),
    "base-frame": Rule("error", "T_world_base, 4x4", "the client stops with a KeyError"),
    "calibrations": Rule("error", "camera_calibrations with logical_sensor_name each", "there is no camera"),
    "camera-pose": Rule("error", "a rigid T_sensor_rig per camera", "that camera cannot be used"),
    "camera-model": Rule(
        "error",
        "camera_model of type ftheta with resolution, principal_point, external_distortion_parameters, reference_poly, "
        "both polynomials, max_angle, linear_cde",
        "that camera cannot be used",
    ),
    "polynomials": Rule(
        "error",
        "two F-theta polynomials of finite numbers that rise from the axis, the reference named",
        "that camera cannot be used",
    ),
    "polynomials-agree": Rule(
        "warning", f"polynomials that undo each other within {AGREE_PX:g} px", "projections depend on which one is read"
    ),
    "fit-error": Rule(
        "warning",
        f"an F-theta fit within {AGREE_PX:g} px of the camera's own lens",
        "images differ from the recorded camera's by that much",
    ),
    "shutter": Rule("error", "a shutter_type of GLOBAL or ROLLING_x_TO_y", "that camera cannot be used"),
    "tracks-file": Rule("error", f"{TRACKS}, an object", "the client stops with a KeyError"),
    "tracks-key": Rule("error", f"the top-level key {CHUNK_KEY!r}", "the client stops with a KeyError"),
    "tracks-fields": Rule(
        "error",
        f"lists tracks_data.{{{', '.join(shared.TRACK_FIELDS)}}} and cuboidtracks_data.cuboids_dims",
        "the client stops with a KeyError",
    ),
    "tracks-lengths": Rule("error", "one entry per track in each list", "actors get the values of others"),
    "track-dims": Rule("error", "length, width, height > 0 per track", "the actor cannot be spawned"),
    "track-flags": Rule("error", "flags per track: a text or a list of texts", "controllable actors are not known"),
    "track-samples": Rule(
        "error", "as many poses [k,7] as strictly increasing integer times per track", "the actor cannot be placed"
    ),
    "track-quaternions": Rule("error", "unit quaternions x y z w", "actors are turned wrongly"),
    "map": Rule("error", "map.xodr, OpenDRIVE with roads", "the client stops with a KeyError"),
    "map-origin": Rule(
        "warning", "a geoReference with +lat_0 and +lon_0", "the map is not moved to where the scene is"
    ),
}


def check(report: Report, contents: Contents) -> None:
    """Adds the findings for CARLA."""
    rig = shared.rig_document(report, contents)
    path_us = None
    if rig is not None:
        document, trajectory = rig
        path = shared.rig_path(report, trajectory)
        path_us = None if path is None else path[0]
        with report.rule("base-frame"):
            maps.check_base_frame(document)
        for uid, camera in shared.calibrations(report, document).items():
            _check_camera(report, camera, f"{RIG}: camera_calibrations[{shown(uid)}]")
    _check_data_info(report, contents, path_us)
    shared.tracks(report, contents, CHUNK_KEY)
    with report.rule("map"):
        root = maps.road_root(contents)
        text = maps.georeference(root)
        if maps.geodetic_origin(text) is None:
            report.add("map-origin", f"map.xodr: the geoReference is {shown(text)}")


def _check_data_info(report: Report, contents: Contents, path_us: np.ndarray | None) -> None:
    info: Any = None
    with report.rule("data-info"):
        info = contents.json(DATA_INFO)
        _check_scene_name(report, contents, text_of(info, "sequence_id", DATA_INFO))
    if not isinstance(info, dict):
        return
    with report.rule("data-info"):
        span = entry_of(info, "pose-range", DATA_INFO)
        start_us, end_us = _interval(span, ("start-timestamp_us", "end-timestamp_us"), f"{DATA_INFO}: pose-range")
        if path_us is not None and not path_us[0] <= start_us <= end_us <= path_us[-1]:
            message = f"{DATA_INFO}: pose-range is {start_us} to {end_us}, the rig's path {path_us[0]} to {path_us[-1]}"
            report.add("pose-range", message)
    with report.rule("interval"):
        key = "sequence_timestamp_interval_us"
        _interval(entry_of(info, key, DATA_INFO), ("start", "stop"), f"{DATA_INFO}: {key}")


def _interval(span: Any, keys: tuple[str, str], where: str) -> tuple[int, int]:
    """Start and end in microseconds.

    Raises:
        ArchiveError: missing, no integers, or not in order.
    """
    start, end = (int(numbers_of(entry_of(span, key, where), f"{where}.{key}", integers=True)) for key in keys)
    if start >= end:
        raise ArchiveError(f"{where} is {start} to {end}")
    return start, end


def _check_scene_name(report: Report, contents: Contents, sequence_id: str) -> None:
    try:
        metadata = contents.yaml("metadata.yaml")
    except ArchiveError:
        return  # AlpaSim's rules tell
    scene_id = metadata.get("scene_id") if isinstance(metadata, dict) else None
    if isinstance(scene_id, str) and sequence_id not in scene_id:
        message = f"{DATA_INFO}: sequence_id {shown(sequence_id)} is no part of the scene_id {shown(scene_id)}"
        report.add("scene-name", message)


def _check_camera(report: Report, camera: dict[str, Any], where: str) -> None:
    with report.rule("camera-pose"):
        pose = numbers_of(entry_of(camera, "T_sensor_rig", where), f"{where}.T_sensor_rig", 4, 4)
        shared.check_rigid(pose[None], f"{where}.T_sensor_rig")
    with report.rule("camera-model"):
        model = entry_of(camera, "camera_model", where)
        parameters = entry_of(model, "parameters", f"{where}.camera_model")
        kind = entry_of(model, "type", f"{where}.camera_model")
        if kind != "ftheta":
            raise ArchiveError(f"{where}.camera_model is of type {shown(kind)}")
        place = f"{where}.camera_model.parameters"
        for key in ("external_distortion_parameters", "reference_poly", *POLYNOMIALS):
            entry_of(parameters, key, place)
        with report.rule("shutter"):
            shutter = entry_of(parameters, "shutter_type", place)
            if shutter not in (*SHUTTERS, "GLOBAL"):
                raise ArchiveError(f"{place}.shutter_type is {shown(shutter)}")
        size = numbers_of(entry_of(parameters, "resolution", place), f"{place}.resolution", 2, integers=True)
        if size.min() < 1:
            raise ArchiveError(f"{place}.resolution is {shown(parameters['resolution'])}")
        center = numbers_of(entry_of(parameters, "principal_point", place), f"{place}.principal_point", 2)
        numbers_of(entry_of(parameters, "linear_cde", place), f"{place}.linear_cde", 3)
        max_angle = float(numbers_of(entry_of(parameters, "max_angle", place), f"{place}.max_angle"))
        if not 0 < max_angle <= np.pi:
            raise ArchiveError(f"{place}.max_angle is {max_angle:g} rad")
        with report.rule("polynomials"):
            _check_polynomials(report, parameters, _reach_px(size, center), max_angle, place)
    error = camera.get("ftheta_fit_error_px")
    worst = error.get("max") if isinstance(error, dict) else None
    if isinstance(worst, (int, float)) and worst > AGREE_PX:
        report.add("fit-error", f"{where}: the F-theta fit is up to {worst:.1f} px off the camera's own lens")


def _reach_px(size: np.ndarray, center: np.ndarray) -> float:
    """Distance of the farthest corner of the image from the principal point."""
    return float(np.hypot(*np.maximum(np.abs(center), np.abs(size - center))))


def _check_polynomials(
    report: Report, parameters: dict[str, Any], reach_px: float, max_angle: float, where: str
) -> None:
    """Both polynomials must exist, increase, and be inverse to each other over the image.

    Raises:
        ArchiveError: one of them is unusable.
    """
    to_angle, to_px = (numbers_of(parameters[key], f"{where}.{key}", -1) for key in POLYNOMIALS)
    for key, terms in zip(POLYNOMIALS, (to_angle, to_px), strict=True):
        if len(terms) < 2 or terms[1] <= 0:
            raise ArchiveError(f"{where}.{key} is {shown(parameters[key])}")
    names = [key.removesuffix("_poly").upper() for key in POLYNOMIALS]
    if parameters["reference_poly"] not in names:
        raise ArchiveError(f"{where}.reference_poly is {shown(parameters['reference_poly'])}")
    distance = np.linspace(0, reach_px, 200)
    with np.errstate(over="ignore", invalid="ignore"):
        angle = np.polynomial.polynomial.polyval(distance, to_angle)
        # Only where the angle still increases: past a fold, the inverse belongs to another distance.
        seen = (angle <= max_angle) & (np.maximum.accumulate(angle) <= angle)
        off_px = np.abs(np.polynomial.polynomial.polyval(angle, to_px) - distance)[seen]
    worst = float(off_px.max()) if len(off_px) else np.inf
    if not worst <= AGREE_PX:
        report.add("polynomials-agree", f"{where}: there and back again is up to {worst:.1f} px off")
