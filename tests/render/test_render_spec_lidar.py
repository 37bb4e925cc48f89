"""The reference's LiDAR against numbers worked out by hand: beams, times, returns and filters."""

import dataclasses

import numpy as np
import pytest
from render_scenes import START_US, cloud, gaussians, request, row_of_walls, scene

from nurec_sim import geometry, sensors
from nurec_sim.errors import RequestError
from nurec_sim.render import spec
from nurec_sim.types import Gaussians, LidarFilter, Spin


def lidar(**changes):
    """Eight beams around, 15 degrees up and down, one turn."""
    model = sensors.lidar_model("VLP-16", np.eye(4), columns=8)
    return dataclasses.replace(model, elevation_rad=np.radians([15.0, 0.0, -15.0]),
                               row_azimuth_offset_rad=np.zeros(3), **changes)  # fmt: skip


def shell(radius_m=10.0, **kwargs):
    """One wide flat Gaussian across each of 24 beams."""
    directions = sensors.beam_directions(lidar()).reshape(-1, 3)
    helper = np.cross(directions, [0.0, 0.0, 1.0])
    helper /= np.linalg.norm(helper, axis=1, keepdims=True)
    rotation = np.stack([directions, helper, np.cross(directions, helper)], axis=-1)
    return gaussians(directions * radius_m, scale=(0.01, 0.3, 0.3), quat=geometry.quat_from_matrix(rotation), **kwargs)


def test_every_beam_meets_the_shell_around_it():
    frame = spec.render_lidar(scene(shell(intensity=0.3)), request(lidar()))
    assert frame.beam.tolist() == list(range(24))
    assert frame.range_m == pytest.approx(np.full(24, 10.0), abs=1e-4)
    assert frame.intensity == pytest.approx(np.full(24, 0.3), abs=1e-6)
    assert frame.xyz_m == pytest.approx(sensors.beam_directions(lidar()).reshape(-1, 3) * 10, abs=1e-4)
    some = spec.render_lidar(scene(shell()), request(lidar()), beams=np.array([3, 17]))
    assert some.beam.tolist() == [3, 17] and some.range_m == pytest.approx([10, 10], abs=1e-4)


@pytest.mark.parametrize("spin", list(Spin))
def test_columns_fire_one_after_the_other_and_points_are_in_the_last_frame(spin):
    """A sensor that drives at 20 m/s past things that stand still."""
    sign = -1 if spin is Spin.CLOCKWISE else 1
    model = lidar(spin=spin, azimuth_rad=np.pi + sign * 2 * np.pi * np.arange(8) / 8)
    end = geometry.pose_from_xyyaw(2.0, 0.0, 0.3)
    asked = request(model, end_from_rig=end, end_us=START_US + 100_000)
    fraction = np.arange(8) / 7
    poses = geometry.interpolate_pose_pair(asked.world_from_sensor, fraction)
    met = poses[:, :3, 3] + 10 * np.einsum("cij,cj->ci", poses[:, :3, :3], sensors.beam_directions(model)[1])
    balls = gaussians(met, scale=0.05)
    frame = spec.render_lidar(scene(balls), asked)
    assert frame.beam.tolist() == list(range(8, 16))
    assert frame.range_m == pytest.approx(np.full(8, 10.0), abs=1e-4)
    assert frame.xyz_m == pytest.approx(geometry.transform_points(geometry.inverse(end), met), abs=1e-4)


def test_beams_wrap_around_behind_the_sensor():
    """The first column looks straight back: half of what it meets lies at azimuths near +pi, half near -pi."""
    sides = gaussians([[-10, 0.06, 0], [-10, -0.06, 0]], scale=0.1, opacity=0.9)
    frame = spec.render_lidar(scene(sides), request(lidar()), LidarFilter(opacity_threshold=0.2))
    alone = spec.render_lidar(scene(sides[:1]), request(lidar()), LidarFilter(opacity_threshold=0.85))
    one = 0.9 * np.exp(-0.18)
    assert frame.beam.tolist() == [8] and one < 0.85 < 1 - (1 - one) ** 2
    assert alone.beam.tolist() == []
    both = spec.render_lidar(scene(sides), request(lidar()), LidarFilter(opacity_threshold=0.85))
    assert both.beam.tolist() == [8]


def test_the_first_return_is_reported_and_not_a_mean():
    world = row_of_walls([4, 9], opacity=[0.6, 0.9], intensity=[0.2, 0.8])
    frame = spec.render_lidar(scene(world), request(lidar()), beams=np.array([12]))
    assert frame.range_m == pytest.approx([4.0], abs=1e-4)
    assert frame.intensity == pytest.approx([(0.6 * 0.2 + 0.36 * 0.8) / 0.96])
    world = row_of_walls([4, 9], opacity=[0.4, 0.9], intensity=[np.nan, 0.8])
    frame = spec.render_lidar(scene(world), request(lidar()), beams=np.array([12]))
    assert frame.range_m == pytest.approx([9.0], abs=1e-4) and frame.intensity == pytest.approx([0.8])
    faint = row_of_walls([4, 9], opacity=[0.2, 0.2])
    frame = spec.render_lidar(scene(faint), request(lidar()), LidarFilter(opacity_threshold=0.3), np.array([12]))
    assert frame.range_m == pytest.approx([(0.2 * 4 + 0.16 * 9) / 0.36], abs=1e-4) and frame.intensity == [0]


