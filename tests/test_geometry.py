import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp
from shapely import LineString, Point

from nurec_sim import geometry

QUICK = settings(max_examples=80, deadline=None)
angles = st.floats(-np.pi, np.pi, allow_nan=False)
fractions = st.floats(0, 1, allow_nan=False)
vectors = st.tuples(*[st.floats(-100, 100, allow_nan=False)] * 3).map(np.array)
axes = st.tuples(*[st.floats(-1, 1, allow_nan=False)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1)
quats = st.builds(
    lambda axis, angle: np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis / np.linalg.norm(axis)]),
    axes,
    angles,
)
poses = st.builds(lambda quat, place: geometry.pose(geometry.matrix_from_quat(quat), place), quats, vectors)


def as_scipy(quat_wxyz: np.ndarray) -> Rotation:
    return Rotation.from_quat(np.roll(quat_wxyz, -1))


# ------------------------------------------------------------------------------------------------------- rotations


@QUICK
@given(quats)
def test_quaternions_and_matrices_are_two_names_of_one_rotation(quat):
    matrix = geometry.matrix_from_quat(quat)
    assert np.allclose(matrix, as_scipy(quat).as_matrix())
    assert geometry.is_rotation(matrix, 1e-9)
    again = geometry.quat_from_matrix(matrix)
    assert again[0] >= 0 and np.allclose(np.abs(again @ quat), 1)


@QUICK
@given(quats, quats)
def test_quaternion_products_follow_matrix_products(a, b):
    product = geometry.matrix_from_quat(geometry.quat_multiply(a, b))
    assert np.allclose(product, geometry.matrix_from_quat(a) @ geometry.matrix_from_quat(b))


@pytest.mark.parametrize("quat", [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [1, 0, 0, 0], [0.5, 0.5, 0.5, 0.5]])
def test_half_turns_survive_the_way_through_a_matrix(quat):
    assert np.allclose(geometry.quat_from_matrix(geometry.matrix_from_quat(np.array(quat, float))), quat)


def test_quaternions_are_normalised_with_w_not_negative():
    assert geometry.quat_normalize(np.array([-2.0, 0, 0, 2])).tolist() == pytest.approx([0.5**0.5, 0, 0, -(0.5**0.5)])
    for broken in ([0.0, 0, 0, 0], [np.nan, 0, 0, 1]):
        with pytest.raises(ValueError, match="a quaternion must be finite and not zero"):
            geometry.quat_normalize(np.array(broken))


@QUICK
@given(quats, quats, fractions)
def test_slerp_agrees_with_scipy(a, b, fraction):
    if np.abs(a @ b) < 1e-3:  # half a turn apart: either way round is right
        return
    expected = Slerp([0, 1], Rotation.concatenate([as_scipy(a), as_scipy(b)]))(fraction)
    ours = as_scipy(geometry.slerp(a, b, np.array(fraction)))
    assert (ours.inv() * expected).magnitude() < 1e-6


def test_slerp_keeps_tiny_angles():
    a, b = np.array([1.0, 0, 0, 0]), geometry.quat_normalize(np.array([1.0, 0, 0, 1e-8]))
    assert geometry.slerp(a, b, np.array(0.25))[3] == pytest.approx(0.25e-8)


@QUICK
@given(angles)
def test_yaw_comes_back_and_wraps(yaw):
    assert geometry.wrap_angle(geometry.yaw_of(geometry.rotation_from_yaw(yaw)) - yaw) == pytest.approx(0, abs=1e-12)
    assert -np.pi <= geometry.wrap_angle(yaw + 20) < np.pi
    assert np.sin(geometry.wrap_angle(yaw + 20)) == pytest.approx(np.sin(yaw + 20))


def test_mirrors_stretches_and_nans_are_no_rotations():
    for broken in (np.diag([1.0, 1, -1]), 1.1 * np.eye(3), np.full((3, 3), np.nan), np.eye(4)):
        assert not geometry.is_rotation(broken)


# ------------------------------------------------------------------------------------------------------ transforms


@QUICK
@given(poses, poses, vectors)
def test_transforms_compose_and_invert(a, b, point):
    assert np.allclose(geometry.inverse(a) @ a, np.eye(4), atol=1e-9)
    assert np.allclose(geometry.inverse(a @ b), geometry.inverse(b) @ geometry.inverse(a), atol=1e-9)
    both = geometry.transform_points(a, geometry.transform_points(b, point[None]))
    assert np.allclose(both, geometry.transform_points(a @ b, point[None]), atol=1e-9)
    assert np.array_equal(geometry.inverse(np.stack([a, b]))[1], geometry.inverse(b))


