"""Traffic of whole towns: what must hold whatever the seed."""

import functools

import numpy as np
import pytest
import shapely

from nurec_sim import geometry
from nurec_sim.world import TownNetwork, town_plan
from nurec_sim.world.plan import splits
from nurec_sim.world.plan.swept_boxes import Boxes, touching
from nurec_sim.world.plan.town import EGO_MIDDLE_M
from nurec_sim.world.plan.traffic import drive, liveliness

ALL_TOWNS = [(seed, splits.TEMPLATES.all[seed % len(splits.TEMPLATES.all)]) for seed in range(18)]
"""Each template twice."""
QUICK = ("curve", "t_junction", "roundabout")


def towns(all_towns):
    """Towns as parameters: one of each of a few templates in the quick suite."""
    quick = {name: town for town in reversed(all_towns) if (name := town[1]) in QUICK}.values()
    return [town if town in quick else pytest.param(*town, marks=pytest.mark.slow) for town in all_towns]


TOWNS = ALL_TOWNS[: len(splits.TEMPLATES.all)]
EGO_M = (4.9, 1.9)


@functools.cache
def town(seed, template, split="test"):
    return town_plan(seed, split, template)


@functools.cache
def boxes(seed, template, split="test"):
    """The ego and all actors every 0.1 s, as the plan says, and which times those are."""
    plan = town(seed, template, split)
    t_us = np.arange(plan.span_us[0], plan.span_us[1] + 1, 100_000)
    ego = np.array(plan.ego)
    ways = [[np.interp(t_us, ego[:, 0], ego[:, k]) for k in (1, 2, 3)]]
    ways[0][0], ways[0][1] = (ways[0][k] + EGO_MIDDLE_M * f(ways[0][2]) for k, f in ((0, np.cos), (1, np.sin)))
    for actor in plan.actors:
        path = np.array(actor.path)
        ways.append([np.interp(t_us, path[:, 0], path[:, k]) for k in (1, 2, 4)])
    table = np.array(ways).transpose(2, 0, 1)
    half = np.array([EGO_M, *(actor.size_m[:2] for actor in plan.actors)]) / 2
    return Boxes(table[..., :2], table[..., 2], half)


@pytest.mark.parametrize("seed, template", towns(ALL_TOWNS))
def test_nobody_ever_touches_anybody(seed, template):
    names = ["ego", *(actor.id for actor in town(seed, template).actors)]
    assert [(names[i], names[j]) for i, j in touching(boxes(seed, template))] == []
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("seed, template", towns(TOWNS))
def test_who_drives_stays_on_the_road_and_who_walks_beside_it(seed, template):
    plan, all_boxes = town(seed, template), boxes(seed, template)
    network = TownNetwork(plan)
    road = network.surface.buffer(0.01)
    shapely.prepare(road)
    for index, actor in enumerate((None, *plan.actors)):
        places = zip(all_boxes.middle_m[::6, index], all_boxes.yaw_rad[::6, index], strict=True)
        outlines = shapely.polygons(np.array([
            geometry.box_corners_xy(geometry.pose_from_xyyaw(x, y, yaw), *(2 * all_boxes.half_m[index]))
            for (x, y), yaw in places
        ]))  # fmt: skip
        if actor is None or actor.kind != "pedestrian":
            outside = shapely.area(shapely.difference(outlines, network.surface))
            assert outside.max() < (0.01 if actor is None else 0.05), actor and actor.id
            continue
        height = np.array(actor.path)[:, 3] - actor.size_m[2] / 2
        assert -1e-3 <= height.min() and height.max() <= plan.kerb.height_m + 1e-3
        on_road = shapely.contains_xy(road, *np.array(actor.path)[:, 1:3].T)
        far = shapely.distance(road, shapely.points(np.array(actor.path)[:, 1:3])) > 0.3
        assert (height[far] > plan.kerb.height_m - 1e-3).all()
        crossing = shapely.union_all([across(network, each).buffer(3) for each in plan.crossings])
        assert shapely.contains_xy(crossing, *np.array(actor.path)[on_road, 1:3].T).all(), actor.id


def across(network, crossing):
    road, station = network.roads[crossing.road], crossing.station_m + crossing.depth_m / 2
    return shapely.LineString([road.at(station, offset)[0] for offset in (-12, 12)])


@pytest.mark.slow
def test_most_drives_are_lively_and_speeds_differ():
    shares, means, fastest = [], [], []
    for seed, template in ALL_TOWNS:
        plan, all_boxes = town(seed, template), boxes(seed, template)
        every = Boxes(
            np.repeat(all_boxes.middle_m, 2, axis=0), np.repeat(all_boxes.yaw_rad, 2, axis=0), all_boxes.half_m
        )
        moves = np.array([False, *(actor.moves for actor in plan.actors)])
        shares.append(liveliness(every, moves))
        ego = np.array(plan.ego)
        speed = np.linalg.norm(np.diff(ego[:, 1:3], axis=0), axis=1) / 0.05
        means.append(speed.mean())
        fastest.append(speed.max())
    assert np.mean(np.array(shares) > 0.5) > 0.8
    assert min(means) < 3 and max(means) > 8 and max(fastest) <= 16.5


@pytest.mark.parametrize("seed, template", towns(TOWNS))
def test_the_ego_drives_like_a_car(seed, template):
    ego = np.array(town(seed, template).ego)
    assert (np.diff(ego[:, 0]) == 50_000).all()
    assert ego[0, 0] == 1_000_000 and ego[-1, 0] == 13_000_000
    step = np.diff(ego[:, 1:3], axis=0)
    middle = (ego[1:, 3] + ego[:-1, 3]) / 2
    along = (step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle)) / 0.05
    aside = (step[:, 1] * np.cos(middle) - step[:, 0] * np.sin(middle)) / 0.05
    assert np.abs(aside).max() < 0.1 and along.min() > -0.05
    accel = np.diff(along) / 0.05
    assert accel.min() > -6.5 and accel.max() < 2.0
    assert np.abs(np.diff(ego[:, 3]) / 0.05 * along).max() < 4.5  # sideways acceleration


def test_same_seed_same_traffic():
    plan = town(4, "x_junction", "train")
    ego, actors = drive(TownNetwork(plan), 4, "train", plan.span_us)
    assert (ego, actors) == (plan.ego, plan.actors)
    assert any(actor.id == "lead" for actor in plan.actors) or plan.ego[0] != plan.ego[-1]


@pytest.mark.slow
def test_no_held_out_kinds_in_training():
    trained = {actor.kind for seed in range(3) for actor in town(seed, "straight", "train").actors}
    assert not trained & set(splits.VEHICLES.held_out)
    tested = {actor.kind for seed, template in TOWNS for actor in town(seed, template).actors}
    assert set(splits.VEHICLES.held_out) <= tested and {"cyclist", "pedestrian", "van", "sedan"} <= tested


def test_what_stands_says_so():
    plan = town(0, splits.TEMPLATES.all[0])
    still = [actor for actor in plan.actors if not actor.moves]
    assert still and all(len(actor.path) == 2 and actor.path[0][1:] == actor.path[1][1:] for actor in still)
    assert all(not actor.track().controllable for actor in still)
    assert all(actor.path[0][0] == plan.span_us[0] and actor.path[-1][0] == plan.span_us[1] for actor in plan.actors)
