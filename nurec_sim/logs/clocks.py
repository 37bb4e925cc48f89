"""Clocks of cameras, if a log has poses of images: pose and path tell when an image was taken, its stamp may not.

The clock of the path is that of sweeps and boxes. KITTI raw's cameras are triggered as the scanner faces ahead, and
their images have the pose of that moment, but stamps of some 10 ms later: at 50 km/h the car is 15 cm ahead then, and
so is what moves. Where all images of a camera are off alike, they get the times of their poses.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float64

from nurec_sim.logs.clip import Clip
from nurec_sim.types import Matrix4

SLOWEST_MPS = 2.0
"""Of a car that hardly moves, places do not tell times."""
FEWEST = 5
"""Images that must tell."""
LEAST_US, MOST_US = 1_000, 100_000
"""Offsets from the size of what is told apart by place up to a period of a camera; larger ones are other errors."""
ALIKE = 0.25
"""All images are off alike if offsets spread by less than this share of their median (median absolute deviations)."""
MOUNTING = 0.5
"""It is the mounting of the camera that is off if distances spread by less than this share of what times spread by."""
STEP_US = 20_000
"""Half of the time over which a speed is measured."""


def with_image_clocks(clip: Clip) -> Clip:
    """The log with the images of cameras whose clock is off at the times of their poses.

    What was found is noted in ``Clip.facts``, as a text for each camera.
    """
    found = {name: late_us for name in clip.rig.cameras if (late_us := _late_us(clip, name))}
    if not found:
        return clip
    images = {name: clip.image_records(name) for name in clip.rig.cameras}
    for name, late_us in found.items():
        images[name] = tuple(
            dataclasses.replace(record, start_us=record.start_us - late_us, end_us=record.end_us - late_us)
            for record in images[name]
        )
    moved = clip.replaced(images=images)
    for name, late_us in found.items():
        moved.facts[f"times_of_{name}"] = (
            f"are those of its poses, {abs(late_us) / 1000:.1f} ms {'before' if late_us > 0 else 'after'} its stamps"
        )
    return moved


def _late_us(clip: Clip, camera: str) -> int:
    """How much later than their poses all images of a camera are stamped, microseconds; 0 if not clearly."""
    records = clip.image_records(camera)
    t_us = np.array([(record.start_us + record.end_us) // 2 for record in records], np.int64)
    places = np.array([record.world_from_camera[:, :3, 3].mean(axis=0) for record in records]).reshape(-1, 3)
    # Poses that are no numbers are a fault that is told elsewhere.
    known = (
        (t_us - STEP_US >= clip.ego.start_us) & (t_us + STEP_US <= clip.ego.end_us) & np.isfinite(places).all(axis=1)
    )
    if np.count_nonzero(known) < FEWEST:
        return 0
    t_us, places = t_us[known], places[known]
    late_us, speed_mps = np.zeros(len(places)), np.zeros(len(places))
    mounting = clip.rig.cameras[camera].rig_from_camera
    for _ in range(2):  # Newton's method; the path is all but straight in between
        off_us, speed_mps = _behind(clip, mounting, t_us - np.round(late_us).astype(np.int64), places)
        late_us = np.clip(late_us + off_us, -2 * MOST_US, 2 * MOST_US)
    driving = speed_mps >= SLOWEST_MPS
    if np.count_nonzero(driving) < FEWEST:
        return 0
    late_us, late_m = late_us[driving], late_us[driving] * speed_mps[driving]
    middle, spread = _spread(late_us)
    if not LEAST_US <= abs(middle) <= MOST_US or spread > ALIKE or _spread(late_m)[1] < MOUNTING * spread:
        return 0
    return round(middle)


def _spread(values: Float64[np.ndarray, " n"]) -> tuple[float, float]:
    """The median, and the median absolute deviation as a share of it."""
    middle = float(np.median(values))
    return middle, float(np.median(np.abs(values - middle))) / max(abs(middle), 1e-9)


def _behind(
    clip: Clip, rig_from_camera: Matrix4, t_us: np.ndarray, places: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """How long before it is where the path has it at some times a camera was at the places, us, and its speed, m/s."""
    before, there, after = (
        (clip.ego.at(np.clip(t_us + step, clip.ego.start_us, clip.ego.end_us)) @ rig_from_camera)[:, :3, 3]
        for step in (-STEP_US, 0, STEP_US)
    )
    velocity = (after - before) / (2e-6 * STEP_US)
    square = np.maximum((velocity**2).sum(axis=1), 1e-12)
    return ((there - places) * velocity).sum(axis=1) / square * 1e6, np.sqrt(square)
