"""The ego vehicle in the frames of a log: found where it stays while the street moves, and not lifted."""

import dataclasses
from functools import cached_property

import cv2
import numpy as np
import pytest
from feedforward_clip import MadeClip, clip_of, frame_times, pinhole

from nurec_sim import geometry, sensors
from nurec_sim.reconstruct.ego_vehicle import find_ego_images
from nurec_sim.reconstruct.ego_vehicle.evidence import compare
from nurec_sim.reconstruct.ego_vehicle.images import ground_before
from nurec_sim.reconstruct.lift.settings import ViewSettings
from nurec_sim.reconstruct.lift.views import read_views
from nurec_sim.types import LidarModel, Rig, Sweep, Track, Trajectory
from nurec_sim.world import LIDAR_ID, street_rig

pytestmark = pytest.mark.slow

CAMERA = pinhole("front", width=400, height=240, field_deg=80.0)


def texture(shape: tuple[int, int], seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 255, shape).astype(np.float32)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.5), None, 30, 220, cv2.NORM_MINMAX)


GROUND, VEHICLE = texture((2000, 2000), 1), texture((240, 400), 2)


@dataclasses.dataclass(frozen=True, eq=False)
class GroundClip(MadeClip):
    """A car that drives straight over textured ground, 1.5 m a frame; its bonnet is a trapezoid of textured paint."""

    bonnet: bool = True
    step_m: float = 1.5
    paint: tuple[tuple[np.ndarray, np.ndarray | float], ...] = ()
    """Masks of the image and their grey levels, over all else."""

    @property
    def ego(self) -> Trajectory:
        t_us = self.times["front"][:, 0]
        return Trajectory(t_us, np.stack([geometry.pose(np.eye(3), np.array([self.step_m * k, 0.0, 0.0]))
                                          for k in range(len(t_us))]))  # fmt: skip

    def image(self, camera_id: str, index: int) -> np.ndarray:
        camera = self.cameras[camera_id]
        rays, _ = sensors.pixel_rays(camera)
        pose = self.world_from_camera(camera_id, index)[0]
        rays = rays @ pose[:3, :3].T
        with np.errstate(divide="ignore", invalid="ignore"):
            place = pose[:3, 3] + np.where(rays[..., 2:] < 0, -pose[2, 3] / rays[..., 2:], np.nan) * rays
        cells = np.nan_to_num(place[..., :2] * 20 + 1000, nan=-1e4).astype(np.float32)
        grey = cv2.remap(GROUND, cells[..., 0], cells[..., 1], cv2.INTER_LINEAR, borderValue=128)
        if self.bonnet:
            grey = np.where(bonnet_mask(), VEHICLE, grey)
        for mask, level in self.paint:
            grey = np.where(mask, level, grey)
        return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)


def bonnet_mask() -> np.ndarray:
    rows, columns = np.indices((240, 400))
    return (rows > 190) & (abs(columns - 200) < 60 + 2.0 * (rows - 190))


def driving(**options) -> GroundClip:
    plain = clip_of(CAMERA, times=frame_times(6, 100_000))
    return GroundClip(plain.cameras, plain.times, **options)


def overlap(found: np.ndarray, true: np.ndarray) -> float:
    """Intersection over union of two masks."""
    return (found & true).sum() / (found | true).sum()


def test_the_bonnet_is_found_to_its_edge_and_keeps_its_colours():
    (image,) = find_ego_images(driving(), ["front"]).values()
    found, true = image[..., 3] > 127, bonnet_mask()
    assert overlap(found, true) > 0.9
    inside = cv2.erode((found & true).astype(np.uint8), np.ones((9, 9))) > 0
    np.testing.assert_array_equal(image[inside, 0], VEHICLE[inside].astype(np.uint8))


def test_plain_paint_is_found_to_the_edge_that_stays():
    """Of a bonnet without texture, a window beside its edge is all the evidence."""
    clip = driving(bonnet=False, paint=((bonnet_mask(), 20.0),))
    (image,) = find_ego_images(clip, ["front"]).values()
    assert overlap(image[..., 3] > 127, bonnet_mask()) > 0.9


