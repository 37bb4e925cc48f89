"""Rigid transforms, rotations, interpolation, boxes, polygons and cubemaps; numpy only."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Int64

BLOCK = 8192
"""So many points are transformed at once."""

# ------------------------------------------------------------------------------------------------------- rotations


def quat_normalize(quat_wxyz: Float64[np.ndarray, "*n 4"]) -> Float64[np.ndarray, "*n 4"]:
    """Unit quaternions with w >= 0.

    Raises:
        ValueError: a quaternion is zero or not finite.
    """
    quat = np.asarray(quat_wxyz, np.float64)
    norm = np.linalg.norm(quat, axis=-1, keepdims=True)
    if not np.isfinite(norm).all() or (norm < 1e-12).any():
        raise ValueError("a quaternion must be finite and not zero")
    quat = quat / norm
    # q and -q are the same rotation; w >= 0 makes equal rotations compare equal.
    return np.where(quat[..., :1] < 0, -quat, quat)


def quat_multiply(a: Float64[np.ndarray, "*n 4"], b: Float64[np.ndarray, "*n 4"]) -> Float64[np.ndarray, "*n 4"]:
    """Hamilton product: the rotation b followed by a."""
    aw, ax, ay, az = np.moveaxis(np.asarray(a, np.float64), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(b, np.float64), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def matrix_from_quat(quat_wxyz: Float64[np.ndarray, "*n 4"]) -> Float64[np.ndarray, "*n 3 3"]:
    """Rotation matrices of quaternions, which need not be normalised."""
    w, x, y, z = np.moveaxis(quat_normalize(quat_wxyz), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quat_from_matrix(rotation: Float64[np.ndarray, "*n 3 3"]) -> Float64[np.ndarray, "*n 4"]:
    """Unit quaternions (w >= 0) of rotation matrices, by the largest diagonal term (Shepperd)."""
    m = np.asarray(rotation, np.float64)
    d0, d1, d2 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    # Row k of `candidates` is 4 * q[k] * q; its norm is largest, hence best conditioned, for the largest |q[k]|.
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    candidates = np.stack(
        [
            np.stack([1 + d0 + d1 + d2, a, b, c], axis=-1),
            np.stack([a, 1 + d0 - d1 - d2, d, e], axis=-1),
            np.stack([b, d, 1 - d0 + d1 - d2, f], axis=-1),
            np.stack([c, e, f, 1 - d0 - d1 + d2], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(np.diagonal(candidates, axis1=-2, axis2=-1), axis=-1)
    quat = np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    return quat_normalize(quat)


def slerp(
    a: Float64[np.ndarray, "*n 4"], b: Float64[np.ndarray, "*n 4"], fraction: Float64[np.ndarray, "*n"]
) -> Float64[np.ndarray, "*n 4"]:
    """Spherical interpolation along the shorter arc."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    fraction = np.asarray(fraction, np.float64)[..., None]
    dot = np.sum(a * b, axis=-1, keepdims=True)
    # q and -q are one rotation: of both arcs to it, the shorter one.
    b = np.where(dot < 0, -b, b)
    # |b - a| keeps the angle accurate where arccos of the dot product would lose it.
    angle = 2 * np.arcsin(np.clip(np.linalg.norm(b - a, axis=-1, keepdims=True) / 2, 0.0, 1.0))
    # sin(angle) vanishes for equal rotations; there the weights go over into linear ones.
    small = angle < 1e-9
    sine = np.where(small, 1.0, np.sin(angle))
    wa = np.where(small, 1 - fraction, np.sin((1 - fraction) * angle) / sine)
    wb = np.where(small, fraction, np.sin(fraction * angle) / sine)
    return quat_normalize(wa * a + wb * b)


