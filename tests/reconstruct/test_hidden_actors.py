"""Actors that no sensor saw, or saw from one or two sides, get bodies of their class; others stay as they are."""

import dataclasses

import numpy as np
import pytest
from reconstruct_street import Street

from nurec_sim import geometry
from nurec_sim.reconstruct import hidden_actors, reconstruct
from nurec_sim.reconstruct.free_space import balls
from nurec_sim.reconstruct.hidden_actors import hidden_bodies, with_bodies
from nurec_sim.render import make_renderer
from nurec_sim.types import (
    DynamicGaussians,
    Gaussians,
    GaussianScene,
    Label,
    SensorRequest,
    Track,
    Trajectory,
)
from nurec_sim.world import actor_gaussians

SIZE_M = (4.5, 1.8, 1.5)
HIDDEN_M, OPEN_M, FAR_M = (8.0, 11.0), (8.0, 2.0), (8.0, 90.0)
"""Behind the wall, on the road that the LiDAR sees to be free, and farther than 60 m from the path."""


@pytest.fixture(scope="module")
def street() -> Street:
    return Street(frames=7, speed_mps=4.0)


def with_hidden_actors(scene, clip, hold_out=()) -> GaussianScene:
    return with_bodies(scene, hidden_bodies(scene, clip, hold_out))


def track(place_m=HIDDEN_M, **changes) -> Track:
    pose = geometry.pose_from_xyyaw(*place_m, 0.0, SIZE_M[2] / 2)
    whole = Trajectory(np.array([1_000_000, 2_400_000]), np.stack([pose, pose]))
    return dataclasses.replace(Track("car", "automobile", SIZE_M, whole), **changes)


def scene_of(street: Street, what: Track, own: Gaussians | None = None, in_box: bool = True) -> GaussianScene:
    dynamic = DynamicGaussians.empty()
    if own is not None:
        dynamic = DynamicGaussians.rigid(own, np.zeros(len(own), np.int32), 1_000_000)
        dynamic = dataclasses.replace(dynamic, in_box=np.full(len(own), in_box))
    return GaussianScene(
        id="street", static=Gaussians.empty(), dynamic=dynamic, sky=np.zeros((6, 8, 8, 3), np.float32), isp={},
        rig=street.rig, ego=street.ego, tracks=(what,), road_map=None, span_us=street.span_us,
        camera_times_us={}, provenance={"unknown": ["no map"]},
    )  # fmt: skip


def plate(x_m: float, y_m: float = 0.0, across: bool = True) -> Gaussians:
    """A wall of red Gaussians 10 cm apart: the rear of the box, or one of its sides."""
    width = SIZE_M[1] if across else SIZE_M[0]
    a, z = (
        part.ravel() for part in np.meshgrid(np.arange(0.05 - width / 2, width / 2, 0.1), np.arange(-0.7, 0.75, 0.1))
    )
    where = np.stack([np.full(a.size, x_m), a, z] if across else [a, np.full(a.size, y_m), z], axis=1)
    red = np.tile(np.array([[0.6, 0.1, 0.1]], np.float32), (len(where), 1))
    solid = np.full(len(where), 0.9, np.float32)
    return dataclasses.replace(balls(where, np.full(len(where), 0.05)), rgb=red, opacity=solid)


def test_an_actor_that_nothing_saw_gets_a_body_that_fills_its_box(street):
    completed = with_hidden_actors(scene_of(street, track()), street)
    body = completed.dynamic.gaussians
    assert (completed.dynamic.track == 0).all() and completed.dynamic.in_box.all()
    assert np.allclose(np.ptp(body.mean_m, axis=0), SIZE_M, atol=0.1)
    assert np.allclose(body.mean_m.min(axis=0), -np.array(SIZE_M) / 2, atol=0.1)
    assert (body.label == Label.MOVABLE).all()  # no second shadow
    assert completed.provenance["completed_actors"] == {"car": 0.0}
    assert completed.provenance["unknown"] == ["no map"]


@pytest.mark.parametrize(
    "label, size_m, kind",
    [
        ("automobile", (4.7, 1.8, 1.4), "sedan"),
        ("automobile", (5.2, 2.0, 2.2), "van"),
        ("bus", (12.0, 2.5, 3.2), "bus"),
        ("person", (0.6, 0.6, 1.8), "pedestrian"),
        ("rider", (1.8, 0.6, 1.7), "cyclist"),
    ],
)
def test_the_body_is_of_the_actors_class_and_the_kind_that_is_stretched_least(street, monkeypatch, label, size_m, kind):
    made = []

    def noted(*given):
        made.append(given)
        return actor_gaussians(*given)

    monkeypatch.setattr(hidden_actors, "actor_gaussians", noted)
    completed = with_hidden_actors(scene_of(street, track(label=label, size_m=size_m)), street)
    assert [given[:2] for given in made] == [(kind, size_m)]
    # 1.5 times as far apart as those of an actor that a scenario adds: 1 / 2.25 as many, a little more on small parts.
    usual = actor_gaussians(kind, size_m, (0.5, 0.5, 0.5))
    assert 0.4 < len(completed.dynamic) / (usual.label == Label.MOVABLE).sum() < 0.6


