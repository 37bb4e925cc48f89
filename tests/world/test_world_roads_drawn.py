"""The drawn ground against the plan's areas: rays straight down in the compiled model."""

import dataclasses

import mujoco
import numpy as np
import pytest
import shapely

from nurec_sim.world import SurfaceClass, TownNetwork
from nurec_sim.world.model.assemble import build_town
from nurec_sim.world.plan.layout import still_town

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", params=["roundabout", "narrowing"])
def town(request):
    plan = dataclasses.replace(still_town(4, "test", request.param), buildings=(), props=())
    drawn = build_town(plan)
    data = mujoco.MjData(drawn.model)
    mujoco.mj_forward(drawn.model, data)
    return TownNetwork(plan), drawn, data


def test_what_rays_meet_is_what_the_plan_says(town):
    network, drawn, data = town
    xy = np.random.default_rng(0).uniform(*np.array(network.paved.bounds).reshape(2, 2), (6000, 2))
    points = shapely.points(xy)
    edges = shapely.union_all([area.boundary for area in (network.surface, network.kerb, network.sidewalk)])
    chosen = (shapely.distance(network.paved, points) < 1.0) & (shapely.distance(edges, points) > 0.005)
    xy, points = xy[chosen], points[chosen]
    ground, lift = network.height_m(xy), network.plan.kerb.height_m
    wanted = {
        "road": (network.surface, {SurfaceClass.ROAD, SurfaceClass.MARKING}, 0.0),
        "kerb": (network.kerb, {SurfaceClass.KERB}, lift),
        "sidewalk": (network.sidewalk, {SurfaceClass.SIDEWALK, SurfaceClass.ISLAND}, lift),
    }
    met, height = np.zeros(len(xy), int), np.zeros(len(xy))
    down, geom = np.array([0.0, 0.0, -1.0]), np.full(1, -1, np.int32)
    for index in range(len(xy)):
        start = np.array([*xy[index], ground[index] + 5.0])
        height[index] = start[2] - mujoco.mj_ray(drawn.model, data, start, down, None, 1, -1, geom)
        met[index] = drawn.geom_class[geom[0]]
    for name, (area, classes, above) in wanted.items():
        inside = shapely.contains(area, points)
        assert inside.sum() >= 10, name
        np.testing.assert_array_equal(np.isin(met, list(classes)), inside, name)
        assert np.abs(height - ground - above)[inside].max() < 0.012