def rotation_from_yaw(yaw_rad: float) -> Float64[np.ndarray, "3 3"]:
    """Rotation about z."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def yaw_of(rotation_or_pose: Float64[np.ndarray, "*n r r"]) -> Float64[np.ndarray, "*n"]:
    """Heading of the x axis in the xy plane."""
    m = np.asarray(rotation_or_pose, np.float64)
    return np.arctan2(m[..., 1, 0], m[..., 0, 0])


def wrap_angle(angle_rad: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
    """The same angle in [-pi, pi)."""
    return (np.asarray(angle_rad, np.float64) + np.pi) % (2 * np.pi) - np.pi


def is_rotation(rotation: Float64[np.ndarray, "3 3"], tolerance: float = 1e-3) -> bool:
    """Whether a matrix is orthonormal and right-handed within ``tolerance``."""
    m = np.asarray(rotation, np.float64)
    return m.shape == (3, 3) and bool(np.all(are_rotations(m[None], tolerance)))


def are_rotations(rotations: Float64[np.ndarray, "n 3 3"], tolerance: float = 1e-3) -> Bool[np.ndarray, " n"]:
    """``is_rotation`` of many matrices."""
    # Elementwise over all matrices, each entry one array: numpy's matmul, det and reductions of many small matrices
    # take ten times as long.
    m = np.array(np.asarray(rotations, np.float64).transpose(1, 2, 0), order="C")
    # First the magnitude, so that nothing below overflows; false for NaN. Entries of a rotation are at most 1.
    sound = np.asarray((np.abs(m) < 2).all(axis=(0, 1)))
    a, b, c = rows = np.where(sound, m, 0.0)
    # Rows must be orthonormal: m m^T = identity, of which the lower triangle is enough.
    for i in range(3):
        for j in range(i + 1):
            u, v = rows[i], rows[j]
            sound &= np.abs(u[0] * v[0] + u[1] * v[1] + u[2] * v[2] - (i == j)) <= tolerance
    # An orthonormal matrix with a negative determinant is a reflection.
    determinant = (
        a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    )
    return sound & (determinant > 0)


# ------------------------------------------------------------------------------------------------------ transforms


def pose(rotation: Float64[np.ndarray, "3 3"], translation: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "4 4"]:
    """A 4x4 transform from its rotation and translation."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = translation
    return matrix


def pose_from_xyyaw(x: float, y: float, yaw_rad: float, z: float = 0.0) -> Float64[np.ndarray, "4 4"]:
    """The pose of a planar placement: rotated about z only.

    Args:
        x: position along x, metres.
        y: position along y, metres.
        yaw_rad: heading about z, counter-clockwise from x.
        z: height, metres.
    """
    return pose(rotation_from_yaw(yaw_rad), np.array([x, y, z]))


def inverse(transform: Float64[np.ndarray, "*n 4 4"]) -> Float64[np.ndarray, "*n 4 4"]:
    """Inverse of rigid transforms: the transposed rotation, not a general matrix inverse."""
    m = np.asarray(transform, np.float64)
    rotation = np.swapaxes(m[..., :3, :3], -1, -2)
    result = np.zeros_like(m)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, m[..., :3, 3])
    result[..., 3, 3] = 1
    return result


def transform_points(
    a_from_b: Float64[np.ndarray, "4 4"], points_b: Float64[np.ndarray, "*n 3"]
) -> Float64[np.ndarray, "*n 3"]:
    """Points of frame b in frame a."""
    return _by_axis(np.asarray(a_from_b, np.float64)[:3], points_b)


def rotate_vectors(
    rotation: Float64[np.ndarray, "3 3"], vectors: Float64[np.ndarray, "*n 3"]
) -> Float64[np.ndarray, "*n 3"]:
    """Vectors multiplied by one 3x3 matrix."""
    return _by_axis(rotation, vectors)


def _by_axis(
    rows: Float64[np.ndarray, "3 3"] | Float64[np.ndarray, "3 4"], vectors: Float64[np.ndarray, "*n 3"]
) -> Float64[np.ndarray, "*n 3"]:
    """Vectors multiplied by a 3x3 matrix, and moved by its fourth column if it has one.

    Axis by axis: a matrix product with rows of three takes several times as long, and its threads wait for each other.
    In blocks: intermediate results that fit into the fastest cache, and need no new memory, take a fifth of the time.
    """
    vectors = np.asarray(vectors, np.float64)
    flat = vectors.reshape(-1, 3)
    result = np.empty(flat.shape)
    for start in range(0, len(flat), BLOCK):
        x, y, z = flat[start : start + BLOCK].T
        out = result[start : start + BLOCK]
        for axis, (a, b, c, *shift) in enumerate(rows):
            turned = a * x + b * y + c * z
            out[:, axis] = turned + shift[0] if shift else turned
    return result.reshape(vectors.shape)


def interpolate_poses(
    t_us: Int64[np.ndarray, " t"], poses: Float64[np.ndarray, "t 4 4"], query_us: int | Int64[np.ndarray, "*n"]
) -> Float64[np.ndarray, "*n 4 4"]:
    """Poses at ``query_us``: linear positions, slerped rotations, held before the first and after the last time."""
    query = np.asarray(query_us, np.int64)
    flat = query.reshape(-1)
    if len(t_us) == 1:
        return np.broadcast_to(poses[0], (*query.shape, 4, 4)).copy()
    clamped = np.clip(flat, t_us[0], t_us[-1])
    # Index of the pose before each time; the last time belongs to the last interval.
    low = np.clip(np.searchsorted(t_us, clamped, side="right") - 1, 0, len(t_us) - 2)
    fraction = (clamped - t_us[low]) / (t_us[low + 1] - t_us[low])
    result = poses[low]
    result[:, :3, 3] += fraction[:, None] * (poses[low + 1, :3, 3] - poses[low, :3, 3])
    # Slerp only where the rotation changes: it is the expensive part, and the others stay exact. Rotations become
    # quaternions once for all times between the same two poses.
    between = np.zeros(len(t_us) - 1, bool)
    between[low] = True
    pairs = np.flatnonzero(between)
    rotations = poses[:, :3, :3]
    turned = (rotations[pairs] != rotations[pairs + 1]).any(axis=(1, 2))
    place = (np.cumsum(between) - 1)[low]
    turning = np.flatnonzero(turned[place] & (fraction > 0))
    if len(turning):
        before, after = quat_from_matrix(rotations[np.stack([pairs, pairs + 1])])[:, place[turning]]
        result[turning, :3, :3] = matrix_from_quat(slerp(before, after, fraction[turning]))
    return result.reshape(*query.shape, 4, 4)


