import time

import mujoco
import numpy as np
import pytest
import shapely

from nurec_sim import geometry, sensors
from nurec_sim.types import Label, SensorRequest
from nurec_sim.world import TrueWorld, pick_backend, street_rig
from nurec_sim.world.model.assemble import FAR_M, build_town
from nurec_sim.world.model.builder import DECAL_ALPHA, DECAL_GROUP
from nurec_sim.world.plan.layout import town_plan
from nurec_sim.world.plan.surface import LABEL_OF_CLASS, SurfaceClass
from nurec_sim.world.sense import simulator

GROUND = [SurfaceClass.ROAD, SurfaceClass.MARKING, SurfaceClass.KERB, SurfaceClass.SIDEWALK, SurfaceClass.ISLAND,
          SurfaceClass.GRASS]  # fmt: skip


@pytest.fixture(scope="module")
def town():
    plan = town_plan(11, "train", "t_junction", seconds=2.0)
    start = time.process_time()
    town = build_town(plan)
    print(f"\nbuilt in {time.process_time() - start:.2f} CPU-s: {town.model.ngeom} geoms, "
          f"{town.model.nmeshface} triangles, {town.model.ntexdata / 1e6:.1f} MB of textures")  # fmt: skip
    return town


@pytest.fixture(scope="module")
def data(town):
    data = mujoco.MjData(town.model)
    start_us = town.plan.span_us[0]
    boxes = {track.id: track.path.at(np.array([start_us])) for track in town.plan.tracks()}
    town.pose(data, start_us, town.actor_places(boxes, 1))
    return data


def cast(town, data, origins, direction):
    """Geom ids and distances of parallel rays, one by one: what a multi-ray must agree with."""
    groups, geom = np.array([1, 1, 1, 0, 0, 0], np.uint8), np.zeros(1, np.int32)
    direction = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    found = []
    for origin in origins:
        distance = mujoco.mj_ray(town.model, data, origin, direction, groups, 1, -1, geom, None)
        found.append((int(geom[0]), distance))
    return np.array([g for g, _ in found]), np.array([d for _, d in found])


def world_triangles(town, data, geom):
    """Corners ``[n, 3, 3]`` of a mesh geom in the world."""
    model = town.model
    mesh = model.geom_dataid[geom]
    first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    faces = model.mesh_face[first : first + count] + model.mesh_vertadr[mesh]
    points = model.mesh_vert[faces].astype(np.float64)
    return points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


@pytest.mark.slow
def test_same_plan_same_bytes(town):
    again = build_town(town.plan)
    tables = """tex_data mesh_vert mesh_normal mesh_texcoord mesh_face geom_pos geom_quat geom_user geom_rgba geom_matid
        mat_rgba mat_emission body_pos light_diffuse"""
    for name in tables.split():
        assert getattr(town.model, name).tobytes() == getattr(again.model, name).tobytes(), name


def test_every_geom_knows_what_it_is(town):
    model, plan = town.model, town.plan
    assert set(np.unique(town.geom_class)) <= {int(c) for c in SurfaceClass} - {int(SurfaceClass.SKY)}
    assert ((town.geom_reflectivity > 0) & (town.geom_reflectivity <= 1)).all()
    assert ((town.geom_rgb >= 0) & (town.geom_rgb <= 1)).all()
    assert (model.geom_contype == 0).all() and (model.geom_conaffinity == 0).all()
    movable = LABEL_OF_CLASS[town.geom_class] == Label.MOVABLE
    assert (movable == (town.geom_instance > 0)).all()
    assert set(town.geom_instance) == set(range(len(plan.actors) + 1))
    of_kind = {"pedestrian": SurfaceClass.PERSON, "cyclist": SurfaceClass.CYCLIST}
    for index, actor in enumerate(plan.actors):
        classes = set(town.geom_class[town.geom_instance == index + 1])
        assert classes == {of_kind.get(actor.kind, SurfaceClass.VEHICLE)}, actor.id


def test_all_static_classes_are_there(town):
    expected = {*GROUND, SurfaceClass.BUILDING, SurfaceClass.VEGETATION, SurfaceClass.POLE, SurfaceClass.SIGN,
                SurfaceClass.FURNITURE} - {SurfaceClass.ISLAND}  # fmt: skip
    assert expected <= {SurfaceClass(c) for c in town.geom_class}


def test_decals_are_in_pictures_only(town):
    decals = town.model.geom_group == DECAL_GROUP
    assert decals.any() and (town.model.geom_group[~decals] == 1).all()
    np.testing.assert_allclose(town.model.geom_rgba[decals, 3], DECAL_ALPHA)
    assert (town.model.geom_rgba[~decals, 3] == 1).all()
    assert (town.geom_class[decals] == SurfaceClass.ROAD).all() and (town.geom_instance[decals] == 0).all()


def test_geoms_can_be_culled(town):
    """Only far ground and hills are wide; everything else lies within small spheres."""
    wide = town.model.geom_rbound > 75.0
    assert wide.sum() < 40
    assert set(town.geom_class[wide]) <= {SurfaceClass.GRASS, SurfaceClass.VEGETATION}
    assert town.model.ngeom < 1100


