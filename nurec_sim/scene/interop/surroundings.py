"""Missing parts of an imported scene: from a scene of the same place, or defaults."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from nurec_sim import geometry
from nurec_sim.scene.interop.sky_sidecar import SkySidecar
from nurec_sim.types import CameraModel, Clip, GaussianScene, Pinhole, Rig, Trajectory

DEFAULT_SPAN_US = (1_000_000, 2_000_000)
CAMERA_HEIGHT_M = 1.5

Sky = Float32[np.ndarray, "6 s s 3"]
Isp = Mapping[str, Float64[np.ndarray, "3 4"]]


def surroundings_of(like: GaussianScene | Clip | None) -> dict[str, Any]:
    """All ``GaussianScene`` fields except id, Gaussians, sky and colours, by name.

    Args:
        like: the source. If None, the car is at the origin for ``DEFAULT_SPAN_US``, with one camera at
            ``CAMERA_HEIGHT_M`` facing along x.
    """
    if like is None:
        return _default_surroundings()
    known = {name: getattr(like, name) for name in ("rig", "ego", "tracks", "road_map", "span_us")}
    if isinstance(like, GaussianScene):
        return known | {"camera_times_us": like.camera_times_us}
    return known | {"camera_times_us": {name: like.camera_times_us(name) for name in like.rig.cameras}}


def taken_from(sky: Path | str | None, like: GaussianScene | Clip | None) -> dict[str, str]:
    """Provenance entries for additional sources."""
    taken = {"sky_file": None if sky is None else Path(sky).name, "like": None if like is None else like.id}
    return {name: value for name, value in taken.items() if value is not None}


def colours_in(sidecar: SkySidecar | None) -> tuple[Sky | None, Isp | None]:
    """Sky and colour corrections of a sky file, if there is one."""
    return (None, None) if sidecar is None else (sidecar.sky, sidecar.isp)


def colours_of(like: GaussianScene | Clip | None) -> tuple[Sky | None, Isp | None]:
    """Sky and colour corrections of a scene; a log has neither."""
    return (like.sky, like.isp) if isinstance(like, GaussianScene) else (None, None)


def first_colours(given: Iterable[tuple[Sky | None, Isp | None]], unknown: list[str]) -> tuple[Sky, Isp]:
    """The first available sky and colour corrections; a missing sky is added to ``unknown``."""
    pairs = list(given)
    sky = next((sky for sky, _ in pairs if sky is not None), None)
    isp: Isp = next((isp for _, isp in pairs if isp is not None), {})
    if sky is None:
        unknown.append("no sky: it is black")
        sky = np.zeros((6, 1, 1, 3), np.float32)
    return sky, isp


def _default_surroundings() -> dict[str, Any]:
    ahead = geometry.pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.0, 0, CAMERA_HEIGHT_M]))
    camera = CameraModel("camera", 1280, 720, Pinhole(640.0, 640.0, 640.0, 360.0), ahead)
    start_us = DEFAULT_SPAN_US[0]
    return {
        "rig": Rig({camera.id: camera}, {}),
        "ego": Trajectory(np.array([start_us]), np.eye(4)[None]),
        "tracks": [],
        "road_map": None,
        "span_us": DEFAULT_SPAN_US,
        "camera_times_us": {camera.id: np.array([[start_us, start_us]])},
    }
