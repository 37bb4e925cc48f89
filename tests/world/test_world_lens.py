"""Any lens and any shutter of the true world, against one exact ray per pixel."""

import dataclasses

import numpy as np
import pytest
from sensor_worlds import request_at

from nurec_sim import geometry, sensors
from nurec_sim.types import Fisheye, FTheta, FThetaReference, Pinhole, Shutter, Windshield, WindshieldReference
from nurec_sim.world import LABEL_OF_CLASS, SurfaceClass, street_rig
from nurec_sim.world.sense.faces import FaceImage, Seen, plan_faces
from nurec_sim.world.sense.shutter import bands_for, camera_patches, lidar_patches

pytestmark = pytest.mark.slow

FRONT = street_rig(112, 64).cameras["camera_front"]
GLASS = Windshield(WindshieldReference.FORWARD, (0.002, 1.01, 0.003, 0.004, 0.002, -0.01),
                   (0.01, 0.004, 0.02, 0.99, 0.01, 0.03))  # fmt: skip
CAMERAS = {
    "pinhole": FRONT,
    "distorted": dataclasses.replace(
        FRONT, lens=dataclasses.replace(FRONT.lens, radial=(-0.32, 0.12, -0.02, 0, 0, 0), tangential=(0.001, -0.0008))
    ),
    "fisheye 190": dataclasses.replace(
        FRONT, width_px=80, height_px=80, lens=Fisheye(24.0, 24.0, 40.0, 40.0, max_angle_rad=np.deg2rad(95))
    ),
    "fisheye polynomial": dataclasses.replace(FRONT, lens=Fisheye(45, 45, 56, 32, (-0.02, 0.003, -0.001, 0.0), 1.6)),
    "f-theta": dataclasses.replace(
        FRONT, lens=FTheta(56, 32, FThetaReference.ANGLE_TO_PIXELDIST, (), (0.0, 53.0, 1.0, -2.0), 1.3)
    ),
    "windshield": dataclasses.replace(FRONT, windshield=GLASS),
    "tele": dataclasses.replace(FRONT, lens=Pinhole(600.0, 600.0, 56.0, 32.0)),
}
EYE_M = 1.5


def drawn_ground(face, world_from_sensor):
    """What a face shows of the endless plane z = 0, exactly."""
    v, u = np.mgrid[0 : face.height_px, 0 : face.width_px] + 0.5
    lens = face.lens
    direction = np.stack([(u - lens.cx_px) / lens.fx_px, (v - lens.cy_px) / lens.fy_px, np.ones_like(u)], axis=-1)
    down = -(direction @ (world_from_sensor[:3, :3] @ face.sensor_from_face).T)[..., 2]
    nearness = np.where(down > 1e-4, down / world_from_sensor[2, 3], 0).astype(np.float32)
    rgb = np.stack([u, v, 0 * u], axis=-1).astype(np.uint8)
    return FaceImage(rgb, np.where(nearness > 0, 0, -1).astype(np.int32), nearness)


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("bands", [1, 4])
def test_every_lens_reads_a_plane_exactly_from_its_faces(name, bands):
    camera = dataclasses.replace(CAMERAS[name], shutter=Shutter.TOP_TO_BOTTOM)
    pose = geometry.pose(FRONT.rig_from_camera[:3, :3], np.array([0.0, 0.0, EYE_M]))
    seen = Seen.nothing(camera.height_px, camera.width_px)
    for patch in camera_patches(camera, bands):
        for face in patch.faces:
            face.read(drawn_ground(face, pose), seen.part(patch.rows, patch.columns))
    rays, valid = sensors.pixel_rays(camera)
    down = -(np.where(valid[..., None], rays, 0) @ pose[:3, :3].T)[..., 2]
    below = valid & (down > 0.02)
    assert below.sum() > 0.3 * valid.sum()
    np.testing.assert_allclose(seen.range_m[below], EYE_M / down[below], rtol=2e-4)
    assert (seen.geom[below] == 0).all() and (seen.range_m[~valid] == 0).all()
    assert (seen.rgb[~valid] == 0).all() and (seen.geom[valid & (down < -0.02)] == -1).all()
    known = below & seen.normal.any(axis=-1)
    assert known.sum() > 0.9 * below.sum()
    up = np.broadcast_to(pose[:3, :3].T @ [0, 0, 1], seen.normal.shape)
    np.testing.assert_allclose(seen.normal[known], up[known], atol=2e-3)


