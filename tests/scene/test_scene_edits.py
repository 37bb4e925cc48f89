"""Actors taken out of a scene, put in, and given other looks: what is where afterwards."""

from dataclasses import replace

import numpy as np
import pytest
from serving_world import LAST_US, START_US, scene

from nurec_sim import geometry
from nurec_sim.errors import RequestError, TooLargeError
from nurec_sim.scene import check_scene, edits
from nurec_sim.types import DynamicGaussians, Gaussians, Track, Trajectory

MIDDLE_US = (START_US + LAST_US) // 2


def track(track_id="new", x=20.0, size=(4.4, 1.8, 1.6), times=(START_US, LAST_US)):
    poses = np.stack([geometry.pose_from_xyyaw(x, 2.0, 1.0, 0.8)] * len(times))
    return Track(track_id, "automobile", size, Trajectory(np.array(times), poses))


def rows(world, track_id):
    return world.dynamic.track == [t.id for t in world.tracks].index(track_id)


def test_an_asset_is_what_the_actor_looks_like_in_its_box():
    asset = edits.asset_of(scene(), "car-1")
    assert len(asset.gaussians) == 60 and asset.size_m == (4.4, 1.8, 1.6) and asset.label == "automobile"
    assert (np.abs(asset.gaussians.mean_m) <= (1.81, 0.73, 0.64)).all()
    np.testing.assert_allclose(asset.gaussians.opacity, 0.9, atol=1e-6)


def test_the_looks_of_a_parked_car_come_from_the_static_layer():
    asset = edits.asset_of(scene(), "parked-1")
    assert len(asset.gaussians) == 40
    assert (asset.gaussians.rgb == np.float32([0.1, 0.2, 0.8])).all()
    assert (np.abs(asset.gaussians.mean_m) <= (2, 0.9, 0.8)).all()


def test_windows_of_time_that_overlap_do_not_double_an_asset():
    world = scene()
    number, dynamic = 0, world.dynamic
    later = replace(dynamic, knot_t_us=dynamic.knot_t_us + 1_900_000)
    both = DynamicGaussians(
        Gaussians.concatenate([dynamic.gaussians, later.gaussians]),
        np.concatenate([dynamic.knot_t_us, later.knot_t_us]),
        np.concatenate([dynamic.knot_m, later.knot_m]),
        np.full(120, number, np.int32),
    )
    assert len(edits.asset_of(replace(world, dynamic=both), "car-1").gaussians) == 60


def test_an_inserted_track_is_rigid_and_keeps_its_looks():
    world = scene()
    asset = edits.asset_of(world, "car-1")
    grown = edits.with_track(world, track(), asset)
    check_scene(grown)
    assert [t.id for t in grown.tracks] == ["car-1", "parked-1", "new"] and len(grown.dynamic) == 120
    again = edits.asset_of(grown, "new")
    np.testing.assert_array_equal(again.gaussians.mean_m, asset.gaussians.mean_m)
    assert len(world.tracks) == 2 and len(world.dynamic) == 60, "the scene itself is not touched"


def test_a_single_pose_stands_for_as_long_as_the_scene_lasts():
    world = scene()
    grown = edits.with_track(world, track(times=(MIDDLE_US,)), edits.asset_of(world, "car-1"))
    path = grown.tracks[-1].path
    assert (path.start_us, path.end_us) == world.span_us


def test_a_replaced_track_keeps_its_id_and_place_and_stands_on_the_same_ground():
    world = scene()
    asset = edits.asset_of(world, "parked-1")
    changed = edits.replaced_track(world, "car-1", asset, (8.8, 1.8, 3.2))
    check_scene(changed)
    assert [t.id for t in changed.tracks] == ["car-1", "parked-1"]
    assert changed.tracks[0].size_m == (8.8, 1.8, 3.2)
    lifted = changed.tracks[0].path.position_m[:, 2] - world.tracks[0].path.position_m[:, 2]
    np.testing.assert_allclose(lifted, 0.8, atol=1e-12)
    new = changed.dynamic.gaussians[rows(changed, "car-1")]
    assert len(new) == 40 and (new.rgb == np.float32([0.1, 0.2, 0.8])).all()
    np.testing.assert_allclose(new.mean_m, asset.gaussians.mean_m * (2, 1, 2), atol=1e-5)


