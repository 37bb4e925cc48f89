"""Pictures of views, against the renderer asked directly; no browser and no viser."""

import dataclasses
import io

import cv2
import numpy as np
import pytest
import view_worlds

from nurec_sim import geometry, sensors
from nurec_sim.errors import NurecSimError
from nurec_sim.logs import overlay
from nurec_sim.render import make_renderer
from nurec_sim.render.images.still import INVENTED_RGB
from nurec_sim.serving.store import LoadedScene
from nurec_sim.types import CameraModel, Pinhole, SensorRequest
from nurec_sim.view import Painter, View
from nurec_sim.view.camera import eye_camera, parts_of, pose_of, ray_hits_box, request_of
from nurec_sim.view.picture import BOX_RGB, PLAN_RGB, lidar_names
from nurec_sim.view.rollouts import events_of, lines_of
from nurec_sim.view.sources import Opened, local_world

T_US = view_worlds.START_US + 630_000
WIDE = (320, 180)
PLAIN = {"size_px": WIDE, "route": False}


@pytest.fixture(scope="module")
def worlds():
    return view_worlds.world(0), view_worlds.world(1)


@pytest.fixture(scope="module")
def painter(worlds):
    return Painter(view_worlds.opened(worlds))


def rendered(world, camera, start_us, end_us, poses=None, **more):
    poses = world.ego.at(np.array([start_us, end_us])) @ camera.rig_from_camera if poses is None else poses
    return world.sense([SensorRequest(world.id, camera, start_us, end_us, poses, **more)], ("rgb",))[0].rgb


def test_a_camera_of_the_car_keeps_its_lens_and_its_shutter(painter, worlds):
    for name in ("front", "fish"):
        camera = worlds[0].rig.cameras[name]
        exposure = 1 + view_worlds.EXPOSURE_US if name == "front" else 1
        shown = painter.paint(View(T_US, (camera.width_px, camera.height_px), camera=name, route=False))
        assert np.array_equal(shown, rendered(worlds[0], camera, T_US, T_US + exposure))


def test_the_free_camera_is_the_browsers(painter, worlds):
    # Not symmetric: 30 degrees to the left, up, and a roll.
    turn = geometry.rotation_from_yaw(0.5) @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    position, wxyz = parts_of(geometry.pose(turn, np.array([-3.0, 1.0, 2.5])))
    assert np.allclose(pose_of(position, wxyz)[:3, :3] @ [0, 0, 1], [np.cos(0.5), np.sin(0.5), 0])  # z is forward
    view = View(T_US, WIDE, browser_from_eye=pose_of(position, wxyz), fov_rad=1.1, follow=False, route=False)
    # The browser's frame begins at the first pose of the drive, rounded to metres; the vertical field of view is given.
    focal = 90 / np.tan(0.55)
    camera = CameraModel("front", 320, 180, Pinhole(focal, focal, 160, 90), np.eye(4))
    pose = geometry.pose(turn, np.array([-3.0, 1.0, 2.5]) + np.round(worlds[0].ego.position_m[0]))
    want = rendered(worlds[0], camera, T_US, T_US + 1, np.stack([pose, pose]))
    # The pose has been a quaternion in between: its last digits may round a colour the other way.
    assert np.abs(painter.paint(view).astype(int) - want).max() <= 1
    # Following, it moves and turns with the car, level.
    followed = request_of(painter.stage, dataclasses.replace(view, follow=True), 1.0)
    car = worlds[0].ego.at(T_US)
    level = geometry.pose_from_xyyaw(car[0, 3], car[1, 3], float(geometry.yaw_of(car)), car[2, 3])
    assert np.allclose(followed.world_from_sensor[0], level @ view.browser_from_eye)