def test_opacity_and_the_range_of_the_sensor_decide_over_a_return():
    world = scene(row_of_walls([8], opacity=0.7))
    beam = np.array([12])
    assert len(spec.render_lidar(world, request(lidar()), LidarFilter(opacity_threshold=0.69), beam).beam) == 1
    assert len(spec.render_lidar(world, request(lidar()), LidarFilter(opacity_threshold=0.71), beam).beam) == 0
    assert len(spec.render_lidar(world, request(lidar(range_m=(0.5, 7.9))), None, beam).beam) == 0
    assert len(spec.render_lidar(world, request(lidar(range_m=(8.1, 20.0))), None, beam).beam) == 0


def test_ray_drop_is_the_weighted_mean_of_what_a_beam_meets():
    world = dataclasses.replace(row_of_walls([4, 9], opacity=[0.6, 0.9]), ray_drop=np.float32([0.9, 0.1]))
    drop = (0.6 * 0.9 + 0.36 * 0.1) / 0.96
    for threshold, returns in ((drop - 0.01, 0), (drop + 0.01, 1)):
        frame = spec.render_lidar(scene(world), request(lidar()), LidarFilter(threshold), np.array([12]))
        assert len(frame.beam) == returns
    sure = dataclasses.replace(world, ray_drop=np.float32([1, 1]))
    assert len(spec.render_lidar(scene(sure), request(lidar()), LidarFilter(1.0), np.array([12])).beam) == 1
    none = dataclasses.replace(world, ray_drop=None)
    assert len(spec.render_lidar(scene(none), request(lidar()), LidarFilter(0.0), np.array([12])).beam) == 1


def test_intensity_falls_off_with_incidence():
    # Beam 12 looks along x. The normal is 60 degrees off it: half of what the surface can lose is lost.
    wall = dataclasses.replace(row_of_walls([8], opacity=0.9), intensity=np.float32([0.8]))
    normal = np.float32([[-0.5, np.sqrt(0.75), 0]])

    def shown(**fields):
        world = dataclasses.replace(wall, **{"normal": normal, "falloff": np.float32([0.6]), **fields})
        return float(spec.render_lidar(scene(world), request(lidar()), None, np.array([12])).intensity[0])

    assert shown() == pytest.approx(0.8 * (1 - 0.6 * 0.5), abs=1e-6)
    assert shown(normal=-normal) == pytest.approx(0.8 * (1 - 0.6 * 0.5), abs=1e-6)
    assert shown(normal=np.float32([[-1, 0, 0]])) == shown(falloff=None) == pytest.approx(0.8, abs=1e-6)
    assert shown(normal=np.zeros((1, 3), np.float32)) == pytest.approx(0.8, abs=1e-6)


def test_the_distance_filter_takes_beams_that_meet_two_things():
    world = scene(row_of_walls([4, 9], opacity=[0.6, 0.9]))  # range 4, mean 5.875
    for limit, returns in ((None, 1), (1.8, 0), (1.9, 1)):
        asked = LidarFilter(distance_threshold_m=limit)
        assert len(spec.render_lidar(world, request(lidar()), asked, np.array([12])).beam) == returns


@pytest.mark.parametrize(
    "fields, text",
    [
        ({"raydrop_threshold": 1.01}, r"raydrop_threshold must lie in 0\.\.1, got 1\.01"),
        ({"raydrop_threshold": float("nan")}, r"raydrop_threshold must lie in 0\.\.1, got nan"),
        ({"opacity_threshold": -0.1}, r"opacity_threshold must lie in 0\.\.1, got -0\.1"),
        ({"distance_threshold_m": float("nan")}, "distance_threshold_m must be finite and not negative, .* got nan"),
        ({"distance_threshold_m": -1.0}, "distance_threshold_m must be finite and not negative, .* got -1"),
    ],
)
def test_filters_that_make_no_sense(fields, text):
    with pytest.raises(RequestError, match=text):
        LidarFilter(**fields)


def test_ray_drop_goes_where_its_gaussians_go():
    plain, dropping = cloud(4), dataclasses.replace(cloud(3), ray_drop=np.float32([0.1, 0.2, 0.3]))
    assert dropping[1:].ray_drop.tolist() == dropping.ray_drop[1:].tolist() and plain[1:].ray_drop is None
    assert Gaussians.concatenate([plain, dropping]).ray_drop.tolist() == [0, 0, 0, 0, *dropping.ray_drop.tolist()]
    assert Gaussians.concatenate([plain, plain]).ray_drop is None
    assert Gaussians.empty(2).ray_drop is None


def test_falloff_goes_where_its_gaussians_go():
    plain, falling = cloud(2), dataclasses.replace(cloud(2), falloff=np.float32([0.1, 0.2]))
    assert falling[1:].falloff.tolist() == falling.falloff[1:].tolist() and plain[1:].falloff is None
    assert Gaussians.concatenate([plain, falling]).falloff.tolist() == [0, 0, *falling.falloff.tolist()]
    assert Gaussians.concatenate([plain, plain]).falloff is None
