"""Normals and motion that follow from exact depth and exact boxes."""

import cv2
import numpy as np
import pytest
from sensor_worlds import request_at, small_plan, true_world

from nurec_sim import geometry, sensors
from nurec_sim.types import Pinhole
from nurec_sim.world import street_rig
from nurec_sim.world.sense.truth import follow, plane_normals, scene_flow, slopes

LENS = Pinhole(60.0, 55.0, 33.0, 20.0)
WIDTH, HEIGHT = 64, 48
FRONT = street_rig(112, 64).cameras["camera_front"]


def nearness_of(normal, distance_m):
    """1 / z of the plane normal . point = distance, seen by ``LENS``."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    rays = np.stack([(u - LENS.cx_px) / LENS.fx_px, (v - LENS.cy_px) / LENS.fy_px, np.ones_like(u)], axis=-1)
    return (rays @ np.asarray(normal) / distance_m).astype(np.float32)


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.6, 0, 0.8), (0.3, -0.5, 0.8), (-0.05, 0.0, 0.9987)])
@pytest.mark.parametrize("distance_m", [2.0, 60.0])
def test_normals_of_planes_are_exact(normal, distance_m):
    normal = np.asarray(normal) / np.linalg.norm(normal)
    nearness = nearness_of(normal, distance_m)
    shown = nearness > 0.05 / distance_m
    geom = np.where(shown, 4, -1).astype(np.int32)
    found = plane_normals(LENS, np.where(shown, nearness, 0), *slopes(np.where(shown, nearness, 0), geom))
    inside = cv2.erode(shown.astype(np.uint8), np.ones((3, 3))) > 0
    np.testing.assert_allclose(found[inside], np.broadcast_to(-normal, found[inside].shape), atol=2e-4)
    assert (found[~shown] == 0).all()


def test_slopes_cross_neither_geoms_nor_folds():
    """Two walls of one house meet at column 30; a post of another geom stands before it."""
    left, right = nearness_of((0.6, 0, 0.8), 8.0), nearness_of((-0.6, 0, 0.8), 8.0)
    u = np.arange(WIDTH)
    house = np.where(u < 30, left, right)
    post = (u >= 45) & (u < 49)
    nearness = np.where(post, np.float32(0.5), house).astype(np.float32)
    geom = np.broadcast_to(np.where(post, 2, 1), nearness.shape).astype(np.int32)
    normal = plane_normals(LENS, nearness, *slopes(nearness, geom))
    expected = np.where((u < 30)[:, None], (-0.6, 0, -0.8), (0.6, 0, -0.8))
    expected = np.where(post[:, None], (0, 0, -1), expected)
    np.testing.assert_allclose(normal, np.broadcast_to(expected, normal.shape), atol=1e-3)


def test_a_lone_pixel_has_no_normal():
    geom = np.zeros((5, 5), np.int32)
    geom[2, 2] = 1
    nearness = np.full((5, 5), 0.1, np.float32)
    _, _, known = slopes(nearness, geom)
    assert not known[2, 2] and known[0, 0]


@pytest.fixture(scope="module")
def world():
    with true_world(small_plan(), "rays") as world:
        yield world


def test_flow_leads_to_where_the_next_view_sees_the_point(world):
    moving_pixels, apart_s = 0, 0.2
    for seconds in (1.0, 4.0, 7.0):
        now, then = request_at(world.plan, FRONT, seconds), request_at(world.plan, FRONT, seconds + apart_s)
        view, later = world.view(now), world.view(then)
        boxes = world.boxes(now.start_us), world.boxes(then.start_us)
        flow = scene_flow(view, FRONT, now.world_from_sensor[0], *boxes)
        assert (flow[view.instance == 0] == 0).all()
        uv, range_m = follow(view, FRONT, now.world_from_sensor[0], flow, then.world_from_sensor[0])
        inside = sensors.in_image(FRONT, uv)
        column, row = np.floor(uv[inside]).astype(int).T
        expected = range_m[inside]
        shown = np.where(later.range_m > 0, later.range_m, 1e6).astype(np.float32)
        slack = 0.02 * expected + 0.05
        assert np.mean(cv2.erode(shown, np.ones((3, 3)))[row, column] < expected + slack) > 0.99
        seen = np.abs(shown[row, column] - expected) < slack
        assert seen.mean() > 0.75
        who, who_then = view.instance[inside][seen], later.instance[row, column][seen]
        assert np.mean(who == who_then) > 0.99
        moving_pixels += int((np.linalg.norm(flow, axis=-1) > 0.2).sum())
    assert moving_pixels > 50


def test_flow_of_a_turning_box_is_that_of_its_points(world):
    request = request_at(world.plan, FRONT, 4.0)
    view = world.view(request)
    now = world.boxes(request.start_us)
    turned = now.copy()
    turned[:, :3, :3] = geometry.rotation_from_yaw(0.3) @ turned[:, :3, :3]
    flow = scene_flow(view, FRONT, request.world_from_sensor[0], now, turned)
    instance = int(np.bincount(view.instance[view.instance > 0]).argmax())
    row, column = np.argwhere(view.instance == instance)[0]
    ray = sensors.pixel_rays(FRONT)[0][row, column]
    point = geometry.transform_points(request.world_from_sensor[0], (ray * view.range_m[row, column])[None])[0]
    middle = now[instance - 1][:3, 3]
    expected = middle + geometry.rotation_from_yaw(0.3) @ (point - middle) - point
    np.testing.assert_allclose(flow[row, column], expected, atol=1e-4)
