"""Surfaces, their points and smoothed depth one at a time, against values worked out by hand."""

import numpy as np
import pytest
from packed_views import TOWARDS
from reconstruct_street import Street

from nurec_sim import geometry
from nurec_sim.reconstruct.lift import surfaces
from nurec_sim.reconstruct.lift.bodies import surfels_of
from nurec_sim.reconstruct.lift.cloud import Cloud
from nurec_sim.reconstruct.lift.points import actors_of, gather, voxel_edge_m
from nurec_sim.reconstruct.lift.settings import LiftSettings, PointSettings
from nurec_sim.reconstruct.lift.smoothing import UNIT, smooth_depth

# ------------------------------------------------------------------------------------------------------------ surfaces


def noisy_wall(noise_m, seed=0):
    """A wall 4 m by 3 m at x = 10 m with points as near as 6 cm, measured from the origin with noise along x."""
    random = np.random.default_rng(seed)
    y, z = random.uniform(-2, 2, 3300), random.uniform(-1.5, 1.5, 3300)
    xyz = np.column_stack([10 + random.normal(0, noise_m, len(y)), y, z])
    return Cloud(xyz, np.zeros_like(xyz), np.full(len(y), 0.06, np.float32), np.zeros(len(y), np.float32))


def test_a_wall_thicker_than_its_points_are_apart_becomes_thin():
    """Noise of 3 cm on points 6 cm apart: the 20 nearest lie as much across the wall as along it."""
    wall = noisy_wall(0.03)
    flat, normals, _, _ = surfaces.surface_of(wall)
    inner = (np.abs(wall.xyz_m[:, 1]) < 1.8) & (np.abs(wall.xyz_m[:, 2]) < 1.3)
    # Points beyond two standard deviations, 4.6 % of them, keep their place.
    assert np.mean(np.abs(flat.xyz_m[inner, 0] - 10) < 0.01) > 0.9
    assert np.mean(normals[inner, 0] < -np.cos(np.radians(8))) > 0.9


def test_a_pole_before_a_wall_stays_before_it():
    """Its points are too few to hide the plane of the wall, and lie 2.4 standard deviations before it."""
    wall, z = noisy_wall(0.01), np.arange(-1.4, 1.4, 0.06)
    pole = np.column_stack([np.full(len(z), 9.88), np.zeros(len(z)), z])
    same = np.full(len(z), 0.06, np.float32)
    found, _, _, _ = surfaces.surface_of(Cloud.concatenate([wall, Cloud(pole, np.zeros_like(pole), same, same)]))
    assert np.mean(np.abs(found.xyz_m[len(wall) :, 0] - 9.88) < 0.04) > 0.9
    assert np.mean(np.abs(found.xyz_m[: len(wall), 0] - 10) < 0.01) > 0.9


def test_cells_get_the_sums_of_those_beside_them():
    cells = np.unique(np.random.default_rng(0).integers(1, 5, (30, 3)), axis=0)
    keys, own = (cells << (42, 21, 0)).sum(axis=1), np.arange(2.0 * len(cells)).reshape(-1, 2)
    for step in [(0, 0, 0), (1, -1, 0), (-1, 0, 1), (0, 0, -1)]:
        total = np.ones_like(own)
        surfaces._add_beside(keys, sum(each << bits for each, bits in zip(step, (42, 21, 0), strict=True)), own, total)
        for cell, found in zip(cells, total - 1, strict=True):
            assert (found == own[(cells == cell + step).all(axis=1)].sum(axis=0)).all()


def test_planes_do_not_depend_on_where_the_origin_is():
    """Sums of squares of coordinates in the hundreds of kilometres would have no digits left for millimetres."""
    wall, far = noisy_wall(0.03), np.array([5e5, -4e6, 100.0])
    moved = Cloud(wall.xyz_m + far, wall.eye_m + far, wall.spacing_m, wall.intensity)
    here, there = surfaces.surface_of(wall), surfaces.surface_of(moved)
    np.testing.assert_allclose(there[0].xyz_m - far, here[0].xyz_m, atol=1e-6)
    np.testing.assert_allclose(there[1], here[1], atol=1e-4)


# ------------------------------------------------------------------------------------------------------------- depth


def smoothed_middle(jump_to):
    """Level in the middle of a picture of level 10, where level 16 costs nothing and level 10 costs 30."""
    cost = np.full((9, 9, 24), 200.0, np.float32)
    cost[:, :, 10] = 0
    cost[4, 4, 10], cost[4, 4, 16] = 30, 0
    image = np.full((9, 9), 0, np.uint8)
    image[4, 4] = jump_to
    return smoothed(cost, image)[4, 4] / 0.01


def smoothed(cost, image):
    """Depth by these costs of all pixels, of which none is measured."""
    whole = np.rint(cost.reshape(-1, 24) * UNIT).astype(np.int16)
    return smooth_depth(whole, np.full(image.shape, -1, np.int32), image, 0.01 * np.arange(24))


def test_lone_matches_are_smoothed_away_unless_an_edge_surrounds_them():
    """Staying alone costs 80 on each of 8 paths, 11 beside a change of 240 grey levels; the match counts 30 on each."""
    assert smoothed_middle(jump_to=0) == pytest.approx(10, abs=0.5)
    assert smoothed_middle(jump_to=240) == pytest.approx(16, abs=0.5)


def test_inverse_depth_lies_at_the_vertex_between_levels():
    cost = ((np.arange(24) - 10.3) ** 2).astype(np.float32)[None, None]
    assert smoothed(cost, np.zeros((1, 1), np.uint8))[0, 0] == pytest.approx(0.103, rel=1e-3)


# ------------------------------------------------------------------------------------------------------------- points


