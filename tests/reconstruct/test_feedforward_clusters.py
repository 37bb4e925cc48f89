"""Dynamic Gaussians without labels become tracks that can be moved by request."""

import dataclasses

import moving_things
import numpy as np
import pytest
import render_scenes

from nurec_sim import geometry
from nurec_sim.reconstruct.feedforward.tracks.clusters import group_into_tracks
from nurec_sim.reconstruct.movers.boxes import LEAST_M, Sighting, lengthened, track_of
from nurec_sim.render.cpu.renderer import CpuRenderer
from nurec_sim.types import MOVABLE_LABELS, DynamicGaussians


@pytest.fixture(scope="module")
def street():
    """Things, the ego path, the layer, the true owner of each Gaussian, the tracks found and the index of each."""
    things, ego = moving_things.street(), moving_things.ego()
    dynamic, owner = moving_things.lifted(things, ego)
    return things, ego, dynamic, owner, *group_into_tracks(dynamic, ego, 7)


def found(street):
    """The track of each thing, by the Gaussians that they share."""
    things, _, _, owner, tracks, index = street
    return [tracks[int(np.bincount(index[(owner == k) & (index >= 0)]).argmax()) - 7] for k in range(len(things))]


def test_every_thing_becomes_one_track(street):
    things, _, dynamic, owner, tracks, index = street
    assert [track.id for track in tracks] == [f"moving-{k}" for k in range(1, 6)]
    assert len({track.id for track in found(street)}) == len(things)
    for number in range(len(tracks)):
        mine = owner[index == number + 7]
        assert np.mean(mine == np.bincount(mine + 1).argmax() - 1) > 0.99
    for k in range(len(things)):
        assert np.mean(index[owner == k] >= 0) > 0.9
    assert np.mean(index[owner == -1] >= 0) < 0.02 and index.dtype == np.int32
    assert set(index.tolist()) == {-1, *range(7, 12)}


def test_tracks_lie_where_the_things_are(street):
    things, ego = street[:2]
    for thing, track in zip(things, found(street), strict=True):
        assert track.label == thing.label and track.label in MOVABLE_LABELS
        t_us = np.arange(ego.start_us + 200_000, ego.end_us - 700_000, 100_000)
        t_us = t_us[(t_us >= track.path.start_us) & (t_us <= track.path.end_us)]
        assert len(t_us) > 40
        got, true = track.path.at(t_us), thing.path.at(t_us)
        error = np.linalg.norm((got - true)[:, :2, 3], axis=1)
        near = np.linalg.norm(true[:, :3, 3] - ego.at(t_us)[:, :3, 3], axis=1) < 40
        assert near.sum() > 30 and error[near].max() < 0.5 and error.max() < 0.8
        turned = geometry.wrap_angle(geometry.yaw_of(got) - geometry.yaw_of(true))
        assert np.abs(turned).max() < np.radians(13)
        assert np.abs(np.subtract(track.size_m, thing.size_m)).max() < 0.5


def test_tracks_cover_the_lives_of_their_gaussians(street):
    _, _, dynamic, _, tracks, index = street
    for number, track in enumerate(tracks):
        lives = dynamic.knot_t_us[index == number + 7]
        assert track.path.start_us == lives[:, 0].min() and track.path.end_us == lives[:, 2].max()


def test_a_request_moves_one_thing_and_nothing_else(street):
    _, ego, dynamic, owner, tracks, index = street
    t_us = ego.start_us + 2_010_000
    ahead = int(index[np.flatnonzero((owner == 0) & (index >= 0))[0]]) - 7
    layer = dataclasses.replace(dynamic, track=np.where(index >= 0, index - 7, -1).astype(np.int32))
    span = (ego.start_us, ego.end_us)
    sensor = render_scenes.camera(240, 120)
    rig = ego.at(t_us) @ geometry.pose(np.eye(3), np.array([1.5, 0.0, 1.4]))

    def picture(scene_layer, actors):
        scene = render_scenes.scene(dynamic=scene_layer, tracks=tracks, span_us=span)
        request = render_scenes.request(sensor, rig, start_us=t_us, end_us=t_us + 1, actors=actors)
        return CpuRenderer(scene, threads=1).render_camera(request, outputs=("rgb", "alpha"))

    def without(number):
        rest = layer.track != number
        return DynamicGaussians(layer.gaussians[rest], layer.knot_t_us[rest], layer.knot_m[rest], layer.track[rest])

    moved_to = tracks[ahead].path.at(t_us)
    moved_to[1, 3] -= 3.0  # to the right
    request = {tracks[ahead].id: np.stack([moved_to, moved_to])}
    before, after, others = picture(layer, {}), picture(layer, request), picture(without(ahead), {})
    assert np.array_equal(picture(without(ahead), request).rgb, others.rgb)  # no other Gaussian follows
    there, gone = (np.abs(frame.alpha - others.alpha) > 0.2 for frame in (before, after))
    assert there.sum() > 150 and gone.sum() > 150
    columns = np.arange(240)
    was, became = (np.average(columns, weights=mask.sum(axis=0)) for mask in (there, gone))
    distance = tracks[ahead].path.at(t_us)[0, 3] - tracks[ahead].size_m[0] / 2 - rig[0, 3]
    assert became - was == pytest.approx(sensor.lens.fx_px * 3.0 / distance, rel=0.15)


