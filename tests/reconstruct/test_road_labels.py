"""Road labels by the LiDAR: what a kerb sets apart, whatever the images said."""

import dataclasses

import numpy as np
import pytest
from reconstruct_street import KERB_M, STEP_M, Street

from nurec_sim.errors import ReconstructError
from nurec_sim.reconstruct import LiftSettings, ViewSettings, reconstruct
from nurec_sim.reconstruct.road_labels import with_measured_road
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
    return with_measured_road(dataclasses.replace(scene, static=wrong), street, set()).static.label


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
    after = with_measured_road(scene, street, set())
    for name in (field.name for field in dataclasses.fields(scene) if field.name != "static"):
        assert getattr(after, name) is getattr(scene, name)
    for name in (field.name for field in dataclasses.fields(scene.static) if field.name != "label"):
        assert getattr(after.static, name) is getattr(scene.static, name)


def test_without_sweeps_an_error_says_what_to_set(street, scene):
    with pytest.raises(ReconstructError, match="road_labels='network'"):
        with_measured_road(scene, street, set(range(street.frames)))
