"""A vehicle that many images saw is stored once, in its box; a person keeps the moments of its images."""

import numpy as np
from render_scenes import gaussians

from nurec_sim import geometry
from nurec_sim.reconstruct.feedforward.tracks.rigid import rigid_once
from nurec_sim.reconstruct.lift.actors import standing_knots_us
from nurec_sim.reconstruct.lift.points import Actor
from nurec_sim.types import DynamicGaussians, Track, Trajectory

SPAN_US = (1_000_000, 3_000_000)
SIZE_M = (4.0, 2.0, 1.6)
TURNING = Trajectory(
    np.array([1_000_000, 2_000_000]),
    np.stack([geometry.pose_from_xyyaw(10, 0, 0), geometry.pose_from_xyyaw(18, 3, 0.8)]),
)
SIDES = np.array([[x, y, z] for x in (-1.6, 0.1, 1.4) for y in (-1.0, 1.0) for z in (-0.35, 0.3)])


def actor(label="automobile", standing=False):
    path = Trajectory(TURNING.t_us[:1], TURNING.world_from_body[:1]) if standing else TURNING
    return Actor(3, Track("a", label, SIZE_M, TURNING), standing, path)


def seen(box_m, t_us, scale_m=0.05, knots_us=None, standing=False):
    """Points of the box as one image at an instant sees them."""
    world_from_box = TURNING.world_from_body[0] if standing else TURNING.at(t_us)
    mean = geometry.transform_points(world_from_box, np.asarray(box_m)).astype(np.float32)
    knots = np.array([t_us - 100_000, t_us, t_us + 100_000]) if knots_us is None else knots_us
    n = len(mean)
    part = gaussians(mean, scale=scale_m)
    return DynamicGaussians(part, np.tile(knots, (n, 1)), np.repeat(mean[:, None], 3, axis=1), np.full(n, 3, np.int32))


def once(parts, who=None, chunks=None):
    chunk = np.repeat(chunks or [0] * len(parts), [len(part) for part in parts])
    return rigid_once(DynamicGaussians.concatenate(parts), chunk, [who or actor()], SPAN_US)


def test_the_finest_view_shows_each_direction():
    near = seen(SIDES[:6] * 1.02, 1_300_000, 0.04)
    far = [seen(SIDES * 0.9, t_us, 0.06) for t_us in (1_500_000, 1_700_000)]
    result = once([far[0], near, far[1]])
    assert result.in_box.all() and (result.track == 3).all()
    found = result.gaussians.mean_m[np.lexsort(result.gaussians.mean_m.T)]
    # Where the near view saw nothing, one of the far ones does.
    wanted = np.concatenate([SIDES[:6] * 1.02, SIDES[6:] * 0.9])
    assert np.allclose(found, wanted[np.lexsort(wanted.T)], atol=1e-5)


def test_a_longer_log_gives_no_more_gaussians():
    views = [seen(SIDES, t_us) for t_us in range(1_100_000, 1_900_000, 50_000)]
    assert len(once(views[:2])) == len(once(views)) == len(SIDES)


def test_a_view_that_hardly_covers_a_direction_does_not_show_it():
    dense = np.concatenate([SIDES + shift for shift in ([0, 0, 0.01], [0, 0, 0.02], [0, 0, 0.03], [0.01, 0, 0.01])])
    result = once([seen(dense, 1_300_000, 0.05), seen(SIDES, 1_500_000, 0.04)])
    assert len(result) == len(dense)


def test_rotations_turn_with_the_box():
    part = seen(SIDES, 1_500_000)
    result = once([part])
    back = geometry.quat_multiply(
        np.tile(geometry.quat_from_matrix(TURNING.at(1_500_000)[:3, :3]), (len(result), 1)), result.gaussians.quat_wxyz
    )
    assert np.allclose(np.abs(np.sum(back * part.gaussians.quat_wxyz, axis=1)), 1, atol=1e-5)


def test_persons_and_moments_outside_of_the_path_stay():
    views = [seen(SIDES, 1_300_000), seen(SIDES, 1_500_000)]
    assert once(views, actor("person")).in_box is None
    late = seen(SIDES, 1_500_000, knots_us=np.array([2_100_000, 2_200_000, 2_300_000]))
    result = once([*views, late])
    assert (~result.in_box).sum() == result.in_box.sum() == len(SIDES)


def test_points_far_from_the_box_are_dropped():
    assert len(once([seen(np.concatenate([SIDES, [[9.0, 0, 0]]]), 1_300_000)])) == len(SIDES)


def test_a_static_actor_of_two_chunks_is_there_once_beside_its_moments():
    lasting = [seen(SIDES, 1_500_000, scale, standing_knots_us(SPAN_US), True) for scale in (0.05, 0.035)]
    moment = seen(SIDES, 1_500_000, standing=True)
    result = once([*lasting, moment], actor(standing=True), [0, 1, 1])
    assert result.in_box.sum() == len(SIDES) and np.allclose(result.gaussians.scale_m[result.in_box], 0.035)
    assert (~result.in_box).sum() == len(SIDES)
