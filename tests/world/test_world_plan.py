import dataclasses

import numpy as np
import pytest
import shapely
from repetition import slow_after

from nurec_sim import geometry
from nurec_sim.errors import ClipError
from nurec_sim.world import TownNetwork, TownPlan, town_plan
from nurec_sim.world.plan import splits
from nurec_sim.world.plan.appearance import town_style, town_weather
from nurec_sim.world.plan.layout import still_town
from nurec_sim.world.plan.terrain import Terrain, Wave

BODY_CENTRE_M, BODY_SIZE_M = 1.4, (4.9, 1.9)


def box(world_from_box, length_m, width_m):
    return shapely.Polygon(geometry.box_corners_xy(world_from_box, length_m, width_m))


@pytest.fixture(scope="module", params=slow_after(4, splits.TEMPLATES.all))
def plan(request):
    split = "test" if request.param in splits.TEMPLATES.held_out else "train"
    return town_plan(3, split, request.param)


@pytest.fixture(scope="module")
def network(plan):
    return TownNetwork(plan)


def test_plan_survives_json_to_the_bit(plan):
    text = plan.to_json()
    again = TownPlan.from_json(text)
    assert again == plan
    assert again.to_json() == text


def test_same_seed_same_bytes_and_splits_share_nothing():
    first, again = town_plan(11, seconds=1.0), town_plan(11, seconds=1.0)
    assert first.to_json() == again.to_json()
    other, test = still_town(12), still_town(11, "test", first.template)
    assert first.roads != other.roads and first.roads != test.roads
    assert first.buildings != test.buildings and first.weather != test.weather


def test_houses_and_furniture_keep_off_the_road_and_off_each_other(plan, network):
    houses = [box(geometry.pose_from_xyyaw(h.x_m, h.y_m, h.yaw_rad), h.width_m, h.depth_m) for h in plan.buildings]
    assert len(houses) > 20
    tree = shapely.STRtree(houses)
    assert (np.diff(tree.query(houses, predicate="intersects"), axis=0) == 0).all()
    assert not any(house.intersects(network.paved) for house in houses)
    places = shapely.points([(prop.x_m, prop.y_m) for prop in plan.props])
    on_road = np.array([prop.on_road for prop in plan.props])
    np.testing.assert_array_equal(shapely.contains(network.surface, places), on_road)
    assert not shapely.intersects(shapely.union_all(houses), places).any()
    assert {prop.kind for prop in plan.props} >= {"tree", "lamp", "bush"}


def test_nobody_touches_anybody_and_the_ego_stays_on_the_road(plan, network):
    road, ego, tracks = network.surface.buffer(0.03), plan.ego_trajectory(), plan.tracks()
    for t_us in range(plan.span_us[0], plan.span_us[1] + 1, 500_000):
        middle = ego.at(t_us) @ geometry.pose_from_xyyaw(BODY_CENTRE_M, 0, 0)
        boxes = [box(middle, *BODY_SIZE_M), *(box(track.path.at(t_us), *track.size_m[:2]) for track in tracks)]
        pairs = shapely.STRtree(boxes).query(boxes, predicate="intersects")
        assert (pairs[0] == pairs[1]).all()
        assert road.contains(boxes[0])
    assert all(track.path.start_us <= plan.span_us[0] and plan.span_us[1] <= track.path.end_us for track in tracks)


def test_ego_and_cars_stand_on_the_sloping_ground(plan):
    poses = plan.ego_trajectory().world_from_body
    wheels = np.array([[0.0, 0.8, 0], [0.0, -0.8, 0], [2.8, 0.8, 0], [2.8, -0.8, 0]])
    for pose in poses[::20]:
        touch = geometry.transform_points(pose, wheels)
        np.testing.assert_allclose(touch[:, 2], plan.terrain.height_m(touch[:, :2]), atol=0.012)
    for actor, track in zip(plan.actors, plan.tracks(), strict=True):
        if track.label == "automobile":
            bottom = geometry.transform_points(track.path.world_from_body[0], np.array([[0, 0, -actor.size_m[2] / 2]]))
            np.testing.assert_allclose(bottom[0, 2], plan.terrain.height_m(bottom[0, :2]), atol=1e-6)


