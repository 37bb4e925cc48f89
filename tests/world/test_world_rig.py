import collections

import numpy as np
import pytest

from nurec_sim import geometry, sensors
from nurec_sim.types import Shutter
from nurec_sim.world import LIDAR_ID, random_readout_us, random_rig
from nurec_sim.world.plan.random_rigs import LENS_KINDS

PIXELS = 16464  # a quarter of the usual ones
NAMES = ["camera_front", "camera_front_left", "camera_front_right", "camera_rear_left", "camera_rear_right"]


def kind_of(lens):
    return "distorted" if lens.perspective and lens.ideal_pinhole is None else lens.kind


@pytest.fixture(scope="module")
def rigs():
    return [random_rig(seed, pixels=PIXELS) for seed in range(60)]


def test_every_camera_is_sound_and_sees_something_at_every_pixel(rigs):
    for rig in rigs:
        sizes = {(camera.width_px, camera.height_px) for camera in rig.cameras.values()}
        assert len(sizes) == 1
        width, height = sizes.pop()
        assert width % 14 == 0 and height % 14 == 0
        assert abs(width * height / PIXELS - 1) < 0.1 and 1.2 < width / height < 3.6
        assert [name for name in NAMES if name in rig.cameras] == list(rig.cameras) == NAMES[: len(rig.cameras)]
        for camera in rig.cameras.values():
            sensors.check_camera(camera)
            assert sensors.pixel_rays(camera)[1].all(), camera


def test_cameras_look_where_their_names_say(rigs):
    places = {"camera_front": (0, 0), "camera_front_left": (45, 62), "camera_rear_left": (125, 150)}
    for rig in rigs:
        for name, camera in rig.cameras.items():
            low, high = places[name.replace("right", "left")]
            forward = camera.rig_from_camera[:3, 2]
            yaw = np.rad2deg(np.arctan2(forward[1], forward[0])) * (-1 if name.endswith("right") else 1)
            assert low - 6 < yaw < high + 6, name
            assert abs(np.rad2deg(np.arcsin(forward[2]))) < 10
            assert geometry.is_rotation(camera.rig_from_camera[:3, :3], 1e-9)
            assert 1.0 <= camera.rig_from_camera[2, 3] <= 2.4


def test_all_kinds_are_drawn_and_plain_pinholes_most_often(rigs):
    kinds = collections.Counter(kind_of(rig.cameras["camera_front"].lens) for rig in rigs)
    assert set(kinds) == set(LENS_KINDS) and kinds["pinhole"] > len(rigs) / 3
    assert {len(rig.cameras) for rig in rigs} == {1, 3, 5}
    shutters = collections.Counter(rig.cameras["camera_front"].shutter for rig in rigs)
    assert shutters[Shutter.GLOBAL] > len(rigs) / 2 and shutters[Shutter.TOP_TO_BOTTOM] > 3
    assert all(8_000 <= random_readout_us(seed) <= 33_000 for seed in range(60))


@pytest.mark.parametrize("lens", LENS_KINDS)
def test_choices_are_kept_and_the_same_seed_gives_the_same_rig(lens):
    rig, again = (random_rig(5, cameras=3, pixels=PIXELS, lens=lens, lidar="VLP-16") for _ in range(2))
    assert len(rig.cameras) == 3 and {kind_of(camera.lens) for camera in rig.cameras.values()} == {lens}
    assert rig.lidars[LIDAR_ID].elevation_rad.shape == (16,)
    for name, camera in rig.cameras.items():
        assert camera.lens == again.cameras[name].lens
        np.testing.assert_array_equal(camera.rig_from_camera, again.cameras[name].rig_from_camera)


def test_fields_of_view_span_what_training_needs(rigs):
    seen = []
    for rig in rigs:
        camera = rig.cameras["camera_front"]
        edge = np.array([[0.0, camera.height_px / 2], [camera.width_px, camera.height_px / 2]])
        rays = sensors.unproject(camera, edge)[0]
        seen.append(np.rad2deg(np.arccos(np.clip(rays[0] @ rays[1], -1, 1))))
    assert min(seen) > 35 and max(seen) < 145 and np.ptp(seen) > 50


@pytest.mark.parametrize(
    "arguments, text",
    [
        ({"seed": -1}, "a rig needs a seed >= 0, got -1"),
        ({"cameras": 2}, "a rig has 1, 3, 5 cameras, got 2"),
        ({"lens": "mirror"}, r"no kind of lens 'mirror'; have \['pinhole', 'distorted'"),
        ({"pixels": 100}, "an image needs at least 12544 pixels, got 100"),
        ({"lidar": "X"}, r"no LiDAR 'X'; have \['64x900', 'PANDAR128'"),
    ],
)
def test_impossible_rigs_are_refused(arguments, text):
    with pytest.raises(ValueError, match=text):
        random_rig(**({"seed": 1} | arguments))


def test_a_rig_may_go_without_lidar():
    rig = random_rig(2, cameras=1, lidar=None, pixels=PIXELS)
    assert rig.lidars == {} and list(rig.cameras) == ["camera_front"]
