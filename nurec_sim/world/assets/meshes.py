"""A small triangle-mesh builder: quads, lattices, boxes, cylinders and walls with texture coordinates.

Front faces wind counter-clockwise; OpenGL culls back faces, so a wrong winding shows as a hole.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import ArrayLike

from nurec_sim.types import Matrix4

Corners = tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 2"]]
"""Positions, unit normals and texture coordinates of triangle corners, three per triangle."""
UNIT_SQUARE = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))


def _unit_box() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners of the six sides of a cube, four each; texture places of the corners; the axes along u and v."""
    corners, axes = [], []
    for axis in range(3):
        for sign in (-1, 1):
            u, w = (axis + 1) % 3, (axis + 2) % 3
            middle, along_u, along_w = sign * np.eye(3)[axis], sign * np.eye(3)[u], np.eye(3)[w]
            corners += [middle + a * along_u + b * along_w for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            axes += [(u, w)] * 4
    return np.array(corners), np.tile(np.array(UNIT_SQUARE), (6, 1)), np.array(axes)


_BOX_CORNERS, _BOX_UV, _BOX_AXES = _unit_box()
_BOX_FACES = (4 * np.arange(6)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)


class MeshBuilder:
    """Collects triangles; ``corners`` returns them with normals smoothed below a crease angle."""

    def __init__(self) -> None:
        self._points: list[np.ndarray] = []
        self._uv: list[np.ndarray] = []
        self._faces: list[np.ndarray] = []
        self._normals: list[np.ndarray] = []
        self._count = 0

    @property
    def empty(self) -> bool:
        """Whether nothing was added."""
        return self._count == 0

    @property
    def points(self) -> Float64[np.ndarray, "n 3"]:
        """All vertices."""
        return np.concatenate(self._points)

    def transform(self, scale: np.ndarray, shift: np.ndarray) -> None:
        """Scales about the origin, then translates, all current vertices."""
        self._points = [points * scale + shift for points in self._points]

    def add(self, points: ArrayLike, faces: ArrayLike, uv: ArrayLike, normals: ArrayLike | None = None) -> None:
        """Adds triangles.

        Args:
            points: [n,3] vertices.
            faces: [m,3] indices of vertices, counter-clockwise seen from the front.
            uv: [n,2] texture coordinates.
            normals: [n,3] unit normals that replace smoothed ones, or None.
        """
        vertices = np.asarray(points, np.float64)
        self._points.append(vertices)
        self._uv.append(np.asarray(uv, np.float64))
        self._faces.append(np.asarray(faces, np.int64) + self._count)
        # NaN marks normals to be computed by `corners`.
        self._normals.append(np.full_like(vertices, np.nan) if normals is None else np.asarray(normals, np.float64))
        self._count += len(vertices)

    def extend(self, other: MeshBuilder, pose: Matrix4 | None = None) -> None:
        """Everything of another mesh, moved by a rigid ``pose``."""
        turn, shift = (np.eye(3), np.zeros(3)) if pose is None else (pose[:3, :3], pose[:3, 3])
        for points, faces, uv, normals in zip(other._points, other._faces, other._uv, other._normals, strict=True):
            self._points.append(points @ turn.T + shift)
            self._uv.append(uv)
            self._faces.append(faces + self._count)
            self._normals.append(normals @ turn.T)
        self._count += other._count

    def shrink_texture(self, part: float) -> None:
        """Moves all texture coordinates into the first ``part`` of the texture, which is uniform."""
        self._uv = [np.mod(uv, 1.0) * part for uv in self._uv]

    def warp(self, move: Callable[[Float64[np.ndarray, "n 3"]], Float64[np.ndarray, "n 3"]]) -> None:
        """Displaces every vertex, for example to follow the terrain."""
        self._points = [move(points) for points in self._points]

    def quad(self, a: ArrayLike, b: ArrayLike, c: ArrayLike, d: ArrayLike, uv: ArrayLike = UNIT_SQUARE) -> None:
        """One quad, counter-clockwise seen from its front.

        Args:
            a: first corner [3].
            b: second corner.
            c: third corner.
            d: fourth corner.
            uv: [4,2] texture coordinates; the whole texture by default.
        """
        self.add(np.array([a, b, c, d], np.float64), [[0, 1, 2], [0, 2, 3]], uv)

    def grid(self, lattice: Float64[np.ndarray, "n m 3"], uv: Float64[np.ndarray, "n m 2"] | None = None) -> None:
        """A lattice of quads whose front is along d/dn x d/dm."""
        n, m = lattice.shape[:2]
        if uv is None:
            uv = np.stack(np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, m), indexing="ij"), axis=-1)
        index = np.arange(n * m).reshape(n, m)
        a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
        faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
        self.add(lattice.reshape(-1, 3), faces, uv.reshape(-1, 2))

    def box(self, center: ArrayLike, half: ArrayLike, uv_per_m: float = 1.0) -> None:
        """An axis-aligned box."""
        half = np.asarray(half, np.float64)
        points = _BOX_CORNERS * half + np.asarray(center, np.float64)
        uv = _BOX_UV * 2 * uv_per_m * np.stack([half[_BOX_AXES[:, 0]], half[_BOX_AXES[:, 1]]], axis=1)
        self.add(points, _BOX_FACES, uv)

    def block(self, low: ArrayLike, high: ArrayLike) -> None:
        """An axis-aligned box between two corners; each of its sides shows the whole texture, upright."""
        (x0, y0, z0), (x1, y1, z1) = np.asarray(low, np.float64), np.asarray(high, np.float64)
        self.quad([x0, y0, z0], [x1, y0, z0], [x1, y0, z1], [x0, y0, z1])
        self.quad([x1, y1, z0], [x0, y1, z0], [x0, y1, z1], [x1, y1, z1])
        self.quad([x1, y0, z0], [x1, y1, z0], [x1, y1, z1], [x1, y0, z1])
        self.quad([x0, y1, z0], [x0, y0, z0], [x0, y0, z1], [x0, y1, z1])
        self.quad([x0, y0, z1], [x1, y0, z1], [x1, y1, z1], [x0, y1, z1])
        self.quad([x0, y1, z0], [x1, y1, z0], [x1, y0, z0], [x0, y0, z0])

    def cylinder(
        self,
        start: ArrayLike,
        end: ArrayLike,
        radius: float,
        end_radius: float | None = None,
        sides: int = 12,
        capped: bool = True,
        side_uv: float = 1.0,
    ) -> None:
        """A cylinder or cone between two points.

        Args:
            start: centre of the first end [3].
            end: centre of the second end [3].
            radius: at the start.
            end_radius: at the end; as at the start if None.
            sides: number of quads around.
            capped: whether the ends are closed.
            side_uv: the side shows this fraction of the texture from its corner on; caps show all of it.
        """
        start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
        radii = (radius, radius if end_radius is None else end_radius)
        axis = (end - start) / np.linalg.norm(end - start)
        # Any direction across the axis; the helper vector must not be parallel to it.
        side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
        side /= np.linalg.norm(side)
        angle = np.linspace(0, 2 * np.pi, sides + 1)
        ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(axis, side)
        around = np.stack(np.meshgrid(np.linspace(0, 1, sides + 1), [0.0, 1.0], indexing="ij"), axis=-1)
        self.grid(np.stack([start + radii[0] * ring, end + radii[1] * ring], axis=1), around * side_uv)
        for center, r, sign in ((start, radii[0], -1), (end, radii[1], 1)):
            if capped and r > 1e-4:
                fan = [[0, i, i + 1][::sign] if sign < 0 else [0, i, i + 1] for i in range(1, sides - 1)]
                disc = np.stack([np.cos(angle), np.sin(angle)], axis=1)[:-1] * 0.5 + 0.5
                self.add(center + r * ring[:-1], fan, disc)

    def wall(
        self, outline: ArrayLike, low_m: float, high_m: float, u_per_m: float, v_low: float, v_high: float
    ) -> None:
        """Vertical quads along a polyline; their front is on its right (outside of a counter-clockwise ring).

        Args:
            outline: [n,2] vertices of the line.
            low_m: height of the lower edge.
            high_m: height of the upper edge.
            u_per_m: texture tiles per metre along the line.
            v_low: texture coordinate of the lower edge.
            v_high: texture coordinate of the upper edge.
        """
        outline = np.asarray(outline, np.float64)
        u = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))]) * u_per_m
        for (a, b), (ua, ub) in zip(zip(outline[:-1], outline[1:], strict=True), zip(u[:-1], u[1:], strict=True),
                                    strict=True):  # fmt: skip
            self.quad([*a, low_m], [*b, low_m], [*b, high_m], [*a, high_m],
                      [[ua, v_low], [ub, v_low], [ub, v_high], [ua, v_high]])  # fmt: skip

    def corners(self, crease_deg: float) -> Corners:
        """Positions, unit normals and texture coordinates of every triangle corner, three per triangle.

        A corner's normal averages the faces at its position that bend less than ``crease_deg`` from its own.
        """
        points, uv, faces = np.concatenate(self._points), np.concatenate(self._uv), np.concatenate(self._faces)
        normal = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
        area = np.linalg.norm(normal, axis=1)
        # Degenerate triangles have no normal.
        faces, normal, area = faces[area > 1e-9], normal[area > 1e-9], area[area > 1e-9]
        place = points[faces].reshape(-1, 3)
        smooth = np.repeat(normal / area[:, None], 3, axis=0)
        if crease_deg > 0:
            smooth = _smoothed(place, smooth, smooth * _corner_angles(place)[:, None], np.cos(np.deg2rad(crease_deg)))
        given = np.concatenate(self._normals)[faces].reshape(-1, 3)
        return place, np.where(np.isnan(given), smooth, given), uv[faces].reshape(-1, 2)


