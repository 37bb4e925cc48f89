"""Summary of a clip as table rows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Int64

from nurec_sim import sensors
from nurec_sim.types import CameraModel, Clip, Spin

SENSOR_COLUMNS = ("sensor", "model", "size", "frames", "rate Hz", "span s", "shutter")


@dataclass(frozen=True)
class ClipSummary:
    """Facts of a clip, and one row per sensor with the columns ``SENSOR_COLUMNS``."""

    facts: tuple[tuple[str, str], ...]
    sensors: tuple[tuple[str, ...], ...]


class OpenedLog(Clip, Protocol):
    """A log and where it comes from: what a summary tells."""

    @property
    def path(self) -> Path | None:
        """Path it was opened from; None if created in memory."""
        ...

    @property
    def format(self) -> str:
        """Name of the reader that opened it."""
        ...

    @property
    def facts(self) -> Mapping[str, Any]:
        """Other metadata of the log."""
        ...


def describe_clip(clip: OpenedLog) -> ClipSummary:
    """Sensors, counts, rates, times, tracks and map of a clip; reads no image and no sweep."""
    start_us, end_us = clip.span_us
    rows = [_camera_row(clip, name) for name in clip.rig.cameras] + [_lidar_row(clip, name) for name in clip.rig.lidars]
    labelled = [track for track in clip.tracks if track.labelled]
    found = Counter(track.label for track in clip.tracks if not track.labelled)
    moving = sum(len(track.path.t_us) > 1 for track in labelled)
    labels = Counter(track.label for track in labelled)
    path_m = float(np.linalg.norm(np.diff(clip.ego.position_m, axis=0), axis=1).sum())
    road_map = clip.road_map
    facts = [
        ("clip", clip.id),
        ("path", "none" if clip.path is None else str(clip.path)),
        ("format", clip.format),
        ("span", f"{start_us} to {end_us} us ({(end_us - start_us) / 1e6:.3f} s)"),
        *([("times", f"those of the log and {clip.time_offset_us} us")] if clip.time_offset_us else []),
        ("ego", f"{len(clip.ego.t_us)} poses{_rate_text(clip.ego.t_us)}, {path_m:.1f} m driven"),
        ("boxes", f"{sum(len(track.path.t_us) for track in labelled)} in {len(labelled)} tracks"),
        ("tracks", f"{moving} with more than one pose; {_counts(labels)}" if labelled else "none"),
        *([("found by motion, unlabelled", _counts(found))] if found else []),
        ("map", str(road_map) if road_map else "none"),
    ]
    facts += [
        (f"log: {key.replace('_', ' ')}", value)
        for key, value in clip.facts.items()
        if key != "name" and isinstance(value, str)
    ]
    return ClipSummary(tuple(facts), tuple(rows))


def _counts(labels: Counter[str]) -> str:
    return ", ".join(
        f"{count} {label}" for label, count in sorted(labels.items(), key=lambda item: (-item[1], item[0]))
    )


def _rate_text(t_us: Int64[np.ndarray, " t"]) -> str:
    rate = _rate(t_us)
    return f" at {rate} Hz" if rate != "-" else ""


def _rate(t_us: Int64[np.ndarray, " t"]) -> str:
    return f"{1e6 / float(np.median(np.diff(t_us))):.2f}" if len(t_us) > 1 else "-"


def _span(times_us: Int64[np.ndarray, "t 2"]) -> str:
    return f"{(times_us[-1, 1] - times_us[0, 0]) / 1e6:.3f}" if len(times_us) else "-"


def _lens_name(camera: CameraModel) -> str:
    name = camera.lens.kind
    if camera.lens.perspective and camera.lens.ideal_pinhole is None:
        name += ", distorted"
    return name + (", windshield" if camera.windshield is not None else "")


def _camera_row(clip: Clip, name: str) -> tuple[str, ...]:
    camera, times = clip.rig.cameras[name], clip.camera_times_us(name)
    size = f"{camera.width_px} x {camera.height_px}"
    return (name, _lens_name(camera), size, str(len(times)), _rate(times[:, 0]), _span(times), camera.shutter.value)


def _lidar_row(clip: Clip, name: str) -> tuple[str, ...]:
    lidar, times = clip.rig.lidars[name], clip.sweep_times_us(name)
    model = next(
        (key for key, table in sensors.LIDAR_TABLES.items()
         if np.array_equal(np.deg2rad(table.elevation_deg), lidar.elevation_rad)), "own table"
    )  # fmt: skip
    size = f"{len(lidar.elevation_rad)} x {len(lidar.azimuth_rad)}"
    spin = "clockwise" if lidar.spin is Spin.CLOCKWISE else "counterclockwise"
    return (name, model, size, str(len(times)), _rate(times[:, 0]), _span(times), spin)