def test_a_line_along_the_motion_is_of_the_street():
    """A kerb beside the bonnet, towards the vanishing point at (200, 120), has five times the contrast of its edge."""
    rows, columns = np.indices((240, 400))
    road, pavement = rows > 122, (rows > 122) & (columns > 200 + 0.9 * (rows - 120))
    clip = driving(bonnet=False, paint=((road, 60.0), (pavement, 160.0), (bonnet_mask(), 40.0)))
    (image,) = find_ego_images(clip, ["front"]).values()
    assert overlap(image[..., 3] > 127, bonnet_mask()) > 0.85


@pytest.mark.parametrize(("side_px", "street"), [(20, False), (50, True)])
def test_reflections_in_the_paint_are_no_street(side_px: int, street: bool):
    """A square of the bonnet shows ground that moves: a connected part counts from 0.2 % of the image, 14 px square."""
    rows, columns = np.indices((240, 400))
    square = (abs(rows - 215) < side_px / 2) & (abs(columns - 200) < side_px / 2)
    clip = driving(paint=((bonnet_mask() & ~square, VEHICLE),), bonnet=False)
    small, poses = clip.rig.cameras["front"], [clip.world_from_camera("front", k)[0] for k in (0, 1)]
    rays, depth_m = ground_before(small, clip)
    points = np.nan_to_num(depth_m, nan=1.0)[..., None] * rays
    first, second = (clip.image("front", k)[..., 0].astype(np.float32) for k in (0, 1))
    _, there = compare(small, first, second, points, geometry.inverse(poses[1]) @ poses[0])
    assert there[square].any() == street


def hanging_mask() -> np.ndarray:
    """The dark corner of a housing."""
    rows, columns = np.indices((240, 400))
    return columns + 2 * rows < 120


def test_what_hangs_into_the_image_belongs_to_the_vehicle():
    clip = driving(paint=((hanging_mask(), 10.0),))
    (image,) = find_ego_images(clip, ["front"]).values()
    found = image[..., 3] > 127
    assert overlap(found[:110], hanging_mask()[:110]) > 0.8
    assert overlap(found[150:], bonnet_mask()[150:]) > 0.9


@pytest.mark.parametrize("hanging", ["cloud", "sky at night"])
def test_clouds_and_the_sky_at_night_do_not(hanging: str):
    """The corner in the colour of a cloud; a black sky, down to a horizon that stays."""
    sky = np.indices((240, 400))[0] < 118
    paint = (hanging_mask(), 200.0) if hanging == "cloud" else (sky, 5.0)
    (image,) = find_ego_images(driving(paint=(paint,)), ["front"]).values()
    assert not image[:110, :, 3].any()


def test_a_street_without_a_bonnet_has_none():
    assert find_ego_images(driving(bonnet=False), ["front"]) == {}


def test_of_a_car_that_stands_its_outline_is_taken():
    """The camera is 1.4 m high, 1.5 m before the origin; the front of the car, 0.75 m high, ends its outline."""
    clip = driving(step_m=0.0)
    (image,) = find_ego_images(clip, ["front"]).values()
    focal_px = 200 / np.tan(np.radians(40))
    front_m = clip.rig.body.center_m[0] + clip.rig.body.size_m[0] / 2
    row = 120 + focal_px * (1.4 - 0.75) / (front_m - 1.5)
    assert 160 < row < 220 and not image[: int(row) - 4, 200, 3].any() and (image[int(row) + 5 :, 200, 3] == 255).all()


def test_where_neither_vehicle_nor_street_has_texture_it_is_taken_too():
    """The street of ``test_a_street_without_a_bonnet_has_none`` has."""
    plain = driving(bonnet=False, paint=((np.ones((240, 400), bool), 128.0),))
    outline = find_ego_images(driving(step_m=0.0), ["front"])["front"][..., 3]
    np.testing.assert_array_equal(find_ego_images(plain, ["front"])["front"][..., 3], outline)


def test_the_masks_of_the_log_come_first():
    class Masked(GroundClip):
        def ego_mask(self, camera_id: str) -> np.ndarray:
            mask = np.zeros((240, 400), bool)
            mask[100:140, 20:60] = True
            return mask

    clip = driving()
    (image,) = find_ego_images(Masked(clip.cameras, clip.times), ["front"]).values()
    assert (image[105:135, 25:55, 3] == 255).all() and not image[150:, :, 3].any()


