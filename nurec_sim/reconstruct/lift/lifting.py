"""Pixels lifted to points: every surface is taken from the view that saw it from nearest, and coloured by that view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, UInt8

from nurec_sim.compute.kernels import inner, kernel
from nurec_sim.reconstruct.lift.blocks import painted
from nurec_sim.reconstruct.lift.bodies import LEVEL
from nurec_sim.reconstruct.lift.splat import project_point
from nurec_sim.reconstruct.lift.views import WorkingView
from nurec_sim.types.rows import rows_of

STATIC, NOBODY = -1, -2
OWNER_RING = 0.1
"""Views own by rings of distance, each larger by exp of this."""
MIXING = 0.3
"""Weight of another view's colour for a surface, next to 1 for the owner's."""
AGREEING = 0.03
"""Share by which inverse depths of a point may differ besides: who owns a point by more would show another place."""
FARTHER = 1.5
"""Views this many times as far away as the own view resolve a surface too badly to be asked about it as others are."""
HIDING = 2
"""So many views that see something in front of a matched point drop it, if none agrees with it."""
GRAZING = 0.1
"""Sine of the angle between ray and surface under which a view loses to others that see the surface better: a camera
that passes a corner sees the wall behind it from nearest, but in a few columns of pixels, each a metre of wall."""
BETWEEN = 0.05
"""Share by which inverse depths of one surface differ between two rows of beams."""
OWNER_BORDER = 0.04
"""Views own nothing in this part of their width at the border, where nothing checks their depth."""


@dataclass(frozen=True)
class Lifted:
    """Points lifted from views, in the frame of their body: world or box. Each stands for a block of pixels.

    ``ray`` is the unit direction from the camera, ``depth_m`` the depth along its axis, ``pixel_m`` the width of the
    block there, ``surfel`` the row of a surfel that gave depth to it, or -1, ``pixel`` the index of its first pixel in
    the picture of ``view``, row by row, ``edge`` its number of rows and of columns.
    """

    xyz_m: Float64[np.ndarray, "n 3"]
    normal: Float64[np.ndarray, "n 3"]
    ray: Float64[np.ndarray, "n 3"]
    depth_m: Float64[np.ndarray, " n"]
    pixel_m: Float64[np.ndarray, " n"]
    rgb: Float32[np.ndarray, "n 3"]
    surfel: Int32[np.ndarray, " n"]
    view: Int32[np.ndarray, " n"]
    pixel: Int32[np.ndarray, " n"]
    edge: UInt8[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.xyz_m)

    def __getitem__(self, index: np.ndarray | slice) -> Lifted:
        return Lifted(*rows_of((getattr(self, name) for name in self.__dataclass_fields__), index))

    @classmethod
    def empty(cls) -> Lifted:
        """No points."""
        vector, number, index = np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int32)
        colour, edge = np.zeros((0, 3), np.float32), np.zeros(0, np.uint8)
        return cls(vector, vector, vector, number, number, colour, index, index, index, edge)

    @classmethod
    def concatenate(cls, parts: Sequence[Lifted]) -> Lifted:
        """All points one after the other."""
        return cls(*(np.concatenate([getattr(p, name) for p in parts]) for name in cls.__dataclass_fields__))


def rays_of(view: WorkingView) -> Float64[np.ndarray, "h w 3"]:
    """Rays through the pixel centres with depth 1, in the view's frame."""
    tile = view.tile
    u, v = np.meshgrid(np.arange(tile.width) + 0.5, np.arange(tile.height) + 0.5)
    return np.stack(
        [(u - tile.center_px[0]) / tile.focal_px, (v - tile.center_px[1]) / tile.focal_px, np.ones_like(u)], axis=-1
    )