def test_chunks_that_were_merged_in_any_order_give_the_same_tracks(street):
    _, ego, dynamic, _, tracks, index = street
    order = np.random.default_rng(0).permutation(len(dynamic))
    mixed = DynamicGaussians(
        dynamic.gaussians[order], dynamic.knot_t_us[order], dynamic.knot_m[order], dynamic.track[order]
    )
    again, mixed_index = group_into_tracks(mixed, ego, 7)
    assert np.array_equal(mixed_index, index[order]) and [t.id for t in again] == [t.id for t in tracks]
    for a, b in zip(again, tracks, strict=True):
        assert a.label == b.label and np.allclose(a.path.world_from_body, b.path.world_from_body, atol=1e-6)
    same, same_index = group_into_tracks(dynamic, ego, 7)
    assert np.array_equal(same_index, index)
    assert all(
        np.array_equal(a.path.world_from_body, b.path.world_from_body) for a, b in zip(same, tracks, strict=True)
    )


def test_defect_2_grouping_does_not_depend_on_the_clock(street):
    tracks, index = street[4:]
    later = 1_550_000_000_000_000
    ego = moving_things.ego(later)
    dynamic, _ = moving_things.lifted(moving_things.street(later), ego)
    again, again_index = group_into_tracks(dynamic, ego, 7)
    assert np.array_equal(again_index, index)
    assert np.allclose(again[0].path.position_m, tracks[0].path.position_m, atol=1e-4)


def test_labelled_gaussians_keep_their_track(street):
    _, ego, dynamic, owner, _, _ = street
    known = dataclasses.replace(dynamic, track=np.where(owner == 1, 3, -1).astype(np.int32))
    tracks, index = group_into_tracks(known, ego, 7, taken=("moving-2",))
    assert (index[owner == 1] == 3).all() and [t.id for t in tracks] == [f"moving-{k}" for k in (1, 3, 4, 5)]
    assert set(index.tolist()) == {-1, 3, *range(7, 11)}


def test_standing_things_are_boxes_that_stand():
    ego = moving_things.ego(speed=3.0)
    parked = moving_things.thing("parked", "automobile", (4.5, 1.8, 1.5), (22.0, 5.0), 0.5, 0.0)
    dynamic, owner = moving_things.lifted([parked], ego, speed_noise=0.1)
    (track,), index = group_into_tracks(dynamic, ego)
    assert np.mean(index[owner == 0] == 0) > 0.95 and np.ptp(track.path.position_m, axis=0).max() == 0
    assert np.linalg.norm(track.path.position_m[0, :2] - [22.0, 5.0]) < 0.6
    turned = geometry.wrap_angle(geometry.yaw_of(track.path.world_from_body[0]) - 0.5)
    assert min(abs(turned), np.pi - abs(turned)) < np.radians(20)


def test_what_is_no_thing_gets_no_track():
    """Noise alone, one frame alone, something as long as a street, and things far away."""
    ego = moving_things.ego()
    assert group_into_tracks(DynamicGaussians.empty(), ego)[0] == ()
    noise, _ = moving_things.lifted([], ego, outliers=3000)
    assert group_into_tracks(noise, ego)[0] == ()
    car = moving_things.thing("car", "automobile", (4.5, 1.8, 1.5), (14.0, 0.3), 0.0, 7.0)
    wall = moving_things.thing("wall", "other_vehicle", (30.0, 1.0, 3.0), (25.0, 6.0), 0.0, 5.0)
    far = moving_things.thing("far", "automobile", (4.5, 1.8, 1.5), (300.0, 0.3), 0.0, 7.0)
    once = moving_things.lifted([car], ego, seconds=0.5, outliers=0)[0]
    twice = moving_things.lifted([car], ego, seconds=1.0, outliers=0)[0]
    assert len(once) > 100 and group_into_tracks(once, ego)[0] == ()
    assert len(group_into_tracks(twice, ego)[0]) == 1
    for each in (wall, far):
        dynamic, _ = moving_things.lifted([each], ego)
        tracks, index = group_into_tracks(dynamic, ego)
        assert tracks == () and (index == -1).all()


