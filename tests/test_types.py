import dataclasses
from typing import get_type_hints

import numpy as np
import pytest

from nurec_sim import geometry, logs
from nurec_sim.types import (
    GAUSSIAN_FIELDS,
    Clip,
    DynamicGaussians,
    EgoState,
    Gaussians,
    Pinhole,
    Reduce,
    Rig,
    Rollout,
    Series,
    Sweep,
    Trajectory,
)
from nurec_sim.types.rows import rows_of


def straight(*t_us: int) -> Trajectory:
    return Trajectory(np.array(t_us), np.array([geometry.pose_from_xyyaw(t / 10, 0, 0) for t in t_us]))


def test_a_trajectory_interpolates_and_knows_its_ends():
    path = straight(0, 100, 300)
    assert (path.start_us, path.end_us) == (0, 300)
    assert path.at(200)[0, 3] == pytest.approx(20)
    assert path.at(np.array([-5, 50, 999]))[:, 0, 3] == pytest.approx([0, 5, 30])
    assert path.covers(300) and not path.covers(301)
    assert path.position_m[:, 0].tolist() == [0, 10, 30]


@pytest.mark.parametrize(
    "t_us, poses, text",
    [
        ([], np.zeros((0, 4, 4)), "needs times .t. and poses .t,4,4., t >= 1; got"),
        ([1, 2], np.zeros((1, 4, 4)), r"got \(2,\), \(1, 4, 4\)"),
        ([2, 2], np.stack([np.eye(4)] * 2), "times must increase strictly"),
        ([1, 2], np.full((2, 4, 4), np.nan), "poses must be finite"),
    ],
)
def test_a_broken_trajectory_is_refused(t_us, poses, text):
    with pytest.raises(ValueError, match=text):
        Trajectory(np.array(t_us, np.int64), poses)


def test_a_pinhole_knows_whether_it_is_distorted():
    lens = Pinhole(1, 1, 0, 0)
    assert not lens.distorted
    for changes in ({"radial": (0, 0, 0, 0, 0, 1e-9)}, {"tangential": (0, 1)}, {"thin_prism": (1, 0, 0, 0)}):
        assert dataclasses.replace(lens, **changes).distorted


def test_a_sweeps_points_in_the_world():
    pose = geometry.pose_from_xyyaw(1, 2, np.pi / 2, z=3)
    sweep = Sweep(5, 5, 5, pose, np.array([[10.0, 0, 0]]), None, np.array([5]))
    assert np.allclose(sweep.xyz_world_m, [[1, 12, 3]])


def numbered(n: int, rest: bool = False) -> Gaussians:
    """Gaussians whose every value tells their index."""
    empty = Gaussians.empty(n)
    fields = {name: (getattr(empty, name).T * 0 + np.arange(n)).T for name in GAUSSIAN_FIELDS if name != "label"}
    sh_rest = np.arange(n * 9, dtype=np.float32).reshape(n, 3, 3) if rest else None
    return dataclasses.replace(empty, label=np.arange(n, dtype=np.uint8), sh_rest=sh_rest, **fields)


def test_gaussians_are_indexed_and_joined_as_one():
    gaussians = numbered(6, rest=True)
    odd = gaussians[np.arange(6) % 2 == 1]
    assert len(odd) == 3 and odd.label.tolist() == [1, 3, 5] and odd.opacity.tolist() == [1, 3, 5]
    assert odd.sh_rest.tolist() == gaussians.sh_rest[1::2].tolist()
    joined = Gaussians.concatenate([gaussians[:2], gaussians[2:]])
    for name in (*GAUSSIAN_FIELDS, "sh_rest"):
        assert np.array_equal(getattr(joined, name), getattr(gaussians, name), equal_nan=True)
    assert len(Gaussians.concatenate([])) == 0


def test_gaussians_with_and_without_view_dependence_do_not_join():
    with pytest.raises(ValueError, match="cannot join Gaussians with and without sh_rest"):
        Gaussians.concatenate([numbered(2, rest=True), numbered(2)])


def test_empty_gaussians_have_identity_rotations_and_unknown_intensity():
    empty = Gaussians.empty(2)
    assert empty.quat_wxyz.tolist() == [[1, 0, 0, 0]] * 2 and np.isnan(empty.intensity).all()
    assert len(DynamicGaussians.empty()) == 0 and DynamicGaussians.empty().knot_m.shape == (0, 3, 3)


def test_a_rollout_lists_its_times_and_poses():
    states = tuple(EgoState(t, geometry.pose_from_xyyaw(t, 0, 0), 1.0) for t in (10, 20))
    rollout = Rollout("s", "scene", "lift", "replay", 0, Rig({}, {}), states, {}, {}, {}, straight(0, 1), ())
    assert rollout.t_us.tolist() == [10, 20] and rollout.world_from_rig[:, 0, 3].tolist() == [10, 20]
    assert dataclasses.replace(rollout, states=()).world_from_rig.shape == (0, 4, 4)


@pytest.mark.parametrize(
    "reduce, expected",
    [(Reduce.MEAN, 3), (Reduce.MEDIAN, 2), (Reduce.MAX, 6), (Reduce.MIN, 1), (Reduce.LAST, 6)],
)
def test_only_valid_values_of_a_series_count(reduce, expected):
    values, valid = np.array([1.0, 2, 99, 6]), np.array([True, True, False, True])
    series = Series("x", "m", np.arange(4), values, valid, reduce)
    assert series.value() == expected
    assert np.isnan(dataclasses.replace(series, valid=np.zeros(4, bool)).value())


def test_an_opened_clip_has_all_that_the_protocol_names():
    names = set(get_type_hints(Clip)) | {name for name in vars(Clip) if not name.startswith("_")}
    attributes = {"id", "rig", "ego", "tracks", "road_map", "time_offset_us"}
    assert attributes < names
    assert names - attributes <= set(dir(logs.Clip))


@pytest.mark.parametrize(
    "index", [np.array([3, 0, 3, -1]), np.arange(5) % 2 == 0, slice(1, 4), np.array([], np.int64), np.zeros(5, bool)]
)
def test_rows_of_arrays_are_those_that_numpy_indexes(index):
    arrays = [np.arange(5.0), np.arange(15).reshape(5, 3), np.arange(40, dtype=np.uint8).reshape(5, 2, 4)]
    for found, array in zip(rows_of(arrays, index), arrays, strict=True):
        np.testing.assert_array_equal(found, array[index])
        assert found.dtype == array.dtype


@pytest.mark.parametrize("index", [np.ones(4, bool), np.ones(6, bool), np.array([5])])
def test_rows_that_arrays_do_not_have_are_refused(index):
    with pytest.raises(IndexError):
        rows_of([np.arange(5.0), np.zeros((5, 3))], index)
