"""``map.xodr`` as AlpaSim reads it: lines and arcs, lanes under the path, the drivable area's off-road verdicts."""

import dataclasses
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely
from repetition import slow_after
from scene_worlds import curved_path, full_scene

from nurec_sim import geometry
from nurec_sim.errors import ArchiveError
from nurec_sim.metrics.offroad_grid import Cell, OffroadGrid, road_map_of_grid
from nurec_sim.scene.interop.validate.alpasim_map import AlpasimMap
from nurec_sim.scene.interop.validate.map_agreement import agreement, outlines
from nurec_sim.scene.opendrive.curves import fitted, sampled
from nurec_sim.scene.opendrive.reader import lanes_from
from nurec_sim.scene.opendrive.road_area import drivable_area
from nurec_sim.scene.opendrive.writer import opendrive_map
from nurec_sim.types import RoadMap
from nurec_sim.world import TownNetwork, town_plan

CENTRE_M, SIZE_M = np.array([1.4, 0.0, 0.75]), np.array([4.9, 1.9, 1.5])
ROAD = """<road id="1" length="20" junction="{junction}"><planView><geometry s="0" x="0" y="0" hdg="0" length="20">
{shape}</geometry></planView><elevationProfile><elevation s="0" a="{z}" b="0" c="0" d="0"/></elevationProfile>
<lanes><laneSection s="0">{left}<center/><right>{right}</right></laneSection></lanes></road>"""
LANE = '<lane id="{}" type="{}"><width sOffset="0" a="{}" b="0" c="0" d="0"/></lane>'


def read(*roads):
    return AlpasimMap(ElementTree.fromstring(f"<OpenDRIVE>{''.join(roads)}</OpenDRIVE>"))


def road(right, left="", shape="<line/>", junction="-1", z=0.0):
    lanes = "".join(LANE.format(-1 - k, kind, width) for k, (kind, width) in enumerate(right))
    left = f"<left>{left}</left>" if left else ""
    return ROAD.format(right=lanes, left=left, shape=shape, junction=junction, z=z)


def car(x, y, yaw=0.0, z=0.0):
    pose = geometry.pose_from_xyyaw(x, y, yaw)
    pose[2, 3] = z
    return outlines(pose[None], np.zeros(3), SIZE_M)


# ------------------------------------------------------------------------------------ the loader's rules, by hand


def test_edges_lie_at_the_right_border_and_beside_the_reference_line():
    found = read(road([("driving", 3.5), ("parking", 2.0)]))
    assert [lane.kind for lane in found.lanes] == ["driving", "parking"]
    assert sorted(edge[0, 1] for edge in found.edges) == [-5.5, 0.01]
    assert [edge[0, 1] for edge in read(road([("driving", 3.5)], junction="7")).edges] == [-3.5]
    assert np.allclose(np.diff(found.lanes[0].centre[:, 0]), 20 / 39)  # 40 samples from end to end


def test_a_left_lane_moves_the_edge_to_its_inner_border_and_a_thin_one_removes_it():
    left = LANE.format(1, "driving", 3.0)
    assert sorted(edge[0, 1] for edge in read(road([("driving", 3.5)], left)).edges) == [-3.5, 0.0]
    thin = LANE.format(1, "none", 0.02)
    assert [edge[0, 1] for edge in read(road([("driving", 3.5)], thin)).edges] == [-3.5]


def test_sidewalks_are_no_lanes_and_other_geometries_are_refused():
    assert [lane.kind for lane in read(road([("driving", 3.5), ("sidewalk", 2.0)])).lanes] == ["driving"]
    with pytest.raises(ArchiveError, match="road 1 has the geometry <paramPoly3>, only line and arc are read"):
        read(road([("driving", 3.5)], shape="<paramPoly3/>"))
    with pytest.raises(ArchiveError, match="no road has a lane"):
        read(road([("sidewalk", 3.5)]))


def test_of_two_near_parallel_edges_the_longer_one_counts():
    """A median of 1 m between two roads: their edges lie 1.01 m apart."""
    other = road([("driving", 3.5)]).replace('y="0"', 'y="-4.5"').replace('length="20"', 'length="19"')
    kept = [edge for edge in read(road([("driving", 3.5)]), other).edges if -4.6 < edge[0, 1] < -3.4]
    assert [edge[0, 1] for edge in kept] == [-3.5]


@pytest.mark.parametrize(("y", "z", "off"), [(-1.75, 0.0, False), (-2.6, 0.0, True), (-1.75, 7.0, True),
                                             (-9.0, 0.0, False), (-0.9, 0.0, True)])  # fmt: skip