def cloud_of(xyz_m):
    n = len(xyz_m)
    return Cloud(np.array(xyz_m, float), np.zeros((n, 3)), np.full(n, 0.1, np.float32), np.full(n, np.nan, np.float32))


def test_a_scan_line_with_noise_of_its_ranges_faces_the_sensor():
    """Its points spread least across the plane of its beams, which says nothing of the wall that they hit."""
    noise_m = np.random.default_rng(0).normal(0, 0.01, 50)
    line = np.column_stack([np.linspace(-1, 1, 50), 5 + noise_m, np.zeros(50)])
    _, normal, _, _ = surfaces.surface_of(cloud_of(line))
    assert (-normal[:, 1] > 0.95).all()


def test_discs_are_a_twentieth_as_thick_as_wide_but_3_mm():
    n = 2
    made = surfaces.discs(np.zeros((n, 3)), np.repeat(-TOWARDS, n, axis=0), np.array([0.045, 0.18]), np.zeros((n, 3)),
                          np.zeros(n), np.zeros(n, np.uint8), 0.9)  # fmt: skip
    assert made.scale_m[0] == pytest.approx([0.045, 0.045, 0.003])
    assert made.scale_m[1] == pytest.approx([0.18, 0.18, 0.009])


def test_the_sheet_of_the_ground_has_no_gaps():
    """Where four discs of its lattice meet, less than a tenth of what is below shows through, at 0.95 of opacity."""
    found = gather(Street(frames=3), [], set(), PointSettings())
    (world,), ground = surfels_of(Street(frames=3), [], found, LiftSettings())
    sheet = np.arange(len(world.cloud)) >= len(world.cloud) - len(ground.sheet(found.static))
    corner = world.spacing_m[sheet] / np.sqrt(2)
    each = 0.95 * np.exp(-((corner / world.sigma_m[sheet]) ** 2) / 2)
    assert sheet.sum() > 100 and ((1 - each) ** 4 < 0.1).all()


def lattice(*counts, pitch_m):
    """Points of a lattice, 0.1 m voxels each, and which of them are not at its border."""
    index = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)
    wide = [axis for axis in range(3) if counts[axis] > 1]
    inner = np.all((index[:, wide] >= 2) & (index[:, wide] < np.array(counts)[wide] - 2), axis=1)
    n = len(index)
    return Cloud(index * pitch_m, np.full((n, 3), 50.0), np.full(n, 0.1, np.float32), np.zeros(n, np.float32)), inner


@pytest.mark.parametrize(("pitch_m", "spacing_m", "sigma_m"), [
    (0.05, 0.1, 0.063), (0.12, 0.12, 0.0756), (0.2, 0.2, 0.126), (0.25, 0.25, 0.126), (0.4, 0.3, 0.126)])  # fmt: skip
def test_discs_close_a_wall_that_beams_sampled_in_rows_and_columns(pitch_m, spacing_m, sigma_m):
    """0.63 of the distance between points, of two to three edges of a voxel (0.1 m) at most."""
    wall, inner = lattice(1, 12, 12, pitch_m=pitch_m)
    _, _, spacing, sigma = surfaces.surface_of(wall)
    assert spacing[inner] == pytest.approx(spacing_m)
    assert sigma[inner] == pytest.approx(sigma_m)


def test_discs_of_foliage_leave_gaps():
    """Points that fill a volume: 0.7 of the distance of the fourth neighbour, and 0.45 of that."""
    leaves, inner = lattice(9, 9, 9, pitch_m=0.2)
    _, _, spacing, sigma = surfaces.surface_of(leaves)
    assert spacing[inner] == pytest.approx(0.14)
    assert sigma[inner] == pytest.approx(0.063)


def test_footprints_have_six_tenths_of_their_pixels():
    made = surfaces.footprints(np.zeros((1, 3)), TOWARDS, -TOWARDS, np.array([0.1]), np.zeros((1, 3)), np.zeros(1),
                               np.zeros(1, np.uint8), 0.9)  # fmt: skip
    assert made.scale_m[0] == pytest.approx([0.06, 0.06, 0.006])


def test_voxels_grow_by_powers_of_two_with_the_distance_from_the_drive():
    """0.75 % of it, between 6 and 24 cm, in powers of two."""
    aside = np.array([2.0, 15.9, 16.1, 31.0, 33.0, 63.0, 100.0])
    edge = voxel_edge_m(np.column_stack([np.zeros(7), aside, np.zeros(7)]), np.zeros((1, 3)), PointSettings())
    assert edge == pytest.approx([0.06, 0.06, 0.12, 0.12, 0.24, 0.24, 0.24])


def test_distances_from_a_long_drive_are_those_from_its_nearest_place():
    random = np.random.default_rng(0)
    path, points = np.cumsum(random.normal(0.2, 0.3, (100, 3)), axis=0), random.uniform(-30, 30, (500, 3))
    settings = PointSettings(min_voxel_m=1e-6, max_voxel_m=1e6, voxel_per_distance=1.0)
    nearest = np.linalg.norm(points[:, None] - path, axis=2).min(axis=1)
    assert voxel_edge_m(points, path, settings) == pytest.approx(1e-6 * 2 ** np.floor(np.log2(nearest / 1e-6)))


def test_the_lowest_30_cm_of_a_box_may_be_road():
    clip = Street(frames=2, boxes={"a": ((4.0, 1.8, 1.5), np.array([12.0, -2.0]))})
    found = gather(clip, actors_of(clip, PointSettings()), set(), PointSettings())
    foot, _ = found.feet[0]
    assert -0.75 + 0.2 < foot.xyz_m[:, 2].max() < -0.75 + 0.3 <= found.actors[0].xyz_m[:, 2].min()
    assert geometry.points_in_box(foot.xyz_m, (4.0, 1.8, 1.5), 0.3).all()