def test_a_coarse_picture_has_fewer_pixels_of_the_same_field(painter):
    view = View(T_US, WIDE, fov_rad=1.1)
    full, coarse = (eye_camera(view, scale, "front") for scale in (1.0, 0.5))
    assert (coarse.width_px, coarse.height_px) == (160, 90)
    assert np.allclose(
        sensors.unproject(full, np.array([[40.0, 30]]))[0], sensors.unproject(coarse, np.array([[20.0, 15]]))[0]
    )


def test_a_picture_of_another_shape_gets_bars(painter):
    shown = painter.paint(View(T_US, (400, 180), camera="front", **{"route": False}))
    assert shown.shape == (180, 400, 3)
    assert not shown[:, :40].any() and not shown[:, 360:].any() and shown[:, 40:360].any()


def test_the_wipe_shows_one_world_on_each_side(painter):
    view = View(T_US, camera="front", **PLAIN)
    left, right = painter.paint(view), painter.paint(dataclasses.replace(view, world=1))
    both = painter.paint(dataclasses.replace(view, other=1, wipe=0.25))
    assert np.array_equal(both[:, :79], left[:, :79]) and np.array_equal(both[:, 81:], right[:, 81:])
    assert (both[:, 79:81] == 255).all() and not np.array_equal(left, right)


def test_recorded_images_are_of_the_same_exposure(painter, worlds):
    view = View(T_US, camera="front", recorded="beside", **PLAIN)  # nearest: frame 3, at 600 ms
    start_us = view_worlds.START_US + 3 * view_worlds.FRAME_US
    want = rendered(worlds[0], worlds[0].rig.cameras["front"], start_us, start_us + view_worlds.EXPOSURE_US)
    request = request_of(painter.stage, view, 1.0)
    assert (request.start_us, request.end_us) == (start_us, start_us + view_worlds.EXPOSURE_US)
    blended = painter.paint(dataclasses.replace(view, recorded="blend", blend=0.25))
    assert np.abs(blended - (0.75 * want + 0.25 * 60)).max() <= 0.5
    beside = painter.paint(dataclasses.replace(view, size_px=(640, 180)))
    assert np.array_equal(beside, np.concatenate([want, np.full_like(want, 60)], axis=1))
    # On a narrow canvas they are stacked.
    assert painter.paint(dataclasses.replace(view, size_px=(320, 360))).shape == (360, 320, 3)


def test_layers_are_those_of_the_renderer(painter, worlds):
    label = painter.paint(View(T_US, camera="front", layer="label", **PLAIN))
    assert {tuple(rgb) for rgb in label.reshape(-1, 3)} >= {(128, 64, 128), (135, 190, 235)}  # road and sky
    plain = painter.paint(View(T_US, camera="front", apply_isp=False, **PLAIN))
    want = rendered(
        worlds[0], worlds[0].rig.cameras["front"], T_US, T_US + 1 + view_worlds.EXPOSURE_US, apply_isp=False
    )
    assert np.array_equal(plain, want)


def test_support_is_red_where_no_camera_looked(worlds):
    scene, times = worlds[0].scene, worlds[0].camera_times_us["front"]
    once = dataclasses.replace(scene, camera_times_us={"front": times[2:3]})
    painter = Painter(Opened((worlds[0], local_world(LoadedScene(once, make_renderer(once, "cpu", threads=1))))))
    at_frame = View(int(times[2, 0]), camera="front", layer="support", **PLAIN)
    plain, shown = painter.paint(dataclasses.replace(at_frame, layer="rgb")), painter.paint(at_frame)
    # All ten recorded views saw this point of the sky, which is in the same direction from everywhere: 10 of 10.2.
    want = plain[2, 160] * (10 / 10.2) + np.array(INVENTED_RGB) * (0.2 / 10.2)
    assert np.abs(shown[2, 160] - want).max() <= 0.6
    # Right of a wipe is a reconstruction from a single view: 1 of 1.2.
    shown = painter.paint(dataclasses.replace(at_frame, other=1, wipe=0.25))
    assert np.abs(shown[2, 160] - (plain[2, 160] / 1.2 + np.array(INVENTED_RGB) * (0.2 / 1.2))).max() <= 0.6
    # No camera looked back: all of it is invented, in a coarse picture too.
    back = geometry.rotation_from_yaw(np.pi) @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    behind = View(T_US, WIDE, browser_from_eye=geometry.pose(back, np.array([0, 0, 1.5])), layer="support", route=False)
    for view in (behind, dataclasses.replace(behind, moving=True)):
        assert (painter.paint(view) == INVENTED_RGB).all()
    # Where it is not known when the cameras recorded, there is no such layer.
    unknown = local_world(LoadedScene(dataclasses.replace(scene, camera_times_us={}), worlds[0].renderer))
    assert (*unknown.layers, "support") == worlds[0].layers