@pytest.mark.parametrize("name", CAMERAS)
def test_every_valid_ray_belongs_to_one_face_of_moderate_size(name):
    camera = CAMERAS[name]
    rays, valid = sensors.pixel_rays(camera)
    owners = np.zeros(valid.shape, int)
    faces = plan_faces(rays, valid, np.array([0.0, 1.0, 0.0]), 1.0)
    for face in faces:
        owners[face.rows, face.columns] += face.owned
    np.testing.assert_array_equal(owners, valid)
    assert sum(face.width_px * face.height_px for face in faces) < 6 * valid.size
    assert len(plan_faces(rays, np.zeros_like(valid), np.array([0.0, 1.0, 0.0]), 1.0)) == 0


def test_lone_holes_in_the_ground_are_closed_and_those_in_leaves_are_not():
    from nurec_sim.world.sense.render import _close_cracks

    geom, nearness = np.full((9, 9), 3, np.int32), np.full((9, 9), 0.1, np.float32)
    for row, column in ((1, 4), (6, 3), (6, 6), (6, 7)):  # above the horizon; alone below it; two side by side
        geom[row, column], nearness[row, column] = -1, 0
    rgb = np.where(geom[..., None] < 0, 255, 90).astype(np.uint8) * np.ones((1, 1, 3), np.uint8)
    drawn = FaceImage(rgb, geom, nearness)
    _close_cracks(drawn, Pinhole(9.0, 9.0, 4.5, 4.5), np.array([0.0, -1.0, 0.0]))
    assert np.argwhere(geom < 0).tolist() == [[1, 4], [6, 6], [6, 7]]
    assert nearness[6, 3] == np.float32(0.1) and rgb[6, 3].tolist() == [90, 90, 90]


def test_columns_of_a_lidar_are_shared_out_in_order():
    lidar = sensors.lidar_model("HDL-64", np.eye(4), columns=100)
    patches = lidar_patches(lidar)
    assert len(patches) == 12 and patches[0].columns.start == 0 and patches[-1].columns.stop == 100
    assert all(a.columns.stop == b.columns.start for a, b in zip(patches, patches[1:], strict=False))
    assert [p.fraction for p in patches] == sorted(p.fraction for p in patches)


@pytest.mark.parametrize("shutter", list(Shutter))
def test_bands_follow_the_shutter(shutter):
    camera = dataclasses.replace(FRONT, shutter=shutter)
    patches = camera_patches(camera, 4)
    assert len(patches) == (1 if shutter is Shutter.GLOBAL else 4)
    for patch in patches:
        corners = np.array([[c + 0.5, r + 0.5] for r in (patch.rows.start, patch.rows.stop - 1)
                            for c in (patch.columns.start, patch.columns.stop - 1)])  # fmt: skip
        fractions = sensors.shutter_fraction(camera, corners)
        assert fractions.min() <= patch.fraction <= fractions.max()
        assert np.isclose(patch.fraction, (fractions.min() + fractions.max()) / 2)


def test_bands_are_as_many_as_the_motion_needs():
    rolling = dataclasses.replace(FRONT, shutter=Shutter.TOP_TO_BOTTOM)
    assert [bands_for(rolling, motion) for motion in (0.0, 0.4, 0.6, 1.9, 500.0)] == [1, 1, 2, 4, 16]
    assert bands_for(dataclasses.replace(rolling, height_px=16), 500.0) == 4


# ------------------------------------------------------------------------------------------------------ in the town


