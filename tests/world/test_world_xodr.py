from xml.etree import ElementTree

import numpy as np
import pytest
import shapely

from nurec_sim.scene.opendrive.reader import lanes_from
from nurec_sim.world import TownNetwork
from nurec_sim.world.plan import splits
from nurec_sim.world.plan.layout import still_town
from nurec_sim.world.xodr import opendrive_town


@pytest.fixture(scope="module", params=splits.TEMPLATES.all)
def town(request):
    plan = still_town(9, "test", request.param)
    return TownNetwork(plan), opendrive_town(plan)


def test_same_plan_same_bytes(town):
    network, xodr = town
    assert opendrive_town(network.plan) == xodr


def test_lanes_read_back_are_those_of_the_network(town):
    network, xodr = town
    read = lanes_from(xodr, "map.xodr")
    assert len(read) == len(network.lanes)
    lines = [shapely.LineString(lane.polyline[:, :2]) for lane in network.lanes]
    starts = [{tuple(np.round(lane.polyline[end, :2], 1)) for end in (0, -1)} for lane in network.lanes]
    for line in read:
        same_ends = [own for own, ends in zip(lines, starts, strict=True)
                     if {tuple(np.round(line[end, :2], 1)) for end in (0, -1)} == ends]  # fmt: skip
        away = min(shapely.distance(own, shapely.points(line[:, :2])).max() for own in same_ends)
        assert away < 0.02  # one metre of arc and its chord
        # Lanes lie beside their reference line, and the reader does not apply superelevation.
        assert np.abs(line[:, 2] - network.height_m(line[:, :2])).max() < 0.45


def test_reference_lines_and_heights_are_exact(town):
    network, xodr = town
    root = ElementTree.fromstring(xodr)
    for road in root.iterfind("road"):
        if road.get("junction") != "-1":
            continue
        line = network.roads[road.get("name")]
        assert float(road.get("length")) == pytest.approx(line.length_m)
        for piece in road.iterfind("planView/geometry"):
            xy, yaw = line.at(float(piece.get("s")))
            np.testing.assert_allclose([float(piece.get("x")), float(piece.get("y"))], xy, atol=1e-9)
            assert np.cos(float(piece.get("hdg")) - yaw) == pytest.approx(1.0)
        rows = [[float(row.get(key)) for key in "sabcd"] for row in road.iterfind("elevationProfile/elevation")]
        for s, a, b, c, d in rows:
            for ahead in (0.0, 3.0):
                if s + ahead < line.length_m:
                    height = a + ahead * (b + ahead * (c + ahead * d))
                    assert height == pytest.approx(float(network.height_m(line.at(s + ahead)[0])), abs=0.002)


def test_links_name_roads_lanes_and_junctions_that_exist(town):
    network, xodr = town
    root = ElementTree.fromstring(xodr)
    roads = {road.get("id"): road for road in root.iterfind("road")}
    junctions = {junction.get("id") for junction in root.iterfind("junction")}
    assert len(roads) == len(root.findall("road")) and len(junctions) == len(network.plan.junctions)
    lanes_of = {key: {lane.get("id") for lane in road.iter("lane")} for key, road in roads.items()}
    for road in roads.values():
        for end in road.find("link"):
            if end.get("elementType") == "junction":
                assert end.get("elementId") in junctions
            else:
                assert end.get("contactPoint") in ("start", "end")
                lane = road.find(f"lanes/laneSection/right/lane/link/{end.tag}")
                assert lane.get("id") in lanes_of[end.get("elementId")]
    for connection in root.iterfind("junction/connection"):
        link = connection.find("laneLink")
        assert link.get("from") in lanes_of[connection.get("incomingRoad")]
        assert roads[connection.get("connectingRoad")].get("junction") in junctions
    paths = sum(len(junction.connections) for junction in network.plan.junctions)
    assert len(root.findall("junction/connection")) == paths