def test_off_road_is_outside_of_the_lanes_and_on_the_nearest_edge(y, z, off):
    """One lane from 0 to -3.5 m. Cars 7 m above it have no lane near; those wholly outside meet no edge."""
    found = read(road([("driving", 3.5)]))
    if z:
        y = -2.6  # one lane that contains it is not enough: it must be near
    assert bool(found.offroad(*car(10.0, y, z=z))[0]) is off


def test_two_lanes_without_a_gap_contain_a_car_between_them():
    both = read(road([("driving", 3.5), ("driving", 3.5)]))
    assert not both.offroad(*car(10.0, -3.5))[0]


# ------------------------------------------------------------------------------------------------------ what we write


@pytest.mark.parametrize(("seed", "split", "template", "kind"), slow_after(1, [(1, "train", "x_junction", "crossing"),
                         (5, "test", "roundabout", "roundabout"), (4, "train", "s_curve", "")]))  # fmt: skip
def test_towns_have_the_verdicts_of_their_drivable_area(seed, split, template, kind):
    plan = town_plan(seed, split, template)
    assert not kind or any(junction.kind == kind for junction in plan.junctions)
    network, ego = TownNetwork(plan), plan.ego_trajectory()
    road_map = network.road_map()
    data = opendrive_map("town", road_map, ego)
    roads = AlpasimMap(ElementTree.fromstring(data))
    found = agreement(roads, drivable_area(road_map), ego.world_from_body, CENTRE_M, SIZE_M, 300)
    assert found.judged > 200 and found.share >= 0.98
    assert found.false_alarms == found.alarms_on_path == found.poses_off_lanes == 0
    assert all(shapely.Polygon(lane.outline).is_valid for lane in roads.lanes)
    assert max(np.ptp(lane.outline, axis=0).min() for lane in roads.lanes) > 0
    widths = [np.linalg.norm(lane.outline[0] - lane.outline[-1]) for lane in roads.lanes]
    assert max(widths) < 4.2
    for line in lanes_from(data, "map.xodr"):  # our own reader finds driving lanes on the ground of the town
        assert np.abs(line[:, 2] - network.height_m(line[:, :2])).max() < 0.15
        assert shapely.distance(drivable_area(road_map), shapely.points(line[:, :2])).max() < 0.05


def test_one_road_per_lane_is_found_out():
    """The layout that AlpaSim misjudges: a lane of 3.5 m along the path, nothing else of a street of 8 m."""
    scene = full_scene(0)
    ego, area = scene.ego, drivable_area(scene.road_map)
    narrow = dataclasses.replace(scene.road_map, drivable=())
    roads = AlpasimMap(ElementTree.fromstring(opendrive_map("a", narrow, ego)))
    assert agreement(roads, area, ego.world_from_body, CENTRE_M, SIZE_M, 200).share < 0.95


def test_maps_without_lanes_or_without_areas():
    scene = full_scene(0)
    for road_map in (RoadMap((), (scene.ego.position_m,)), RoadMap(scene.road_map.drivable[:1], ())):
        roads = AlpasimMap(ElementTree.fromstring(opendrive_map("a", road_map, scene.ego)))
        assert "driving" in {lane.kind for lane in roads.lanes}
        assert roads.on_lane(scene.ego.position_m[1:-1]).all()


def test_curves_stay_by_their_line_without_kinks():
    line = curved_path(200).position_m[:, :2]
    pieces = fitted(line)
    xy, yaw = sampled(pieces)
    assert shapely.distance(shapely.LineString(line), shapely.points(xy)).max() < 0.03
    assert np.abs(np.diff(yaw)).max() < 0.06
    assert {piece.curvature_per_m == 0 for piece in pieces} == {True, False}
    # 0.5 m per sample, whatever the pieces are; the last one may be of any length.
    samples = sum(max(2, int(np.ceil(piece.length_m / 0.5))) for piece in pieces)
    assert abs(0.5 * samples / sum(piece.length_m for piece in pieces) - 1) < 0.03


def test_the_road_cells_of_a_grid_become_an_area():
    state = np.full((100, 200), Cell.NONROAD, np.uint8)
    state[20:60, 10:190] = Cell.ROAD
    (rings,) = road_map_of_grid(OffroadGrid.from_state((5.0, -3.0), 0.1, state, 0.2, 0.0)).drivable
    area = shapely.Polygon(rings[0])
    assert np.allclose(area.bounds, (6.0, -1.0, 24.0, 3.0), atol=0.06)
    assert 71 < area.area <= 72.1