def assert_agree(drawn, cast, labels=0.98):
    """Drawn and exact views show the same; images this small have many edge pixels."""
    assert np.mean(LABEL_OF_CLASS[drawn.surface] == LABEL_OF_CLASS[cast.surface]) > labels
    same = (drawn.surface == cast.surface) & (drawn.instance == cast.instance) & (drawn.range_m > 0)
    assert np.median(np.abs(drawn.depth_m - cast.depth_m)[same]) < 1e-3
    assert np.quantile((np.abs(drawn.range_m - cast.range_m) / np.maximum(cast.range_m, 1))[same], 0.9) < 5e-3
    known = same & drawn.normal.any(axis=-1)
    assert np.median(np.einsum("nc,nc->n", drawn.normal[known], cast.normal[known])) > 0.9999


@pytest.mark.needs_gl
@pytest.mark.parametrize("name", [name for name in CAMERAS if name not in ("pinhole", "tele")])
def test_drawn_lenses_agree_with_rays(plan, painted, rays, name):
    request = request_at(plan, CAMERAS[name], 3.0)
    drawn, cast = painted.view(request), rays.view(request)
    assert_agree(drawn, cast)
    pixel, valid = sensors.pixel_rays(request.sensor)
    assert (drawn.rgb[~valid] == 0).all() and (drawn.surface[~valid] == SurfaceClass.SKY).all()
    assert (drawn.depth_m >= 0).all() and (drawn.depth_m[pixel[..., 2] <= 0] == 0).all()
    assert abs(drawn.rgb[valid].mean() - cast.rgb[valid].mean()) < 40


@pytest.mark.parametrize("shutter", [Shutter.TOP_TO_BOTTOM, Shutter.RIGHT_TO_LEFT])
def test_rays_of_a_rolling_shutter_start_where_their_line_is(plan, rays, shutter):
    camera = dataclasses.replace(FRONT, shutter=shutter, width_px=32, height_px=24, lens=Pinhole(20.0, 20.0, 16, 10))
    request = request_at(plan, camera, 3.0, 60_000)
    rolling = rays.view(request)
    frozen = dataclasses.replace(camera, shutter=Shutter.GLOBAL)
    for line in (0, 11, 23):
        fraction = sensors.shutter_fraction(camera, np.array([[line + 0.5, line + 0.5]]))
        now = request.start_us + round(float(fraction[0]) * 60_000)
        pose = geometry.interpolate_pose_pair(request.world_from_sensor, fraction)[0]
        still = rays.view(dataclasses.replace(request, sensor=frozen, start_us=now, end_us=now,
                                              world_from_sensor=np.stack([pose, pose])))  # fmt: skip
        part = np.s_[:, line] if shutter is Shutter.RIGHT_TO_LEFT else np.s_[line]
        np.testing.assert_allclose(rolling.range_m[part], still.range_m[part], rtol=1e-5)
        np.testing.assert_array_equal(rolling.instance[part], still.instance[part])


@pytest.mark.needs_gl
@pytest.mark.parametrize("name", ["pinhole", "f-theta"])
@pytest.mark.parametrize("shutter, turn_rad", [
    (Shutter.TOP_TO_BOTTOM, 0.05), (Shutter.BOTTOM_TO_TOP, 0.4), (Shutter.LEFT_TO_RIGHT, -0.4)
])  # fmt: skip
def test_drawn_rolling_shutters_agree_with_rays_of_every_line(plan, painted, rays, name, shutter, turn_rad):
    camera = dataclasses.replace(CAMERAS[name], shutter=shutter)
    request = request_at(plan, camera, 4.0, 30_000)
    turned = request.world_from_sensor[1].copy()
    turned[:3, :3] = geometry.rotation_from_yaw(turn_rad) @ turned[:3, :3]
    request = dataclasses.replace(request, world_from_sensor=np.stack([request.world_from_sensor[0], turned]))
    drawn, cast = painted.view(request), rays.view(request)
    assert_agree(drawn, cast, labels=0.97)
    start = painted.view(dataclasses.replace(request, sensor=CAMERAS[name], end_us=request.start_us))
    wrong = np.mean(LABEL_OF_CLASS[start.surface] != LABEL_OF_CLASS[cast.surface])
    assert wrong > 2 * np.mean(LABEL_OF_CLASS[drawn.surface] != LABEL_OF_CLASS[cast.surface])
