"""The tree of coordinate frames of a ROS 2 bag: transforms of /tf and /tf_static, and odometry.

Their conventions: a transform holds the pose of the child in its parent; quaternions are x, y, z, w.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.types import Matrix4, Trajectory

WORLDS = ("map", "odom", "world")


@dataclass
class _Edge:
    parent: str
    poses: dict[int, Matrix4] = field(default_factory=dict)
    fixed: Matrix4 | None = None
    path: Trajectory | None = None


class Frames:
    """Poses of frames in one another."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}

    def add(self, parent: str, child: str, position: Any, rotation: Any, t_us: int | None) -> None:
        """Add the pose of a frame in its parent.

        Args:
            parent: the frame that it is given in.
            child: the frame.
            position: with x, y, z.
            rotation: with x, y, z, w.
            t_us: its time; None if it holds always.

        Raises:
            ClipError: the quaternion is zero, or a number not finite.
        """
        parent, child = parent.strip("/"), child.strip("/")
        quat = np.array([rotation.w, rotation.x, rotation.y, rotation.z], np.float64)
        place = np.array([position.x, position.y, position.z], np.float64)
        if not (np.isfinite(place).all() and 1e-6 < np.linalg.norm(quat) < np.inf):
            raise ClipError(f"the transform from {child!r} to {parent!r} is not a rotation and a position")
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent:
            edge = self._edges[child] = _Edge(parent)
        pose = geometry.pose(geometry.matrix_from_quat(quat), place)
        if t_us is None:
            edge.fixed = pose
        else:
            edge.poses[t_us] = pose
            edge.path = None

    def replace(self, child: str, parent: str) -> None:
        """Drop what is known about a frame's pose, for it is now given in another parent."""
        self._edges[child.strip("/")] = _Edge(parent.strip("/"))

    @property
    def names(self) -> list[str]:
        """All frames."""
        return sorted({*self._edges, *(edge.parent for edge in self._edges.values())})

    def above(self, frame: str) -> list[str]:
        """The frame, its parent, and so on up to the root.

        Raises:
            ClipError: the frames form a loop.
        """
        found = [frame]
        while found[-1] in self._edges:
            parent = self._edges[found[-1]].parent
            if parent in found:
                raise ClipError(f"the transforms form a loop: {' -> '.join([*found, parent])}")
            found.append(parent)
        return found

    def pose(self, parent: str, child: str, t_us: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 4 4"]:
        """Poses of one frame in another; before the first and after the last known pose, that one holds.

        Raises:
            ClipError: they are not connected.
        """
        up, down = self.above(parent), self.above(child)
        if up[-1] != down[-1]:
            raise ClipError(f"no transforms lead from frame {child!r} to {parent!r}; frames are {self.names}")
        return geometry.inverse(self._from_root(up, t_us)) @ self._from_root(down, t_us)

    def _from_root(self, chain: list[str], t_us: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 4 4"]:
        poses = np.tile(np.eye(4), (len(t_us), 1, 1))
        for frame in chain[:-1]:
            path = self._path(self._edges[frame])
            poses = (path if isinstance(path, np.ndarray) else path.at(t_us)) @ poses
        return poses

    @staticmethod
    def _path(edge: _Edge) -> Matrix4 | Trajectory:
        if edge.fixed is not None:
            return edge.fixed
        if edge.path is None:
            times = sorted(edge.poses)
            edge.path = Trajectory(np.array(times, np.int64), np.array([edge.poses[t] for t in times]))
        return edge.path

    def trajectory(self, world: str, base: str) -> Trajectory:
        """The path of a frame, at all times at which one of the transforms to the world is known.

        Raises:
            ClipError: they are not connected, or nothing moves between them.
        """
        up, down = self.above(world), self.above(base)
        moving = [self._path(self._edges[frame]) for frame in {*up, *down} - ({*up} & {*down})]
        paths = [path for path in moving if isinstance(path, Trajectory)]
        if up[-1] == down[-1] and not paths:
            raise ClipError(f"frame {base!r} does not move in {world!r}; name the topic of its poses under 'poses'")
        start, end = max([p.start_us for p in paths], default=0), min([p.end_us for p in paths], default=0)
        times = np.unique(np.concatenate([path.t_us for path in paths])) if paths else np.zeros(1, np.int64)
        times = times[(times >= start) & (times <= end)]
        if paths and len(times) == 0:
            raise ClipError(f"the transforms between {world!r} and {base!r} have no time in common")
        return Trajectory(times, self.pose(world, base, times))