def interpolate_pose_pair(
    pair: Float64[np.ndarray, "2 4 4"], fraction: Float64[np.ndarray, "*n"]
) -> Float64[np.ndarray, "*n 4 4"]:
    """Poses between the two of a pair: fraction 0 gives the first, 1 the second."""
    fraction = np.asarray(fraction, np.float64)
    flat = fraction.reshape(-1)
    result = np.broadcast_to(pair[0], (len(flat), 4, 4)).copy()
    result[:, :3, 3] += flat[:, None] * (pair[1, :3, 3] - pair[0, :3, 3])
    if (pair[0, :3, :3] != pair[1, :3, :3]).any():
        quats = quat_from_matrix(pair[:, :3, :3])
        result[:, :3, :3] = matrix_from_quat(slerp(quats[0], quats[1], flat))
    return result.reshape(*fraction.shape, 4, 4)


def interpolate_pose_pairs(
    pairs: Float64[np.ndarray, "n 2 4 4"], fraction: float | Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 4 4"]:
    """``interpolate_pose_pair`` of many pairs, at one fraction or one each."""
    pairs = np.asarray(pairs, np.float64).reshape(-1, 2, 4, 4)
    fractions = np.broadcast_to(fraction, len(pairs))
    result = pairs[:, 0].copy()
    result[:, :3, 3] += fractions[:, None] * (pairs[:, 1, :3, 3] - pairs[:, 0, :3, 3])
    turned = (pairs[:, 0, :3, :3] != pairs[:, 1, :3, :3]).any(axis=(1, 2))
    if turned.any():
        quats = quat_from_matrix(pairs[turned, :, :3, :3])
        result[turned, :3, :3] = matrix_from_quat(slerp(quats[:, 0], quats[:, 1], fractions[turned]))
    return result


# -------------------------------------------------------------------------------------------------- boxes, polygons

BOX_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
"""[8,3] of a box in its frame, in units of its sides."""


def box_crossings(
    origin: Float64[np.ndarray, "*n 3"],
    direction: Float64[np.ndarray, "*n 3"],
    low: Float64[np.ndarray, " 3"],
    high: Float64[np.ndarray, " 3"],
) -> tuple[Float64[np.ndarray, " *n"], Float64[np.ndarray, " *n"]]:
    """Where lines enter and leave a box along the axes, in units of ``direction``; those that miss it leave first.

    Slab test (Kay and Kajiya 1986): a line is inside while it is between all three pairs of faces.
    """
    # A line along a face never crosses it; a tiny step instead of none keeps 0 / 0 out.
    direction = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    first, second = (low - origin) / direction, (high - origin) / direction
    return np.minimum(first, second).max(axis=-1), np.maximum(first, second).min(axis=-1)


def box_corners_xy(
    world_from_box: Float64[np.ndarray, "*n 4 4"], length_m: float, width_m: float
) -> Float64[np.ndarray, "*n 4 2"]:
    """Footprint corners of upright boxes seen from above, counter-clockwise from front left."""
    m = np.asarray(world_from_box, np.float64)
    yaw = yaw_of(m)
    forward = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    left = np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1)
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * 0.5
    # Length along the heading, width to its left; roll and pitch are ignored.
    offsets = signs[:, :1] * length_m * forward[..., None, :] + signs[:, 1:] * width_m * left[..., None, :]
    return m[..., None, :2, 3] + offsets


def points_in_box(
    points_box_m: Float64[np.ndarray, "n 3"], size_m: tuple[float, float, float], margin_m: float = 0.0
) -> Bool[np.ndarray, " n"]:
    """Which points, given in the box frame, lie in a box grown by ``margin_m`` on every side."""
    # Axis by axis: a reduction over rows of three takes several times as long.
    x, y, z = (np.abs(points_box_m[..., k]) <= size_m[k] / 2 + margin_m for k in range(3))
    return x & y & z


