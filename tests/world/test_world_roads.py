import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from nurec_sim import geometry
from nurec_sim.world import Road, RoadLine, RoadPiece, TownNetwork
from nurec_sim.world.model.triangles import ground_triangles, on_ground
from nurec_sim.world.plan import splits
from nurec_sim.world.plan.junctions import join, reaches
from nurec_sim.world.plan.layout import still_town
from nurec_sim.world.plan.road import RoadLanes
from nurec_sim.world.plan.templates import road_graph
from nurec_sim.world.plan.town import Narrowing


@pytest.fixture(scope="module", params=splits.TEMPLATES.all)
def network(request):
    return TownNetwork(still_town(5, "test", request.param))


pieces = st.builds(
    RoadPiece,
    length_m=st.floats(5, 60),
    start_curvature_per_m=st.floats(-0.04, 0.04),
    end_curvature_per_m=st.floats(-0.04, 0.04),
)
roads = st.builds(
    Road,
    id=st.just("road"),
    x_m=st.floats(-50, 50),
    y_m=st.floats(-50, 50),
    yaw_rad=st.floats(-3, 3),
    pieces=st.lists(pieces, min_size=1, max_size=4).map(tuple),
)


@settings(max_examples=40, deadline=None)
@given(road=roads, share=st.floats(0.05, 0.95), offset=st.floats(-5.0, 5.0))
def test_places_on_the_road_are_found_again(road, share, offset):
    line = RoadLine(road)
    fine, heading = line.at(np.linspace(0.0, line.length_m, 1000))
    assert np.isclose(geometry.arc_length(fine)[-1], line.length_m, rtol=1e-4)
    turn = sum(p.length_m * (p.start_curvature_per_m + p.end_curvature_per_m) / 2 for p in road.pieces)
    assert np.isclose(heading[-1] - heading[0], turn, atol=1e-9)
    xy, yaw = line.at(share * line.length_m, offset)
    centre, _ = line.at(share * line.length_m)
    assert np.isclose(np.linalg.norm(xy - centre), abs(offset))
    assert np.isclose((xy - centre) @ [np.cos(yaw), np.sin(yaw)], 0.0, atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(road=roads)
def test_centre_lines_agree_with_fine_integration(road):
    line = RoadLine(road)
    step = 0.002
    station = np.arange(0, line.length_m - step, step)
    _, yaw = line.at(station + step / 2)
    xy = np.array([road.x_m, road.y_m]) + step * np.stack([np.cos(yaw), np.sin(yaw)], axis=1).sum(axis=0)
    np.testing.assert_allclose(line.at(station[-1] + step)[0], xy, atol=1e-5)


def test_quarter_circle():
    xy, yaw = RoadLine(Road("arc", 0.0, 0.0, 0.0, (RoadPiece(np.pi * 15, 1 / 30, 1 / 30),))).end
    np.testing.assert_allclose(xy, [30.0, 30.0], atol=1e-9)
    np.testing.assert_allclose(yaw, np.pi / 2, atol=1e-12)


def test_widths_ease_into_the_narrowing_and_out():
    narrow = Narrowing(40.0, 60.0, 10.0, 2.8, 0.0, 2.2)
    lanes = RoadLanes(Road("n", 0.0, 0.0, 0.0, (RoadPiece(100.0),), 1, 1, 3.4, 2.2, 2.2, narrowing=narrow))
    station = np.array([0.0, 30.0, 35.0, 40.0, 50.0, 60.0, 65.0, 70.0])
    np.testing.assert_allclose(lanes.lane_width_m(station), [3.4, 3.4, 3.1, 2.8, 2.8, 2.8, 3.1, 3.4])
    np.testing.assert_allclose(lanes.strip_width_m(1, station), [2.2, 2.2, 1.1, 0, 0, 0, 1.1, 2.2], atol=1e-12)
    np.testing.assert_allclose(lanes.edge_m(-1, station)[4], -5.0)


@settings(max_examples=80, deadline=None)
@given(x=st.floats(8, 40), y=st.floats(-30, 30), turn=st.floats(-2.2, 2.2))
def test_paths_arrive_where_they_should(x, y, turn):
    start, end = (np.zeros(2), 0.3), (np.array([x, y]), 0.3 + turn)
    path = join(start, end)
    assert all(piece.length_m > 0 for piece in path)
    xy, yaw = RoadLine(Road("path", 0.0, 0.0, 0.3, path)).end
    np.testing.assert_allclose(xy, end[0], atol=1e-6)
    assert abs(geometry.wrap_angle(np.array(yaw - end[1]))) < 1e-6


def test_mouths_leave_room_for_the_corner():
    right_angles = reaches([(0.0, 4.0, 4.0), (np.pi / 2, 3.0, 3.0), (np.pi, 4.0, 4.0)], 6.0)
    np.testing.assert_allclose(right_angles, [3 + 6 + 0.5, 4 + 6 + 0.5, 3 + 6 + 0.5])


def test_lanes_are_connected(network):
    lanes = {lane.id: lane for lane in network.lanes}
    assert len(lanes) == len(network.lanes)
    for lane in network.lanes:
        assert bool(lane.successors) == bool(lane.ends_at or lane.in_junction)
        for name in lane.successors:
            follower = lanes[name]
            np.testing.assert_allclose(follower.polyline[0], lane.polyline[-1], atol=1e-6)
            before, after = lane.polyline[-1] - lane.polyline[-2], follower.polyline[1] - follower.polyline[0]
            assert before @ after > 0.98 * np.linalg.norm(before) * np.linalg.norm(after)
        ribbon = shapely.LineString(lane.polyline[:, :2]).buffer(lane.width_m / 2 - 0.05, cap_style="flat")
        assert ribbon.difference(network.surface.buffer(0.03)).area < 0.05


def test_areas_fit_together(network):
    surface = network.surface
    assert surface.is_valid and len(surface.geoms) == 1
    for a, b in ((surface, network.kerb), (network.kerb, network.sidewalk), (surface, network.sidewalk)):
        assert a.intersection(b).area < 1e-3
    whole = surface.area + network.kerb.area + network.sidewalk.area
    assert np.isclose(whole, network.paved.area, atol=0.05)
    inside = surface.buffer(1e-6)
    assert network.markings and all(inside.contains(marking.area) for marking in network.markings)
    islands = sum(len(polygon.interiors) for polygon in surface.geoms)
    assert islands == (network.plan.template == "roundabout")


def test_paint_lies_where_the_plan_says(network):
    white = shapely.union_all([marking.area for marking in network.markings if marking.colour == "white"])
    rules = {(arm.road, arm.end): arm.rule for junction in network.plan.junctions for arm in junction.arms}
    for stop in network.plan.stop_lines:
        line, side = network.roads[stop.road], -1 if stop.forward else 1
        middle = stop.station_m + 0.2 * side  # the line lies before the bumpers' station
        across = line.at(np.full(2, middle), np.array([side * 0.3, line.lane_edge_m(side, middle) - side * 0.5]))[0]
        painted = shapely.LineString(across).intersection(white).length / np.linalg.norm(across[1] - across[0])
        broken = rules[stop.road, "end" if stop.forward else "start"] == "yield"
        assert (0.4 < painted < 0.9) if broken else painted > 0.99
        other_side = line.at(middle, -side * 0.5 * line.plan.lane_width_m)[0]
        assert shapely.distance(white, shapely.Point(other_side)) > 0.1
    for crossing in network.plan.crossings:
        line = network.roads[crossing.road]
        band = line.surface(crossing.station_m + 0.2, crossing.station_m + crossing.depth_m - 0.2)
        painted = band.intersection(white).area / band.area
        assert (0.35 < painted < 0.6) if crossing.zebra else painted < 0.01


def test_road_map_is_the_surface(network):
    road_map = network.road_map()
    outer, *holes = road_map.drivable[0]
    polygon = shapely.Polygon(outer, holes)
    assert polygon.equals(network.surface.geoms[0]) and polygon.exterior.is_ccw
    assert len(road_map.lanes) == len(network.lanes)
    line = road_map.lanes[0]
    np.testing.assert_allclose(line[:, 2], network.height_m(line[:, :2]))


def test_ground_triangles_cover_an_area_once_and_follow_the_terrain(network):
    triangles = ground_triangles(network.surface)
    side = triangles[:, 1:] - triangles[:, :1]
    area = (side[:, 0, 0] * side[:, 1, 1] - side[:, 0, 1] * side[:, 1, 0]) / 2
    assert (area > 0).all() and np.isclose(area.sum(), network.surface.area, rtol=1e-6)
    assert shapely.union_all(shapely.polygons(triangles)).symmetric_difference(network.surface).area < 0.01
    terrain = network.plan.terrain
    middle = on_ground(triangles, terrain, 0.0).mean(axis=1)
    assert np.abs(middle[:, 2] - terrain.height_m(middle[:, :2])).max() < 0.004


@pytest.mark.parametrize("template", splits.TEMPLATES.all)
@pytest.mark.parametrize("seed", range(6))
def test_roads_meet_in_junctions_only(template, seed):
    found = road_graph(template, np.random.default_rng([seed, 99]))
    surfaces = [(lanes := RoadLanes(road)).surface(0.0, lanes.length_m) for road in found.roads]
    for k, first in enumerate(surfaces):
        assert first.is_valid
        assert all(first.intersection(second).area < 0.3 for second in surfaces[:k])
    tightest = [abs(p.start_curvature_per_m) for j in found.junctions for c in j.connections for p in c.pieces]
    assert max(tightest, default=0.0) < 1 / 4.5


def test_curves_come_in_many_radii():
    radii = []
    for seed in range(30):
        road = road_graph("curve", np.random.default_rng(seed)).roads[0]
        radii.append(1 / max(abs(piece.start_curvature_per_m) for piece in road.pieces))
    assert min(radii) < 40 and max(radii) > 130 and 25 - 1e-9 <= min(radii) and max(radii) <= 200 + 1e-9