def test_what_beams_passed_through_is_left_out(street):
    # Half of the box lies behind the wall at y = 8 m, the other half stands over the pavement that the LiDAR saw.
    over = with_hidden_actors(scene_of(street, track((8.0, 8.2))), street).dynamic.gaussians
    behind = with_hidden_actors(scene_of(street, track()), street).dynamic.gaussians
    inside, outside = ([(each.mean_m[:, 1] * side > 0.3).sum() for side in (1, -1)] for each in (behind, over))
    assert inside[0] == pytest.approx(inside[1], rel=0.1)
    assert outside[0] == pytest.approx(inside[0], rel=0.05) and outside[1] < 0.9 * inside[1]


@pytest.mark.parametrize("grey, factor", [(0.33, 1.0), (0.6, 1.0), (0.165, 0.5), (0.01, 0.3)])
def test_bodies_are_as_dark_as_the_night_around_them(street, grey, factor):
    around = plate(20.0)
    dark = dataclasses.replace(around, rgb=np.full((len(around), 3), grey, np.float32))
    by_night = dataclasses.replace(scene_of(street, track()), static=dark)
    bodies = [with_hidden_actors(each, street).dynamic.gaussians for each in (scene_of(street, track()), by_night)]
    assert bodies[1].rgb == pytest.approx(factor * bodies[0].rgb, abs=1e-5)


def test_what_was_seen_from_behind_keeps_its_rear_and_gets_the_rest_in_its_colour(street):
    rear = plate(-2.2)
    completed = with_hidden_actors(scene_of(street, track(), rear), street)
    added = completed.dynamic.gaussians[len(rear) :]
    distance = np.linalg.norm(added.mean_m[:, None] - rear.mean_m[None], axis=2).min(axis=1)
    assert distance.min() > 0.4 and added.mean_m[:, 0].max() > 2.1
    red, green, _ = np.median(added.rgb[(np.abs(added.mean_m[:, 1]) > 0.8) & (added.mean_m[:, 2] < 0)], axis=0)
    assert red > 3 * green
    # Four of sixteen directions are those to the rear, from corner to corner.
    assert completed.provenance["completed_actors"]["car"] == 0.25


def test_the_paint_is_the_colour_of_the_brighter_half_of_what_was_seen(street):
    """More than half of a rear is a dark window."""
    rear = plate(-2.2)
    dark = dataclasses.replace(rear, rgb=np.where(rear.mean_m[:, 2:] > -0.2, np.float32(0.02), rear.rgb))
    assert (dark.rgb[:, 0] < 0.1).mean() == pytest.approx(0.6)
    bodies = [with_hidden_actors(scene_of(street, track(), own), street).dynamic.gaussians[len(own) :]
              for own in (rear, dark)]  # fmt: skip
    sides = [
        np.median(body.rgb[(np.abs(body.mean_m[:, 1]) > 0.8) & (body.mean_m[:, 2] < 0)], axis=0) for body in bodies
    ]
    assert sides[1][0] > 0.5 * sides[0][0] and sides[1][0] > 2 * sides[1][1]


def test_what_was_seen_from_two_sides_gets_the_others(street):
    own = Gaussians.concatenate([plate(-2.2), plate(0, 0.9, across=False)])
    completed = with_hidden_actors(scene_of(street, track(), own), street)
    added = completed.dynamic.gaussians[len(own) :].mean_m
    assert added[:, 1].min() < -0.8 and added[:, 0].max() > 2.1
    assert added[np.abs(added[:, 0]) < 1.5, 1].max() < 0.6
    assert completed.provenance["completed_actors"]["car"] == 0.5


@pytest.mark.parametrize("in_box", [True, False])
def test_a_shadow_shows_nothing_of_its_actor(street, in_box):
    """It lies around the whole box; that of a turning car is not fixed to it."""
    own = plate(-2.2)
    dark = plate(0, 0.9, across=False)
    dark = dataclasses.replace(dark, label=np.full(len(dark), Label.ROAD, np.uint8))
    alone = with_hidden_actors(scene_of(street, track(), own), street)
    scene = scene_of(street, track(), Gaussians.concatenate([own, dark]))
    fixed = np.arange(len(scene.dynamic)) < len(own)
    scene = dataclasses.replace(scene, dynamic=dataclasses.replace(scene.dynamic, in_box=fixed | in_box))
    completed = with_hidden_actors(scene, street)
    added = completed.dynamic.gaussians[len(scene.dynamic) :]
    assert np.array_equal(added.mean_m, alone.dynamic.gaussians[len(own) :].mean_m)
    assert np.array_equal(added.rgb, alone.dynamic.gaussians[len(own) :].rgb)


def test_an_actor_found_in_the_sweeps_of_the_log_gets_a_body(street, monkeypatch):
    found = track(labelled=False)
    monkeypatch.setattr(street, "tracks", (found,))
    assert with_hidden_actors(scene_of(street, found), street).provenance["completed_actors"] == {"car": 0.0}