def arc_length(points: Float64[np.ndarray, "k d"]) -> Float64[np.ndarray, " k"]:
    """Distance along a polyline at each vertex."""
    steps = np.linalg.norm(np.diff(np.asarray(points, np.float64), axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def project_to_polyline(
    points: Float64[np.ndarray, "n 2"], line: Float64[np.ndarray, "k 2"]
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Arc length of the nearest point on a polyline, and the signed distance to it (left positive)."""
    points, line = np.atleast_2d(np.asarray(points, np.float64)), np.asarray(line, np.float64)
    if len(line) < 2:
        raise ValueError(f"a polyline needs at least 2 points, got {len(line)}")
    start, step = line[:-1], np.diff(line, axis=0)
    length = np.linalg.norm(step, axis=1)
    # Repeated vertices give segments of length 0, whose nearest point is their start.
    safe = np.where(length > 0, length, 1.0)
    offset = points[:, None] - start[None]
    # Foot of the perpendicular on each segment, as a fraction of it; clamped to the segment's ends.
    along = np.clip(np.sum(offset * step, axis=2) / safe**2, 0.0, 1.0)
    rest = offset - along[..., None] * step
    distance = np.linalg.norm(rest, axis=2)
    best = np.argmin(distance, axis=1)
    rows = np.arange(len(points))
    # The sign of the cross product tells the side: positive is left of the direction of travel.
    cross = step[best, 0] * offset[rows, best, 1] - step[best, 1] * offset[rows, best, 0]
    s = arc_length(line)[best] + along[rows, best] * length[best]
    return s, np.where(cross < 0, -1.0, 1.0) * distance[rows, best]


# --------------------------------------------------------------------------------------------------------- cubemaps


def cubemap_directions(size: int, rim: int = 0) -> Float64[np.ndarray, "6 n n 3"]:
    """World directions (z up) of the texel centres of a cubemap.

    Faces in OpenGL order +X -X +Y -Y +Z -Z, looked up with GL axes x = -y_world, y = z_world, z = -x_world
    (docs/scene_format.md), so face 5 (-Z) looks along the world's x axis and face 2 (+Y) up.

    Args:
        size: texels along the edge of a face.
        rim: additional texels on each side, in the plane of their face; ``n = size + 2 rim``.
    """
    gl = _opengl_texels(size, rim)
    # Inverse of x = -y_world, y = z_world, z = -x_world.
    world = np.stack([-gl[..., 2], -gl[..., 0], gl[..., 1]], axis=-1)
    return world / np.linalg.norm(world, axis=-1, keepdims=True)


def released_cubemap_directions(size: int) -> Float64[np.ndarray, "6 size size 3"]:
    """Directions of the texel centres of a cubemap as the released network and its sky files lay it out.

    Faces +X -X -Y +Y +Z -Z of the cubemap's own frame, whichever that is: OpenGL's layout with y flipped, designed
    for camera frames (x right, y down, z forward), in which every face is upright.
    """
    direction = _opengl_texels(size) * np.array([1.0, -1.0, 1.0])
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def _opengl_texels(size: int, rim: int = 0) -> Float64[np.ndarray, "6 n n 3"]:
    """Points on the cube [-1, 1]^3 in OpenGL's axes, at the texel centres of its faces +X -X +Y -Y +Z -Z."""
    c = (np.arange(-rim, size + rim) + 0.5) / size * 2 - 1
    t, s = np.meshgrid(c, c, indexing="ij")
    one = np.ones_like(s)
    # OpenGL specification, cube map face selection: the major axis, then sc and tc solved for the other two.
    faces = [(one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)]
    return np.stack([np.stack(face, axis=-1) for face in faces])


def cubemap_coordinates(
    direction: Float64[np.ndarray, "*n 3"],
) -> tuple[Int64[np.ndarray, "*n"], Float64[np.ndarray, "*n"], Float64[np.ndarray, "*n"]]:
    """Face index and coordinates (column s, row t, both 0..1) where world directions meet the cube."""
    d = np.asarray(direction, np.float64)
    # World to GL axes.
    x, y, z = -d[..., 1], d[..., 2], -d[..., 0]
    ax, ay, az = np.abs(x), np.abs(y), np.abs(z)
    # The axis of largest magnitude selects the face; strict and weak comparisons settle ties one way.
    face = np.where((ax >= ay) & (ax >= az), np.where(x > 0, 0, 1), 0)
    face = np.where((ay > ax) & (ay >= az), np.where(y > 0, 2, 3), face)
    face = np.where((az > ax) & (az > ay), np.where(z > 0, 4, 5), face)
    major = np.maximum(np.maximum(np.maximum(ax, ay), az), 1e-30)
    s = np.choose(face, [-z, z, x, x, x, -x]) / major
    t = np.choose(face, [-y, -y, z, -z, -y, -y]) / major
    return face.astype(np.int64), (s + 1) / 2, (t + 1) / 2