def test_stretching_stretches_covariances():
    asset = edits.asset_of(scene(), "car-1")
    turned = replace(asset.gaussians, quat_wxyz=np.tile(np.float32([0.8, 0.0, 0.6, 0.0]), (60, 1)))
    turned = replace(turned, scale_m=np.tile(np.float32([0.3, 0.2, 0.1]), (60, 1)))
    wide = edits.resized(replace(asset, gaussians=turned), (4.4, 3.6, 4.8)).gaussians

    def covariance(gaussians):
        turn = geometry.matrix_from_quat(gaussians.quat_wxyz)
        return turn @ (gaussians.scale_m[:, :, None].astype(float) ** 2 * turn.swapaxes(1, 2))

    stretch = np.diag([1.0, 2.0, 3.0])
    np.testing.assert_allclose(covariance(wide), stretch @ covariance(turned) @ stretch, atol=1e-6)


def test_a_removed_track_is_gone_with_all_its_gaussians():
    world = scene()
    without = edits.without_track(world, "car-1")
    check_scene(without)
    assert [t.id for t in without.tracks] == ["parked-1"] and len(without.dynamic) == 0
    bare = edits.without_track(world, "parked-1")
    assert len(bare.static) == len(world.static) - 40 and (bare.dynamic.track == 0).all()
    both = edits.without_track(edits.with_track(world, track(), edits.asset_of(world, "car-1")), "car-1")
    assert (both.dynamic.track == 1).all() and both.tracks[1].id == "new"


@pytest.mark.parametrize(
    ("edit", "kind", "text"),
    [
        (lambda w, a: edits.asset_of(w, "nobody"), RequestError, "has no track 'nobody'; have ['car-1', 'parked-1']"),
        (lambda w, a: edits.without_track(w, "nobody"), RequestError, "has no track 'nobody'"),
        (lambda w, a: edits.replaced_track(w, "nobody", a), RequestError, "has no track 'nobody'"),
        (lambda w, a: edits.with_track(w, track("car-1"), a), RequestError, "has a track 'car-1' already"),
        (lambda w, a: edits.with_track(w, track(times=(1, 2)), a), RequestError, "lives during [1, 2] us, scene"),
        (lambda w, a: edits.with_track(w, track(times=(1, 2**62)), a), RequestError, "at most a day before and after"),
        (lambda w, a: edits.with_track(w, track(x=1e7), a), RequestError, "leaves the 1e+06 m around"),
        (lambda w, a: edits.asset_of(edits.without_track(w, "car-1"), "car-1"), RequestError, "have ['parked-1']"),
    ],
)
def test_what_cannot_be_edited_says_why(edit, kind, text):
    world = scene()
    with pytest.raises(kind) as caught:
        edit(world, edits.asset_of(world, "car-1"))
    assert text in str(caught.value)


def test_a_track_of_which_nothing_was_seen_is_no_asset():
    world = scene()
    empty = replace(world, dynamic=DynamicGaussians.empty())
    with pytest.raises(RequestError, match="track 'car-1' of scene 'street' has no Gaussians of its own"):
        edits.asset_of(empty, "car-1")


def test_a_scene_does_not_grow_without_end(monkeypatch):
    monkeypatch.setattr(edits, "MAX_DYNAMIC", 100)
    world = scene()
    with pytest.raises(TooLargeError, match="may have 100 moving Gaussians; with track 'new' it has 120"):
        edits.with_track(world, track(), edits.asset_of(world, "car-1"))