def test_the_car_and_actors_can_be_moved_and_hidden(painter, worlds):
    camera, end_us = worlds[0].rig.cameras["front"], T_US + 1 + view_worlds.EXPOSURE_US
    times = np.array([T_US, end_us])
    aside = geometry.pose_from_xyyaw(0.5, -1.0, 0.1)
    shown = painter.paint(View(T_US, camera="front", ego_offset=aside, **PLAIN))
    poses = worlds[0].ego.at(times) @ aside @ camera.rig_from_camera
    assert np.array_equal(shown, rendered(worlds[0], camera, T_US, end_us, poses))
    (car,) = [track for track in worlds[0].tracks if track.id == "car-1"]
    moved = {"car-1": car.path.at(times) @ aside}
    shown = painter.paint(View(T_US, camera="front", offsets={"car-1": aside}, **PLAIN))
    assert np.array_equal(shown, rendered(worlds[0], camera, T_US, end_us, actors=moved))
    shown = painter.paint(View(T_US, camera="front", hidden=frozenset({"car-1"}), **PLAIN))
    assert np.array_equal(shown, rendered(worlds[0], camera, T_US, end_us, hidden={"car-1"}))
    assert not np.array_equal(shown, rendered(worlds[0], camera, T_US, end_us))


def test_boxes_and_names_are_drawn_where_the_actors_are(painter, worlds):
    view = View(T_US, camera="front", **PLAIN)
    plain, boxed = painter.paint(view), painter.paint(dataclasses.replace(view, boxes=True))
    camera, request = worlds[0].rig.cameras["front"], request_of(painter.stage, view, 1.0)
    want = plain.copy()
    for track in worlds[0].tracks:
        overlay.draw_box(want, camera, request.world_from_sensor, track.size_m, track.path.at(T_US))
    assert np.array_equal(boxed, want) and (boxed != plain).any() and (boxed == BOX_RGB).all(axis=2).any()
    assert (painter.paint(dataclasses.replace(view, names=True)) != plain).any()
    # A selected one has a box of its own colour, without the others.
    chosen = painter.paint(view, selected="car-1")
    assert (chosen != plain).any() and not (chosen == boxed).all()


def test_lidar_points_of_any_model(painter, worlds):
    assert lidar_names(painter.opened)[:4] == ["none", "recorded", "roof", "PANDAR128"]
    world, lidar = worlds[0], worlds[0].rig.lidars["roof"]
    times = np.array([T_US - 100_000, T_US])
    request = SensorRequest(world.id, lidar, *times.tolist(), world.ego.at(times) @ lidar.rig_from_lidar)
    (sweep,) = world.sense([request])
    found = painter.points(View(T_US, lidar="roof"))
    assert len(found) > 100
    assert np.allclose(found, geometry.transform_points(request.world_from_sensor[1], sweep.xyz_m))
    assert len(painter.points(View(T_US, lidar="VLP-16"))) > 100
    # Recorded: the sweep nearest in time, at 600 ms.
    recorded = painter.points(View(T_US, lidar="recorded"))
    pose = world.ego.at(view_worlds.START_US + 600_000) @ lidar.rig_from_lidar
    assert np.allclose(recorded, geometry.transform_points(pose, view_worlds.POINT[None]))
    view = View(T_US, camera="front", lidar="recorded", **PLAIN)
    assert (painter.paint(view) != painter.paint(dataclasses.replace(view, lidar="none"))).any()
    with pytest.raises(NurecSimError, match=r"no LiDAR 'HDL-1'; have \['none', 'recorded', 'roof'"):
        painter.points(View(T_US, lidar="HDL-1"))