@QUICK
@given(poses, poses, st.integers(-50, 150))
def test_interpolated_poses_stay_rigid_and_between_their_ends(first, last, t_us):
    t_us_known = np.array([0, 100])
    found = geometry.interpolate_poses(t_us_known, np.stack([first, last]), t_us)
    assert geometry.is_rotation(found[:3, :3], 1e-9)
    share = np.clip(t_us, 0, 100) / 100
    assert np.allclose(found[:3, 3], (1 - share) * first[:3, 3] + share * last[:3, 3])
    pair = geometry.interpolate_pose_pair(np.stack([first, last]), np.array(share))
    assert np.allclose(found, pair, atol=1e-7)


def test_poses_at_known_times_are_returned_exactly():
    known = np.stack([geometry.pose_from_xyyaw(x, x**2, 0.3 * x) for x in (0.0, 1, 3)])
    times = np.array([1_600_000_000_000_000, 1_600_000_000_100_000, 1_600_000_000_300_000])
    assert np.array_equal(geometry.interpolate_poses(times, known, times), known)
    assert geometry.interpolate_poses(times, known, times.reshape(3, 1)).shape == (3, 1, 4, 4)
    assert np.array_equal(geometry.interpolate_poses(times[:1], known[:1], 5), known[0])


def test_poses_are_interpolated_between_their_own_neighbours():
    rng = np.random.default_rng(0)
    known = np.stack(
        [geometry.pose(geometry.matrix_from_quat(rng.normal(size=4)), rng.normal(size=3)) for _ in range(9)]
    )
    known[4, :3, :3] = known[3, :3, :3]
    times, asked = np.arange(9) * 100, rng.integers(0, 800, 300)
    low, share = asked // 100, asked % 100 / 100
    expected = [geometry.interpolate_pose_pair(known[k : k + 2], f) for k, f in zip(low, share, strict=True)]
    np.testing.assert_allclose(geometry.interpolate_poses(times, known, asked), expected, atol=1e-14)


# -------------------------------------------------------------------------------------------------- boxes, polygons


def test_box_corners_start_at_the_front_left_and_run_counterclockwise():
    corners = geometry.box_corners_xy(geometry.pose_from_xyyaw(10, 5, np.pi / 2), 4.0, 2.0)
    assert np.allclose(corners, [[9, 7], [9, 3], [11, 3], [11, 7]])
    area = 0.5 * np.sum(corners[:, 0] * np.roll(corners[:, 1], -1) - corners[:, 1] * np.roll(corners[:, 0], -1))
    assert area == pytest.approx(8)


def test_points_in_box_with_a_margin():
    points = np.array([[1.9, 0, 0], [2.1, 0, 0], [0, 0, -0.8]])
    assert geometry.points_in_box(points, (4, 2, 1.5)).tolist() == [True, False, False]
    assert geometry.points_in_box(points, (4, 2, 1.5), 0.2).tolist() == [True, True, True]


@QUICK
@given(st.lists(st.tuples(st.integers(-20, 20), st.integers(-20, 20)), min_size=2, max_size=8, unique=True), vectors)
def test_projection_to_a_polyline_agrees_with_shapely(line, point):
    line = np.array(line, float)
    s, offset = geometry.project_to_polyline(point[None, :2], line)
    shape = LineString(line)
    assert abs(offset[0]) == pytest.approx(shape.distance(Point(point[:2])), abs=1e-9)
    nearest = shape.interpolate(s[0])
    assert nearest.distance(Point(point[:2])) == pytest.approx(abs(offset[0]), abs=1e-9)
    assert 0 <= s[0] <= geometry.arc_length(line)[-1] + 1e-9


def test_left_of_a_line_is_positive_and_one_point_is_no_line():
    line = np.array([[0.0, 0], [10, 0], [10, 10]])
    s, offset = geometry.project_to_polyline(np.array([[5, 1], [5, -2], [9, 5]]), line)
    assert s.tolist() == [5, 5, 15] and offset.tolist() == [1, -2, 1]
    with pytest.raises(ValueError, match="a polyline needs at least 2 points, got 1"):
        geometry.project_to_polyline(np.zeros((1, 2)), line[:1])


# --------------------------------------------------------------------------------------------------------- cubemaps


@pytest.mark.parametrize("size", [1, 2, 7])
def test_texel_centres_come_back_from_their_directions(size):
    directions = geometry.cubemap_directions(size)
    face, s, t = geometry.cubemap_coordinates(directions)
    faces, rows, columns = np.indices((6, size, size))
    assert np.array_equal(face, faces)
    assert np.allclose(s * size - 0.5, columns) and np.allclose(t * size - 0.5, rows)


def test_faces_look_where_the_format_says():
    centres = geometry.cubemap_directions(1)[:, 0, 0]
    # +X -X +Y -Y +Z -Z of OpenGL, with x = -y_world, y = z_world, z = -x_world.
    assert centres.tolist() == [[0, -1, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [-1, 0, 0], [1, 0, 0]]


@QUICK
@given(axes)
def test_every_direction_meets_one_face(direction):
    face, s, t = geometry.cubemap_coordinates(direction)
    assert 0 <= face < 6 and 0 <= s <= 1 and 0 <= t <= 1