@pytest.mark.parametrize(
    "what, own",
    [
        (track(), Gaussians.concatenate([plate(-2.2), *(plate(0, side, across=False) for side in (0.9, -0.9))])),
        (track(labelled=False), None),
        (track(actor=False), None),
        (track(label="animal"), None),
        (track(size_m=(14.0, 1.8, 1.5)), None),
        (track(size_m=(4.5, 0.0, 1.5)), None),
        (track(FAR_M), None),
        (track(OPEN_M), None),
    ],
    ids=[
        "seen from three sides",
        "found by a network",
        "no actor",
        "no body of its class",
        "far too long",
        "no width",
        "far away",
        "in free space",
    ],
)
def test_others_stay_as_they_are(street, what, own):
    before = scene_of(street, what, own)
    assert with_hidden_actors(before, street) is before


def test_no_part_of_a_body_is_where_an_image_looks(street):
    # The car stands 3.2 m above the road, where no beam came by; the camera 5.25 m behind it sees a wall and its lower
    # part.
    place = geometry.pose_from_xyyaw(9.0, 0.0, 0.0, 4.0)
    there = Trajectory(np.array([1_000_000, 2_400_000]), np.stack([place, place]))
    across, z = (part.ravel() for part in np.meshgrid(np.arange(-9, 9, 0.15), np.arange(-1, 14, 0.15)))
    times_us = {"front": street.camera_times_us("front")[:1]}

    def along(wall_m):
        wall = balls(np.stack([np.full(across.size, wall_m), across, z], axis=1), np.full(across.size, 0.15))
        solid = dataclasses.replace(wall, opacity=np.full(len(wall), 0.95, np.float32))
        before = dataclasses.replace(scene_of(street, track(path=there)), static=solid, camera_times_us=times_us)
        return with_hidden_actors(before, street).dynamic.gaussians.mean_m[:, 0]

    before_it, at_its_rear, behind_it = along(4.0), along(6.9), along(14.0)
    assert not len(behind_it)  # the image looks through it
    assert before_it.max() > 2.2 and at_its_rear.max() > 2.2
    rear = [(each < -2.2).sum() for each in (before_it, at_its_rear)]
    assert rear[1] < 0.9 * rear[0]  # what the image sees there is the wall, 15 cm thick


def test_what_is_not_fixed_to_its_box_stays(street):
    before = scene_of(street, track(), plate(-2.2), in_box=False)
    assert with_hidden_actors(before, street) is before


def test_a_body_joins_view_dependent_colours(street):
    rear = dataclasses.replace(plate(-2.2), sh_rest=np.full((len(plate(-2.2)), 3, 3), 0.1, np.float32))
    rest = with_hidden_actors(scene_of(street, track(), rear), street).dynamic.gaussians.sh_rest
    assert (rest[: len(rear)] == np.float32(0.1)).all() and (rest[len(rear) :] == 0).all() and len(rest) > len(rear)


def test_a_standing_car_that_a_method_left_in_the_static_layer_was_seen(street):
    around = Gaussians.concatenate([plate(x) for x in (-2.2, 2.2)] + [plate(0, y, across=False) for y in (-0.8, 0.8)])
    place = around.mean_m + np.array([*HIDDEN_M, SIZE_M[2] / 2], np.float32)
    label = np.full(len(around), Label.MOVABLE, np.uint8)
    before = dataclasses.replace(
        scene_of(street, track()), static=dataclasses.replace(around, mean_m=place, label=label)
    )
    assert with_hidden_actors(before, street) is before
    wall = dataclasses.replace(before, static=dataclasses.replace(before.static, label=np.zeros_like(label)))
    assert with_hidden_actors(wall, street).provenance["completed_actors"] == {"car": 0.0}


def test_sweeps_that_are_held_out_are_not_read(street):
    class Careful(Street):
        def sweep(self, lidar_id, index):
            assert index not in (1, 3)
            return super().sweep(lidar_id, index)

    with_hidden_actors(scene_of(street, track()), Careful(frames=7, speed_mps=4.0), {1, 3})


@pytest.mark.parametrize("complete", [True, False])
def test_reconstruct_makes_a_hidden_actor_visible_to_a_lidar_beside_it(complete):
    log = Street(frames=5, speed_mps=4.0)
    log.tracks = [track()]
    scene = reconstruct(log, "lift", complete_actors=complete)
    assert ("completed_actors" in scene.provenance) == complete
    lidar = log.rig.lidars["top"]
    pose = geometry.pose_from_xyyaw(0.0, HIDDEN_M[1], 0.0) @ lidar.rig_from_lidar  # behind it, behind the wall
    (sweep,) = make_renderer(scene, "cpu").sense(
        [SensorRequest("street", lidar, 1_500_000, 1_500_001, np.stack([pose, pose]))]
    )
    points = geometry.transform_points(pose, sweep.xyz_m.astype(np.float64)) - [*HIDDEN_M, SIZE_M[2] / 2]
    on_it = (np.abs(points) < np.array(SIZE_M) / 2 + 0.1).all(axis=1) & (points[:, 2] > 0)  # not on the ground
    assert (on_it.sum() > 20) == complete