def test_its_pixels_are_not_lifted():
    clip = driving()
    images = find_ego_images(clip, ["front"])
    view = read_views(clip, ["front"], images, ViewSettings())[0]
    np.testing.assert_array_equal(view.tile.valid, images["front"][..., 3] == 0)


AHEAD_M, REAR = 6.0, (slice(120, 175), slice(165, 235))
"""Distance of the car ahead from the camera, and where its rear is in the image: 1.76 m wide, from the ground up."""


@dataclasses.dataclass(frozen=True, eq=False)
class FollowingClip(GroundClip):
    """A plain road, and a car ahead that keeps its distance, known by returns from its rear or by its box."""

    ahead: bool = True
    returns: bool = False

    @cached_property
    def rig(self) -> Rig:
        lidars: dict[str, LidarModel] = {LIDAR_ID: street_rig().lidars[LIDAR_ID]} if self.returns else {}
        return Rig(self.cameras, lidars)

    def sweep_times_us(self, lidar_id: str) -> np.ndarray:
        return self.times["front"] + np.array([-50_000, 50_000])

    def sweep(self, lidar_id: str, index: int) -> Sweep:
        """Returns every 10 cm on the rear."""
        y, z = np.meshgrid(np.arange(-0.85, 0.9, 0.1), np.arange(0.05, 1.4, 0.1))
        ahead_m = CAMERA.rig_from_camera[0, 3] + AHEAD_M
        xyz = np.stack([np.full(y.size, ahead_m), y.ravel(), z.ravel()], axis=1)
        start_us, end_us = self.sweep_times_us(lidar_id)[index].tolist()
        t_us = (start_us + end_us) // 2
        return Sweep(t_us, start_us, end_us, self.ego.at(t_us), xyz, None, np.full(len(xyz), t_us))

    def image(self, camera_id: str, index: int) -> np.ndarray:
        grey = np.full((240, 400), 128, np.float32)
        if self.ahead:
            grey[REAR] = VEHICLE[REAR]
        if self.bonnet:
            grey = np.where(bonnet_mask(), VEHICLE, grey)
        return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)


def following(known: str, **options) -> FollowingClip:
    plain = clip_of(CAMERA, times=frame_times(6, 100_000))
    clip = FollowingClip(plain.cameras, plain.times, returns=known == "returns", **options)
    return with_box(clip, CAMERA.rig_from_camera[0, 3] + AHEAD_M) if known == "box" else clip


def with_box(clip: GroundClip, rear_m: float):
    """A car ahead is labelled, its rear at so much before the origin of the rig."""
    middle = geometry.pose(np.eye(3), np.array([rear_m + 2.0, 0.0, 0.7]))
    path = Trajectory(clip.ego.t_us, clip.ego.world_from_body @ middle)
    return dataclasses.replace(clip, tracks=(Track("ahead", "automobile", (4.0, 1.76, 1.4), path),))


@pytest.mark.parametrize("known", ["returns", "box"])
def test_a_car_ahead_that_keeps_its_distance_is_not_the_ego_vehicle(known: str):
    """Without a bonnet nothing but its outline is taken: the road is plain."""
    (outline,) = find_ego_images(following(known, bonnet=False), ["front"]).values()
    np.testing.assert_array_equal(outline[..., 3], find_ego_images(driving(step_m=0.0), ["front"])["front"][..., 3])
    (image,) = find_ego_images(following(known), ["front"]).values()
    (alone,) = find_ego_images(following("nothing", ahead=False), ["front"]).values()
    found, true = image[..., 3] > 127, alone[..., 3] > 127
    assert (found & true).sum() / (found | true).sum() > 0.95 and not found[REAR].any()


def test_sweeps_that_are_held_out_say_nothing():
    """Without them, nothing tells the car ahead from a bonnet: the picture alone would be taken for one."""
    clip = following("returns", bonnet=False)
    (image,) = find_ego_images(clip, ["front"], hold_out=range(6)).values()
    assert (image[REAR][10:, :, 3] > 127).mean() > 0.5


def test_what_the_bonnet_may_hide_from_the_camera_is_no_evidence():
    """A box that stands in front of the bonnet reaches into its image: the bonnet is found as without it."""
    clip = with_box(driving(), rear_m=4.5)
    (image,) = find_ego_images(clip, ["front"]).values()
    found, true = image[..., 3] > 127, bonnet_mask()
    assert overlap(found, true) > 0.9
