"""Tracks from the labelled boxes of other data sets, which label frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from nurec_sim.errors import ClipError
from nurec_sim.logs.labels import IGNORED, is_movable, our_label
from nurec_sim.types import Matrix4, Track, Trajectory


@dataclass
class _Boxes:
    """The boxes of one track: its label, and pose and size by time."""

    label: str
    poses: dict[int, Matrix4] = field(default_factory=dict)
    sizes: list[tuple[float, float, float]] = field(default_factory=list)


class BoxTracks:
    """Groups boxes by their track ids, in any order of time."""

    def __init__(self) -> None:
        self._seen: dict[str, _Boxes] = {}

    def add(
        self,
        where: str,
        id: str,
        label: str,
        t_us: int,
        world_from_box: Matrix4,
        size_m: tuple[float, float, float],
    ) -> None:
        """Add a box; those with a label that says "do not care" are left out.

        Args:
            where: file and place, for messages.
            id: what all boxes of the object have in common.
            label: its class, as the data set names it; the first one of a track counts.
            t_us: time of the pose.
            world_from_box: pose of the centre, x forward, z up.
            size_m: length, width, height.

        Raises:
            ClipError: a size is not positive, or the track has a box at that time already.
        """
        if label.lower() in IGNORED:
            return
        if not all(0 < value < np.inf for value in size_m):
            raise ClipError(f"{where}: length, width and height must be positive, got {[float(v) for v in size_m]}")
        boxes = self._seen.setdefault(id, _Boxes(our_label(label)))
        if t_us in boxes.poses:
            raise ClipError(f"{where}: track {id!r} appears twice at {t_us} us")
        boxes.poses[t_us] = world_from_box
        boxes.sizes.append(size_m)

    def tracks(self) -> list[Track]:
        """The tracks, each with the median of its sizes."""
        return [_track(id, boxes) for id, boxes in self._seen.items()]


def _track(id: str, boxes: _Boxes) -> Track:
    times = sorted(boxes.poses)
    length, width, height = np.median(boxes.sizes, axis=0)
    return Track(
        id=id,
        label=boxes.label,
        size_m=(float(length), float(width), float(height)),
        path=Trajectory(np.array(times, np.int64), np.array([boxes.poses[t] for t in times])),
        controllable=is_movable(boxes.label),
    )