def _corner_angles(place: np.ndarray) -> np.ndarray:
    """Angle of each triangle at each of its corners: weights independent of the triangulation of quads."""
    corner = place.reshape(-1, 3, 3)
    ahead, back = np.roll(corner, -1, axis=1) - corner, np.roll(corner, 1, axis=1) - corner
    lengths = np.linalg.norm(ahead, axis=2) * np.linalg.norm(back, axis=2)
    return np.arccos(np.clip(np.einsum("nci,nci->nc", ahead, back) / np.maximum(lengths, 1e-12), -1, 1)).ravel()


def _smoothed(place: np.ndarray, own: np.ndarray, weighted: np.ndarray, limit: float) -> np.ndarray:
    """Each corner's normal averaged over those at its position whose cosine to its own exceeds ``limit``."""
    # Corners within 0.1 mm count as one vertex. The spatial hash of Teschner et al. (2003) makes one number of its grid
    # cell, with products summed.
    grid = np.round(place * 1e4).astype(np.int64)
    key = grid @ np.array([73856093, 19349663, 83492791], np.int64)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.concatenate([[True], np.diff(key[order]) != 0]))
    count = np.diff(np.concatenate([first, [len(order)]]))
    # Every corner is compared with all corners of its vertex: a flat list of (corner, partner) pairs, sorted by corner.
    many = np.repeat(count, count)
    start = np.cumsum(many) - many  # of each corner's run of partners
    partner = np.arange(many.sum()) - np.repeat(start - np.repeat(first, count), many)
    own, weighted = own[order], weighted[order]
    alike = np.einsum("ij,ij->i", np.repeat(own, many, axis=0), own[partner]) > limit
    total = np.add.reduceat(weighted[partner] * alike[:, None], start, axis=0)
    smooth = np.empty_like(total)
    smooth[order] = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    return smooth


