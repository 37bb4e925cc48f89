"""The true world answers requests: images, ground truth and LiDAR turns of any moment, exactly."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import shapely
from sensor_worlds import request_at, small_plan, true_world

from nurec_sim import geometry, sensors
from nurec_sim.errors import RequestError, TooLargeError
from nurec_sim.types import Fisheye, Label
from nurec_sim.world import LABEL_OF_CLASS, LIDAR_ID, SurfaceClass, TrueWorld, street_rig
from nurec_sim.world.sense.isp import CameraResponse
from nurec_sim.world.sense.rays import cast

RIG = street_rig(112, 64, lidar_rows=16, lidar_columns=90)
FRONT, LIDAR = RIG.cameras["camera_front"], RIG.lidars[LIDAR_ID]
HORIZON = -0.05
"""Towns are hilly: only rays steeper than this must meet the ground."""


@pytest.mark.slow
def test_two_worlds_of_one_plan_give_the_same_bytes(plan, rays):
    camera, lidar = request_at(plan, FRONT, 2.0), request_at(plan, LIDAR, 2.0, 100_000)
    with TrueWorld(small_plan.__wrapped__(), "rays") as again:
        (image, sweep), (other_image, other_sweep) = rays.sense([camera, lidar]), again.sense([camera, lidar])
    assert image.rgb.tobytes() == other_image.rgb.tobytes()
    assert image.depth_m.tobytes() == other_image.depth_m.tobytes()
    assert sweep.xyz_m.tobytes() == other_sweep.xyz_m.tobytes()
    assert sweep.intensity.tobytes() == other_sweep.intensity.tobytes()


def test_many_rays_at_once_agree_with_single_rays(plan, rays):
    """Guards against mj_multiRay losing the visual geoms of bodies with colliders."""
    import mujoco

    rng = np.random.default_rng(3)
    request = request_at(plan, LIDAR, 4.0)
    scan = rays.scan(request)
    pose, beams = request.world_from_sensor[0], sensors.beam_directions(LIDAR)
    actors = scan.instance > 0
    assert actors.sum() > 10
    picked = [
        *zip(*np.nonzero(actors), strict=True),
        *zip(rng.integers(0, 16, 150), rng.integers(0, 90, 150), strict=True),
    ]
    town, geom = rays.town, np.zeros(1, np.int32)
    for row, column in picked:
        direction = pose[:3, :3] @ beams[row, column]
        groups = np.array([1, 1, 1, 0, 0, 0], np.uint8)
        distance = mujoco.mj_ray(town.model, rays._stage.data, pose[:3, 3], direction, groups, 1, -1, geom, None)
        if distance < 0 or not LIDAR.range_m[0] <= distance <= LIDAR.range_m[1]:
            assert scan.range_m[row, column] == 0
        else:
            assert np.isclose(scan.range_m[row, column], distance, atol=1e-9)
            assert scan.surface[row, column] == town.geom_class[geom[0]]


@pytest.mark.parametrize("camera_id", list(RIG.cameras))
@pytest.mark.parametrize("seconds", [0.0, 6.0, 11.0])
def test_no_sky_below_the_horizon(plan, rays, camera_id, seconds):
    request = request_at(plan, RIG.cameras[camera_id], seconds)
    view = rays.view(request)
    assert_ground_below_horizon(request, view)


def assert_ground_below_horizon(request, view):
    up = (sensors.pixel_rays(request.sensor)[0] @ request.world_from_sensor[0][:3, :3].T)[..., 2]
    assert (view.surface[up < HORIZON] != SurfaceClass.SKY).all()
    assert ((view.range_m > 0) == (view.surface != SurfaceClass.SKY)).all()


@pytest.mark.needs_gl
@pytest.mark.parametrize(
    "camera_id, seconds", [("camera_front", 1.0), ("camera_front_left", 6.0), ("camera_front_right", 11.0)]
)
def test_opengl_agrees_with_ray_casting(plan, painted, rays, camera_id, seconds):
    request = request_at(plan, street_rig(224, 128).cameras[camera_id], seconds)
    drawn, cast = painted.view(request), rays.view(request)
    assert_ground_below_horizon(request, drawn)
    assert np.mean(LABEL_OF_CLASS[drawn.surface] == LABEL_OF_CLASS[cast.surface]) > 0.995
    assert np.mean(drawn.instance == cast.instance) > 0.995
    same = (drawn.surface == cast.surface) & (drawn.depth_m > 0)
    assert np.median(np.abs(drawn.depth_m - cast.depth_m)[same]) < 1e-3
    sky = cast.surface == SurfaceClass.SKY
    if sky.sum() > 50:  # both look up the same sky
        assert np.abs(drawn.rgb.astype(int) - cast.rgb)[sky].mean() < 8
    ground = cast.surface == SurfaceClass.ROAD
    assert abs(drawn.rgb[ground].mean() - cast.rgb[ground].mean()) < 45


@pytest.mark.needs_gl
def test_opengl_follows_an_off_centre_lens(plan, painted, rays):
    lens = dataclasses.replace(FRONT.lens, cx_px=30.0, cy_px=40.0, fy_px=FRONT.lens.fx_px * 1.2)
    request = request_at(plan, dataclasses.replace(FRONT, lens=lens), 3.0)
    drawn, cast = painted.view(request), rays.view(request)
    assert np.mean(drawn.surface == cast.surface) > 0.98
    assert np.median(np.abs(drawn.depth_m - cast.depth_m)[drawn.surface == cast.surface]) < 1e-3


@pytest.mark.slow
@pytest.mark.needs_gl
def test_opengl_serves_many_threads_with_the_same_frames(plan, painted):
    requests = [request_at(plan, FRONT, 0.5 * i) for i in range(8)]
    alone = [painted.sense([request])[0].rgb.tobytes() for request in requests]
    large = painted.sense([request_at(plan, sensors.scaled_camera(FRONT, 1120, 640), 0.0)])[0]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda request: painted.sense([request])[0].rgb.tobytes(), requests))
    assert together == alone
    small = np.frombuffer(alone[0], np.uint8).reshape(64, 112, 3).astype(float)
    assert np.abs(large.rgb.reshape(64, 10, 112, 10, 3).mean((1, 3)) - small).mean() < 8


def test_drivable_polygon_is_where_the_road_is(plan, rays):
    network = rays.town.network
    drive = plan.ego_trajectory().position_m[:, :2]
    rng = np.random.default_rng(5)
    xy = drive[rng.integers(0, len(drive), 1500)] + rng.uniform(-11, 11, (1500, 2))
    clear = shapely.distance(shapely.points(xy), network.surface.boundary) > 0.03
    inside = shapely.contains_xy(network.surface, *xy.T)
    assert 200 < (inside & clear).sum() < 1300
    for place, expected in zip(xy[clear], inside[clear], strict=True):
        origin = np.array([*place, float(network.height_m(place)) + 1.2])
        geom, distance, _ = cast(rays.town, rays._stage.data, origin, np.array([[0.0, 0.0, -1.0]]))
        if distance[0] > 1.0 and rays.town.geom_instance[geom[0]] == 0:  # nothing stands there
            surface = SurfaceClass(rays.town.geom_class[geom[0]])
            assert (LABEL_OF_CLASS[surface] == Label.ROAD) == expected, (place, surface)
            assert abs(distance[0] - 1.2) < 0.04 or not expected


def test_returns_from_actors_lie_in_their_boxes(plan, rays):
    seen = set()
    for seconds in (0.0, 3.0, 8.0):
        request = request_at(plan, LIDAR, seconds)
        frame, scan = rays.sense([request])[0], rays.scan(request)
        world = geometry.transform_points(request.world_from_sensor[1], frame.xyz_m.astype(np.float64))
        instance = scan.instance.ravel()[frame.beam]
        for index in np.unique(instance[instance > 0]):
            track = plan.tracks()[index - 1]
            box = geometry.transform_points(geometry.inverse(track.path.at(request.start_us)), world[instance == index])
            assert geometry.points_in_box(box, track.size_m, 0.01).all(), track.id
            seen.add(track.label)
    assert seen >= {"automobile", "person"}


def test_turning_lidar_on_a_moving_car_sees_the_road_where_it_is(plan, rays):
    network = rays.town.network
    request = request_at(plan, LIDAR, 5.0, 100_000)
    assert np.linalg.norm(np.diff(request.world_from_sensor[:, :3, 3], axis=0)) > 0.3
    frame, scan = rays.sense([request])[0], rays.scan(request)
    world = geometry.transform_points(request.world_from_sensor[1], frame.xyz_m.astype(np.float64))
    surface = scan.surface.ravel()[frame.beam]
    road = LABEL_OF_CLASS[surface] == Label.ROAD
    assert road.sum() > 100
    np.testing.assert_allclose(world[road, 2], network.height_m(world[road, :2]), atol=0.04)
    assert shapely.contains_xy(network.surface.buffer(0.01), *world[road, :2].T).all()
    assert (frame.intensity > 0).all() and (frame.intensity <= 1).all()


def test_actors_stand_where_a_request_puts_them(plan, rays):
    request = request_at(plan, FRONT, 5.0)
    index = next(i for i, actor in enumerate(plan.actors) if actor.label == "automobile" and actor.moves)
    length, _, height = plan.actors[index].size_m
    rig = plan.ego_trajectory().at(request.start_us)
    place = rig @ geometry.pose_from_xyyaw(8.0, 0.0, 0.0, height / 2)
    moved = dataclasses.replace(request, actors={plan.actors[index].id: np.stack([place, place])})
    recorded, shown = rays.view(request), rays.view(moved)
    on_it = shown.instance == index + 1
    assert on_it.sum() > 300 and on_it.sum() > 2 * (recorded.instance == index + 1).sum()
    assert abs(np.nonzero(on_it)[1].mean() - FRONT.lens.cx_px) < 3
    rear = 8.0 - length / 2 - FRONT.rig_from_camera[0, 3]
    assert np.isclose(shown.depth_m[on_it].min(), rear, atol=0.15)
    assert rays.view(request).rgb.tobytes() == recorded.rgb.tobytes()  # nothing stays behind


def test_frames_carry_labels_depth_and_alpha(plan, rays):
    request = request_at(plan, FRONT, 0.0)
    frame = rays.sense([request])[0]
    assert frame.rgb.shape == (64, 112, 3) and frame.rgb.dtype == np.uint8
    flat = (frame.label == Label.ROAD) & (frame.depth_m < 15)
    assert (frame.normal[flat][:, 2] > 0.95).all()
    np.testing.assert_array_equal(frame.normal.any(axis=-1), frame.alpha > 0)
    assert {Label.ROAD, Label.MOVABLE, Label.SKY, Label.OTHER} <= set(np.unique(frame.label))
    assert (frame.alpha[frame.label == Label.SKY] == 0).all() and (frame.alpha[frame.label != Label.SKY] == 1).all()


def test_cameras_respond_as_told_and_by_time(plan, rays):
    response = CameraResponse(white_balance=(1.1, 1.0, 0.9), noise=0.01)
    request = request_at(plan, FRONT, 3.0)
    with true_world(plan, "rays", responses={FRONT.id: response}) as world:
        view, again = world.view(request), world.view(request)
        unnamed = world.view(dataclasses.replace(request, sensor=dataclasses.replace(FRONT, id="other")))
    ideal = rays.view(request)
    assert view.rgb.tobytes() == again.rgb.tobytes() and unnamed.rgb.tobytes() == ideal.rgb.tobytes()
    bright = ideal.rgb.max(axis=-1) < 220
    gains = view.rgb[bright].mean(axis=0) / ideal.rgb[bright].mean(axis=0)
    np.testing.assert_allclose(gains, response.white_balance, atol=0.01)
    assert view.depth_m.tobytes() == ideal.depth_m.tobytes()


def test_what_cannot_be_drawn_is_refused(plan, rays):
    request = request_at(plan, FRONT, 0.0)

    def ask(text, error=RequestError, **changes):
        camera = {key: changes.pop(key) for key in list(changes) if hasattr(FRONT, key)}
        with pytest.raises(error, match=text):
            rays.sense([dataclasses.replace(request, sensor=dataclasses.replace(FRONT, **camera), **changes)])

    ask("focal lengths must be positive", lens=Fisheye(-50.0, 50.0, 56.0, 32.0))
    ask("5000 x 64 pixels; at most 4096 a side", TooLargeError, width_px=5000)
    ask(r"no actor 'ghost' in this town; have \['", actors={"ghost": np.stack([np.eye(4)] * 2)})
    first = plan.actors[0].id
    ask(f"actor '{first}': world_from_box must be two poses", actors={first: np.eye(4)})
    ask("world_from_sensor must be two poses", world_from_sensor=np.zeros((2, 4, 4)))
    ask("end_us not before start_us", end_us=5)
    with pytest.raises(RequestError, match="a view needs a camera, and 'lidar_top' is none"):
        rays.view(request_at(plan, LIDAR, 0.0))
    with pytest.raises(RequestError, match="a scan needs a LiDAR, and 'camera_front' is none"):
        rays.scan(request)


def test_a_closed_world_says_so_and_closes_twice(plan):
    world = true_world(plan, "rays")
    world.close()
    world.close()
    with pytest.raises(RuntimeError, match="this town is closed"):
        world.sense([request_at(plan, FRONT, 0.0)])
