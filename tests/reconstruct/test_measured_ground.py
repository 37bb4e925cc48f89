"""The ground by the LiDAR: what a kerb sets apart, whatever the images said, and what no image showed."""

import dataclasses

import numpy as np
import pytest
from reconstruct_street import KERB_M, STEP_M, WALL_M, Street

from nurec_sim.errors import ReconstructError
from nurec_sim.reconstruct import LiftSettings, ViewSettings, reconstruct
from nurec_sim.reconstruct.measured_ground import with_measured_ground
from nurec_sim.types import Label

SMALL = LiftSettings(views=ViewSettings(width_px=96, levels=8, max_views=3), sky_px=32)


@pytest.fixture(scope="module")
def street():
    return Street()


@pytest.fixture(scope="module")
def scene(street):
    return reconstruct(street, "lift", cameras=["front"], settings=SMALL)


def relabelled(scene, street, label, raised_m=0.0):
    """The labels that the LiDAR gives to a scene, all of whose Gaussians have the given one and lie too high."""
    static = scene.static
    wrong = dataclasses.replace(
        static, mean_m=static.mean_m + np.float32([0, 0, raised_m]), label=np.full(len(static), label, np.uint8)
    )
    return with_measured_ground(dataclasses.replace(scene, static=wrong), street, set()).static.label[: len(static)]


@pytest.mark.parametrize("label", [Label.ROAD, Label.OTHER])
@pytest.mark.parametrize("raised_m", [-0.4, 0.0, 0.4])
def test_road_ends_at_the_kerb_whatever_the_images_said(street, scene, label, raised_m):
    x, y, z = scene.static.mean_m.T.astype(float)
    found = relabelled(scene, street, label, raised_m)
    near = (x > -2) & (x < 12) & (np.abs(z) < 0.03)
    road = near & (np.abs(y) < KERB_M - 0.3)
    pavement = (x > -2) & (x < 12) & (np.abs(z - STEP_M) < 0.03) & (np.abs(y) > KERB_M + 0.3) & (np.abs(y) < 7.5)
    assert min(road.sum(), pavement.sum()) > 100
    assert np.mean(found[road] == Label.ROAD) > 0.99
    assert np.mean(found[pavement] == Label.OTHER) > 0.99


def test_what_is_far_above_the_ground_or_movable_keeps_its_label(street, scene):
    high = scene.static.mean_m[:, 2] > 1.5
    assert high.sum() > 100
    assert (relabelled(scene, street, Label.ROAD)[high] == Label.ROAD).all()
    assert (relabelled(scene, street, Label.MOVABLE) == Label.MOVABLE).all()


def test_nothing_else_changes(street, scene):
    after = with_measured_ground(scene, street, set())
    for name in (field.name for field in dataclasses.fields(scene) if field.name != "static"):
        assert getattr(after, name) is getattr(scene, name)
    for name in ("mean_m", "quat_wxyz", "scale_m", "opacity", "rgb", "normal", "intensity"):
        np.testing.assert_array_equal(getattr(after.static, name)[: len(scene.static)], getattr(scene.static, name))
    assert not len(before_the_wall(after.static[len(scene.static) :]))


def in_hole(gaussians, margin_m=0.0):
    x, y, z = gaussians.mean_m.T.astype(float)
    return (x > 3 - margin_m) & (x < 7 + margin_m) & (np.abs(y) < 2 + margin_m) & (np.abs(z) < 0.5)


def before_the_wall(gaussians):
    """Without ground behind the wall, where there are holes anyway."""
    return gaussians[np.abs(gaussians.mean_m[:, 1]) < WALL_M]


def test_ground_that_no_image_showed_is_added_as_measured(street, scene):
    static = scene.static
    rest = static[~in_hole(static)]
    found = with_measured_ground(dataclasses.replace(scene, static=rest), street, set()).static
    for name in ("mean_m", "quat_wxyz", "scale_m", "rgb", "opacity"):
        np.testing.assert_array_equal(getattr(found, name)[: len(rest)], getattr(rest, name))
    added = before_the_wall(found[len(rest) :])
    x, y, z = added.mean_m.T.astype(float)
    assert in_hole(added).all()
    assert np.abs(z).max() < 0.02
    assert (np.abs(added.normal[:, 2]) > 0.99).all()
    assert (added.label == Label.ROAD).all()
    # One Gaussian per cell of 0.1 m, but not within 0.3 m of others, which lie up to a cell outside of the hole.
    assert 34 * 34 <= len(added) <= 36 * 36
    around = in_hole(rest, 1.0) & (rest.label == Label.ROAD)
    assert np.abs(added.rgb.mean(axis=0) - rest.rgb[around].mean(axis=0)).max() < 0.05


def test_small_or_faint_gaussians_leave_holes_and_large_ones_do_not(street, scene):
    static = scene.static
    rest, inside = static[~in_hole(static)], static[in_hole(static)]
    one = inside[[np.argmin(np.linalg.norm(inside.mean_m - (5, 0, 0), axis=1))]]

    def added(**changes):
        patch = dataclasses.replace(one, **changes)
        everything = type(static).concatenate([rest, patch])
        found = with_measured_ground(dataclasses.replace(scene, static=everything), street, set()).static
        return len(before_the_wall(found[len(everything) :]))

    wide = np.full((1, 3), 2.5, np.float32)
    assert added(scale_m=wide) == 0
    assert added(scale_m=wide, opacity=np.full(1, 0.05, np.float32)) > 1000
    assert added() > 1000


def test_without_sweeps_an_error_says_what_to_set(street, scene):
    with pytest.raises(ReconstructError, match="road_labels='network'"):
        with_measured_ground(scene, street, set(range(street.frames)))