def test_ground_faces_up_everywhere(town, data):
    for geom in np.flatnonzero(np.isin(town.geom_class, GROUND) & (town.model.geom_bodyid == 0)):
        corners = world_triangles(town, data, geom)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        upright = town.geom_class[geom] in (SurfaceClass.KERB, SurfaceClass.SIDEWALK)  # edges of stones and paving
        limit = -0.01 * np.linalg.norm(normal, axis=1) if upright else 0.0
        assert (normal[:, 2] >= limit).all(), SurfaceClass(town.geom_class[geom])


def test_rays_straight_down_meet_the_surface_of_the_network(town, data):
    network, kerb = town.network, town.plan.kerb
    rng = np.random.default_rng(4)
    low, high = np.array(network.surface.bounds).reshape(2, 2)
    xy = rng.uniform(low - 20, high + 20, (900, 2))
    houses = [geometry.box_corners_xy(geometry.pose_from_xyyaw(h.x_m, h.y_m, h.yaw_rad), h.width_m + 2, h.depth_m + 4)
              for h in town.plan.buildings]  # fmt: skip
    built = shapely.union_all([shapely.Polygon(corners) for corners in houses])
    xy = xy[~shapely.contains_xy(built, *xy.T)]
    heights = town.plan.terrain.height_m(xy)
    edge = shapely.distance(shapely.points(xy), network.surface.boundary)
    geom, distance = cast(town, data, np.column_stack([xy, heights + 0.30]), (0, 0, -1))
    assert (geom >= 0).all(), "a hole in the ground"
    surface = town.geom_class[geom]
    on_ground = np.isin(surface, GROUND)
    assert on_ground.mean() > 0.9
    ground_m = heights + 0.30 - distance
    road = np.isin(surface, [SurfaceClass.ROAD, SurfaceClass.MARKING])
    inside = shapely.contains_xy(network.surface, *xy.T)
    clear = on_ground & (edge > 0.05)
    assert (road[clear] == inside[clear]).all()
    np.testing.assert_allclose(ground_m[road], heights[road], atol=0.012)
    walk = np.isin(surface, [SurfaceClass.SIDEWALK, SurfaceClass.ISLAND])
    np.testing.assert_allclose(ground_m[walk], heights[walk] + kerb.height_m, atol=0.006)
    lawn = surface == SurfaceClass.GRASS
    np.testing.assert_allclose(ground_m[lawn], heights[lawn] + kerb.height_m, atol=0.08)


@pytest.mark.needs_gl
def test_drawn_from_anywhere_there_is_no_sky_below_the_horizon(town, monkeypatch):
    """OpenGL leaves out back faces, so what is wound wrongly or lacks a side is a hole; seen from lawns as well."""
    backend = pick_backend()
    if backend == "rays":
        pytest.skip("neither EGL nor OSMesa works here (or NUREC_SIM_GL=rays)")
    camera = street_rig(160, 96).cameras["camera_front"]
    rng, start_us = np.random.default_rng(8), town.plan.span_us[0]
    places = town.plan.ego_trajectory().position_m[::8, :2]
    low, high = np.array(town.network.surface.bounds).reshape(2, 2)
    around = rng.uniform(low - 10, high + 10, (40, 2))
    houses = [shapely.Point(h.x_m, h.y_m).buffer(np.hypot(h.width_m, h.depth_m) / 2) for h in town.plan.buildings]
    places = np.concatenate([places, around[~shapely.contains_xy(shapely.union_all(houses), *around.T)][:12]])
    monkeypatch.setattr(simulator, "build_town", lambda plan: town)
    with TrueWorld(town.plan, backend) as world:
        for place, yaw in zip(places, rng.uniform(-np.pi, np.pi, len(places)), strict=True):
            rig = geometry.pose_from_xyyaw(*place, yaw, float(town.plan.terrain.height_m(place)) + 0.2)
            pose = np.stack([rig @ camera.rig_from_camera] * 2)
            view = world.view(SensorRequest("town", camera, start_us, start_us, pose, {}))
            up = (sensors.pixel_rays(camera)[0] @ pose[0][:3, :3].T)[..., 2]
            assert (view.surface[up < -0.004] != SurfaceClass.SKY).all(), place


def test_nothing_open_below_the_horizon(town, data):
    """Level rays and rays a little below the horizon end at the hills at the latest."""
    angles = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    for place in town.plan.ego_trajectory().position_m[::10]:
        for slope in (0.0, -0.004, -0.03, -0.3):
            for angle in angles[::3]:
                direction = np.array([np.cos(angle), np.sin(angle), slope])
                geom, distance = cast(town, data, [place + [0, 0, 1.5]], direction)
                assert geom[0] >= 0 and 0 < distance[0] < FAR_M, (angle, slope)


def test_people_walk_and_stand(town):
    walkers = [a for a in town.plan.actors if a.kind == "pedestrian" and a.moves]
    assert walkers and len(town.gaits) >= len(walkers)
    for gait, addresses in town.gaits:
        assert set(gait.joints.values()) == set(addresses)
        times = np.linspace(gait.t_us[0], gait.t_us[-1], 40)
        angles = np.array([list(gait.angles(t).values()) for t in times])
        assert np.abs(angles).max() < 1.8
        moved = gait.distance_m[-1] > 1.0
        assert (np.ptp(angles, axis=0).max() > 0.3) == moved