@functools.cache
def icosphere(subdivisions: int) -> tuple[Float64[np.ndarray, "n 3"], Int64[np.ndarray, "m 3"]]:
    """A unit sphere of near-equal triangles."""
    # The golden ratio: vertices of an icosahedron.
    t = (1 + 5**0.5) / 2
    points = np.array([[-1, t, 0], [1, t, 0], [-1, -t, 0], [1, -t, 0], [0, -1, t], [0, 1, t],
                       [0, -1, -t], [0, 1, -t], [t, 0, -1], [t, 0, 1], [-t, 0, -1], [-t, 0, 1]])  # fmt: skip
    faces = np.array([[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4], [11, 10, 2],
                      [10, 7, 6], [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9], [4, 9, 5],
                      [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1]])  # fmt: skip
    points = points / np.linalg.norm(points[0])
    for _ in range(subdivisions):
        # Every face becomes four; edges are shared, so each midpoint is created once and moved onto the sphere.
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        unique, index = np.unique(edges, axis=0, return_inverse=True)
        middle = points[unique].mean(axis=1)
        middle /= np.linalg.norm(middle, axis=1, keepdims=True)
        ab, bc, ca = np.split(index.ravel() + len(points), 3)
        a, b, c = faces.T
        faces = np.concatenate([np.stack(f, axis=1) for f in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
        points = np.concatenate([points, middle])
    return points, faces