@pytest.mark.slow
def test_training_never_sees_what_is_held_out():
    kinds = (splits.TEMPLATES, splits.FACADES, splits.ASPHALTS, splits.PAVINGS, splits.FOLIAGES, splits.SKIES)
    held_out = {name for choices in kinds for name in choices.held_out}
    presets = set()
    for seed in range(40):
        rng = np.random.default_rng(seed)
        style, weather = town_style(rng, "train"), town_weather(rng, "train")
        assert not {*style.facades, style.asphalt, style.paving, *style.foliages, weather.preset} & held_out
        style, weather = town_style(rng, "test"), town_weather(rng, "test")
        assert style.asphalt in splits.ASPHALTS.held_out and style.paving in splits.PAVINGS.held_out
        assert set(style.facades) & set(splits.FACADES.held_out)
        presets.add(weather.preset in splits.SKIES.held_out)
    assert presets == {True, False}
    trained = [still_town(seed) for seed in range(5)]
    assert not {town.template for town in trained} & held_out
    assert not {house.family for town in trained for house in town.buildings} & held_out
    assert {still_town(seed, "test").template for seed in range(5)} & held_out


def test_held_out_vehicles_drive_in_test_towns_only(plan):
    strange = {actor.kind for actor in plan.actors} & set(splits.VEHICLES.held_out)
    assert bool(strange) == (plan.split == "test")


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"seed": -1}, "a town needs a seed >= 0 and 1..30 seconds, got seed -1"),
        ({"seed": 1, "seconds": 0.5}, "1..30 seconds, got seed 1, 0.5 seconds"),
        ({"seed": 1, "split": "val"}, "no split 'val'; have train, test"),
        ({"seed": 1, "template": "roundabout"}, "no template 'roundabout' in split 'train'; have straight, curve"),
    ],
)
def test_impossible_towns_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        town_plan(**arguments)


def test_broken_plans_are_refused_with_the_field():
    text = town_plan(1, template="straight", seconds=1.0).to_json()
    with pytest.raises(ClipError, match=r"not a town plan: roads\.0\.lane_widht_m: Unexpected keyword.*seed, split"):
        TownPlan.from_json(text.replace('"lane_width_m"', '"lane_widht_m"'))
    with pytest.raises(ClipError, match=r"not a town plan: roads\.0\.pieces\.0\.length_m: .*number"):
        TownPlan.from_json(
            text.replace(
                '"pieces": [\n    {\n     "length_m": ', '"pieces": [\n    {\n     "length_m": "long", "was": '
            )
        )
    with pytest.raises(ClipError, match="not a town plan: the text itself: Invalid JSON"):
        TownPlan.from_json(text[:-30])


@pytest.mark.parametrize(
    "old, new, message",
    [
        ('"road": "stem"', '"road": "trunk"', "no road 'trunk'; have east, stem, west"),
        ('"from_lane": "stem:1"', '"from_lane": "stem:7"', "no lane 'stem:7'; have east:-1"),
        ('"id": "west"', '"id": "east"', "two roads are called 'east'"),
        ('"pieces": [', '"pieces": [], "other": [', r"roads\.0\.pieces: Tuple should have at least 1 item"),
    ],
)
def test_plans_whose_parts_do_not_fit_are_refused(old, new, message):
    text = still_town(2, template="t_junction").to_json()
    assert old in text
    with pytest.raises(ClipError, match=f"not a town plan: {message}"):
        TownPlan.from_json(text.replace(old, new))


def test_plans_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        town_plan(1, template="straight", seconds=1.0).seed = 3


def test_terrain_gradient_is_the_slope_of_its_height():
    terrain = Terrain((Wave(1.2, 180.0, 0.4, 1.0), Wave(0.7, 150.0, -2.0, 0.2)))
    xy, step = np.random.default_rng(0).uniform(-200, 200, (50, 2)), 1e-4
    for axis in (0, 1):
        ahead = xy + step * np.eye(2)[axis]
        slope = (terrain.height_m(ahead) - terrain.height_m(xy)) / step
        np.testing.assert_allclose(terrain.gradient(xy)[:, axis], slope, atol=1e-5)
    poses = terrain.poses(xy, np.linspace(-3, 3, 50), np.full(50, 0.7))
    assert all(geometry.is_rotation(pose[:3, :3], 1e-9) for pose in poses)