def test_a_rollout_has_its_own_path_actors_plan_and_events(painter):
    stage, rollout = painter.stage, painter.opened.rollouts["hits"]
    view = View(view_worlds.START_US + 250_000, camera="front", rollout="hits", size_px=WIDE)
    assert stage.times_us(view) == (view_worlds.START_US, view_worlds.START_US + 900_000)
    assert np.allclose(stage.ego(view, view.t_us)[:2, 3], [5.0, 1.0])  # 2 m each 100 ms
    assert np.allclose(stage.overrides(view, view.t_us, view.t_us)["car-1"][0, :2, 3], [12.0, 1.0])
    # Once it is gone, it is out of sight: 100 m below.
    late = dataclasses.replace(view, t_us=view_worlds.START_US + 800_000)
    assert stage.overrides(late, late.t_us, late.t_us)["car-1"][0, 2, 3] < -90
    # The plan that was made at 0 ms goes on along x from the car's pose at that time, at 20 m/s.
    driven, plan = lines_of(rollout, view.t_us)
    assert len(driven) == 10 and np.allclose(plan[:3, :2], [[0, 1], [2, 1], [4, 1]])
    assert np.allclose(lines_of(rollout, view_worlds.START_US + 500_000)[1][0, :2], [10, 1])  # the second plan
    (stop_us, stop), (_, contact) = events_of(rollout)
    assert (stop_us - view_worlds.START_US, stop) == (100_000, "stop session: asked to")
    assert contact == "front contact with automobile car-1"
    assert (painter.paint(view) == PLAN_RGB).all(axis=2).any()


def test_a_click_meets_the_nearest_box():
    size = (4.0, 2.0, 1.5)
    assert ray_hits_box(np.array([-10.0, 0.5, 0.2]), np.array([1.0, 0, 0]), size) == 8.0
    assert ray_hits_box(np.array([-10.0, 1.5, 0.2]), np.array([1.0, 0, 0]), size) == np.inf
    assert ray_hits_box(np.array([10.0, 0.5, 0.2]), np.array([1.0, 0, 0]), size) == np.inf  # behind


def test_a_film_follows_the_camera_path(painter):
    import av

    from nurec_sim.errors import RequestError
    from nurec_sim.view.film import film_of, path_views, time_views

    first = View(view_worlds.START_US, (201, 100), fov_rad=1.0)
    last = dataclasses.replace(
        first, t_us=view_worlds.START_US + 1_000_000, browser_from_eye=geometry.pose_from_xyyaw(4, 0, 1.0), fov_rad=0.5
    )
    views = path_views([first, last], 0.55)
    assert len(views) == 11
    assert (views[5].t_us, views[5].fov_rad) == (view_worlds.START_US + 500_000, 0.75)
    assert np.allclose(views[5].browser_from_eye, geometry.pose_from_xyyaw(2, 0, 0.5))
    with av.open(io.BytesIO(film_of(painter, views))) as film:
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(frames) == 11 and frames[0].shape == (100, 200, 3)
    assert cv2.PSNR(frames[5], painter.paint(views[5])[:, :200]) > 25
    assert [view.t_us for view in time_views(first, (0, 100_000))] == [0, 100_000]
    with pytest.raises(RequestError, match="needs at least 2 key views, got 1"):
        path_views([first], 2.0)
    with pytest.raises(RequestError, match="2 to 3600 frames at 20 a second, got 1000 s: 20000 frames"):
        path_views([first, last], 1000)
