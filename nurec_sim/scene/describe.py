"""Hash and summary of a scene."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import numpy as np

from nurec_sim.scene import codec
from nurec_sim.scene.facts import scene_facts
from nurec_sim.types import GAUSSIAN_FIELDS, OPTIONAL_GAUSSIAN_FIELDS, Gaussians, GaussianScene, Label


def scene_arrays(scene: GaussianScene) -> dict[str, np.ndarray]:
    """The large arrays of a scene by name."""
    dynamic = scene.dynamic
    arrays = {f"static.{name}": array for name, array in _columns(scene.static).items()}
    arrays |= {f"dynamic.{name}": array for name, array in _columns(dynamic.gaussians).items()}
    arrays |= {f"dynamic.{name}": getattr(dynamic, name) for name in ("knot_t_us", "knot_m", "track")}
    if dynamic.in_box is not None:
        arrays["dynamic.in_box"] = dynamic.in_box
    arrays |= {f"ego.{camera}": image for camera, image in scene.ego_images.items()}
    return arrays | {"sky": scene.sky}


def _columns(gaussians: Gaussians) -> Mapping[str, np.ndarray]:
    columns = {name: getattr(gaussians, name) for name in GAUSSIAN_FIELDS + OPTIONAL_GAUSSIAN_FIELDS}
    return {name: column for name, column in columns.items() if column is not None}


def scene_hash(scene: GaussianScene) -> str:
    """SHA-256 of everything in a scene, hexadecimal; equal scenes have equal hashes."""
    given = {"facts": scene_facts(scene), "isp": scene.isp}
    if scene.exposures:
        given["exposures"] = scene.exposures
    digest = hashlib.sha256()
    digest.update(codec.dump(given, "the scene"))
    for name, array in scene_arrays(scene).items():
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        canonical = array + array.dtype.type(
            0
        )  # -0 becomes 0: OpenUSD merges equal arrays regardless of the sign of zero
        digest.update(np.ascontiguousarray(canonical).data.cast("B") if array.size else b"")
    return digest.hexdigest()


def summary(scene: GaussianScene) -> list[tuple[str, str]]:
    """Human-readable (name, text) rows: counts, sizes, sensors, times."""
    start_us, end_us = scene.span_us
    arrays = scene_arrays(scene)
    counts = np.bincount(scene.static.label, minlength=len(Label))
    labels = ", ".join(f"{label.name.lower()} {counts[label]:,}" for label in Label if counts[label])
    degree = 0 if scene.static.sh_rest is None else int(np.sqrt(scene.static.sh_rest.shape[1] + 1)) - 1
    owners = np.unique(scene.dynamic.track[scene.dynamic.track >= 0])
    path_m = np.linalg.norm(np.diff(scene.ego.position_m, axis=0), axis=1).sum()
    cameras = [f"{c.id} {c.width_px}x{c.height_px} {type(c.lens).__name__}" for c in scene.rig.cameras.values()]
    lidars = [f"{x.id} {len(x.elevation_rad)}x{len(x.azimuth_rad)}" for x in scene.rig.lidars.values()]
    return [
        ("scene", scene.id),
        ("time", f"{(end_us - start_us) / 1e6:.2f} s from {start_us} us"),
        ("recorded path", f"{path_m:.1f} m, {len(scene.ego.t_us)} poses"),
        ("static Gaussians", f"{len(scene.static):,} ({labels or 'none'}), harmonics degree {degree}"),
        ("moving Gaussians", f"{len(scene.dynamic):,} of {len(owners)} tracks"),
        ("tracks", _tracks(scene)),
        ("sky", f"6 x {scene.sky.shape[1]} x {scene.sky.shape[2]}"),
        ("colour correction", ", ".join(scene.isp) or "none"),
        ("cameras", ", ".join(cameras) or "none"),
        ("LiDARs", ", ".join(lidars) or "none"),
        ("road map", "none" if scene.road_map is None else str(scene.road_map)),
        ("method", str(scene.provenance.get("method", "unknown"))),
        *_alignment(scene.provenance.get("sweep_alignment")),
        *_camera_alignment(scene.provenance.get("camera_alignment")),
        ("in memory", f"{sum(array.nbytes for array in arrays.values()) / 2**20:.1f} MiB"),
    ]


def _alignment(found: object) -> list[tuple[str, str]]:
    """The row about sweeps that disagreed and were aligned."""
    if (apart := _before_and_after(found, "apart_m")) is None:
        return []
    before, after = (1000 * each for each in apart)
    return [("sweeps aligned", f"points were {before:.1f} mm off the planes that sweeps share, and are {after:.1f} mm")]


def _camera_alignment(found: object) -> list[tuple[str, str]]:
    """The row about cameras that disagreed and were turned."""
    if (apart := _before_and_after(found, "apart_px")) is None:
        return []
    return [("cameras aligned", f"features that two share were {apart[0]:.1f} px off, and are {apart[1]:.1f} px")]


def _before_and_after(found: object, name: str) -> list[float] | None:
    """Two numbers of what a provenance says of an alignment; None if it does not say them."""
    apart = found.get(name) if isinstance(found, Mapping) else None
    if isinstance(apart, list) and len(apart) == 2 and all(isinstance(each, float) for each in apart):
        return apart
    return None


def _tracks(scene: GaussianScene) -> str:
    """Numbers of actors, unlabelled actors and unlabelled movers."""
    actors = [track for track in scene.tracks if track.actor]
    found, movers = sum(not track.labelled for track in actors), len(scene.tracks) - len(actors)
    notes = [f"{found} of them detected by motion, unlabelled"] * (found > 0)
    notes += [f"{movers} additional unlabelled movers"] * (movers > 0)
    return ", ".join([f"{len(actors)} actors" if notes else f"{len(actors)}", *notes])