def test_things_that_pass_close_by_are_kept_apart():
    """Two cars meet with 0.7 m between them, and a person steps past a parked car."""
    ego = moving_things.ego(speed=2.0)
    meeting = [
        moving_things.thing("one", "automobile", (4.5, 1.8, 1.5), (12.0, 0.0), 0.0, 4.0),
        moving_things.thing("two", "automobile", (4.5, 1.8, 1.5), (50.0, 2.5), np.pi, 5.0),
        moving_things.thing("parked", "automobile", (4.5, 1.8, 1.5), (24.0, -4.0), 0.0, 0.0),
        moving_things.thing("walker", "person", (0.6, 0.6, 1.7), (18.0, -1.9), 0.0, 1.5),
    ]
    dynamic, owner = moving_things.lifted(meeting, ego)
    tracks, index = group_into_tracks(dynamic, ego)
    for number in range(len(tracks)):
        mine = owner[index == number]
        assert np.mean(mine == np.bincount(mine + 1).argmax() - 1) > 0.95
    assert {int(np.bincount(owner[index == k] + 1).argmax()) - 1 for k in range(len(tracks))} == {0, 1, 2, 3}


@pytest.mark.parametrize("hidden_s, expected", [(0.9, 1), (2.4, 2)])
def test_a_thing_that_is_hidden_for_a_moment_stays_one_track(hidden_s, expected):
    ego = moving_things.ego()
    car = moving_things.thing("car", "automobile", (4.5, 1.8, 1.5), (14.0, 3.0), 0.0, 7.0)
    dynamic, _ = moving_things.lifted([car], ego, outliers=0)
    seen_s = (dynamic.knot_t_us[:, 1] - ego.start_us) / 1e6
    kept = (seen_s < 3.2) | (seen_s > 3.2 + hidden_s)
    hidden = DynamicGaussians(
        dynamic.gaussians[kept], dynamic.knot_t_us[kept], dynamic.knot_m[kept], dynamic.track[kept]
    )
    tracks, index = group_into_tracks(hidden, ego)
    assert len(tracks) == expected and np.mean(index >= 0) > 0.99


@pytest.mark.parametrize(
    "label, size, speed",
    [
        ("person", (0.6, 0.6, 1.75), 1.5),
        ("rider", (1.8, 0.6, 1.75), 5.0),
        ("automobile", (4.4, 1.8, 1.5), 6.0),
        ("heavy_truck", (9.0, 2.5, 3.4), 6.0),
    ],
)
def test_labels_go_by_size_and_speed(label, size, speed):
    ego = moving_things.ego(speed=4.0)
    thing = moving_things.thing("it", label, size, (18.0, 4.0), 0.2, speed)
    (track,), _ = group_into_tracks(moving_things.lifted([thing], ego, outliers=0)[0], ego)
    assert track.label == label and np.abs(np.subtract(track.size_m, size)).max() < 0.7


def test_a_car_of_which_only_the_rear_is_seen_stands_ahead_of_it():
    rng = np.random.default_rng(0)
    ego = moving_things.ego(speed=0.0)
    sightings = []
    for second in range(4):
        rear = np.column_stack([np.full(200, 10.0 + 5 * second), rng.uniform(-0.9, 0.9, 200), rng.uniform(0, 1.5, 200)])
        sightings.append(Sighting(ego.start_us + second * 1_000_000, rear, np.tile([5.0, 0, 0], (200, 1))))
    track = track_of("car", sightings, ego)
    assert track.label == "automobile" and track.size_m[0] == LEAST_M["automobile"][0]
    assert np.allclose(track.path.position_m[:, 0], [10, 15, 20, 25] + np.array(track.size_m[0] / 2), atol=0.01)
    assert np.abs(track.path.position_m[:, 1]).max() < 0.1
    longer = lengthened(track.path, (track.path.start_us - 500_000, track.path.end_us - 1))
    assert len(longer.t_us) == 5 and longer.position_m[0, 0] == pytest.approx(track.path.position_m[0, 0] - 2.5)