def points_of(view: WorkingView, inverse_depth: Float32[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w 3"]:
    """World points of all pixels; pixels at infinity lie at 1000 m."""
    return _points(view.packed, view.world_from_view, inverse_depth)


@kernel
def _points(view, world_from_view, inverse_depth):
    """``points_of`` a packed view."""
    height, width = inverse_depth.shape
    points, m = np.empty((height, width, 3)), world_from_view
    for row in range(height):
        for column in range(width):
            u, v, w = column + 0.5, row + 0.5, np.float64(inverse_depth[row, column])
            depth = 1.0 / (1e-3 if w < 1e-3 else w)  # NaN stays
            f = min(max(view[20] * u + view[21] * v + view[22], -0.5), 0.5)
            x = (u - view[1]) / view[0] * depth + f * view[17]
            y = (v - view[2]) / view[0] * depth + f * view[18]
            z = depth + f * view[19]
            for k in range(3):
                points[row, column, k] = m[k, 0] * x + m[k, 1] * y + m[k, 2] * z + m[k, 3]
    return points


def normals_of(view: WorkingView, inverse_depth: Float32[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w 3"]:
    """World normals from the depth of neighbouring pixels; where these lie on other surfaces, facing the camera.

    In inverse depth a plane is linear in the pixel: w = n.ray / d, so its gradient gives the normal without noise
    growing with distance.
    """
    return _normals(view.packed, view.world_from_view, inverse_depth)


@kernel
def _normals(view, world_from_view, inverse_depth):
    """``normals_of`` a packed view."""
    height, width = inverse_depth.shape
    normals, m, focal = np.empty((height, width, 3)), world_from_view, view[0]
    for row in range(height):
        above, below = max(row - 2, 0), min(row + 2, height - 1)
        for column in range(width):
            w = np.float64(inverse_depth[row, column])
            # Central differences over four pixels: a shorter baseline would show the noise of matched depth.
            left = np.float64(inverse_depth[row, max(column - 2, 0)])
            right = np.float64(inverse_depth[row, min(column + 2, width - 1)])
            upper, lower = np.float64(inverse_depth[above, column]), np.float64(inverse_depth[below, column])
            slope_u, slope_v = (right - left) / 4 * focal, (lower - upper) / 4 * focal
            ray_x, ray_y = (column + 0.5 - view[1]) / focal, (row + 0.5 - view[2]) / focal
            x, y, z = slope_u, slope_v, w - slope_u * ray_x - slope_v * ray_y
            size = np.sqrt(x * x + y * y + z * z)
            # The second difference is zero on a plane and large across an edge of depth.
            flat = abs(right + left - 2 * w) < 0.05 * w and abs(lower + upper - 2 * w) < 0.05 * w
            if not (flat and size > 1e-9):
                x, y, z = ray_x, ray_y, 1.0
                size = np.sqrt(x * x + y * y + 1.0)
            x, y, z = x / size, y / size, z / size
            for k in range(3):
                normals[row, column, k] = -m[k, 0] * x + -m[k, 1] * y + -m[k, 2] * z
    return normals


@kernel
def between_measured(inverse_depth, measured):
    """Pixels [h,w] as far away as the next measured ones above and below them, within ``BETWEEN``.

    Args:
        inverse_depth: [h,w], 1/m.
        measured: [h,w] whether a surfel gave it.
    """
    height, width = measured.shape
    found = np.zeros((height, width), np.bool_)
    for column in range(width):
        above = -1
        for row in range(height):
            if not measured[row, column]:
                continue
            if above >= 0:
                upper, lower = inverse_depth[above, column], inverse_depth[row, column]
                for k in range(above + 1, row):
                    here = inverse_depth[k, column]
                    near = BETWEEN * here
                    found[k, column] = abs(here - upper) < near and abs(here - lower) < near
            above = row
    return found


@inner
def _owner_distance(views, k, xyz, normal, z, actor):
    """Depth ``z`` of a point in a view, larger where the view sees its surface obliquely.

    In the static world that is from less than ``GRAZING``. Views of actors are compared by the areas of their pixels on
    the surface, z^2 over the sine: a car that turns shows its side across the view first, and along it when it is near.
    On level ground it is the depth: pixels are longest where they are farthest, so the nearest view sees it best.
    """
    if abs(normal[2]) > LEVEL:
        return z
    a = views[k, 5] * xyz[0] + views[k, 6] * xyz[1] + views[k, 7] * xyz[2] + views[k, 14]
    b = views[k, 8] * xyz[0] + views[k, 9] * xyz[1] + views[k, 10] * xyz[2] + views[k, 15]
    c = views[k, 11] * xyz[0] + views[k, 12] * xyz[1] + views[k, 13] * xyz[2] + views[k, 16]
    across = normal[0] * (views[k, 5] * a + views[k, 8] * b + views[k, 11] * c)
    across += normal[1] * (views[k, 6] * a + views[k, 9] * b + views[k, 12] * c)
    across += normal[2] * (views[k, 7] * a + views[k, 10] * b + views[k, 13] * c)
    sine = abs(across) / np.sqrt(a * a + b * b + c * c)
    sine = max(sine, 1e-3)
    return z / np.sqrt(sine) if actor else z * max(1.0, GRAZING / sine)


@kernel
def owned(
    xyz,
    normal,
    depth,
    own_view,
    matched,
    rgb,
    packed,
    inverse_depth,
    owns,
    pictures,
    present,
    tolerance,
    ring,
    border,
    actor,
):
    """Which points no other view owns, and that few views look through.

    The owner of a surface is the view in the nearest ring of distance (``_owner_distance``), rings growing by the
    factor ``exp(ring)``, and the first of these; a strict order, so that exactly one view owns it. A view agrees with a
    point that projects well inside it if its inverse depth there is the same within ``tolerance`` plus ``AGREEING``; it
    looks through the point if it is smaller. Points are dropped if more than half as many views look through them as
    agree. Matched points that no other view agrees with are dropped if any view looks through them, from however far:
    wrong depth at the edges of trees puts points in front of the sky, which often only views from farther back see
    past. They are dropped as well if ``HIDING`` views see something in front of them: depth that is matched too far
    hides behind the true surface from all views along the path, and would hang beside it as a dot for a camera that is
    turned or moved aside.

    Args:
        xyz: [n,3] points in the body's frame, metres.
        normal: [n,3] their unit normals there.
        depth: [n] depth in their own view, metres.
        own_view: [n] index of that view.
        matched: [n] whether only matching tells the depth; only then views from ``FARTHER`` are asked.
        rgb: [n,3] colours 0..255; changed: those of kept points are mixed with the colours that agreeing views show,
            weighted by nearness, which evens out exposure drift and reflections.
        packed: [k,23] projections from the points' frame into the views.
        inverse_depth: [k,h,w] of the views, 1/m; NaN where a pixel is masked.
        owns: [k,h,w] pixels of the views that may own; the others only agree or look through.
        pictures: [k,h,w,3] colours of the views, 0..255.
        present: [k] whether the body is there at each view's time.
        tolerance: 1/m, see above.
        ring: logarithm of the factor between rings of distance.
        border: share of a view's width at its border in which it owns nothing.
        actor: whether the body is one (``_owner_distance``).

    Returns:
        [n] True where the point stays.
    """
    keep, mixed = np.ones(len(xyz), np.bool_), np.empty(3, np.float32)
    for i in range(len(xyz)):
        agree, through, hidden, total = 0, 0, 0, 1.0
        far_agree, far_through = 0, 0
        # Rings instead of plain distance: neighbouring pixels then share one owner, and the surface does not become a
        # patchwork of views with slightly different depth.
        own_distance = _owner_distance(packed, own_view[i], xyz[i], normal[i], depth[i], actor)
        own_ring = np.floor(np.log(own_distance) / ring)
        for c in range(3):
            mixed[c] = rgb[i, c]
        # From the next view on: where another view owns the point, it is most often this one, which is nearer.
        for step in range(1, len(packed)):
            k = (own_view[i] + step) % len(packed)
            if not present[k]:
                continue
            u, v, z = project_point(packed, k, xyz[i, 0], xyz[i, 1], xyz[i, 2])
            if z <= 0.3 or u < 0 or v < 0 or u >= packed[k, 3] or v >= packed[k, 4]:
                continue
            farther = z > FARTHER * depth[i]
            if farther and not matched[i]:
                continue
            here, w = 1.0 / z, inverse_depth[k, int(v), int(u)]
            agrees = abs(w - here) < tolerance + AGREEING * here
            if farther:
                far_agree += agrees
                far_through += not agrees and w < here
            elif agrees:
                agree += 1
                width, height = packed[k, 3], packed[k, 4]
                margin = border * width
                inside = margin < u < width - margin and 0.5 * margin < v < height - 0.5 * margin
                owner = inside and owns[k, int(v), int(u)]
                if owner:
                    distance = _owner_distance(packed, k, xyz[i], normal[i], z, actor)
                    if (np.floor(np.log(distance) / ring), k) < (own_ring, own_view[i]):
                        keep[i] = False
                        break
                # Views from farther resolve the surface less: by the area of their pixels on it.
                share = MIXING * (depth[i] / z) ** 2
                total += share
                for c in range(3):
                    mixed[c] += share * pictures[k, int(v), int(u), c]
            elif w < here:
                through += 1
            elif w > here:  # not where it is NaN
                hidden += 1
        if 2 * through > agree:
            keep[i] = False
        elif matched[i] and agree + far_agree == 0 and (far_through > 0 or hidden >= HIDING):
            keep[i] = False
        if keep[i]:
            for c in range(3):
                rgb[i, c] = mixed[c] / total
    return keep


def owning(
    bodies: Sequence[Int32[np.ndarray, "h w"]], pixels: Lifted, kept: Bool[np.ndarray, " n"]
) -> list[Bool[np.ndarray, "h w"]]:
    """Pixels of each view that own: of this body those of blocks that were kept, of other bodies all.

    Args:
        bodies: of each view: the body that each pixel shows.
        pixels: all lifted blocks of one body.
        kept: which of them are still there.
    """
    masks, number = [], None
    if len(pixels):
        number = bodies[pixels.view[0]].flat[pixels.pixel[0]]
    for k, body in enumerate(bodies):
        mine = kept & (pixels.view == k)
        masks.append((body != number) | painted(*body.shape, pixels.pixel[mine], pixels.edge[mine]))
    return masks


def stacked(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Pictures of different sizes in one array, padded at the right and the bottom."""
    height, width = max(p.shape[0] for p in pictures), max(p.shape[1] for p in pictures)
    result = np.zeros((len(pictures), height, width, *pictures[0].shape[2:]), pictures[0].dtype)
    for k, picture in enumerate(pictures):
        result[k, : picture.shape[0], : picture.shape[1]] = picture
    return result
